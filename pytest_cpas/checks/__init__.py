"""Plain functions that check, usable without pytest.

:mod:`pytest_cpas.checks.metrics` checks implementations of metrics,
:mod:`pytest_cpas.checks.contract` methods, :mod:`pytest_cpas.checks.dataset` data sets.
"""
