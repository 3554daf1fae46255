"""What crosses the pipe, as the types of this side: declarations, observations, predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

from numpy.typing import NDArray

from pytest_cpas.types import (
    AnswerError,
    Asset,
    DeclarationError,
    Hypothesis,
    Mesh,
    MethodInfo,
    Observation,
    Prediction,
    shown,
)

__all__ = ["asset_of", "info_of", "predictions_of", "told_observations"]

_SETS = ("needs", "gives", "equivariances")


def info_of(told: object, name: str, as_called: str = "") -> MethodInfo:
    """What a class on the other side declares; :class:`DeclarationError` if that is nothing.

    ``name``: of the method, for messages; ``as_called``: what it is called here, if not as it
    declares.
    """
    if not isinstance(told, Mapping):
        raise DeclarationError(f"method {name!r}: info is {shown(told)}, expected a dictionary")
    known = {field.name for field in fields(MethodInfo)}
    if unknown := sorted(told.keys() - known):
        raise DeclarationError(
            f"method {name!r}: info has {', '.join(map(shown, unknown))}, expected some of"
            f" {', '.join(sorted(known))}"
        )
    values: dict[str, Any] = dict(told)
    if as_called:
        values["name"] = as_called
    for part in (*_SETS, "categories", "assets"):
        if part in values and not isinstance(values[part], list):
            seen = shown(values[part])
            raise DeclarationError(f"method {name!r}: info's {part} is {seen}, expected a list")
    for part in ("needs", "gives", "categories", "equivariances"):
        if not all(isinstance(each, str) for each in values.get(part, ())):
            raise DeclarationError(
                f"method {name!r}: info's {part} is {shown(values[part])}, expected names"
            )
    values |= {part: frozenset(values[part]) for part in _SETS if part in values}
    values["categories"] = tuple(values.get("categories", ()))
    values["assets"] = tuple(asset_of(each, name) for each in values.get("assets", ()))
    for part, kind, expected in (
        ("name", str, "a text"),
        ("licence", str, "a text, such as 'MIT' or 'unknown'"),
        ("deterministic", bool, "True or False"),
        ("tolerance", (int, float), "a number"),
        ("batch", int, "a number of samples"),
    ):
        if part in values and not isinstance(values[part], kind):
            seen = shown(values[part])
            raise DeclarationError(f"method {name!r}: info's {part} is {seen}, expected {expected}")
    try:
        return MethodInfo(**values)
    except TypeError as error:
        lacking = str(error).partition("missing ")[2] or str(error)
        raise DeclarationError(f"method {name!r}: info lacks {lacking}") from None


def asset_of(told: object, name: str) -> Asset:
    """A file that a method declares to need; :class:`DeclarationError`."""
    if not isinstance(told, Mapping) or told.keys() != {"path", "url", "licence"}:
        raise DeclarationError(
            f"method {name!r}: an asset is {shown(told)}, expected a dictionary of path, url and"
            " licence"
        )
    return Asset(**{key: str(value) for key, value in told.items()})


def told_observations(
    batch: Sequence[Observation],
) -> tuple[list[dict[str, Any]], list[NDArray[Any]]]:
    """A batch as plain values, and three arrays for each of it."""
    told = [{"category": seen.category, "camera": asdict(seen.camera)} for seen in batch]
    return told, [array for seen in batch for array in (seen.rgb, seen.depth, seen.mask)]


def predictions_of(told: object, arrays: Sequence[NDArray[Any]]) -> list[Prediction]:
    """The answers of a worker; :class:`AnswerError` for what is none, or breaks the contract."""
    if not isinstance(told, list):
        raise AnswerError(f"predict: {shown(told)}, expected a list of answers")
    return [_prediction(each, arrays) for each in told]


def _prediction(told: object, arrays: Sequence[NDArray[Any]]) -> Prediction:
    if not isinstance(told, Mapping) or not isinstance(told.get("hypotheses"), list):
        raise AnswerError(f"predict: {shown(told)}, expected hypotheses or a reason for none")
    reason = told.get("reason")
    hypotheses = [_hypothesis(each, arrays) for each in told["hypotheses"]]
    return Prediction(tuple(hypotheses), reason=reason)


def _hypothesis(told: object, arrays: Sequence[NDArray[Any]]) -> Hypothesis:
    if not isinstance(told, Mapping) or not all(
        type(place) is int and 0 <= place < len(arrays) for place in told.values()
    ):
        raise AnswerError(f"predict: {shown(told)}, expected the places of arrays")
    parts: dict[str, Any] = {name: arrays[place] for name, place in told.items()}
    if lacking := {"rotation", "translation"} - parts.keys():
        raise AnswerError(f"hypothesis: no {' and no '.join(sorted(lacking))}")
    vertices, triangles = parts.pop("vertices", None), parts.pop("triangles", None)
    if (vertices is None) != (triangles is None):
        raise AnswerError("hypothesis: a mesh is both vertices and triangles")
    if vertices is not None:
        parts["mesh"] = Mesh(vertices, triangles)
    score = parts.pop("score", None)
    if score is not None:
        if score.size != 1:
            raise AnswerError(f"score: an array of shape {score.shape}, expected a number")
        parts["score"] = score.reshape(-1)[0].item()
    try:
        return Hypothesis(**parts)
    except TypeError as error:
        raise AnswerError(f"hypothesis: {error}") from None
