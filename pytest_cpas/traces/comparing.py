"""Two traces of one observation, value by value: where do they part?

Two values are EXACT if they are equal to the last bit, FLOAT NOISE if they differ by no more than
two right codes may, and else they PART. Numbers that are no real ones must be equal.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from pytest_cpas.reading.text import terminal_line
from pytest_cpas.traces.explaining import Explanation, explain
from pytest_cpas.traces.recording import Trace, answer_of
from pytest_cpas.traces.values import Array, Value

__all__ = ["NOISE", "Comparison", "Difference", "compare"]

#: The relative difference that the order of float32 sums explains, where no spread was measured.
NOISE = 1e-5
#: A measured spread is a few draws of it, so that so many times as much is allowed; and at least so
#: much, where what was measured agreed to the last bit.
MARGIN, LEAST = 10.0, 1e-6
#: A value that is nearly constant hides a difference behind its mean: so many times as much is
#: allowed relative to what is left without the mean.
WITHOUT_MEAN = 10.0

Word = Literal["EXACT", "FLOAT NOISE", "PARTS"]


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How a value differs from the reference's.

    ``relative``: the L2 norm of the difference over that of the reference, infinite where shapes or
    kinds differ or one of them is not finite; ``largest``: the largest difference of a number, and
    ``at`` its index; ``allowed``: the relative difference that was; ``problem``: why it cannot be
    told in numbers.
    """

    name: str
    word: Word
    kind: str
    stage: str
    relative: float = 0.0
    largest: float = 0.0
    at: tuple[int, ...] = ()
    allowed: float = 0.0
    problem: str = ""

    def plain(self) -> dict[str, Any]:
        """As plain values, which travel on test reports."""
        return {**vars(self), "at": list(self.at)}

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> Difference:
        """The inverse of :meth:`plain`."""
        return cls(**{**plain, "at": tuple(plain["at"])})


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """What comparing a sample's traces has shown.

    ``differences``: of the values that both name, in the reference's order; ``undecided``: the
    first that differs where two right codes may, from which on nothing is compared;
    ``only_here`` and ``only_there``: what one side alone names; ``explanation``: of the first that
    parts, and ``pair`` that value on both sides, if both have it;
    ``degrees``, ``millimetres``: how far the two answers are apart, None where one of them is none.
    """

    differences: Sequence[Difference]
    undecided: str = ""
    only_here: Sequence[str] = ()
    only_there: Sequence[str] = ()
    explanation: Explanation = field(default_factory=Explanation)
    pair: tuple[Value, Value] | None = None
    degrees: float | None = None
    millimetres: float | None = None

    @property
    def parting(self) -> Difference | None:
        """The first value that parts."""
        return next((each for each in self.differences if each.word == "PARTS"), None)


def compare(here: Trace, reference: Trace, replayed: Collection[str] = ()) -> Comparison:
    """Compare two traces that name their values alike.

    ``replayed``: the names of the draws that were taken over from the reference, and are not
    compared.
    """
    ours = here.by_key()
    differences: list[Difference] = []
    pairs: list[tuple[Value, Value]] = []
    left_open = ""
    for theirs in reference.values:
        own = ours.get(theirs.key)
        if own is None or (theirs.kind == "draw" and theirs.name in replayed):
            continue
        found = difference(own, theirs)
        if theirs.is_open and found.word != "EXACT":
            left_open = theirs.told
            break
        pairs.append((own, theirs))
        differences.append(found)
    if not left_open and (reference.reason is not None or here.reason is not None):
        differences.append(_outcome(here, reference))
    elif not left_open:
        differences += _lacking_answers(here, reference)
    first = next((i for i, each in enumerate(differences) if each.word == "PARTS"), None)
    explanation, pair = Explanation(), None
    if first is not None and first < len(pairs):
        pair = pairs[first]
        explanation = explain(*pair, before=pairs[:first])
    names = {value.key for value in reference.values}
    degrees, millimetres = _apart(here, reference)
    return Comparison(
        differences=differences,
        undecided=left_open,
        only_here=[v.told for v in here.values if v.key not in names],
        only_there=[v.told for v in reference.values if v.key not in ours],
        explanation=explanation,
        pair=pair,
        degrees=degrees,
        millimetres=millimetres,
    )


