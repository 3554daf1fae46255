"""A whole run in which everything that others write is hostile: nothing of it reaches a terminal,
a JUnit file or a report as anything but text."""

import json

import pytest
from harness import RUN
from hostile import (
    ALL,
    harmless_csv,
    harmless_in_a_terminal,
    harmless_markdown,
    harmless_xml,
)

from pytest_cpas.cli import main

#: Where a run takes text from others, each told from the others by a word that stands before it;
#: and which of them stand in the terminal.
FIELDS = {
    "IN-ID": True,
    "IN-CATEGORY": True,
    "IN-SCENE": False,
    "IN-MISSING": True,
    "IN-DAMAGED": True,
    "IN-DATA-ERROR": True,
    "IN-CONTRACT-ERROR": True,
    "IN-REASON": True,
    "IN-EXCEPTION": True,
    "IN-REPR": True,
    "IN-NOTE": True,
    "IN-WARNING": True,
    "IN-FILENAME": True,
    "IN-OUTPUT": True,
    "IN-KNOWN": True,
}

HOSTILE = """

import warnings
from tiny import *
from hostile import ALL, IN_NAMES
from pytest_cpas.types import AnswerError

NAMES = list(IN_NAMES.values())
CATEGORY = "::error::IN-CATEGORY ##[group]|<b>=@me"

def said(field):
    return f"{field} {ALL}\\n{ALL} {field}"

class Strange(Exception):
    def __repr__(self):
        return said("IN-REPR")

class Data(Tiny):
    name = "hostile"
    missing = (said("IN-MISSING"),)

    def __init__(self, data_dir):
        super().__init__(data_dir)
        self.samples = [
            replace(
                ref,
                id=f"{NAMES[i % len(NAMES)]}IN-ID/{ref.id.split('/')[1]}",
                category=CATEGORY if ref.category == "mug" else "bowl",
                scene="::x IN-SCENE",
            )
            for i, ref in enumerate(self.samples)
        ]

    def load(self, ref):
        if ref.id.endswith("0011"):
            raise ContractError(said("IN-DATA-ERROR"))
        return super().load(replace(ref, id="/" + ref.id.split("IN-ID/")[1]))

class Damaged(Data):
    damaged = (said("IN-DAMAGED"),)

class Unlisted(Perfect):
    def __init__(self):
        raise AnswerError(said("IN-EXCEPTION"))

class Method(Perfect):
    info = replace(Perfect.info, name="hostile", categories=("bowl", CATEGORY))

    def answer(self, index):
        if index == 5:
            return Prediction.failed(said("IN-REASON"))
        if index == 6:
            raise RuntimeError(said("IN-EXCEPTION"))
        if index == 7:
            raise Strange
        if index == 8:
            raise AnswerError(said("IN-CONTRACT-ERROR"))
        if index == 9:
            print(said("IN-OUTPUT"))
            error = ValueError("x")
            error.add_note(said("IN-NOTE"))
            raise error
        if index == 10:
            warnings.warn(said("IN-WARNING"))
            warnings.warn_explicit("x", UserWarning, said("IN-FILENAME"), 3)
        return super().answer(index)
"""


@pytest.fixture
def hostile(cpas, pytester, request):
    """Run the hostile method on the hostile data."""
    pytester.makepyfile(strange=HOSTILE)
    here = request.config.rootpath / "tests"
    (pytester.path / "hostile.py").write_text((here / "hostile.py").read_text("utf-8"), "utf-8")
    known = f"IN-KNOWN {ALL}"
    # JSON's strings are TOML's, but for a lone surrogate
    known = json.dumps(known.encode("utf-8", "replace").decode(), ensure_ascii=False)
    known = known.replace("\x7f", "\\u007f")
    (pytester.path / "hostile.known.toml").write_text(
        f'[[contract]]\ncheck = "answers"\nreason = {known}\n', "utf-8"
    )

    def run(*args, dataset="Damaged", method="strange:Method"):
        names = [f"--cpas-dataset=strange:{dataset}", "--junitxml=junit.xml"]
        names += [f"--cpas-method={method}"] if method else []
        more = ["-Wdefault", "--cpas-report=out", "--cpas-results=kept"] if method else []
        return pytester.runpytest_subprocess(*RUN, *names, *more, *args)

    return run


@pytest.mark.parametrize(
    "args", ["-v -rA", "-v -rA -n2", "-rA --tb=native", "-rA --tb=line", "-rA --tb=short -l"]
)
def test_run(hostile, pytester, args):
    result = hostile(*args.split())
    assert result.ret == 1
    told = result.stdout.str() + result.stderr.str()
    harmless_in_a_terminal(told)
    if "-v" in args:
        assert [field for field in FIELDS if FIELDS[field] and field not in told] == []
    harmless_xml((pytester.path / "junit.xml").read_bytes())
    out = pytester.path / "out"
    harmless_markdown((out / "report.md").read_text("utf-8"))
    harmless_csv((out / "precision.csv").read_text("utf-8"))
    assert "IN-REASON" in (out / "report.html").read_text("utf-8")
    kept = [path.read_text("utf-8") for path in (pytester.path / "kept").iterdir()]
    assert all(line.isprintable() for text in kept for line in text.split("\n"))


