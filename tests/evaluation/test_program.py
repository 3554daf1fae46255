"""Which program answers: what changes an answer changes the digest, and nothing else does."""

import importlib
import os
import subprocess
import sys
import textwrap
import zipfile

import pytest

from pytest_cpas.evaluation.program import UNKNOWN, program_of

FILES = {
    "adapter.py": """
        import json
        import numpy
        import own_helpers
        from own_package import network
        from own_package.sub import layers as things
        try:
            import not_there
        except ImportError:
            pass

        PRIORS = "priors.npz"
        TABLE = "tables/of/shapes.npz"

        class Method:
            def load(self, assets, device):
                from own_late import late
                import importlib
                importlib.import_module("own_dynamic")
    """,
    "own_helpers.py": "from own_deep import deep\n",
    "own_deep.py": "deep = 1\n",
    "own_late.py": "late = 1\n",
    "own_dynamic.py": "x = 1\n",
    "own_package/__init__.py": "from .side import side\n",
    "own_package/network.py": "from . import relative\n",
    "own_package/relative.py": "from ..own_package import sub\n",
    "own_package/side.py": "side = 1\n",
    "own_package/sub/__init__.py": "",
    "own_package/sub/layers.py": "from ...own_package.sub.ops import op\n",
    "own_package/sub/ops.py": "op = 1\n",
    "priors.npz": "numbers",
    "tables/of/shapes.npz": "numbers",
    "tables/of/others.npz": "numbers",
    "unrelated.py": "y = 1\n",
    "own_package/unrelated.py": "z = 1\n",
    "results.csv": "1,2\n",
}

REACHED = [
    "adapter.py",
    "own_helpers.py",
    "own_deep.py",
    "own_late.py",
    "own_dynamic.py",
    "own_package/__init__.py",
    "own_package/network.py",
    "own_package/relative.py",
    "own_package/side.py",
    "own_package/sub/__init__.py",
    "own_package/sub/layers.py",
    "own_package/sub/ops.py",
    "priors.npz",
    "tables/of/shapes.npz",
]


