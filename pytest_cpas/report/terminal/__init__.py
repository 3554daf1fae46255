"""What stands in the terminal at the end: of runs, of robustness, of the check of a data set."""

from pytest_cpas.report.terminal._robustness import print_robustness
from pytest_cpas.report.terminal._run import print_run, shows_samples
from pytest_cpas.report.terminal._survey import print_survey
from pytest_cpas.report.terminal._table import Terminal

__all__ = ["Terminal", "print_robustness", "print_run", "print_survey", "shows_samples"]