def difference(own: Value, theirs: Value) -> Difference:
    """How a value differs from the reference's."""
    told: dict[str, Any] = {
        "name": own.told,
        "kind": theirs.kind,
        "stage": terminal_line(own.stage),
    }
    if own.digest == theirs.digest:
        return Difference(**told, word="EXACT")
    if own.shape != theirs.shape:
        problem = f"shape {_shape(own)}, the reference's is {_shape(theirs)}"
        return Difference(**told, word="PARTS", relative=math.inf, problem=problem)
    stride = max(own.stride, theirs.stride)
    a, b = own.thinned(stride).kept, theirs.thinned(stride).kept
    if "U" in (a.dtype.kind, b.dtype.kind):
        return Difference(**told, word="PARTS", relative=math.inf, problem="another text")
    same = a == b  # of integers before they are floats, which have 53 bits
    if stride > 1 and same.all() and a.dtype == b.dtype and not theirs.is_real:
        problem = "another integer among those that were not kept"
        return Difference(**told, word="PARTS", relative=math.inf, problem=problem)
    a, b = a.astype(float), b.astype(float)
    same |= np.isnan(a) & np.isnan(b)
    if same.all() and stride == 1:  # float32 and float64, say
        return Difference(**told, word="EXACT")
    with np.errstate(invalid="ignore"):
        apart = np.where(same, 0, np.abs(a - b))
    worst = int(np.nanargmax(np.where(np.isnan(apart), np.inf, apart)))
    at = tuple(int(i) for i in np.unravel_index(worst * stride % max(own.size, 1), own.shape))
    if not np.isfinite(apart).all():
        problem = f"{np.ravel(a)[worst]:g} at {list(at)}, the reference has {np.ravel(b)[worst]:g}"
        return Difference(**told, word="PARTS", relative=math.inf, at=at, problem=problem)
    finite = np.where(same, 0, b) if not np.isfinite(b).all() else b
    norm, spread = (float(np.linalg.norm(x)) for x in (finite, finite - finite.mean()))
    relative = _share(float(np.linalg.norm(apart)), norm)
    # of a single number, or of one that is repeated, nothing is left but its rounding
    constant = spread <= np.finfo(np.float32).eps * norm
    without = 0.0 if constant else _share(float(np.linalg.norm(apart)), spread)
    allowed = allowed_of(theirs)
    # how large the noise is beside what is left without the mean was not measured
    noisy = relative <= allowed and without <= WITHOUT_MEAN * max(allowed, NOISE * theirs.is_real)
    noisy = noisy and (theirs.is_real or bool(same.all()))
    return Difference(
        **told,
        word="FLOAT NOISE" if noisy and _norms_near(own, theirs, allowed) else "PARTS",
        relative=relative,
        largest=float(np.ravel(apart)[worst]),
        at=at,
        allowed=allowed,
    )


def allowed_of(reference: Value) -> float:
    """The relative difference that two right codes may have at a value of the reference; at
    integers, such as chosen indices, none."""
    if not reference.is_real:
        return 0.0
    return NOISE if reference.spread is None else max(MARGIN * reference.spread, LEAST)


def relative_difference(a: Array, b: Array) -> float:
    """The L2 norm of a - b over that of b; infinite where one of them is not finite."""
    a, b = a.astype(float), b.astype(float)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return 0.0 if np.array_equal(a, b, equal_nan=True) else math.inf
    return _share(float(np.linalg.norm(a - b)), float(np.linalg.norm(b)))


def _share(part: float, whole: float) -> float:
    if part == 0:
        return 0.0
    return part / whole if whole > 0 else math.inf


def _norms_near(own: Value, theirs: Value, allowed: float) -> bool:
    """Of thinned values: what was not kept must not differ by more than is allowed either."""
    if own.is_whole and theirs.is_whole:
        return True
    if own.norm is None or theirs.norm is None:
        return own.norm == theirs.norm
    return abs(own.norm - theirs.norm) <= allowed * theirs.norm


def _shape(value: Value) -> str:
    return f"({', '.join(map(str, value.shape))})"


def _outcome(here: Trace, reference: Trace) -> Difference:
    """Whether both have an answer, or give none for the same reason."""
    said = [
        "an answer" if each.reason is None else f"none ({each.reason})"
        for each in (here, reference)
    ]
    same = said[0] == said[1]
    return Difference(
        name="answer",
        word="EXACT" if same else "PARTS",
        kind="answer",
        stage="",
        relative=0.0 if same else math.inf,
        problem="" if same else f"{said[0]}, the reference has {said[1]}",
    )


def _lacking_answers(here: Trace, reference: Trace) -> Iterator[Difference]:
    """Parts of the reference's answer that are none of ours, and hypotheses that it has not."""
    ours, theirs = (
        {value.name for value in each.values if value.kind == "answer"}
        for each in (here, reference)
    )
    further = {name for name in ours if name.split(".")[1].isdigit()}
    sides = (
        (theirs - ours, "the reference alone has it"),
        (further - theirs, "the reference has none"),
    )
    for names, problem in sides:
        for name in sorted(names):
            yield Difference(
                name=terminal_line(name),
                word="PARTS",
                kind="answer",
                stage="",
                relative=math.inf,
                problem=problem,
            )


def _apart(here: Trace, reference: Trace) -> tuple[float | None, float | None]:
    """Degrees and millimetres between two answers."""
    own, theirs = answer_of(here), answer_of(reference)
    if own is None or theirs is None:
        return None, None
    turned = own.rotation @ theirs.rotation.T
    # exact near 0, where the cosine is not
    sine = np.linalg.norm(turned - turned.T) / (2 * math.sqrt(2))
    degrees = math.degrees(math.atan2(float(sine), (float(np.trace(turned)) - 1) / 2))
    distance = float(np.linalg.norm(own.translation - theirs.translation))
    return degrees, 1000 * distance
