"""What the program of a method on the other side is made of: which files count, and when."""

import os
import shutil
from pathlib import Path

import pytest
import tiny
import workers

from pytest_cpas.evaluation import MethodRun
from pytest_cpas.evaluation.surroundings import leave_out
from pytest_cpas.remote import remote_method
from pytest_cpas.remote import worker as worker_file

METHOD = """
import importlib, sys
import planted_methods
{at_import}

class Method(planted_methods.Good):
    def load(self, assets, device):
        {at_load}
"""

#: Of a Python before 3.8, which does not tell what is opened.
DEAF = "import sys\nif hasattr(sys, 'addaudithook'):\n    del sys.addaudithook\n"


@pytest.fixture
def side(tmp_path):
    """Makes runs of a method whose folders are of a test, and sees that no worker is left."""
    code, installed = tmp_path / "code", tmp_path / "lib" / "site-packages"
    for folder in (code, installed / "package", tmp_path / "deaf"):
        folder.mkdir(parents=True)
    shutil.copy(workers.HERE / "planted_methods.py", code)
    for name in ("loose.py", "package/__init__.py", "package/part.py"):
        (installed / name).write_text("WIDTH = 3\n")
    (tmp_path / "deaf" / "sitecustomize.py").write_text(DEAF)
    made = []

    def make(at_import: str = "", at_load: str = "pass", *, deaf: bool = False) -> MethodRun:
        (code / "method.py").write_text(METHOD.format(at_import=at_import, at_load=at_load))
        places = [str(installed), *([str(tmp_path / "deaf")] if deaf else [])]
        asked = workers.spec(
            "method:Method",
            path=(str(code),),
            env={"PYTHONPATH": os.pathsep.join(places), workers.MARK: str(tmp_path)},
        )
        kind = remote_method(asked)
        made.append((asked, kind))
        run = MethodRun(kind(), tiny.Tiny(None))
        run.judge(run.samples[0])
        return run

    make.code, make.installed = code, installed
    yield make
    for _, kind in made:
        kind.remote.close()
    for asked, _ in made:
        assert workers.left_of(asked) == []


def edited(file: Path) -> None:
    """Another content of the same size and time."""
    before = file.stat()
    file.write_text(file.read_text().replace("3", "4"))
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.parametrize("deaf", [False, True], ids=["3.8", "3.6"])
@pytest.mark.parametrize(
    ("module", "name"),
    [("loose", "loose.py"), ("package.part", "package"), ("package", "package")],
)
def test_what_is_installed_and_imported_with_the_class_is_in_its_code(side, module, name, deaf):
    """Also what its package imports later."""
    before, same = (side(f"import {module}", deaf=deaf) for _ in range(2))
    assert before.provenance["code"] == same.provenance["code"]
    part = side.installed / ("package/part.py" if name == "package" else name)
    edited(part)
    after = side(f"import {module}", deaf=deaf)
    told = f"site-packages/{name} (other side)"
    assert before.files[told] != after.files[told]
    assert before.provenance["code"] != after.provenance["code"]
    assert not before.newly_heard_there()


@pytest.mark.parametrize("deaf", [False, True], ids=["3.8", "3.6"])
@pytest.mark.parametrize(
    ("module", "heard"),
    [
        ("loose", "lib/site-packages/loose.py"),
        ("package", "lib/site-packages/package"),
        ("golden.mod", "code/golden/mod.py"),
        ("more", "more/more.py"),
    ],
)
def test_modules_imported_later_are_heard_of(side, tmp_path, module, heard, deaf):
    """From what is installed, from a folder that is left out, from one that is found then."""
    (side.code / "golden").mkdir()
    (side.code / "golden" / "mod.py").write_text("WIDTH = 3\n")
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "more.py").write_text("WIDTH = 3\n")
    leave_out([side.code / "golden"])
    load = f"sys.path.append({str(tmp_path / 'more')!r}); importlib.import_module({module!r})"
    run = side(at_load=load, deaf=deaf)
    told = dict(run.newly_heard_there())
    name = f"other side: {tmp_path / heard}"
    assert name in told
    assert len(told) == (1 if module != "golden.mod" or deaf else len(told))
    assert not run.changed_meanwhile(thoroughly=True)
    assert run.digests_of_opened([name]) == {name: told[name]}
    changed = tmp_path / heard
    edited(changed / "part.py" if changed.is_dir() else changed)
    assert side(at_load=load, deaf=deaf).digests_of_opened([name]) != {name: told[name]}


def test_what_is_heard_of_after_a_worker_has_ended(side, tmp_path):
    (tmp_path / "late.txt").write_text("3")
    run = side(at_load=f"open({str(tmp_path / 'late.txt')!r}).close()")
    name = f"other side: {tmp_path / 'late.txt'}"
    assert [each for each, _ in run.newly_heard_there()] == [name]
    method = run.loaded()
    method.remote.close()
    (tmp_path / "late.txt").write_text("4")
    run.judge(run.samples[1])
    assert [each for each, _ in run.newly_heard_there()] == [name]


@pytest.mark.parametrize("deaf", [False, True], ids=["3.8", "3.6"])
def test_a_package_that_a_link_leads_to_is_below_the_folder(side, tmp_path, deaf):
    (tmp_path / "third").mkdir()
    (tmp_path / "third" / "__init__.py").write_text("WIDTH = 3\n")
    (side.code / "linked").symlink_to(tmp_path / "third")
    seen = []
    for _ in range(2):
        run = side(at_load="import linked", deaf=deaf)
        assert not run.changed_meanwhile(thoroughly=True)
        assert not run.newly_heard_there()
        seen.append(run.provenance["code"])
        edited(tmp_path / "third" / "__init__.py")
    assert seen[0] != seen[1]


def test_too_many_files_are_counted_and_not_read(side, tmp_path, monkeypatch):
    """A worker in this process, with a limit that a test can reach."""
    monkeypatch.setattr(worker_file, "_MOST_FILES", 1)
    monkeypatch.setattr(worker_file, "_digest", None)
    sources = worker_file.Sources()
    monkeypatch.setattr(worker_file.sys, "path", [str(side.code), str(side.installed.parent)])
    sources.begin()
    (side.code / "second.py").write_text("")
    told = sources.told([str(side.code)], [])
    assert told["unknown"] == f"{side.code} has more than 1 files"
    assert told["files"] == {}


@pytest.mark.parametrize(
    ("seconds", "told"),
    [(-1.0, "code cannot be looked through in -1 s"), (0.05, "below path cannot be read in 0.05")],
)
def test_looking_takes_no_longer_than_it_may(side, monkeypatch, seconds, told):
    monkeypatch.setattr(worker_file, "_LONGEST", seconds)
    monkeypatch.setattr(worker_file, "_digest", _slow)
    sources = worker_file.Sources()
    monkeypatch.setattr(worker_file.sys, "path", [str(side.code)])
    sources.begin()
    assert told in sources.told([str(side.code)], [])["unknown"]


def _slow(file: str, whole: bool) -> tuple[int, str]:
    worker_file._sleep(0.1)
    return 0, file


def test_a_digest_is_kept_while_its_file_rests(tmp_path, monkeypatch):
    file = tmp_path / "file.py"
    file.write_text("3")
    monkeypatch.setattr(worker_file, "_REST", -1.0)
    first = worker_file._digest(str(file), True)
    monkeypatch.setattr(worker_file, "_read_digest", lambda *_: (0, "read anew"))
    assert worker_file._digest(str(file), True) == first
    edited(file)
    assert worker_file._digest(str(file), True) == (0, "read anew")
