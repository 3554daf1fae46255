"""What no text names is seen when it is read: rows of a program that has read another file are not
reused."""

import os
import sys
from pathlib import Path

import pytest
from harness import RUN

from pytest_cpas.evaluation import OWN, digest_of_opened, opened_name
from pytest_cpas.evaluation.opened import other_names
from pytest_cpas.session import opened_files

METHOD = """
import importlib, os, sys
from pathlib import Path
from tiny import *

HERE = os.path.dirname(os.path.abspath(__file__))

def read(path, mode="r"):
    with open(path, mode) as file:
        return file.read()

def there(path):
    try:
        read(path)
        return 1
    except OSError:
        return 0

class Mine(Perfect):
    strength = 0.0

    def answer(self, index):
        (best,) = super().answer(index).hypotheses
        # so little that no judging again of the samples that are drawn could be sure to see it
        found = float(self.found())
        off = found if index == 7 else 0
        return Prediction((replace(best, translation=best.translation + off),))

    def found(self):
        return {found}
"""

FROM_CONFTEST = """
import os, pytest, mine

def pytest_addoption(parser):
    parser.addoption("--strength", default="0")
    parser.addini("strength", "as the option", default="0")

def pytest_configure(config):
    mine.Mine.strength = {found}
"""

#: How a method gets at a number that a file has, and where that is; no text has its name.
WAYS = {
    "beside, joined": ("{p}/.k/on", "read(os.path.join(HERE, '.' + 'k', 'o' + 'n'))"),
    "a sibling's": ("{p}/../other/on.txt", "(Path(HERE).parent / 'other' / 'on.txt').read_text()"),
    "of the home folder": ("{h}/k/on", "read(os.path.expanduser('~') + '/k' + '/on')"),
    "a descriptor": (
        "{p}/.k/on",
        "os.read(os.open(Path(HERE) / ('.' + 'k') / ('o' + 'n'), os.O_RDONLY), 9)",
    ),
    "of bytes": ("{p}/.k/on", "read(os.fsencode(HERE) + b'/.' + b'k/on')"),
    "relative, elsewhere": (
        "{h}/k/on",
        "(os.chdir(Path.home()), read('k' + '/on'), os.chdir(HERE))[1]",
    ),
    "a module": (
        "{h}/k/onn.py",
        "(sys.path.insert(0, str(Path.home() / 'k')), importlib.import_module('on' + 'n').V)[1]",
    ),
    "to be written, too": ("{p}/.k/on", "read(os.path.join(HERE, '.' + 'k', 'o' + 'n'), 'r+')"),
    "a memory map": (
        "{p}/.k/on",
        "bytes(np.memmap(os.path.join(HERE, '.' + 'k', 'o' + 'n'), dtype='u1')).decode()",
    ),
    "numpy": ("{p}/.k/on", "np.loadtxt(os.path.join(HERE, '.' + 'k', 'o' + 'n'))"),
    "a thread": (
        "{p}/.k/on",
        "__import__('concurrent.futures').futures.ThreadPoolExecutor(1).submit("
        "lambda: read(os.path.join(HERE, '.' + 'k', 'o' + 'n'))).result()",
    ),
    "a process": (
        "{p}/.k/on.py",
        "__import__('subprocess').run([sys.executable, '-c', 'import sys; exec(open(sys.argv[1])"
        ".read()); print(V)', os.path.join(HERE, '.' + 'k', 'o' + 'n.py')], capture_output=True,"
        " text=True).stdout",
    ),
    "whether it is there": ("{p}/.k/on", "there(os.path.join(HERE, '.' + 'k', 'o' + 'n'))"),
    "a conftest": ("{p}/.k/on", "self.strength"),
}


def content(path, number):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"V = {number}" if path.suffix == ".py" else str(number))
    # of a module the time and the size are what Python looks at
    stamp = path.stat().st_mtime + (100 if number else 0)
    os.utime(path, (stamp, stamp))