@pytest.fixture
def project(tmp_path, monkeypatch):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(textwrap.dedent(text))
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("adapter", "own_helpers", "own_deep"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    (tmp_path / "own_helpers.py").write_text("def f():\n    from own_deep import deep\n")
    # the modules that are imported for real need nothing that is not there
    monkeypatch.setitem(sys.modules, "own_package", None)
    return tmp_path


def a_method(project):
    """The class, of a module that is not run: only its name and file count."""
    module = type(sys)("adapter")
    module.__file__ = str(project / "adapter.py")
    sys.modules["adapter"] = module
    method = type("Method", (), {"__module__": "adapter"})
    module.Method = method
    return method


def code(project):
    importlib.invalidate_caches()
    program_of.cache_clear()
    try:
        return program_of(a_method(project)).code
    finally:
        del sys.modules["adapter"]


@pytest.mark.parametrize("name", REACHED)
def test_every_file_that_is_reached_counts(project, name):
    before = code(project)
    assert before != UNKNOWN
    with (project / name).open("a") as file:
        file.write("\n# changed\n")
    assert code(project) != before


@pytest.mark.parametrize("name", sorted(FILES.keys() - set(REACHED)))
def test_what_is_not_reached_does_not_count(project, name):
    before = code(project)
    with (project / name).open("a") as file:
        file.write("# changed\n")
    (project / "new.py").write_text("")
    os.utime(project / "adapter.py")
    assert code(project) == before


@pytest.mark.parametrize(
    "name", ["own_a/b/deep.py", "own_a/b/c/d/deep.py", "own_i/__init__.py", "own_i/n/m/deep.py"]
)
def test_folders_without_init_are_followed_at_any_depth(project, name):
    files = ["own_a/b/deep.py", "own_a/b/c/d/deep.py", "own_i/__init__.py", "own_i/n/m/deep.py"]
    for file in files:
        (project / file).parent.mkdir(parents=True, exist_ok=True)
        (project / file).write_text("")
    with (project / "adapter.py").open("a") as adapter:
        adapter.write("from own_a.b.deep import x\nimport own_a.b.c.d.deep, own_i.n.m.deep\n")
    before = code(project)
    (project / name).write_text("x = 1\n")
    assert code(project) != before


def test_what_importlib_raises_is_no_end(project, monkeypatch):
    def raises(*_):
        raise KeyError("sub")

    monkeypatch.setattr(importlib.machinery.PathFinder, "find_spec", raises)
    assert code(project) == UNKNOWN


def test_place_does_not_count(project, tmp_path_factory, monkeypatch):
    before = code(project)
    other = tmp_path_factory.mktemp("other") / "place"
    project.rename(other)
    monkeypatch.syspath_prepend(other)
    assert code(other) == before


def test_extension_modules_count(project):
    suffix = importlib.machinery.EXTENSION_SUFFIXES[0]
    with (project / "own_helpers.py").open("a") as file:
        file.write("import own_ops\n")
    without = code(project)
    (project / f"own_ops{suffix}").write_bytes(b"\x7fELF one")
    one = code(project)
    (project / f"own_ops{suffix}").write_bytes(b"\x7fELF two")
    assert len({without, one, code(project)}) == 3


def test_modules_in_an_archive_count(project, monkeypatch):
    archive = project / "own_archive.zip"
    monkeypatch.syspath_prepend(archive)
    with (project / "own_helpers.py").open("a") as file:
        file.write("import own_zipped\n")

    def with_content(text):
        with zipfile.ZipFile(archive, "w") as file:
            file.writestr(zipfile.ZipInfo("own_zipped.py"), text)
        sys.path_importer_cache.pop(str(archive), None)
        return code(project)

    without = code(project)
    codes = [with_content(text) for text in ("answer = 1\n", "answer = 2\n", "answer = 1\n")]
    assert without not in codes
    assert codes[0] != codes[1]
    assert codes[0] == codes[2]


def test_bases_count(project):
    (project / "own_base.py").write_text("class Base: pass\n")
    method = a_method(project)
    base = type("Base", (), {"__module__": "own_base"})
    child = type("Child", (base,), {"__module__": "adapter"})
    importlib.invalidate_caches()
    program_of.cache_clear()
    before = program_of(child).code
    assert before != program_of(method).code
    (project / "own_base.py").write_text("class Base: answer = 2\n")
    program_of.cache_clear()
    assert program_of(child).code != before


def test_other_distributions_are_told_by_version(project):
    program_of.cache_clear()
    packages = program_of(a_method(project)).packages
    assert packages.startswith(f"python {sys.version_info.major}.")
    assert "numpy " in packages
    assert "json" not in packages


def test_revision_is_told_and_does_not_count(project):
    before = code(project)
    git = ["git", "-C", str(project), "-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "one"]):
        subprocess.run([*git, *command], check=True)
    assert code(project) == before
    program_of.cache_clear()
    clean = program_of(a_method(project)).revision
    assert clean
    assert not clean.endswith("+")
    (project / "unrelated.py").write_text("changed")
    program_of.cache_clear()
    assert program_of(a_method(project)).revision == f"{clean}+"


def test_looking_at_the_revision_writes_nothing(project):
    """A lock for the index would be in the way of whoever commits meanwhile, and stay if the run is
    killed."""
    git = ["git", "-C", str(project), "-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "one"]):
        subprocess.run([*git, *command], check=True)
    # what git would refresh in its index
    os.utime(project / "adapter.py", (1, 1))
    index = project / ".git" / "index"
    before = index.stat()
    program_of.cache_clear()
    assert program_of(a_method(project)).revision
    assert (index.stat().st_ino, index.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_class_without_a_file_is_unknown():
    program_of.cache_clear()
    assert program_of(type("Loose", (), {"__module__": "__main__"})).code == UNKNOWN


def test_own_methods_have_a_program():
    from method_adapters.icp import Icp

    program_of.cache_clear()
    program = program_of(Icp)
    assert program.code != UNKNOWN
    assert "numpy " in program.packages
    assert "pytest-cpas" not in program.packages
