"""What a method reaches by the words of its text alone, or by how it was installed, counts."""

import base64
import hashlib
import importlib
import importlib.util
import json
import os
import sys
from pathlib import Path

import pytest
import tiny

from pytest_cpas.evaluation import MethodRun, program, surroundings
from pytest_cpas.evaluation.program import program_of
from pytest_cpas.evaluation.surroundings import changes

OWN = ("adapters", "apart", "edited", "installed", "maker", "optional", "ours")


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project, and a folder beside it that is on the path; the home is another one."""
    for folder in ("project", "beside", "home"):
        (tmp_path / folder).mkdir()
    for folder in ("project", "beside"):
        monkeypatch.syspath_prepend(tmp_path / folder)
        (tmp_path / folder / "setup.py").write_text("")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    monkeypatch.setattr(surroundings, "_left_out", set())
    yield tmp_path
    _forget()


def _forget():
    for name in [name for name in sys.modules if name.partition(".")[0] in OWN]:
        del sys.modules[name]
    importlib.invalidate_caches()
    program_of.cache_clear()
    program._distributions.cache_clear()
    surroundings._everybodys.cache_clear()  # of another home


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def files(project, method="", head=""):
    text = f"import tiny\n{head}\nclass Mine(tiny.Perfect):\n    at = {method or None}\n"
    write(project / "project/adapters/mine.py", text)
    _forget()
    method = importlib.import_module("adapters.mine").Mine
    return MethodRun(method(), tiny.Tiny(None)).files


def said(before, after):
    return "; ".join(changes(before, after))


@pytest.mark.parametrize("text", ["apart", "apart:Class", "apart.deep", "apart.deep:Class"])
def test_modules_that_a_text_names(project, text):
    """As for ``__import__``, ``pkgutil.resolve_name``, a registry, a file of settings."""
    write(project / "beside/apart/__init__.py", "")
    write(project / "beside/apart/deep.py", "from apart import deeper")
    write(project / "beside/apart/deeper.py", "angle = 0")
    at = project / ("beside/apart/deeper.py" if "deep" in text else "beside/apart/__init__.py")
    before = files(project, repr(text))
    write(at, "angle = 7")
    name = "apart.deeper" if "deep" in text else "apart"
    assert said(before, files(project, repr(text))) == f"changed: {name}"


def test_a_text_makes_no_distribution_the_programs_own(project):
    before = program_of(tiny.Perfect).files
    after = files(project, repr("numpy.linalg"))
    assert not [name for name in after.keys() - before.keys() if "numpy" in name]


@pytest.mark.parametrize("kind", ["method", "helper"])
def test_variables_that_a_text_names(project, monkeypatch, kind):
    write(project / "project/helper.py", "KEY = 'MINE_ANGLE'")
    told = {"head": "import helper"} if kind == "helper" else {"method": "'MINE_ANGLE'"}
    seen = [files(project, **told)]
    for value in ("0", "7"):
        monkeypatch.setenv("MINE_ANGLE", value)
        seen.append(files(project, **told))
    assert said(*seen[:2]) == "new: $MINE_ANGLE"
    assert said(*seen[1:]) == "changed: $MINE_ANGLE"


@pytest.mark.parametrize("name", ["USER", "CUDA_VISIBLE_DEVICES", "SLURM_JOB_ID", "OTHER_ANGLE"])
def test_variables_of_a_machine_or_a_job_do_not_count(project, monkeypatch, name):
    """Nor does one that no text names."""
    monkeypatch.setenv(name, "0")
    text = repr(name.replace("OTHER_ANGLE", ""))
    before = files(project, text)
    monkeypatch.setenv(name, "7")
    assert files(project, text) == before


def test_a_file_that_a_variable_names(project, monkeypatch):
    at = project / "elsewhere/settings.cfg"
    write(at, "angle: 0")
    monkeypatch.setenv("MINE_SETTINGS", str(at))
    before = files(project, "'MINE_SETTINGS'")
    write(at, "angle: 7")
    assert said(before, files(project, "'MINE_SETTINGS'")) == f"changed: {at}"


#: What a method may do when it is loaded, and is the same program.
MOVES = {
    "a variable": lambda patch, _: patch.setenv("MINE_ANGLE", "7"),
    "a variable with a path": lambda patch, at: patch.setenv("MINE_ANGLE", str(at / "angle.yaml")),
    "a folder on the path": lambda patch, at: patch.syspath_prepend(at),
    "the end of the path": lambda patch, at: patch.setattr(sys, "path", [*sys.path, str(at)]),
    "another folder": lambda patch, at: patch.chdir(at),
}


@pytest.mark.parametrize("changed", [False, True])
@pytest.mark.parametrize("move", MOVES)
def test_what_a_method_does_to_its_process_has_not_changed_it(project, monkeypatch, move, changed):
    """A folder has what an import, a text and a variable would have found; one on the path by a
    relative name is where it was."""
    for name in ("optional.py", "settings.cfg", "angle.yaml", "tiny_data.egg-info/top_level.txt"):
        write(project / "third" / name, "optional")
    write(project / "third/tiny_data.egg-info/PKG-INFO", "Name: tiny_data\nVersion: 1.0\n")
    monkeypatch.chdir(project)
    monkeypatch.setattr(sys, "path", ["project", *sys.path])
    monkeypatch.delenv("MINE_ANGLE", raising=False)
    head = "try:\n    import optional\nexcept ImportError:\n    import ours"
    write(project / "project/ours.py", "angle = 0")
    files(project, "('MINE_ANGLE', 'settings.cfg')", head)
    run = MethodRun(sys.modules["adapters.mine"].Mine(), tiny.Tiny(None))
    MOVES[move](monkeypatch, project / "third")
    here = [*sys.path]
    if changed:
        write(project / "project/ours.py", "angle = 7")
    assert bool(run.changed_meanwhile(thoroughly=True)) == changed
    assert sys.path == here


@pytest.mark.parametrize("text", ["~/.mine/angle.yaml", ".mine/angle.yaml"])
def test_files_of_ones_home_that_a_text_names(project, text):
    at = project / "home/.mine/angle.yaml"
    write(at, "0")
    before = files(project, repr(text))
    write(at, "7")
    assert said(before, files(project, repr(text))) == f"changed: {text}"


@pytest.mark.parametrize("folder", [".mine", ".cache"])
@pytest.mark.parametrize("named", [True, False])
def test_a_hidden_folder_counts_if_a_text_names_it(project, named, folder):
    at = project / "project" / folder / "angle.yaml"
    write(at, "0")
    text = repr(folder if named else "mine")
    before = files(project, text)
    write(at, "7")
    assert said(before, files(project, text)) == f"changed: {folder}/angle.yaml" * named


class Finder:
    """As setuptools writes one for a package that is installed as editable."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def find_spec(self, name, path=None, target=None):
        if name != "edited":
            return None
        init = self.folder / "__init__.py"
        return importlib.util.spec_from_file_location(
            name, init, submodule_search_locations=[str(self.folder)]
        )


