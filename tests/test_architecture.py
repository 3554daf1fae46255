"""Which room imports which, as docs/architecture.md draws it; how large rooms and modules are."""

import ast
import functools
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

#: Small things in the package's root that stand below every room.
_BOTTOM = {"_deprecation", "_files", "_open3d", "similarity", "stages", "types"}

#: What each room may import. A room stands on those before it, never on one after it.
ARROWS: Mapping[str, set[str]] = {
    "_deprecation": set(),
    "_files": set(),
    "_open3d": set(),
    "stages": set(),
    "similarity": {"stages"},
    "types": {"_deprecation"},
    "documents": {"types"},
    "metrics": {"types"},
    "reading": {"types"},
    "adapting": {"_open3d", "metrics", "reading", "similarity", "stages", "types"},
    "registry": {"types"},
    "remote": {"reading", "stages", "types"},
    "datasets": {"reading", "similarity", "types", "_files", "_open3d"},
    "facts": {"metrics", "types"},
    "protocols": {"facts", "metrics", "reading", "types"},
    "submissions": {"datasets", "reading", "types", "_files"},
    "evaluation": {
        "remote",
        "submissions",
        "protocols",
        "facts",
        "datasets",
        "metrics",
        "reading",
        "types",
        "_files",
    },
    "traces": {"documents", "protocols", "evaluation", "reading", "stages", "types", "_files"},
    "golden": {"protocols", "facts", "evaluation", "metrics", "reading", "types", "_files"},
    "diagnosis": {"_deprecation", "facts", "golden", "evaluation", "metrics", "types"},
    "checks": {
        "golden",
        "evaluation",
        "datasets",
        "reading",
        "remote",
        "metrics",
        "registry",
        "types",
        "_deprecation",
        "_files",
    },
    "metric_subjects": {"checks", "metrics", "types", "_open3d"},
    "fetching": {"datasets", "reading", "registry", "types", "_files"},
    "timing": {
        "documents",
        "golden",
        "evaluation",
        "reading",
        "remote",
        "stages",
        "types",
        "_files",
    },
    "report": {
        "documents",
        "facts",
        "checks",
        "diagnosis",
        "golden",
        "protocols",
        "evaluation",
        "datasets",
        "metrics",
        "reading",
        "types",
        "_files",
    },
    "session": {
        "submissions",
        "report",
        "documents",
        "timing",
        "traces",
        "checks",
        "diagnosis",
        "golden",
        "protocols",
        "evaluation",
        "datasets",
        "reading",
        "registry",
        "remote",
        "types",
        "_files",
        "_open3d",
    },
    "suite": {"session", "timing", "traces", "checks", "evaluation", "types"},
    "listing": {"protocols", "registry", "remote", "types"},
    "new_adapter": {"registry", "types"},
    "plugin": {"session", "listing", "golden", "reading", "remote", "types"},
    "cli": {
        "golden",
        "session",
        "fetching",
        "report",
        "evaluation",
        "new_adapter",
        "reading",
        "registry",
        "remote",
        "submissions",
        "types",
    },
    # what it hands out is imported when it is asked for
    "__init__": {"types", "_deprecation"},
    # an adapter needs no more, whoever wrote it
    "method_adapters": {"adapting"},
}

#: Longest module, lines; of one that is sent elsewhere as a single file, more.
LONGEST, LONGEST_SENT = 420, 1300
SENT = Path("pytest_cpas/remote/worker.py")

#: Most modules in the package's root.
MOST_IN_ROOT = 12


#: Many copies of the package differ by a line.
parsed = functools.cache(ast.parse)


def sources(root: Path) -> dict[Path, ast.Module]:
    """Every module of the wheel, relative to ``root``."""
    return {
        path.relative_to(root): parsed(path.read_bytes())
        for package in ("pytest_cpas", "method_adapters")
        for path in sorted((root / package).rglob("*.py"))
    }


def room_of(module: str) -> str:
    """The room that a dotted name is in: the package's own name stands for its root."""
    first, *rest = module.split(".")
    return (rest[0] if rest else "__init__") if first == "pytest_cpas" else first


@functools.cache
def imports(tree: ast.Module, path: Path) -> frozenset[str]:
    """The dotted names of ours that a module imports, wherever in it and however."""
    return frozenset(_imports(tree, path))


