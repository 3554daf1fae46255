"""The contract that every method must keep.

Usable without pytest::

    from pytest_cpas.checks.contract import CONTRACT, MethodSubject, check_contract

    subject = MethodSubject(method, [dataset.load(ref) for ref in dataset.samples[:4]])
    for check in CONTRACT.values():
        result = check_contract(subject, check)
        print(check.name, result.outcome.value, result.message)

``docs/method-contract.md`` lists the checks.
"""

from pytest_cpas.checks.contract.checking import (
    CONTRACT,
    ContractCheck,
    ContractResult,
    MethodSubject,
    check_contract,
)

# the modules register their checks when they are imported, in this order
from pytest_cpas.checks.contract import answers as _answers  # isort: skip  # noqa: F401
from pytest_cpas.checks.contract import invariance as _invariance  # isort: skip  # noqa: F401
from pytest_cpas.checks.contract import equivariance as _equivariance  # isort: skip  # noqa: F401

__all__ = ["CONTRACT", "ContractCheck", "ContractResult", "MethodSubject", "check_contract"]
