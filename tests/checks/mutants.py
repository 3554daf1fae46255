"""Mutants of our own metrics as implementations under test: which of them does no property catch?

A mutant is a module of ``pytest_cpas.metrics`` in which one operator, number or name is another
one. Of all that are possible a seeded sample is checked; survivors are to be explained, each by a
line in ``survivors.toml``, or caught by a new property::

    python tests/checks/mutants.py --count 320 --processes 2

What only refuses bad arguments is not mutated: ``tests/metrics/test_ranges.py`` is about that.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib.abc
import importlib.util
import multiprocessing
import os
import signal
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import pytest_cpas
from pytest_cpas.checks.metrics import PROPERTIES, Subject, check
from pytest_cpas.checks.outcome import Outcome

ROOT = Path(__file__).parents[2] / "pytest_cpas" / "metrics"
EXPLAINED = Path(__file__).with_name("survivors.toml")

_BOXES = ("box_iou", "symmetric_box_iou")
#: The modules, and what is computed with each.
MODULES = {
    "pose": ("rotation_error", "symmetric_rotation_error", "translation_error"),
    "precision": (
        "precision", "mean_precision", "best_precision", "worst_precision", "precision_curve",
        "count_interval", "iou_auc", "pose_vus",
    ),
    "average_precision": (
        "average_precision", "detection_ap", "mean_detection_ap", "pose_ap", "matched_pose_ap",
    ),
    "surfaces": (
        "average_distance", "chamfer", "surface_precision", "surface_recall", "fscore", "nad",
        "diameter", "sample_surface",
    ),
    "model_points": ("add", "add_s", "mssd", "mspd"),
    "boxes": (
        "iou_plus", "axis_aligned_iou", "legacy_iou", "relative_translation_error",
        "equal_diagonals_iou", *_BOXES,
    ),
    "_box_clipping": _BOXES,
    "_box_spin": ("symmetric_box_iou",),
    "_box_ball": ("symmetric_box_iou",),
}  # fmt: skip

#: Those whose survivors are explained so far; those of boxes take an hour.
POINTS_AND_COUNTS = [name for name in MODULES if "box" not in name]

_COMPARED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt,
             ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
             ast.In: ast.NotIn, ast.NotIn: ast.In}  # fmt: skip
_COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
             ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
             ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd}  # fmt: skip
_NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "any": "all",
          "all": "any", "argmin": "argmax", "argmax": "argmin", "sum": "max", "mean": "max",
          "sin": "cos", "cos": "sin", "logical_and": "logical_or", "logical_or": "logical_and",
          "sqrt": "abs", "cumsum": "array"}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """What is changed, as a line of the module, and the mutated module's source."""

    module: str
    change: str
    source: str


def _refuses(node: ast.AST) -> bool:
    """Whether a statement is there to refuse bad arguments."""
    if isinstance(node, (ast.Raise, ast.Assert)):
        return True
    if isinstance(node, ast.If):
        return all(isinstance(inner, ast.Raise) for inner in node.body) and not node.orelse
    call = getattr(node, "value", None)
    return isinstance(call, ast.Call) and ast.unparse(call.func).startswith(
        ("checked_", "finite_array", "_checked", "check_sides", "_points")
    )