def _imports(tree: ast.Module, path: Path) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = ".".join(
                    [*path.parent.parts[: len(path.parent.parts) + 1 - node.level], base]
                )
            names = [f"{base}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            names = [a.value for a in node.args if isinstance(a, ast.Constant)]
        else:
            continue
        yield from (n for n in names if n.split(".")[0] in ("pytest_cpas", "method_adapters"))


def arrows(root: Path) -> set[tuple[Path, str, str]]:
    """Every import from one room into another: file, room, room."""
    found = set()
    for path, tree in sources(root).items():
        room = room_of(".".join(path.with_suffix("").parts))
        found |= {(path, room, room_of(name)) for name in imports(tree, path)}
    return {(path, room, target) for path, room, target in found if room != target}


def forbidden(root: Path) -> list[str]:
    """Each import that the table does not allow, as file and arrow."""
    return [
        f"{path}: {room} -> {target}"
        for path, room, target in sorted(arrows(root))
        if target not in ARROWS[room]
    ]


def test_arrows_point_one_way():
    assert forbidden(ROOT) == []


def test_table_has_no_circle():
    known: set[str] = set()
    for room, targets in ARROWS.items():
        if room not in ("adapting", "__init__"):
            assert targets <= known | {"adapting"}, f"{room} stands on {targets - known}"
        known.add(room)


def test_table_names_what_is_there():
    rooms = {room_of(".".join(path.with_suffix("").parts)) for path in sources(ROOT)}
    assert rooms == set(ARROWS)
    used = {(room, target) for _, room, target in arrows(ROOT)}
    unused = {f"{room} -> {t}" for room, ts in ARROWS.items() for t in ts if (room, t) not in used}
    assert unused == set(), "the table allows what nobody needs"


@pytest.mark.parametrize(
    ("file", "line", "arrow"),
    [
        ("pytest_cpas/metrics/pose.py", "from pytest_cpas.evaluation import Row", "evaluation"),
        ("pytest_cpas/metrics/pose.py", "import pytest_cpas.evaluation.rows as r", "evaluation"),
        ("pytest_cpas/metrics/pose.py", "from pytest_cpas import evaluation", "evaluation"),
        ("pytest_cpas/metrics/pose.py", "from ..evaluation import Row", "evaluation"),
        (
            "pytest_cpas/metrics/pose.py",
            "def late():\n    from pytest_cpas.evaluation import Row",
            "evaluation",
        ),
        ("pytest_cpas/facts/answers.py", "from pytest_cpas.protocols import Column", "protocols"),
        (
            "pytest_cpas/protocols/judging.py",
            "from pytest_cpas.evaluation import Row",
            "evaluation",
        ),
        (
            "pytest_cpas/checks/dataset/sanity.py",
            "from pytest_cpas.report.terminal import print_table",
            "report",
        ),
        (
            "pytest_cpas/golden/tables.py",
            "import importlib\nimportlib.import_module('pytest_cpas.session')",
            "session",
        ),
        ("method_adapters/icp.py", "from pytest_cpas.session import suite_session", "session"),
        ("method_adapters/icp.py", "from pytest_cpas.types import Mesh", "types"),
        ("method_adapters/_networks/spd.py", "import pytest_cpas", "__init__"),
    ],
)
def test_planted_arrow_is_named(tmp_path, file, line, arrow):
    for path in sources(ROOT):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes((ROOT / path).read_bytes())
    with (tmp_path / file).open("a") as module:
        module.write(f"\n{line}\n")
    room = room_of(".".join(Path(file).with_suffix("").parts))
    assert forbidden(tmp_path) == [f"{file}: {room} -> {arrow}"]


def test_rooms_and_modules_are_small():
    assert len(list((ROOT / "pytest_cpas").glob("*.py"))) <= MOST_IN_ROOT
    long = {
        f"{path}: {length} lines"
        for path in sources(ROOT)
        if (length := len((ROOT / path).read_text(encoding="utf-8").splitlines()))
        > (LONGEST_SENT if path == SENT else LONGEST)
    }
    assert long == set()


def test_every_room_can_be_imported_first():
    """In an order that no other import has prepared: a circle shows where it is entered."""
    for path in sorted((ROOT / "pytest_cpas").glob("*/__init__.py")):
        room = f"pytest_cpas.{path.parent.name}"
        done = subprocess.run(
            [sys.executable, "-c", f"import {room}"], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{room}: {done.stderr}"


def test_files_of_tests_have_names_of_their_own():
    """Of two with the same name pytest can import one alone."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("*.py"))
    assert {name for name, count in names.items() if count > 1} == {"conftest.py"}


def test_tests_mirror_the_package():
    """Each room has a folder of tests; the others are named for what they are about."""
    rooms = {
        path.name
        for path in (ROOT / "pytest_cpas").iterdir()
        if path.is_dir() and any(path.glob("*.py"))
    }
    folders = {path.name for path in (ROOT / "tests").iterdir() if any(path.glob("test_*.py"))}
    # the suite is run by the tests of sessions, the subjects by those of the checks
    assert rooms - folders <= {"adapter_template", "suite", "metric_subjects"}
    assert folders - rooms <= {"documentation", "methods", "ports"}
