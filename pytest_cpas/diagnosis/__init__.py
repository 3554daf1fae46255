"""What is wrong with a method whose answers are wrong: the usual mistakes, tested on its answers.

:func:`diagnose` takes :class:`Evidence`, arrays of answers and truths, and returns a list
of :class:`Explanation`; it needs no pytest and runs no method. :func:`diagnose_run` does so for the
rows of a run that is far below what is expected of it.
"""

from typing import TYPE_CHECKING

from pytest_cpas._deprecation import deprecated
from pytest_cpas.diagnosis.evidence import Evidence
from pytest_cpas.diagnosis.mistakes import Mistake
from pytest_cpas.diagnosis.running import diagnose_run
from pytest_cpas.diagnosis.search import Explanation, diagnose

__all__ = ["Evidence", "Explanation", "Mistake", "diagnose", "diagnose_run"]

if not TYPE_CHECKING:  # a type checker would take every name for one that there is

    def __getattr__(name: str) -> object:
        if name == "Finding":
            deprecated("pytest_cpas.diagnosis.Finding", "pytest_cpas.diagnosis.Explanation", "0.3")
            return Explanation
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
