"""Modules, classes and functions as Markdown, from their signatures and docstrings."""

import enum
import functools
import importlib
import inspect
import re
import textwrap
from collections import Counter
from types import ModuleType
from typing import Any

from pytest_cpas import metrics
from reference.markdown import block, heading

#: What users import, beside the metrics, which have a page of their own.
API: dict[str, tuple[str, ...]] = {
    "pytest_cpas.types": (),
    "pytest_cpas.evaluation": (
        "MethodRun",
        "Run",
        "Row",
        "Selection",
        "SampleError",
        "MethodError",
        "Answer",
    ),
    "pytest_cpas.facts": (),
    "pytest_cpas.protocols": (),
    "pytest_cpas.golden": ("RunTable", "TableSample", "GoldenError", "find_golden", "record"),
    "pytest_cpas.golden.comparison": ("compare", "Word"),
    "pytest_cpas.golden.published": ("published_cells", "published_curves", "compare_published"),
    "pytest_cpas.evaluation.predictions": ("StoredRun",),
    "pytest_cpas.evaluation.results": (
        "read_results",
        "Results",
        "Header",
        "Shard",
        "ResultsError",
    ),
    "pytest_cpas.evaluation.merging": ("merge",),
    "pytest_cpas.datasets.perturbed": ("perturbed",),
    "pytest_cpas.checks.outcome": ("Outcome", "Finding"),
    "pytest_cpas.checks.contract": (),
    "pytest_cpas.checks.dataset": (),
    "pytest_cpas.checks.dataset.verdicts": ("judge", "DatasetWord"),
    "pytest_cpas.checks.known": ("KnownFailure", "known_failures", "read_known"),
    "pytest_cpas.checks.metrics": (),
    "pytest_cpas.diagnosis": (),
    "pytest_cpas.stages": ("stage",),
    "pytest_cpas.fetching.command": (),
}

_METRICS = metrics.__name__

_ROLE = re.compile(r":(?:class|func|meth|data|mod|attr):`~?([^`]+)`")


def members(module: ModuleType, names: tuple[str, ...] = ()) -> dict[str, Any]:
    """What is documented of a module: ``names``, else all that it exports."""
    return {name: getattr(module, name) for name in names or module.__all__}


def prose(docstring: str) -> str:
    """A docstring as Markdown."""
    text = inspect.cleandoc(docstring)
    text = re.sub(r"``([^`]+)``", r"`\1`", text)
    text = _ROLE.sub(_linked, text)
    text = re.sub(r"^::$\n?", "", text, flags=re.MULTILINE)
    text = re.sub(r"::$", ":", text, flags=re.MULTILINE)
    # Python-Markdown wants an empty line before a list
    return re.sub(r"(^[^*\n -][^\n]*\n)(?=[*-] )", r"\1\n", text, flags=re.MULTILINE)


def _linked(role: re.Match[str]) -> str:
    """What a role names, and where that is."""
    name = role[1]
    address = _addresses().get(name)
    return f"[`{name.rpartition('.')[2]}`]({address})" if address else f"`{name}`"


@functools.cache
def _addresses() -> dict[str, str]:
    """Where names have their section: full names, and short ones that only one thing has."""
    full = {
        f"{module}.{name}": f"api.md#{module}.{name}"
        for module, names in API.items()
        for name in names or importlib.import_module(module).__all__
    }
    full |= {f"{_METRICS}.{name}": f"metrics.md#{_METRICS}.{name}" for name in metrics.__all__}
    counts = Counter(name.rpartition(".")[2] for name in full)
    short = {k.rpartition(".")[2]: v for k, v in full.items() if counts[k.rpartition(".")[2]] == 1}
    return full | short


def first_line(docstring: str | None) -> str:
    """The summary of a docstring as Markdown."""
    return " ".join(prose(docstring or "").split("\n\n")[0].split()).rstrip(".")


def doc_comments(owner: ModuleType | type) -> dict[str, str]:
    """What the ``#:`` comments above the names of a module or class say."""
    found, comment = {}, []
    for line in inspect.getsource(owner).splitlines():
        text = line.strip()
        if text.startswith("#:"):
            comment.append(text.removeprefix("#:").strip())
        else:
            name = re.match(r"(\w+(?:, \w+)*)(?:: [^=]+)? = ", text)
            if comment and name:
                found |= dict.fromkeys(name[1].split(", "), prose(" ".join(comment)))
            comment = []
    return found


