"""Text leaves the package by few doors, at which it is escaped: a new one is noticed here."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2] / "pytest_cpas"

#: Calls that write where people or services read, and in which modules they may stand.
DOORS = {
    "print": {"reading/text.py", "session/guard.py", "session/holding.py"},
    "pytest.exit": {"session/suite_session.py"},
    "os.write": {
        *("session/holding.py", "evaluation/watching.py", "evaluation/watchdog.py"),
        "remote/worker.py",  # to the process that has started it
    },
    "sys.stdout.write": set(),
    "sys.stderr.write": {"remote/process.py"},
    "terminalreporter.write_line": set(),
    "terminalreporter.section": set(),
    "terminalreporter.write": set(),
    "self._reporter.write_line": {"report/terminal/_table.py"},
    "self._reporter.section": {"report/terminal/_table.py"},
    "pytest.TestReport": {"session/suite_session.py"},
    # what they show is escaped by the hooks of suite_session
    "pytest.fail": {f"suite/test_{name}.py" for name in ("samples", "metrics", "speed", "parity")},
    "pytest.skip": set(),
    # where it is not in usage_errors(): nothing in it but names of our options
    "pytest.UsageError": {
        "plugin.py",
        "golden/snapshot.py",
        *(f"session/{name}.py" for name in ("guard", "rootdir", "suite_session")),
        *(f"session/{name}.py" for name in ("method_session", "speed_session", "parity_session")),
    },
    "csv.writer": {"report/export.py", "golden/texts.py"},
    "tostring": {"report/_html.py"},
    "Element": {"report/_html.py"},
}


def found(tree: ast.Module) -> Iterator[str]:
    """The doors that a module uses."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in DOORS:
            yield ast.unparse(node.func)


@pytest.mark.parametrize("door", DOORS)
def test_doors(door):
    used = {
        path.relative_to(ROOT).as_posix()
        for path in ROOT.rglob("*.py")
        if door in found(ast.parse(path.read_bytes()))
    }
    assert used == DOORS[door]


def test_a_new_door_is_noticed():
    code = "def f(terminalreporter):\n    print(1)\n    terminalreporter.write_line('x')"
    assert list(found(ast.parse(code))) == ["print", "terminalreporter.write_line"]
