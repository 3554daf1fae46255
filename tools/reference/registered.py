"""What is registered: data sets, methods, implementations of metrics."""

import ast
import importlib.util
import sys
from pathlib import Path

from pytest_cpas.registry import registered, resolve
from reference.code import first_line, prose
from reference.markdown import code, codes, heading, table


def datasets() -> str:
    """Every data set: its class's summary, and the layout that its module reads."""
    parts = []
    for entry in registered("dataset"):
        cls = resolve("dataset", entry.name)
        module = sys.modules[cls.__module__]
        parts += [
            heading(3, code(entry.name), f"dataset-{entry.name}"),
            f"{first_line(cls.__doc__)}. (`{entry.value}`)",
            prose(module.__doc__ or ""),
        ]
    return "\n\n".join(parts)


def methods() -> str:
    """Every method, with what it declares."""
    parts = []
    for entry in registered("method"):
        cls = resolve("method", entry.name)
        info = cls.info
        facts = {
            "class": code(entry.value),
            "name of its golden tables": code(info.name),
            "licence": info.licence,
            "categories": ", ".join(info.categories),
            "needs": codes(sorted(info.needs)),
            "gives": codes(["pose", *sorted(info.gives)]),
            "object frame, camera frame": f"{info.object_frame}, {info.camera_frame}",
            "deterministic": "yes" if info.deterministic else "no",
            "tolerance": f"{info.tolerance:g}",
            "follows": codes(sorted(info.equivariances)) or "-",
            "files of weights": codes(asset.path for asset in info.assets) or "none needed",
        }
        parts += [
            heading(3, code(entry.name), f"method-{entry.name}"),
            f"{first_line(sys.modules[cls.__module__].__doc__)}.",
            table(["declared", ""], facts.items()),
        ]
    return "\n\n".join(parts)


def metric_implementations() -> str:
    """Every implementation of metrics; what it needs is not installed everywhere, so that its
    module is read and not imported."""
    rows = []
    for entry in registered("metric"):
        package, _, _ = entry.module.rpartition(".")
        folder = Path(importlib.util.find_spec(package).origin).parent
        source = (folder / f"{entry.module.rpartition('.')[2]}.py").read_text(encoding="utf-8")
        rows.append((code(entry.name), first_line(ast.get_docstring(ast.parse(source)))))
    return table(["name", "what it is"], rows)