def module_docstring(name: str) -> str:
    """A module's docstring."""
    return prose(importlib.import_module(name).__doc__ or "")


def api() -> str:
    """Everything in :data:`API`."""
    parts = []
    for name, names in API.items():
        module = importlib.import_module(name)
        parts += [heading(2, f"`{name}`", name), prose(module.__doc__ or "")]
        parts += [documented(f"{name}.{key}", it) for key, it in members(module, names).items()]
    return "\n\n".join(parts)


def documented(full_name: str, thing: Any) -> str:
    """A class, function or constant under a heading whose anchor is its full name."""
    module, _, name = full_name.rpartition(".")
    title = heading(3, f"`{name}`", full_name)
    if not (inspect.isclass(thing) or inspect.isroutine(thing)):
        told = doc_comments(importlib.import_module(_home(module, name))).get(name, "")
        return "\n\n".join(filter(None, [title, told, _value(name, thing)]))
    parts = [title]
    if not inspect.isclass(thing) or _is_made_by_users(thing):
        parts.append(block(_signature(name, thing), "python"))
    parts.append(prose(thing.__doc__ or ""))
    if inspect.isclass(thing):
        parts.append(prose(getattr(vars(thing).get("__init__"), "__doc__", None) or ""))
        parts += _members(thing)
    return "\n\n".join(filter(None, parts))


def _home(module: str, name: str) -> str:
    """The module that a package's constant comes from."""
    text = inspect.getsource(importlib.import_module(module))
    found = re.search(rf"^from (\S+) import (?:\([^)]*\b{name}\b|.*\b{name}\b)", text, re.MULTILINE)
    return found[1] if found else module


def _value(name: str, value: Any) -> str:
    shown = repr(value)
    return block(f"{name} = {shown}", "python") if len(shown) < 200 else ""


def _is_made_by_users(cls: type) -> bool:
    kinds = (enum.Enum, BaseException)
    return not issubclass(cls, kinds) and not getattr(cls, "_is_protocol", False)


class _Annotation(str):
    """An annotation, which is text already: all modules import them from __future__."""

    __repr__ = str.__str__


def _signature(name: str, thing: Any, skipped: int = 0) -> str:
    """The call, without the first ``skipped`` parameters; over several lines if it is long."""
    signature = inspect.signature(thing)
    parameters = list(signature.parameters.values())[skipped:]
    returned = inspect.Signature.empty if inspect.isclass(thing) else signature.return_annotation
    signature = signature.replace(
        parameters=[p.replace(annotation=_text(p.annotation)) for p in map(_shown, parameters)],
        return_annotation=_text(returned),
    )
    text = f"{name}{signature}"
    if len(text) <= 88 or not parameters:
        return text
    start, end = text.index("("), text.rindex(")")
    inner = _split(text[start + 1 : end])
    return "\n".join([text[: start + 1], *(f"    {each}," for each in inner), text[end:]])


def _shown(parameter: inspect.Parameter) -> inspect.Parameter:
    """With a default that can be read: functions and factories have an address, or no name."""
    nameless = parameter.default is not parameter.empty and "<" in repr(parameter.default)
    return parameter.replace(default=...) if nameless else parameter


def _text(annotation: Any) -> Any:
    return _Annotation(annotation) if isinstance(annotation, str) else annotation


def _split(text: str) -> list[str]:
    """Split at commas outside of brackets."""
    parts, depth = [""], 0
    for char in text:
        depth += (char in "([{") - (char in ")]}")
        if char == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += char
    return [part.strip() for part in parts]


def _members(cls: type) -> list[str]:
    comments = doc_comments(cls)
    if issubclass(cls, enum.Enum):
        return [f"* `{m.name}` (`{m.value}`): {comments.get(m.name, '')}" for m in cls]
    parts = []
    for name, member in vars(cls).items():
        function = inspect.unwrap(getattr(member, "__func__", getattr(member, "fget", member)))
        function = getattr(function, "func", function)  # a cached_property
        if name.startswith("_") or not inspect.isroutine(function) or not function.__doc__:
            continue
        bound = not isinstance(member, staticmethod)
        call = _signature(name, function, skipped=bound) if inspect.isroutine(member) else name
        told = textwrap.indent(prose(function.__doc__), "    ")
        parts.append(f"*   `{' '.join(call.split())}`\n\n{told}")
    return parts