@pytest.mark.parametrize(
    ("args", "method", "dataset", "field"),
    [
        (("--cpas-granularity=scene", "-v", "-rA"), "strange:Method", "Data", "IN-SCENE"),
        (("--collect-only",), "strange:Method", "Data", "IN-ID"),
        (("--collect-only", "-q", "-n2"), "strange:Method", "Data", ""),
        (("--cpas-category=nothing",), "strange:Method", "Damaged", ""),
        (("--cpas-category=nothing",), "strange:Method", "Data", "IN-MISSING"),
        (("--cpas-limit=3",), "strange:Unlisted", "Data", "IN-EXCEPTION"),
        (("--cpas-check-dataset=strange:Damaged", "-v", "-rA"), "", "Data", "IN-DAMAGED"),
    ],
)
def test_other_ways(hostile, pytester, args, method, dataset, field):
    if not method:  # a data set alone
        result = pytester.runpytest_subprocess(*RUN, "--junitxml=junit.xml", *args)
    else:
        result = hostile(*args, method=method, dataset=dataset)
    told = result.stdout.str() + result.stderr.str()
    harmless_in_a_terminal(told)
    assert field in told


PASSES = """
import os
from pathlib import Path
text = "\\x1b[31m\\n::error::IN-{0}\\u202e ##[x]"

class Unregistered:
    def __init__(self, data_dir):
        raise OSError(text.format("OPENING"))
"""


def test_usage_errors(pytester):
    pytester.makepyfile(broken=PASSES)
    result = pytester.runpytest_inprocess(
        *RUN, "--cpas-check-dataset=broken:Unregistered", "-pno:terminalreporter"
    )
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    told = result.stderr.str()
    harmless_in_a_terminal(told)
    assert "IN-OPENING" in told


BROKEN = """
from tiny import Tiny, Perfect

class Mute(Exception):
    def __str__(self):
        raise RuntimeError("\\x1b[31m\\n::error::IN-MUTE")

class Asking(type):
    def __getattr__(cls, name):
        raise RuntimeError("\\x1b[31m\\n::error::IN-ASKING")

class Made(Perfect):
    def __init__(self):
        raise Mute

class Asked(Perfect, metaclass=Asking):
    pass

class Infoless(metaclass=Asking):
    pass
"""


@pytest.mark.parametrize(
    ("method", "words"),
    [
        ("Made", "cannot be made (Mute: its message cannot be told, for that raises RuntimeError)"),
        ("Asked", "its assets raises RuntimeError"),
        ("Infoless", "its info raises RuntimeError"),
    ],
)
def test_class_that_raises_whatever_is_asked_is_a_usage_error(cpas, pytester, method, words):
    pytester.makepyfile(broken=BROKEN)
    names = (f"--cpas-method=broken:{method}", "--cpas-dataset=tiny:Tiny")
    result = pytester.runpytest_inprocess(*RUN, *names)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    harmless_in_a_terminal(result.stderr.str())
    assert f"method 'broken:{method}'" in result.stderr.str()
    assert words in result.stderr.str()


@pytest.mark.parametrize("plugin", ["terminal", "no:terminalreporter"])
def test_error_that_nobody_caught_before_there_is_a_session(pytester, plugin):
    """It is told as text, whoever raised it."""
    pytester.makeconftest("""
        import pytest

        @pytest.hookimpl(tryfirst=True)
        def pytest_configure(config):
            raise RuntimeError("\\x1b[31m\\n::error::IN-CONFTEST")
    """)
    names = ("--cpas-method=tiny:Perfect", "--cpas-dataset=tiny:Tiny")
    result = pytester.runpytest_inprocess(*RUN, *names, "-p", plugin)
    told = result.stdout.str() + result.stderr.str()
    harmless_in_a_terminal(told)
    assert "IN-CONFTEST" in told


PROTOCOL = '[tool.pytest-cpas.protocols."\\u001b[31m\\n::error::IN-PROTOCOL"]\nversion = 1\n'


def test_list_of_protocols_of_which_one_is_wrong(pytester):
    pytester.makepyprojecttoml("[tool.pytest.ini_options]\n" + PROTOCOL)
    result = pytester.runpytest_inprocess(*RUN, "--cpas-list")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    harmless_in_a_terminal(result.stderr.str())
    assert "IN-PROTOCOL" in result.stderr.str()


def test_golden_folder_that_has_no_name(pytester, cpas):
    pytester.makepyprojecttoml('[tool.pytest.ini_options]\ncpas_golden = "a\\u0000b"\n')
    result = cpas("Perfect")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*cpas_golden is 'a*x00b', expected a folder; no name has a NUL"])


def test_a_name_on_the_command_line(pytester, capsys):
    name = "x:\x1b[31m\n::error::y"
    result = pytester.runpytest_inprocess(*RUN, f"--cpas-method={name}", "--cpas-dataset=tod")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    harmless_in_a_terminal(result.stderr.str())
    capsys.readouterr()
    assert main(["report", f"{name}.json", "--to=there"]) == 1
    harmless_in_a_terminal(capsys.readouterr().err)
