"""A map of names, proposed: which value here is which value of the reference.

Values that hold the same numbers, to within float noise, are the same, whatever they are called and
whichever way round they are; where several are, that whose name is most alike. Where nothing at all
agrees, a value is proposed by its shape, if no other has it.
"""

from __future__ import annotations

import difflib
import itertools
import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from pytest_cpas._files import toml_string
from pytest_cpas.traces.fitting import fits
from pytest_cpas.traces.maps import Named
from pytest_cpas.traces.recording import Trace
from pytest_cpas.traces.values import Array, Value
from pytest_cpas.types import DataError

__all__ = ["Proposal", "map_text", "propose"]

#: By entry of a map, as JSON of :class:`Named` or of a name to ignore: whether numbers say so.
Proposal = Mapping[str, bool]

#: Values that are looked at on each side; numbers of one.
MOST, MOST_NUMBERS = 2_000, 2**23
#: Calls of one name that are put in order.
MOST_CALLS = 50
#: How far the norms of two that are the same may be apart, relative.
SAME_NORM = 1e-4


def propose(own: Trace, theirs: Trace) -> Proposal:
    """What is called otherwise in a trace of the reference than in one's own."""
    ours = {value.name for value in own.values}
    named = {value.name for value in theirs.values}
    here = _candidates(own, named)
    there = _candidates(theirs, ours)
    found: dict[str, bool] = {}
    taken: set[str] = set()
    later = _later_calls(own), _later_calls(theirs)
    for theirs_value in there:
        matches: list[tuple[int, float, Named]] = []
        for value in here:
            if value.name in taken or (change := _change(value, theirs_value)) is None:
                continue
            entry = Named(reference=theirs_value.name, here=value.name, **change)
            agreeing = _calls_that_agree(entry, *later)
            if agreeing is not None:
                matches.append((agreeing, _alike(value.name, theirs_value.name), entry))
        if matches:
            best = max(matches, key=lambda match: match[:2])[2]
            taken.add(best.here)
            found[_told(best)] = True
    reordered = list(_reordered(own, theirs))
    found |= {_told(named): True for named in reordered}
    ends_agree = _ends_agree(own, theirs)
    for name in _other_things(own, theirs, {named.here for named in reordered}):
        found[json.dumps({"ignore": name})] = ends_agree
    if not found and not _agree(own, theirs):
        for mine, other in _by_shape(here, there):
            found[_told(Named(reference=other.name, here=mine.name))] = False
    return found


def map_text(proposals: Sequence[Proposal]) -> str:
    """The text of a ``parity.toml`` from what samples propose: what all of them do."""
    count = Counter(told for proposal in proposals for told in proposal)
    by_numbers = {told for proposal in proposals for told, sure in proposal.items() if sure}
    unsure = {told for proposal in proposals for told, sure in proposal.items() if not sure}
    lines = ["# Proposed by --cpas-parity-propose; read it before you use it.", ""]
    agreed = [told for told, times in count.items() if times == len(proposals)]
    ignored = {told: json.loads(told)["ignore"] for told in agreed if "ignore" in json.loads(told)}
    for words, sign, names in (
        (
            "# Of these names are other values here: what comes after them is the same.",
            "",
            [name for told, name in ignored.items() if told not in unsure],
        ),
        (
            "# Either of these names are other values here, or here the two part: of what comes\n"
            "# after them some is the same, and some is not.",
            "# ",
            [name for told, name in ignored.items() if told in unsure],
        ),
    ):
        if names:
            listed = ["ignore = [", *(f"    {toml_string(name)}," for name in names), "]"]
            lines += [words, *(f"{sign}{line}" for line in listed), ""]
    for sure in (True, False):
        part = [t for t in agreed if (t in by_numbers) == sure and "ignore" not in json.loads(t)]
        if part and not sure:
            lines += ["# By their shapes alone, which no other value has.", ""]
        for told in part:
            lines.append("[[values]]")
            for name, value in json.loads(told).items():
                if value is not None and (name != "axis" or value):
                    text = toml_string(value) if isinstance(value, str) else json.dumps(value)
                    lines.append(f"{name} = {text}")
            lines.append("")
    return "\n".join(lines)


def _candidates(trace: Trace, others: set[str]) -> list[Value]:
    """The first calls of what is tapped or drawn and has no name that the other side knows."""
    return [
        value
        for value in trace.values
        if value.kind in ("tap", "draw")
        and value.call == 1
        and value.name not in others
        and value.is_whole
        and 1 < value.size <= MOST_NUMBERS
        and value.kept.dtype.kind in "fiub"
    ][:MOST]


def _change(own: Value, theirs: Value) -> dict[str, Any] | None:
    """How the reference's value has to be turned to be this one; None if it is another."""
    a, b = own.kept, theirs.kept
    if own.size < theirs.size:
        return _taken(a, b)
    if own.size != theirs.size or own.norm is None or theirs.norm is None:
        return None
    if abs(own.norm - theirs.norm) > SAME_NORM * theirs.norm:
        return None
    a, b = a.astype(float), b.astype(float)
    if not np.isfinite(a).all() or not np.isfinite(b).all():
        return None
    if fits(a, b):
        return {}
    if a.shape == b.shape and a.shape[-1] == 4 and fits(a, np.roll(b, -1, -1)):
        return {"quaternion": "scalar-first"}
    if 2 <= b.ndim <= 4:
        for axes in itertools.permutations(range(b.ndim)):
            turned = b.transpose(axes)
            if fits(a, turned):
                return {"transpose": list(axes)}
            if turned.shape != a.shape and fits(a.ravel(), turned.ravel()):
                plain = list(axes) == sorted(axes)
                return {**({} if plain else {"transpose": list(axes)}), "reshape": list(a.shape)}
    if a.shape != b.shape and fits(a.ravel(), b.ravel()):
        return {"reshape": list(a.shape)}
    return None


