"""The checks are plain functions: pytest need not be installed, and nothing is reported."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest_cpas.checks

PACKAGE = Path(pytest_cpas.checks.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE.parents[1]).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
)

CODE = """
import importlib, sys

for name in ("pytest", "_pytest", "syrupy"):
    sys.modules[name] = None
for name in {modules}:
    importlib.import_module(name)
above = [name for name in sys.modules if name.startswith(("pytest_cpas.report", "pytest_cpas.ses"))]
assert not above, above

from pytest_cpas.checks.contract import CONTRACT, MethodSubject, check_contract
from pytest_cpas.checks.dataset import CHECKS, survey
from pytest_cpas.checks.dataset.verdicts import judge
from pytest_cpas.checks.metrics import PROPERTIES, check, load_subject

import tiny

data, method = tiny.Tiny(None), tiny.Perfect()
method.load(None, "cpu")
subject = MethodSubject(method, [data.load(ref) for ref in data.samples[:3]])
print(len([check_contract(subject, check) for check in CONTRACT.values()]))
print(len([judge(survey(data), name) for name in CHECKS]))
print(check(load_subject("cpas"), PROPERTIES["diameter.of_round_bodies"], examples=2).outcome)
"""


def test_every_kind_of_check_runs_without_pytest():
    assert len(MODULES) > 20
    code = CODE.format(modules=MODULES)
    folder = Path(__file__).parents[1]  # where tiny is
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    contract, dataset, outcome = done.stdout.split()
    assert int(contract) > 20
    assert int(dataset) > 10
    assert outcome == "passed"
