"""Facts of the pose of a known object: how far its true model is from where it should be."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TypeAlias

from pytest_cpas.facts.answers import AnswerBatch
from pytest_cpas.facts.fact import Fact, Known
from pytest_cpas.metrics.definitions import definition
from pytest_cpas.metrics.model_points import SPINS, add, add_s, mspd, mssd

__all__ = ["KNOWN_OBJECTS"]

_Compute: TypeAlias = Callable[[AnswerBatch], Sequence[float | None]]

_MODEL: frozenset[Known] = frozenset({"shape"})


def _by_symmetry(batch: AnswerBatch) -> Sequence[float | None]:
    symmetry = batch.symmetry
    any_symmetry = symmetry.sphere or symmetry.axis is not None or len(symmetry.rotations) > 1
    return batch.of_models(add_s if any_symmetry else add)


def _mssd(batch: AnswerBatch) -> Sequence[float | None]:
    return batch.of_models(functools.partial(mssd, symmetry=batch.symmetry))


def _mspd(batch: AnswerBatch) -> Sequence[float | None]:
    return [
        None
        if model is None or camera is None
        else mspd(estimate.pose, truth.pose, model, batch.symmetry, camera)
        for truth, estimate, model, camera in zip(
            batch.truths, batch.estimates, batch.models, batch.cameras, strict=True
        )
    ]


def _relative(metres: _Compute) -> _Compute:
    def compute(batch: AnswerBatch) -> Sequence[float | None]:
        return [
            None if distance is None or model is None else distance / model.diameter
            for distance, model in zip(metres(batch), batch.models, strict=True)
        ]

    return compute


def _adds() -> list[Fact]:
    kinds: list[tuple[str, str, str, _Compute]] = [
        ("add", "ADD", "same-points", lambda batch: batch.of_models(add)),
        ("adds", "ADD-S", "nearest-points", lambda batch: batch.of_models(add_s)),
        ("add_or_adds", "ADD(-S)", "by-symmetry", _by_symmetry),
    ]
    return [
        *(
            Fact(
                f"{name}_m",
                definition("add", variant).id(),
                "m",
                "lower",
                f"{told} {{}} cm",
                compute,
                knows=_MODEL,
                factor=100,
            )
            for name, told, variant, compute in kinds
        ),
        *(
            Fact(
                f"{name}_relative",
                definition("add_relative", variant).id(),
                "",
                "lower",
                f"{told} {{}} %",
                _relative(compute),
                knows=_MODEL,
                factor=100,
            )
            for name, told, variant, compute in kinds
        ),
    ]


#: In the order in which they are told.
KNOWN_OBJECTS: Sequence[Fact] = (
    *_adds(),
    Fact(
        "mssd_relative",
        definition("mssd", "relative-to-diameter").id(spins=SPINS),
        "",
        "lower",
        "MSSD {} %",
        _relative(_mssd),
        knows=_MODEL,
        factor=100,
    ),
    Fact(
        "mspd_px",
        definition("mspd", "of-width-640").id(spins=SPINS),
        "px",
        "lower",
        "MSPD {} px",
        _mspd,
        knows=_MODEL | {"camera"},
    ),
)
