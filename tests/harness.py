"""What runs of pytest inside a test are started with, and what is the same in all of them."""

import argparse
import re

import pytest
import tiny

from pytest_cpas.checks.contract import CONTRACT, MethodSubject, check_contract
from pytest_cpas.checks.outcome import Outcome

RUN = ("-p", "no:dash", "-p", "no:cacheprovider")


def _perfect() -> tiny.Perfect:
    method = tiny.Perfect()
    method.load(None, "cpu")
    return method


def _contract_items() -> tuple[int, int]:
    data = tiny.Tiny(None)
    samples = [data.load(ref) for ref in data.samples[::3]]
    subject = MethodSubject(_perfect(), samples, fresh=_perfect)
    found = [check_contract(subject, check).outcome for check in CONTRACT.values()]
    return found.count(Outcome.PASSED), len(found) - found.count(Outcome.PASSED)


#: Contract items of tests/tiny.py's perfect method: those that pass, and those that do not apply
#: or find what is not demanded.
KEPT, NOT_DEMANDED = _contract_items()


class DeclaredOptions:
    """What stands for pytest's parser where only the plugin's own options are wanted."""

    def __init__(self) -> None:
        self.names: set[str] = set()
        self.parser = argparse.ArgumentParser()

    def getgroup(self, *_: str) -> "DeclaredOptions":
        return self

    def addoption(self, name: str, **keywords: object) -> None:
        self.names.add(name)
        self.parser.add_argument(name, **keywords)

    def addini(self, *_: str, **keywords: object) -> None:
        pass


def unfolded(result: pytest.RunResult) -> pytest.LineMatcher:
    """What a run printed, with the lines put together that the terminal folds."""
    return pytest.LineMatcher(re.sub(r"\n {4}(?=\S)", " ", result.stdout.str()).split("\n"))