def test_packages_that_a_finder_of_their_own_finds(project):
    write(project / "source/edited/__init__.py", "from edited import deep")
    write(project / "source/edited/deep.py", "angle = 0")
    write(project / "site-packages/edited-1.dist-info/METADATA", "Name: edited\nVersion: 1\n")
    write(project / "site-packages/edited-1.dist-info/top_level.txt", "edited\n")
    sys.path.append(str(project / "site-packages"))
    sys.meta_path.append(Finder(project / "source/edited"))
    before = files(project, head="import edited")
    write(project / "source/edited/deep.py", "angle = 7")
    assert "edited/deep.py" in said(before, files(project, head="import edited"))


@pytest.mark.parametrize("how", ["folder", "repository", "index", "nothing"])
def test_installed_anew_with_the_same_version(project, how):
    """From an index a version is what it is; elsewhere nobody says so."""
    site = project / "site-packages"
    info = site / "installed-1.dist-info"

    def install(angle):
        at = site / "installed/__init__.py"
        write(at, f"angle = {angle}")
        if how == "nothing":
            return
        digest = base64.urlsafe_b64encode(hashlib.sha256(at.read_bytes()).digest()).decode()
        write(info / "METADATA", "Name: installed\nVersion: 1\n")
        write(info / "RECORD", f"installed/__init__.py,sha256={digest},9\n../bin/x,sha256={angle},")
        origin = {"vcs_info": {"commit_id": str(angle)}} if how == "repository" else {}
        if how != "index":
            write(info / "direct_url.json", json.dumps({"url": "file:///x", **origin}))

    install(0)
    sys.path.append(str(site))
    seen = [files(project, head="import installed") for _ in range(2)]
    assert seen[0] == seen[1]
    install(7)
    told = {
        "folder": "changed: installed as installed",
        "repository": "changed: installed as installed",
        "index": "",
        "nothing": "changed: installed",
    }
    assert said(seen[0], files(project, head="import installed")) == told[how]


def test_what_makes_a_method_counts(project):
    text = "import tiny\ndef make(): return tiny.Perfect()\nmake.angle = {}\n"
    codes = []
    for angle in (0, 7):
        write(project / "project/maker.py", text.format(angle))
        _forget()
        make = importlib.import_module("maker").make
        codes.append(MethodRun(make(), tiny.Tiny(None), made_by=make).provenance["code"])
    assert len({*codes}) == 2
    of_class = [MethodRun(tiny.Perfect(), tiny.Tiny(None), made_by=m) for m in (None, tiny.Perfect)]
    assert len({run.provenance["code"] for run in of_class}) == 1


def test_weights_behind_a_link_to_a_folder_count(project):
    (project / "weights").mkdir()
    (project / "weights/stage").symlink_to(project / "elsewhere")
    (project / "weights/again").symlink_to(project / "weights")
    seen = []
    for content in ("0", "7"):
        write(project / "elsewhere/w.pt", content)
        run = MethodRun(tiny.Perfect(), tiny.Tiny(None), weights=project / "weights")
        seen.append(run.provenance["weights_folder"])
    assert len({*seen}) == 2
    assert os.path.islink(project / "weights/again")
