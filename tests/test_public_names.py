"""What outsiders import: the short names, what adapters may use, and old paths."""

import ast
import importlib
import re
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import pytest_cpas
from pytest_cpas import adapting, metrics, reading, similarity, stages, types
from pytest_cpas._deprecation import MOVED, deprecated

ROOT = Path(__file__).parents[1]

#: What was documented at paths that there are no more, when they were the only ones.
DOCUMENTED = {
    "pytest_cpas.comparison": ("compare", "Verdict", "Word"),
    "pytest_cpas.published": ("published_cells", "published_curves", "compare_published"),
    "pytest_cpas.predictions": ("StoredRun",),
    "pytest_cpas.results": ("read_results", "Results", "Header", "Shard", "merge", "ResultsError"),
    "pytest_cpas.robustness": ("perturbed",),
    "pytest_cpas.checks.dataset.report": ("draw_up_axes",),
    "pytest_cpas.fetch": ("FetchError", "fetch", "find_source"),
}


def outcome(code: str) -> str:
    run = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(run, check=True, capture_output=True, text=True, cwd=ROOT).stdout.strip()


def test_short_names_are_those_of_the_types():
    for name in pytest_cpas.__all__:
        assert getattr(pytest_cpas, name) is getattr(types, name)
    assert set(pytest_cpas.__all__) <= set(dir(pytest_cpas))
    with pytest.raises(AttributeError, match=r"'pytest_cpas' has no attribute 'Possum'"):
        _ = pytest_cpas.Possum
    with pytest.raises(ImportError, match="Possum"):
        exec("from pytest_cpas import Possum")


def test_short_names_cost_nothing_until_they_are_asked_for():
    code = "import sys, pytest_cpas; print('numpy' in sys.modules, end=' '); pytest_cpas.Pose; "
    assert outcome(code + "print('numpy' in sys.modules)") == "False True"


def test_type_checkers_see_the_short_names():
    """Those imported for them are those handed out."""
    tree = ast.parse((ROOT / "pytest_cpas" / "__init__.py").read_text())
    imported = [
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "pytest_cpas.types"
        for alias in node.names
    ]
    assert imported == pytest_cpas.__all__


def test_adapting_hands_out_the_same_objects():
    homes = (
        types,
        types.frames,
        stages,
        similarity,
        metrics,
        reading.arrays,
        reading.checkpoints,
        reading.structured,
        importlib.import_module("pytest_cpas._open3d"),
    )
    for name in adapting.__all__:
        (home, *_) = [home for home in homes if hasattr(home, name)]
        assert getattr(adapting, name) is getattr(home, name)
    assert set(adapting.__all__) <= set(dir(adapting))
    with pytest.raises(AttributeError, match="Possum"):
        _ = adapting.Possum


def test_adapting_is_light():
    heavy = ("scipy", "torch", "open3d", "trimesh", "PIL", "pytest")
    code = f"import sys, pytest_cpas.adapting; print(sorted(set({heavy}) & set(sys.modules)))"
    assert outcome(code) == "[]"


@pytest.mark.parametrize("old", MOVED)
def test_old_paths_are_the_modules_that_were_moved(old, monkeypatch):
    where, public = MOVED[old]
    monkeypatch.delitem(sys.modules, old, raising=False)
    with pytest.warns(DeprecationWarning, match="is deprecated") as told:
        module = importlib.import_module(old)
    assert module is importlib.import_module(where)
    assert module.__name__ == module.__spec__.name == where
    (warning,) = told
    assert str(warning.message) == (
        f"{old} is deprecated, and goes in pytest-cpas 0.3: write {public}"
    )
    for name in DOCUMENTED.get(old, ()):
        assert getattr(importlib.import_module(public), name) is getattr(module, name)


@pytest.mark.parametrize("old", MOVED)
def test_every_public_name_is_where_the_warning_says(old):
    """Whoever writes what it says finds each class and function that was at the old path."""
    where, public = map(importlib.import_module, MOVED[old])
    names = [
        name
        for name, value in vars(where).items()
        if getattr(value, "__module__", None) == where.__name__ and not name.startswith("_")
    ]
    offered = getattr(where, "__all__", names)
    assert not [name for name in {*names, *offered} if not hasattr(public, name)]


def test_all_paths_that_were_documented_are_found():
    assert set(DOCUMENTED) <= set(MOVED)
    assert not [old for old in MOVED if (ROOT / f"{old.replace('.', '/')}.py").exists()]


def test_warning_is_at_the_line_that_imports(tmp_path):
    """For each way to write it."""
    for line in (
        "from pytest_cpas.comparison import Verdict, Word",
        "import pytest_cpas.comparison",
        "from pytest_cpas import comparison",
    ):
        script = tmp_path / "lab.py"
        script.write_text(f"# ours\n\n{line}\n")
        run = [sys.executable, "-W", "always", str(script)]
        result = subprocess.run(run, check=True, capture_output=True, text=True)
        assert f"{script}:3: DeprecationWarning: pytest_cpas.comparison is deprec" in result.stderr
        assert result.stderr.count("DeprecationWarning") == 1


def test_modules_that_never_were_are_not_found():
    with pytest.raises(ModuleNotFoundError, match=r"pytest_cpas\.possum"):
        importlib.import_module("pytest_cpas.possum")


def test_deprecated_functions_tell_their_callers():
    def old_name():
        deprecated("old_name()", "new_name()", "7.0")

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        old_name()
    (warning,) = told
    assert warning.filename == __file__
    assert (
        str(warning.message)
        == "old_name() is deprecated, and goes in pytest-cpas 7.0: write new_name()"
    )
    assert "old_name()" in Path(__file__).read_text().splitlines()[warning.lineno - 1]


def test_page_lists_the_old_paths():
    page = (ROOT / "docs" / "stability.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| `(pytest_cpas\.[\w.]+)` \| `(pytest_cpas\.[\w.]+)` \|$", page, re.MULTILINE
    )
    assert rows == [(old, public) for old, (_, public) in MOVED.items()]