def _later_calls(trace: Trace) -> Mapping[str, Sequence[Value]]:
    """By name the values of all calls but the first."""
    found = defaultdict[str, list[Value]](list)
    for value in trace.values:
        if value.call > 1 and value.is_whole:
            found[value.name].append(value)
    return found


def _calls_that_agree(
    named: Named,
    own: Mapping[str, Sequence[Value]],
    theirs: Mapping[str, Sequence[Value]],
) -> int | None:
    """How many of the later calls are the same under a name; None if one is of another shape, so
    that it is another thing."""
    calls, agreeing = {value.call: value for value in own.get(named.here, ())}, 0
    for value in theirs.get(named.reference, ()):
        mine = calls.get(value.call)
        if mine is None:
            continue
        try:
            turned = named.of(value)
        except DataError:
            return None
        if turned.shape != mine.shape:
            return None
        agreeing += _same(mine, turned)
    return agreeing


def _reordered(own: Trace, theirs: Trace) -> Iterator[Named]:
    """What both call alike, and in another order."""
    sides = [defaultdict[str, list[Value]](list) for _ in range(2)]
    for side, trace in zip(sides, (own, theirs), strict=True):
        for value in trace.values:
            if value.is_whole and value.kept.dtype.kind in "fiub":
                side[value.name].append(value)
    for name, values in sides[0].items():
        others = sides[1][name]
        if not 1 < len(values) == len(others) <= MOST_CALLS or _same(values[0], others[0]):
            continue
        calls = [next((o.call for o in others if _same(v, o)), 0) for v in values]
        if sorted(calls) == list(range(1, len(values) + 1)):
            yield Named(reference=name, here=name, calls=calls)


def _other_things(own: Trace, theirs: Trace, known: set[str]) -> list[str]:
    """Shared names whose values differ although later ones are the same."""
    others = theirs.by_key()
    shared = [
        (value, others[value.key])
        for value in own.values
        if value.kind == "tap" and value.is_whole and value.key in others
    ]
    shared = [pair for pair in shared if pair[0].kept.dtype.kind in "fiub"]
    same = [_same(*pair) for pair in shared]
    last = max((index for index, agrees in enumerate(same) if agrees), default=0)
    differing = [value.name for (value, _), agrees in zip(shared[:last], same, strict=False)
                 if not agrees]  # fmt: skip
    return [name for name in dict.fromkeys(differing) if name not in known]


def _ends_agree(own: Trace, theirs: Trace) -> bool:
    """Whether both answers are the same or, of traces without any, the last value that both have:
    then nothing that differs before it is a fault."""
    others = theirs.by_key()
    shared = [(value, others[value.key]) for value in own.values if value.key in others]
    shared = [pair for pair in shared if pair[0].kept.dtype.kind in "fiub"]
    answers = [pair for pair in shared if pair[0].kind == "answer"]
    return all(_same(*pair) for pair in answers or shared[-1:])


def _same(own: Value, theirs: Value) -> bool:
    return own.digest == theirs.digest or (
        own.shape == theirs.shape and fits(own.kept.astype(float), theirs.kept.astype(float))
    )


def _agree(own: Trace, theirs: Trace) -> bool:
    """Whether something that is computed is the same on both sides."""
    others = theirs.by_key()
    return any(
        value.kind == "tap" and value.key in others and _same(value, others[value.key])
        for value in own.values
        if value.is_whole and value.kept.dtype.kind in "fiub"
    )


def _taken(a: Array, b: Array) -> dict[str, Any] | None:
    """Whether ``a`` is a range of ``b`` along one axis."""
    if a.ndim != b.ndim:
        return None
    longer = [axis for axis in range(a.ndim) if a.shape[axis] != b.shape[axis]]
    if len(longer) != 1:
        return None
    [axis] = longer
    length = a.shape[axis]
    firsts = range(b.shape[axis] - length + 1)
    if len(firsts) > 1024:
        firsts = range(0, len(firsts), length)
    for first in firsts:
        if fits(a.astype(float), b.take(range(first, first + length), axis).astype(float)):
            return {"take": [first, first + length], "axis": axis}
    return None


def _by_shape(here: Sequence[Value], there: Sequence[Value]) -> Iterator[tuple[Value, Value]]:
    ours, theirs = (Counter(value.shape for value in side) for side in (here, there))
    for mine, other in itertools.product(here, there):
        if mine.shape == other.shape and ours[mine.shape] == theirs[other.shape] == 1:
            yield mine, other


def _alike(name: str, other: str) -> float:
    return difflib.SequenceMatcher(None, name, other).ratio()


def _told(named: Named) -> str:
    return json.dumps(asdict(named))
