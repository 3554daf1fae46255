"""However a run is spread out, it ends with the same table, verdicts, JUnit and exit code."""

import os
import sys
import xml.etree.ElementTree as ET

import pytest
from harness import RUN

from pytest_cpas.checks.contract import CONTRACT

#: What the golden table was recorded with, what is run on what, the exit code.
CASES = {
    "good": ("Perfect", "Perfect", "Tiny", 0),
    "regressed": ("Perfect", "Biased", "Tiny", 1),
    "improved": ("Biased", "Perfect", "Tiny", 1),
    "incomplete": ("Perfect", "Perfect", "Torn", 1),
}

#: An ssh that runs the command on this machine, from another folder, as another login would.
SSH = """#!/bin/sh
for command; do :; done
cd / && exec sh -c "$command"
"""


@pytest.fixture
def hosts(pytester, monkeypatch):
    """Options of two hosts that execnet reaches by ssh."""
    folder = pytester.mkdir("bin")
    ssh = folder / "ssh"
    ssh.write_text(SSH)
    ssh.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    spec = f"//python={sys.executable}//chdir={pytester.path}"
    return ["--dist=load", f"--tx=ssh=first{spec}", f"--tx=ssh=second{spec}"]


@pytest.fixture
def run(cpas, pytester, hosts):
    """Run a method as ``how`` says and return the result and its JUnit file's cases."""
    ways = {
        "serial": [],
        "-n2": ["-n2"],
        "worksteal": ["-n2", "--dist=worksteal"],
        "ssh": hosts,
    }

    def run(
        how: str, method: str, dataset: str
    ) -> tuple[pytest.RunResult, dict[str, tuple[str, str]]]:
        junit = "--junitxml=junit.xml"
        if how == "shards":
            for index in (1, 2, 3):
                cpas(method, f"--cpas-shard={index}/3", "--cpas-results=out", dataset=dataset)
            parts = sorted((pytester.path / "out").iterdir())
            merged = [f"--cpas-merge={path}" for path in parts]
            result = pytester.runpytest_inprocess(*RUN, junit, *merged)
        elif how == "serial":
            result = cpas(method, junit, dataset=dataset)
        else:
            names = (f"--cpas-method=tiny:{method}", f"--cpas-dataset=tiny:{dataset}")
            result = pytester.runpytest_subprocess(*RUN, *names, junit, *ways[how])
        return result, _cases(pytester.path / "junit.xml")

    return run


def _cases(path) -> dict[str, tuple[str, str]]:
    """Outcome of every test case, and of verdicts what they say."""
    found = {}
    for case in ET.parse(path).iter("testcase"):
        name = f"{case.get('classname')}::{case.get('name')}"
        (outcome,) = case or [None]
        if "test_contract" in name and (outcome is None or outcome.tag == "skipped"):
            outcome = None  # what is mere information may differ with the samples of a shard
        message = outcome.get("message") if outcome is not None and "golden" in name else ""
        found[name] = ("passed" if outcome is None else outcome.tag, message)
    return found


def _summary(result: pytest.RunResult) -> list[str]:
    lines = result.stdout.lines
    start = next(i for i, line in enumerate(lines) if line.startswith("correct "))
    unlike = ("==", "FAILED", "rows: ")  # where rows come from is what differs
    return [line for line in lines[start:] if line and not any(text in line for text in unlike)]


@pytest.mark.thinned(3)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("how", ["-n2", "worksteal", "shards", "ssh"])
def test_spread_out_like_in_one_process(run, cpas, how, case):
    recorded, method, dataset, code = CASES[case]
    assert cpas(recorded, "--snapshot-update").ret == 0
    serial, serial_cases = run("serial", method, dataset)
    spread, cases = run(how, method, dataset)
    assert (serial.ret, spread.ret) == (code, code)
    assert _summary(spread) == _summary(serial)
    assert cases == serial_cases
    assert len(cases) == 1 + len(CONTRACT) + 12 + 2  # listing, contract, samples, verdicts
