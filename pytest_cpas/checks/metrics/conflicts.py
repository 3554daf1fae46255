"""Small scenes on which a wrong rule of matching shows: found by trying all of a kind.

A scene is the overlap of detections (rows, the surest first) with ground truths (columns), all of
one image and category. A rule says which detections are right.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from pytest_cpas.checks.metrics import exact

__all__ = ["conflicts"]

Matrix = tuple[tuple[float, ...], ...]
#: What leaves a detection out of the ranking says None of it.
Rule = Callable[[Matrix], Sequence[bool | None]]

#: Of an overlap, above which two fit.
LIMIT = 0.5

#: Numbers of detections and truths, how many scenes of each are tried, and kept for each rule.
_SIZES = ((2, 1), (3, 1), (2, 2), (3, 2), (2, 3), (4, 3))
_TRIED = 400
_KEPT = 3


def _greedy(choose: Callable[[list[tuple[float, int]]], tuple[float, int]]) -> Rule:
    """Each detection in turn takes one of the free truths that fit."""

    def rule(scene: Matrix) -> list[bool]:
        free, right = set(range(len(scene[0]))), []
        for row in scene:
            fits = [(row[truth], truth) for truth in sorted(free) if row[truth] > LIMIT]
            right.append(bool(fits))
            if fits:
                free.discard(choose(fits)[1])
        return right

    return rule


def _best_or_none(scene: Matrix) -> list[bool]:
    """The best truth, also if another detection has it: then the detection is wrong."""
    taken, right = set(), []
    for row in scene:
        truth = max(range(len(row)), key=row.__getitem__)
        right.append(row[truth] > LIMIT and truth not in taken)
        if right[-1]:
            taken.add(truth)
    return right


def _reused(scene: Matrix) -> list[bool]:
    return [max(row) > LIMIT for row in scene]


def _by_truth(key: Callable[[Matrix, int, int], float]) -> Rule:
    """Each truth in turn takes the free detection with the largest key."""

    def rule(scene: Matrix) -> list[bool]:
        right = [False] * len(scene)
        for truth in range(len(scene[0])):
            fits = [d for d, row in enumerate(scene) if not right[d] and row[truth] > LIMIT]
            if fits:
                right[max(fits, key=lambda d: key(scene, d, truth))] = True
        return right

    return rule


def _largest_overlap_first(scene: Matrix) -> list[bool]:
    pairs = [(v, d, t) for d, row in enumerate(scene) for t, v in enumerate(row) if v > LIMIT]
    right, taken = [False] * len(scene), set()
    for _, detection, truth in sorted(pairs, reverse=True):
        if not right[detection] and truth not in taken:
            right[detection] = True
            taken.add(truth)
    return right


def _optimal(worth: Callable[[float], float]) -> Rule:
    """The assignment that is worth most."""

    def rule(scene: Matrix) -> list[bool]:
        count, truths = len(scene), len(scene[0])
        best: tuple[float, list[bool]] = (-1.0, [])
        places = [*range(truths), *([None] * count)]
        for chosen in itertools.permutations(places, count):
            fits = [t is not None and row[t] > LIMIT for row, t in zip(scene, chosen, strict=True)]
            total = sum(
                worth(row[t])
                for row, t, fit in zip(scene, chosen, fits, strict=True)
                if fit and t is not None
            )
            best = max(best, (total, fits))
        return best[1]

    return rule


def _only_the_first(scene: Matrix) -> list[bool]:
    """A truth belongs to the first detection that fits it, which may have several."""
    owner: dict[int, int] = {}
    for d, row in enumerate(scene):
        for truth, value in enumerate(row):
            if value > LIMIT:
                owner.setdefault(truth, d)
    return [d in owner.values() for d in range(len(scene))]


def _takes_all(scene: Matrix) -> list[bool]:
    """A detection takes every truth that it fits."""
    taken: set[int] = set()
    right = []
    for row in scene:
        fits = {t for t, value in enumerate(row) if value > LIMIT} - taken
        right.append(bool(fits))
        taken |= fits
    return right


def _taken_without_fit(scene: Matrix) -> list[bool]:
    """The best free truth is taken even where it does not fit."""
    free, right = set(range(len(scene[0]))), []
    for row in scene:
        truth = max(free, key=row.__getitem__, default=None)
        right.append(truth is not None and row[truth] > LIMIT)
        if truth is not None:
            free.discard(truth)
    return right


def _without_duplicates(scene: Matrix) -> list[bool | None]:
    """A detection whose truths all have one is left out instead of wrong."""
    right = RIGHT(scene)
    return [r or (None if max(row) > LIMIT else False) for r, row in zip(right, scene, strict=True)]


def _until_the_first_miss(scene: Matrix) -> list[bool]:
    right = list(RIGHT(scene))
    return [bool(r) and all(right[:i]) for i, r in enumerate(right)]


RIGHT: Rule = _greedy(max)

#: Rules that are met in the field, or are easily written by mistake.
WRONG: dict[str, Rule] = {
    "first fit": _greedy(lambda fits: fits[0]),
    "last fit": _greedy(lambda fits: fits[-1]),
    "worst fit": _greedy(min),
    "the best truth or none": _best_or_none,
    "truths are reused": _reused,
    "each truth takes the best": _by_truth(lambda scene, d, t: scene[d][t]),
    "each truth takes the surest": _by_truth(lambda scene, d, t: -d),
    "each truth takes the last": _by_truth(lambda scene, d, t: d),
    "largest overlap first": _largest_overlap_first,
    "most matches": _optimal(lambda value: 1 + value / 100),
    "largest total overlap": _optimal(lambda value: value),
    "only the first": _only_the_first,
    "takes all": _takes_all,
    "taken without a fit": _taken_without_fit,
    "duplicates are left out": _without_duplicates,
    "nothing after the first miss": _until_the_first_miss,
}


def _area(rule: Rule, scene: Matrix) -> float:
    right = [r for r in rule(scene) if r is not None]
    scores = [float(len(right) - i) for i in range(len(right))]
    return exact.average_precision(scores, right, len(scene[0]), interpolated=True)


def _scenes(count: int, truths: int) -> Iterator[Matrix]:
    """Scenes of a size, in a mixed order, whose overlaps differ wherever they fit."""
    values = (0.2, 0.6, 0.7, 0.8, 0.9)
    source = np.random.default_rng([count, truths])
    for _ in range(_TRIED):
        drawn = source.choice(values, (count, truths)).tolist()
        rows = tuple(map(tuple, drawn))
        fitting = [[v for v in line if v > LIMIT] for line in (*rows, *zip(*rows, strict=True))]
        if all(len(set(line)) == len(line) for line in fitting):
            yield rows


@functools.cache
def conflicts() -> list[list[list[float]]]:
    """Scenes such that each wrong rule gives another area than the right one on some of them."""
    kept: list[list[list[float]]] = []
    for size in _SIZES:
        missing = dict.fromkeys(WRONG, _KEPT)
        for scene in _scenes(*size):
            right = _area(RIGHT, scene)
            found = [n for n in missing if abs(_area(WRONG[n], scene) - right) > 1e-9]
            for name in found:
                missing[name] -= 1
                if not missing[name]:
                    del missing[name]
            if found:
                kept.append([list(row) for row in scene])
    return kept
