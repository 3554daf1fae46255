"""A conformance and regression harness for RGB-D categorical pose and shape methods.

The names that everyone needs are here; ``docs/stability.md`` says what else is public. They are
imported when they are first asked for: this module is also imported by every run of pytest beside
which the plugin is installed.

Nothing in this module is asserted, and PYTEST_DONT_REWRITE says so: pytest would warn that it was
imported before pytest, as ``pytest-cpas merge`` does, and fail where warnings are errors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pytest_cpas._deprecation import find_moved_modules

if TYPE_CHECKING:
    from pytest_cpas.types import (
        AnswerError,
        Asset,
        Camera,
        ContractError,
        DataError,
        Dataset,
        DeclarationError,
        Derived,
        GroundTruth,
        Hypothesis,
        Mesh,
        Method,
        MethodInfo,
        Observation,
        Pose,
        Prediction,
        Sample,
        SampleRef,
        Symmetry,
        WrappedDataset,
    )

__all__ = [
    "AnswerError",
    "Asset",
    "Camera",
    "ContractError",
    "DataError",
    "Dataset",
    "DeclarationError",
    "Derived",
    "GroundTruth",
    "Hypothesis",
    "Mesh",
    "Method",
    "MethodInfo",
    "Observation",
    "Pose",
    "Prediction",
    "Sample",
    "SampleRef",
    "Symmetry",
    "WrappedDataset",
]

find_moved_modules()

if not TYPE_CHECKING:  # a type checker would take every name for one that there is

    def __getattr__(name: str) -> object:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from pytest_cpas import types

        return getattr(types, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
