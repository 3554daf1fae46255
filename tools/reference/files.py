"""What files of the repository say: examples of formats, the schema of the report, the README."""

import functools
import importlib
import json
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from reference.markdown import block, code, codes, heading, table

ROOT = Path(__file__).parents[2]


def head(path: str, lines: str) -> str:
    """The first lines of a file of this repository."""
    with (ROOT / path).open(encoding="utf-8") as file:
        shown = "".join(islice(file, int(lines)))
    return block(shown + "...", path.rpartition(".")[2])


def readme(*title: str) -> str:
    """A section of the README, for a page in ``docs/``; ``KeyError`` if there is none."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^### (.+)\n((?:(?!^##).*\n)+)", text, re.MULTILINE))
    return sections[" ".join(title)].replace("](docs/", "](").strip()


def format_number(module: str) -> str:
    """The format that a module reads and writes."""
    return f"Format {importlib.import_module(module).FORMAT}."


def schema() -> str:
    """The fields of the report, object by object."""
    content = _schema()
    objects = {"report": content} | content["$defs"]
    parts = []
    for name, described in objects.items():
        rows = list(_nested(described, ""))
        if rows:
            parts.append(heading(3, code(name), f"schema-{name}"))
            parts.append(described.get("description", ""))
            parts.append(table(["field", "type", "required", "meaning"], rows))
    return "\n\n".join(parts)


@functools.cache
def _schema() -> dict[str, Any]:
    text = (ROOT / "pytest_cpas/report/schema.json").read_text(encoding="utf-8")
    content: dict[str, Any] = json.loads(text)
    return content


def _fields(described: dict[str, Any], prefix: str) -> Iterator[tuple[str, str, str, str]]:
    required = described.get("required", ())
    for name, field in described.get("properties", {}).items():
        path = f"{prefix}{name}"
        yield (
            code(path),
            _type(field),
            "yes" if name in required else "",
            field.get("description", ""),
        )
        yield from _nested(field, path)


def _nested(field: dict[str, Any], path: str) -> Iterator[tuple[str, str, str, str]]:
    """The fields of what a field holds."""
    if "properties" in field:
        yield from _fields(field, f"{path}." if path else "")
    if isinstance(field.get("items"), dict):
        yield from _nested(field["items"], f"{path}[]")
    if isinstance(field.get("additionalProperties"), dict):
        yield from _nested(field["additionalProperties"], f"{path}.*")


def _type(field: dict[str, Any]) -> str:
    if "$ref" in field:
        name = field["$ref"].rpartition("/")[2]
        named = _schema()["$defs"][name]
        return f"[`{name}`](#schema-{name})" if any(_nested(named, "")) else _type(named)
    if "const" in field:
        return code(field["const"])
    if "enum" in field:
        return codes(json.dumps(value) for value in field["enum"])
    if "anyOf" in field:
        return " or ".join(map(_type, field["anyOf"]))
    given = field.get("type", "any")
    kinds = given if isinstance(given, list) else [given]
    if isinstance(field.get("items"), dict):
        kinds = [f"array of {_type(field['items'])}" if k == "array" else k for k in kinds]
    if isinstance(field.get("additionalProperties"), dict):
        values = _type(field["additionalProperties"])
        kinds = [f"object of {values}" if k == "object" else k for k in kinds]
    return " or ".join(kinds)
