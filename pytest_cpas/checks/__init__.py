"""Plain functions that check, usable without pytest.

Conformance of metric implementations, properties that every one must keep::

    from pytest_cpas.checks import PROPERTIES, check, load_subject

    subject = load_subject("my_package.my_adapter")
    for prop in PROPERTIES.values():
        result = check(subject, prop)
        print(prop.name, result.outcome, result.message)

``docs/metric-conformance.md`` says how an adapter is written.

The contract of methods: :mod:`pytest_cpas.checks.contract`, ``docs/method-contract.md``.
"""

from pytest_cpas.checks.contract import (
    CONTRACT,
    ContractCheck,
    ContractResult,
    MethodSubject,
    check_contract,
)
from pytest_cpas.checks.metric_adapter import KNOWN, Box, Offer, Sample, offer
from pytest_cpas.checks.properties import PROPERTIES, Property
from pytest_cpas.checks.running import Result, as_subject, check, load_subject, replay
from pytest_cpas.checks.subject import Finding, Outcome, Subject

# the modules register their properties when they are imported; the matrix follows this order
from pytest_cpas.checks import rotations as _rotations  # isort: skip  # noqa: F401
from pytest_cpas.checks import boxes as _boxes  # isort: skip  # noqa: F401
from pytest_cpas.checks import surfaces as _surfaces  # isort: skip  # noqa: F401
from pytest_cpas.checks import precision as _precision  # isort: skip  # noqa: F401
from pytest_cpas.checks import average_precision as _average_precision  # isort: skip  # noqa: F401
from pytest_cpas.checks import conduct as _conduct  # isort: skip  # noqa: F401

# and these the checks of methods
from pytest_cpas.checks import contract_answers as _answers  # isort: skip  # noqa: F401
from pytest_cpas.checks import contract_invariance as _invariance  # isort: skip  # noqa: F401
from pytest_cpas.checks import contract_equivariance as _equivariance  # isort: skip  # noqa: F401

__all__ = [
    "CONTRACT",
    "KNOWN",
    "PROPERTIES",
    "Box",
    "ContractCheck",
    "ContractResult",
    "Finding",
    "MethodSubject",
    "Offer",
    "Outcome",
    "Property",
    "Result",
    "Sample",
    "Subject",
    "as_subject",
    "check",
    "check_contract",
    "load_subject",
    "offer",
    "replay",
]
