"""Make ``pytest_cpas/report/schema.json`` from the types of ``pytest_cpas.documents``."""

import inspect
import json
import re
import types
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, Union, get_args, get_origin, get_type_hints
from typing import is_typeddict as is_object

from pytest_cpas.documents import Allowed, Document

PATH = Path(__file__).parents[1] / "pytest_cpas" / "report" / "schema.json"

PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean"}

Schema = dict[str, Any]


def schema_text() -> str:
    """The text of the file."""
    definitions: Schema = {}
    content = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Report of pytest-cpas",
        **object_schema(Document, definitions),
        "$defs": definitions,
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def object_schema(kind: type, definitions: Schema) -> Schema:
    """The schema of a class; those of the classes that it needs go into ``definitions``."""
    fields = get_type_hints(kind, include_extras=True)
    description = inspect.cleandoc(kind.__doc__).partition("\n\n")[0]
    properties, required = {}, []
    for name, hint in fields.items():
        needed, described = field_schema(hint, definitions)
        properties[name] = described
        if needed and kind.__total__:
            required.append(name)
    return {
        "description": " ".join(description.replace("``", "").split()),
        "type": "object",
        "properties": properties,
        **({"required": required} if required else {}),
        "additionalProperties": False,
    }


def field_schema(hint: Any, definitions: Schema) -> tuple[bool, Schema]:
    """Whether a field is required, and the schema of its value."""
    if get_origin(hint) is Annotated:
        inner, *metadata = get_args(hint)
        required, content = field_schema(inner, definitions)
        for entry in metadata:
            if isinstance(entry, Allowed):
                content |= entry.keywords()
            else:
                content = {"description": entry} | content
        return required, content
    if get_origin(hint) is NotRequired:
        return False, field_schema(*get_args(hint), definitions)[1]
    return True, value_schema(hint, definitions)


def value_schema(hint: Any, definitions: Schema) -> Schema:
    """The schema of a type; ``TypeError`` for one that no document may have."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return field_schema(hint, definitions)[1]
    if hint in PLAIN:
        return {"type": PLAIN[hint]}
    if origin is Literal:
        return {"enum": list(arguments)} if len(arguments) > 1 else {"const": arguments[0]}
    if origin is list:
        return {"type": "array", "items": value_schema(*arguments, definitions)}
    if origin is dict and arguments[0] is str:
        return {"type": "object", "additionalProperties": value_schema(arguments[1], definitions)}
    if origin in (Union, types.UnionType) and arguments[1:] == (types.NoneType,):
        return or_null(value_schema(arguments[0], definitions))
    if is_object(hint):
        name = re.sub("(?<=.)(?=[A-Z])", "_", hint.__name__.removesuffix("Document")).lower()
        if name not in definitions:
            definitions[name] = {}  # its place, before those that it needs
            definitions[name] |= object_schema(hint, definitions)
        return {"$ref": f"#/$defs/{name}"}
    raise TypeError(f"{hint}: expected a TypedDict, a list, a dict by str, a Literal or a scalar")


def or_null(content: Schema) -> Schema:
    """The schema of a value that may be null as well."""
    if "enum" in content:
        return content | {"enum": [*content["enum"], None]}
    if "type" in content:
        return content | {"type": [content["type"], "null"]}
    return {"anyOf": [content, {"type": "null"}]}


if __name__ == "__main__":
    PATH.write_text(schema_text(), encoding="utf-8")
    print(f"wrote {PATH}")