@pytest.fixture
def mine(cpas, pytester, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for name in ("home", "temporary"):
        (tmp_path / name).mkdir()
    # all of a test is in the folder of temporary files, else
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    pytester.syspathinsert()

    def write(found, conftest=None):
        pytester.makepyfile(mine=METHOD.replace("{found}", found))
        if conftest is not None:
            pytester.makeconftest(FROM_CONFTEST.replace("{found}", conftest))
        return pytester.path

    def run(*args):
        names = ("--cpas-method=mine:Mine", "--cpas-dataset=tiny:Tiny", "--cpas-results=kept")
        start = pytester.runpytest_subprocess if "-n2" in args else pytester.runpytest_inprocess
        return start(*RUN, *names, *args)

    return write, run


def rows(result):
    return next(line for line in result.stdout.lines if line.startswith("rows: "))


@pytest.mark.parametrize("way", WAYS)
def test_what_it_reads_is_of_the_program(mine, tmp_path, way):
    write, run = mine
    where, found = WAYS[way]
    conftest = "mine.read(os.path.dirname(__file__) + '/.' + 'k/on')"
    folder = write(found, conftest if way == "a conftest" else None)
    path = Path(where.format(p=folder, h=tmp_path / "home"))
    if way != "whether it is there":
        content(path, 0)
    first = run("--snapshot-update")
    assert first.ret == 0, first.stdout.str()
    assert "reused 12" in rows(run()), "nothing has changed"
    content(path, 1)
    result = run()
    assert result.ret == 1
    result.stdout.fnmatch_lines([f"rows: *not reused 12 *changed since: *{path.name}*", "*REGR*"])


def test_what_a_worker_reads_is_known_too(mine, tmp_path):
    write, run = mine
    where, found = WAYS["of the home folder"]
    path = Path(where.format(p=write(found), h=tmp_path / "home"))
    content(path, 0)
    assert run("-n2").ret == 0
    assert "reused 12" in rows(run("-n2"))
    content(path, 1)
    assert "not reused 12" in rows(run("-n2"))


@pytest.mark.parametrize(
    ("found", "given"),
    [
        ("config.getoption('str' + 'ength')", ["--strength=1"]),
        ("config.getini('str' + 'ength')", ["-o", "strength=1"]),
    ],
    ids=["option", "setting"],
)
def test_what_a_conftest_adds_is_of_the_program(mine, found, given):
    write, run = mine
    write("self.strength", found)
    assert run().ret == 0
    assert "reused 12" in rows(run("-n2"))
    assert "not reused 12" in rows(run(*given))


def test_what_the_program_has_written_itself_is_not(mine, tmp_path):
    """A cache, which it reads the next time, and what it has another process write and reads."""
    write, run = mine
    cache = "os.write(os.open(HERE + '/.' + 'k', os.O_RDWR | os.O_CREAT), b'0') * 0"
    output = (
        "(os.system('echo 0 > ' + (at := __import__('tempfile').mkdtemp() + '/o' + 'n')),"
        " read(at))[1]"
    )
    write(f"{cache} + float({output})")
    assert run().ret == 0
    assert "reused 12" in rows(run())


def test_what_pytest_and_the_plugin_write_is_not(mine):
    """Into the project, too; with its cache, which workers read."""
    write, run = mine
    write("0")
    outputs = ["--junitxml=junit.xml", "--log-file=run.xml", "--cpas-save-predictions=saved.jsonl"]
    reports = ["--cpas-report=report", "-p", "cacheprovider", "-n2"]
    assert run(*outputs, *reports).ret == 0
    result = run(*outputs, *reports)
    assert rows(result).startswith("rows: reused 12 from "), rows(result)


def test_predictions_that_are_written_anew_are_others(mine, pytester):
    names = ("--cpas-dataset=tiny:Tiny", "--cpas-results=kept")
    saved = pytester.path / "saved.jsonl"
    made = pytester.runpytest_inprocess(
        *RUN, names[0], "--cpas-method=tiny:Perfect", f"--cpas-save-predictions={saved}"
    )
    assert made.ret == 0
    again = [pytester.runpytest_inprocess(*RUN, *names, f"--cpas-predictions={saved}")]
    again += [pytester.runpytest_inprocess(*RUN, *names, f"--cpas-predictions={saved}")]
    assert "reused 12" in rows(again[-1])
    *lines, last = saved.read_text().splitlines(keepends=True)
    saved.write_text("".join([*lines, last.replace('"translation":[', '"translation":[ ')]))
    again = pytester.runpytest_inprocess(*RUN, *names, f"--cpas-predictions={saved}")
    assert "not reused 12 of another program (changed: saved.jsonl)" in rows(again)


def test_a_file_that_changes_while_it_runs_is_told(mine, pytester):
    """It is read at each sample, and written by somebody else between two."""
    write, run = mine
    at = write(
        "(read(at := HERE + '/.' + 'k'), os.system(f'echo {os.urandom(4).hex()} > {at}')) and 0"
    )
    (at / ".k").write_text("0")
    assert run().ret == 0
    assert "not reused 12 of another program (changed while it ran: " in rows(run())


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """A folder of temporary files that is not the one of all tests."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "t"))


def heard(opened, path, flags=os.O_RDONLY):
    opened.opened(str(path), flags, sys._getframe())


def test_what_is_none_is_none(tmp_path, temporary):
    (tmp_path / "t").mkdir()
    good = tmp_path / "good"
    for path in (good, tmp_path / "written"):
        path.write_text("0")
    os.mkfifo(tmp_path / "pipe")
    opened = opened_files.OpenedFiles()
    (tmp_path / "t" / "made").write_text("0")
    opened.started("no file", sys._getframe())
    heard(opened, tmp_path / "written")
    heard(opened, tmp_path / "written", os.O_WRONLY)
    for path in (
        good,
        tmp_path / "pipe",
        tmp_path,
        tmp_path / "t" / "made",
        "/dev/null",
        os.__file__,
    ):
        heard(opened, path)
    opened.opened(3, os.O_RDONLY, sys._getframe())
    name = opened_name(good)
    assert {*opened.told()} == {(name, digest_of_opened(name))}
    assert opened.news() == [*opened.told()]
    assert opened.news() == []
    good.write_text("another")
    heard(opened, good)
    assert {name for name, _ in opened.told()} == {name}
    assert len(opened.told()) == 2


def test_what_was_written_while_it_was_read_is_no_digest_of_either(tmp_path, temporary):
    path = tmp_path / "f"
    path.write_text("0")
    opened = opened_files.OpenedFiles()
    heard(opened, path)
    path.write_text("another")
    [(name, digest)] = opened.told()
    assert digest.startswith(digest_of_opened(name))
    assert digest != digest_of_opened(name)


def test_what_is_read_and_then_written_is_its_own(tmp_path, temporary):
    path = tmp_path / "f"
    path.write_text("0")
    opened = opened_files.OpenedFiles()
    heard(opened, path, os.O_RDWR)
    name = opened_name(path)
    before = {(name, digest_of_opened(name))}
    assert {*opened.told()} == before
    path.write_text("another")
    assert {*opened.told()} == before | {(name, OWN)}
    assert other_names(dict(before), {name: OWN}) == []
    assert other_names(dict(before), {name: "another"}) == [name]


def test_no_more_than_so_many_are_remembered(tmp_path, monkeypatch, temporary):
    monkeypatch.setattr(opened_files, "_MOST", 3)
    opened = opened_files.OpenedFiles()
    for index in range(5):
        (tmp_path / str(index)).write_text("0")
        heard(opened, tmp_path / str(index))
    assert len(opened.told()) == 3