def _places(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes that compute something."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or _refuses(child):
                continue
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                continue  # a docstring
            yield child
            yield from _places(child)


def _mutations(node: ast.AST) -> Iterator[ast.AST]:
    """What a node may become."""
    made = copy.deepcopy(node)
    if isinstance(made, ast.Compare) and type(made.ops[0]) in _COMPARED:
        made.ops[0] = _COMPARED[type(made.ops[0])]()
        yield made
    elif isinstance(made, ast.BinOp) and type(made.op) in _COMPUTED:
        made.op = _COMPUTED[type(made.op)]()
        yield made
    elif isinstance(made, ast.BoolOp):
        made.op = ast.Or() if isinstance(made.op, ast.And) else ast.And()
        yield made
    elif isinstance(made, ast.UnaryOp) and isinstance(made.op, (ast.USub, ast.Not, ast.Invert)):
        yield made.operand
    elif isinstance(made, ast.Constant) and isinstance(made.value, (bool, int, float)):
        if isinstance(made.value, bool):
            yield ast.Constant(not made.value)
        else:
            yield ast.Constant(made.value + 1 if made.value < 100 else made.value // 10)
    elif isinstance(made, ast.Attribute) and made.attr in _NAMES:
        made.attr = _NAMES[made.attr]
        yield made
    elif isinstance(made, ast.Name) and made.id in _NAMES:
        made.id = _NAMES[made.id]
        yield made
    elif isinstance(made, ast.IfExp):
        made.body, made.orelse = made.orelse, made.body
        yield made
    elif isinstance(made, ast.If):
        made.test = ast.UnaryOp(ast.Not(), made.test)
        yield made


def mutants(module: str) -> list[Mutant]:
    """All mutants of a module, in the order of its lines."""
    text = (ROOT / f"{module}.py").read_text(encoding="utf-8")
    tree, lines, found = ast.parse(text), text.splitlines(), []
    for node in list(_places(tree)):
        for made in _mutations(node):
            before = {name: getattr(node, name, None) for name in node._fields}
            kind = node.__class__
            node.__class__, node.__dict__ = made.__class__, {**node.__dict__, **made.__dict__}
            source = ast.unparse(ast.fix_missing_locations(tree))
            became = ast.unparse(node).splitlines()[0]
            node.__class__ = kind
            for name, value in before.items():
                setattr(node, name, value)
            was = ast.unparse(node).splitlines()[0]
            if was.startswith("__all__") or "TYPE_CHECKING" in was:
                continue
            line = lines[getattr(node, "lineno", 1) - 1].strip()
            found.append(Mutant(module, f"{line} | {was} -> {became}", source))
    return found


def sample(count: int, seed: int) -> list[Mutant]:
    """So many of all mutants."""
    everything = [mutant for module in MODULES for mutant in mutants(module)]
    chosen = np.random.default_rng(seed).permutation(len(everything))[:count]
    return [everything[i] for i in sorted(chosen)]


class _Instead(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports a mutated module in the place of ours."""

    def __init__(self, mutant: Mutant) -> None:
        self.name, self.source = f"pytest_cpas.metrics.{mutant.module}", mutant.source

    def find_spec(self, name, path, target=None):
        return importlib.util.spec_from_loader(name, self) if name == self.name else None

    def exec_module(self, module):
        exec(compile(self.source, "mutant", "exec"), module.__dict__)


def caught_by(mutant: Mutant, examples: int, seconds: int) -> str:
    """The first property that is violated; how it ended otherwise; "" for a survivor."""
    for name in [name for name in sys.modules if name.startswith("pytest_cpas.metric")]:
        del sys.modules[name]  # they are imported anew, with the mutant among them
    vars(pytest_cpas).pop("metrics", None)
    sys.meta_path.insert(0, _Instead(mutant))
    signal.alarm(seconds)  # ends this process: a mutant may never return
    try:
        from pytest_cpas.metric_subjects.cpas import METRICS

        subject = Subject("mutant", METRICS)
    except Exception as error:
        return f"import: {type(error).__name__}"
    wanted = MODULES[mutant.module]
    for name, prop in PROPERTIES.items():
        if name.split(".")[0] in wanted:
            result = check(subject, prop, examples=examples, shrink=False)
            if result.outcome not in (Outcome.PASSED, Outcome.NOT_OFFERED):
                return name
    return ""


def _in_a_process(args: tuple[Mutant, int, int]) -> str:
    """In a process of its own, which has not imported the metrics."""
    mine, its = os.pipe()
    if (child := os.fork()) == 0:
        os.close(mine)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        os.write(its, caught_by(*args).encode())
        os._exit(0)
    os.close(its)
    with os.fdopen(mine) as pipe:
        text = pipe.read()
    _, status = os.waitpid(child, 0)
    return text if os.waitstatus_to_exitcode(status) == 0 else "hung or crashed"


def explained() -> dict[str, str]:
    """Why a mutant survives, by module and change."""
    text = EXPLAINED.read_text(encoding="utf-8")
    return {
        f"{entry['module']}: {change}": entry["reason"]
        for entry in tomllib.loads(text)["survivor"]
        for change in entry["changes"]
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=320, help="of all modules together")
    parser.add_argument("--modules", nargs="*", default=POINTS_AND_COUNTS, choices=MODULES)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--examples", type=int, default=40)
    parser.add_argument("--seconds", type=int, default=300, help="that one mutant may take")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    chosen = [m for m in sample(options.count, options.seed) if m.module in options.modules]
    reasons, survivors = explained(), []
    with multiprocessing.get_context("fork").Pool(options.processes, maxtasksperchild=20) as pool:
        tasks = [(mutant, options.examples, options.seconds) for mutant in chosen]
        for mutant, by in zip(chosen, pool.imap(_in_a_process, tasks), strict=True):
            name = f"{mutant.module}: {mutant.change}"
            if not by:
                survivors.append(name)
            print(f"{by or 'SURVIVES'}\t{name}", flush=True)
    unexplained = [name for name in survivors if name not in reasons]
    gaps = [name for name in survivors if reasons.get(name, "").startswith("not caught")]
    print(
        f"\n{len(chosen)} mutants, {len(survivors)} survive: {len(gaps)} should be caught and are"
        f" not, {len(unexplained)} are unexplained"
    )
    for name in survivors:
        print(f"  {name}\n      {reasons.get(name, 'UNEXPLAINED')}")
    return bool(unexplained)


if __name__ == "__main__":
    sys.exit(main())
