"""What is wrong with a method whose answers are wrong: the usual mistakes, tested on its answers.

:func:`diagnose` takes :class:`Evidence`, arrays of answers and truths, and returns
:class:`Finding`; it needs no pytest and runs no method.
"""

from pytest_cpas.diagnosis.evidence import Evidence
from pytest_cpas.diagnosis.mistakes import Mistake
from pytest_cpas.diagnosis.search import Finding, diagnose

__all__ = ["Evidence", "Finding", "Mistake", "diagnose"]
