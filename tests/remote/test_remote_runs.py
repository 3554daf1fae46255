"""Runs of pytest with methods in another interpreter: named in a file, kept, limited, killed."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import tiny
import workers
from harness import RUN

NAMED = """
[tool.pytest-cpas.methods.{name}]
command = [{python!r}]
class = "{cls}"
path = ["there"]
env = {{ {mark} = {value!r}, ASLEEP = "asleep", PYTHONPATH = "" }}
"""


@pytest.fixture
def there(pytester, monkeypatch):
    """A project that names a method of ``there/``; runs it, and sees that no process is left."""
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    monkeypatch.delitem(sys.modules, "tiny", raising=False)
    asked = workers.spec()
    folder = pytester.path / "there"
    folder.mkdir()
    for file in (Path(tiny.__file__), *workers.HERE.glob("planted_*.py")):
        shutil.copy(file, folder)
    shutil.copy(tiny.__file__, pytester.path)

    def run(cls: str, *args: str, start: str = "runpytest_inprocess") -> pytest.RunResult:
        values = {"name": "there", "cls": cls, "python": sys.executable}
        mark = {"mark": workers.MARK, "value": asked.env[workers.MARK]}
        (pytester.path / "pyproject.toml").write_text(NAMED.format(**values, **mark))
        command = ("--cpas-method=there", "--cpas-dataset=tiny:Tiny", *args)
        return getattr(pytester, start)(*RUN, *command, "-k", "test_sample")

    run.asked = asked
    yield run
    assert workers.left_of(asked) == []


def test_rows_are_reused_while_the_other_side_is_the_same(there, pytester):
    first = there("tiny:Perfect", "--cpas-results=out")
    assert first.ret == 0
    first.stdout.fnmatch_lines(["*= there on tiny =*", "rows: computed 12"])
    there("tiny:Perfect", "--cpas-results=out").stdout.fnmatch_lines(["rows: *reused 12 from *"])
    with (pytester.path / "there" / "planted_import.py").open("a") as file:
        file.write("# changed\n")
    changed = there("tiny:Perfect", "--cpas-results=out")
    changed.stdout.fnmatch_lines(["rows: computed 12*not reused 12 of another program*"])


@pytest.fixture
def more(pytester):
    """What the method of :class:`planted_methods.ReadsElsewhere` reads, beside the project."""
    folder = pytester.path.parent / f"{pytester.path.name}-more"
    folder.mkdir()
    (folder / "late_module.py").write_text("WIDTH = 3\n")
    (folder / "settings.txt").write_text("3\n")
    return folder


def test_what_is_read_there_from_elsewhere_belongs_to_the_program(there, more):
    """Also a module from a folder that no path names, and a file whose name is made."""
    command = ("planted_methods:ReadsElsewhere", "--cpas-results=out")
    there(*command).stdout.fnmatch_lines(["rows: computed 12"])
    there(*command).stdout.fnmatch_lines(["rows: *reused 12 from *"])
    for name in ("late_module.py", "settings.txt"):
        with (more / name).open("a") as file:
            file.write("\n")
        result = there(*command)
        result.stdout.fnmatch_lines(
            [f"rows: computed 12*not reused 12 of another program (*{name}*"]
        )


def test_workers_of_xdist_have_one_each_and_tell_what_it_reads(there, more, pytester):
    command = ("planted_methods:ReadsElsewhere", "--cpas-results=out")
    result = there(*command, "-n2", start="runpytest_subprocess")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["rows: computed 12"])
    [file] = pytester.path.glob("out/*.jsonl")
    assert f'"other side: {more / "settings.txt"}":' in file.read_text()


def test_rows_of_what_cannot_be_identified_are_not_reused(there, pytester, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(pytester.path / "there"), prepend=os.pathsep)
    monkeypatch.setenv(workers.MARK, there.asked.env[workers.MARK])
    command = (f"--cpas-method=exec:{sys.executable}#tiny:Perfect", "--cpas-dataset=tiny:Tiny")
    for told in ("computed 12", "computed 12*not reused 12 of another program (*sources are in no"):
        result = pytester.runpytest_inprocess(*RUN, *command, "--cpas-results=out", "-ktest_sample")
        assert result.ret == 0
        result.stdout.fnmatch_lines(["*= perfect on tiny =*", f"rows: {told}*"])


def test_limit_ends_the_worker_and_not_the_run(there):
    result = there("planted_methods:Sleeps", "--cpas-timeout=0.4")
    assert result.ret == 1
    result.assert_outcomes(passed=11, failed=1, skipped=1)  # no golden table
    result.stdout.fnmatch_lines(
        [
            "*there on tiny, sample scene_0/0001 (mug): predict took longer than 0.4 s, so the"
            " worker was ended; it printed last:",
            "*in fault",
            "*started again for what comes next (1 of 3 times)",
        ]
    )


def test_the_list_names_it_and_starts_nothing(there, pytester):
    there("nowhere:Nothing", "--collect-only")  # writes the project's file
    result = pytester.runpytest_inprocess(*RUN, "--cpas-list")
    result.stdout.fnmatch_lines(
        [
            "  there  *nowhere:Nothing  (in another interpreter)",
            f"      {sys.executable}; pytest-cpas worker-check there tries it",
            "data sets:",
        ]
    )


def test_what_cannot_be_reached_is_a_usage_error(there):
    result = there("tiny:Perfekt")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(
        [
            "ERROR: method 'there': the class tiny:Perfekt cannot be loaded there: module tiny is"
            " */there/tiny.py, and has no Perfekt"
        ]
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_process_is_left_of_a_run_that_is_ended(there, pytester, number):
    there("planted_methods:Sleeps", "--collect-only")  # writes the project's file
    command = [sys.executable, "-m", "pytest", *RUN, "--cpas-method=there"]
    run = subprocess.Popen(
        [*command, "--cpas-dataset=tiny:Tiny", "-k", "test_sample"],
        cwd=pytester.path,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    asleep = pytester.path / "asleep"
    until = time.monotonic() + 30
    while not asleep.exists() and time.monotonic() < until:
        time.sleep(0.02)
    assert asleep.exists()
    if number == signal.SIGINT:  # as a terminal does
        os.killpg(run.pid, number)
    else:
        for pid in _of_group(run.pid):
            os.kill(pid, number)
    run.communicate(timeout=30)
    assert run.returncode != 0


def _of_group(group: int) -> list[int]:
    found = []
    for name in os.listdir("/proc"):
        try:
            if name.isdigit() and os.getpgid(int(name)) == group:
                found.append(int(name))
        except OSError:
            continue
    return found
