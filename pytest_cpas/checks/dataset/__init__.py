"""Sanity of data sets: plain functions from what was measured to the problems found.

Usable without pytest::

    from pytest_cpas.checks.dataset import CHECKS, survey

    measured = survey(MyDataset(folder))
    for name, check in CHECKS.items():
        print(name, check(measured))

``docs/dataset-checks.md`` says what each one demands.
"""

from pytest_cpas.checks.dataset.facts import Survey, survey
from pytest_cpas.checks.dataset.sanity import CHECKS, Check, Problem

__all__ = ["CHECKS", "Check", "Problem", "Survey", "survey"]
