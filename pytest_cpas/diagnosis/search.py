"""Which usual mistakes explain the answers that are wrong.

Every explanation of at most two mistakes is undone on all answers and judged by how many samples
become correct. It is believed if it repairs a good part of them, breaks next to none, is not what
any other object's answer would do as well, and is not what trying hundreds of explanations finds
by chance. Of those that repair as many, the simplest is reported, and the others named.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

from pytest_cpas.diagnosis.evidence import ANGLE_DEG, BOX_IOU, DISTANCE_M, Bools, Evidence, finite
from pytest_cpas.diagnosis.fitted import fitted_lengths, fitted_offsets, part_flips, wrong_boxes
from pytest_cpas.diagnosis.mistakes import READINGS, Mistake, cameras, object_frames, units
from pytest_cpas.evaluation.estimates import Estimates
from pytest_cpas.metrics.precision import Count
from pytest_cpas.types import some_of
from pytest_cpas.types.samples import ALL

#: An explanation must make at least this share of the answers correct that were not.
REPAIRED = 0.1

#: ... or, with a number that was fitted, or with half turns in a part of them alone, this share,
_FITTED = 0.2

#: ... and repair this many for one that it breaks.
_REPAIRED_PER_BROKEN = 4

#: The probability that chance alone makes one of all explanations pass.
_FALSE_ALARMS = 1e-3

#: A mistake more must repair this share of the answers more.
_WORTH = 0.02

#: Explanations that differ by less than this share are equally good.
_TIE = 0.005

#: Other samples' truths that each answer is compared with to see what chance does.
_SHUFFLES = 8

#: A number that was fitted must hold in so many scenes.
_SCENES = 3

#: Samples among which explanations of all samples are searched; the best one is judged on all.
_SEARCHED = 4000

#: An explanation, and the names of those that are as good.
_Best = tuple[tuple[Mistake, ...], tuple[str, ...]]

Part = Literal["pose", "position", "rotation", "box"]

_MEASURES: dict[Part, str] = {
    "pose": f"at {ANGLE_DEG:g} deg, {100 * DISTANCE_M:g} cm",
    "position": f"in position, at {100 * DISTANCE_M:g} cm",
    "rotation": f"in rotation, at {ANGLE_DEG:g} deg",
    "box": f"at IoU {BOX_IOU:g}",
}


@dataclass(frozen=True)
class Explanation:
    """Mistakes that explain wrong answers of a ``category`` (or "all"), with the counts of samples
    correct ``before`` and ``after`` they are undone; ``ties`` names what would explain as much;
    ``of_file``: there is no code of a method to change, but what writes a file of answers.
    """

    category: str
    part: Part
    mistakes: tuple[Mistake, ...]
    before: Count
    after: Count
    ties: tuple[str, ...] = ()
    of_file: bool = False

    @property
    def name(self) -> str:
        """The names of the mistakes."""
        return _name(self.mistakes)

    def lines(self) -> list[str]:
        """In words: what is wrong, what undoing it repairs, what to change."""
        where = "" if self.category == ALL else f"{self.category}: "
        words = ", and ".join(mistake.words for mistake in self.mistakes)
        cures = [mistake.cure for mistake in self.mistakes]
        cure = "both" if len(set(cures)) < len(cures) else " and ".join(cures)
        share = 100 * self.after.precision
        lines = [
            f"{where}{words}: with {cure} {share:.0f} % of the samples are correct"
            f" ({self.after.correct} of {self.after.total}, before {self.before.correct};"
            f" {_MEASURES[self.part]})"
        ]
        for mistake in self.mistakes:
            fix = mistake.fix_of_numbers if self.of_file else mistake.fix
            lines.append(f"  change{' where the file is written' * self.of_file}: {fix}")
        if self.ties:
            lines.append(f"  these samples cannot tell it from {some_of(self.ties)}")
        return lines


def diagnose(evidence: Evidence) -> list[Explanation]:
    """What explains the wrong answers: of all samples, then of single categories, then of boxes.

    Empty if nothing does. Pure; the same evidence gives the same explanations.
    """
    explanations, evidence = _explain_poses(evidence)
    for category in sorted(set(evidence.category.tolist())):
        part = evidence.of_category(category)
        if _share(part) >= 0.5:
            continue
        found = _explain(part, "pose", category) or _explain_flips(part, category)
        if found is not None:
            explanations.append(found)
            chosen = evidence.category == category
            evidence = _with(evidence, chosen, _undone(part.answers, found.mistakes))
    box = _explain_boxes(evidence)
    return explanations if box is None else [*explanations, box]


def _explain_poses(evidence: Evidence) -> tuple[list[Explanation], Evidence]:
    """Explain the poses as far as possible; where that fails, position or rotation alone."""
    explanations: list[Explanation] = []
    parts: list[Part] = ["pose", "position", "rotation"]
    while parts:
        found = _explain(evidence, parts[0], ALL)
        if found is None:
            parts.pop(0)
            continue
        explanations.append(found)
        evidence = replace(evidence, answers=_undone(evidence.answers, found.mistakes))
        parts = ["pose"] if found.part == "pose" else ["pose", *parts[1:]]
    return explanations, evidence


def _undone(answers: Estimates, mistakes: Sequence[Mistake]) -> Estimates:
    for mistake in mistakes:
        answers = mistake.undo(answers)
    return answers


def _with(evidence: Evidence, chosen: Bools, answers: Estimates) -> Evidence:
    """The evidence with other answers of the chosen samples."""
    old = evidence.answers
    merged = Estimates(old.rotation.copy(), old.translation.copy(), old.extents.copy())
    merged.rotation[chosen] = answers.rotation
    merged.translation[chosen] = answers.translation
    merged.extents[chosen] = answers.extents
    return replace(evidence, answers=merged)


def _share(evidence: Evidence) -> float:
    return float(_correct(evidence, evidence.answers, "pose").mean())


def _correct(
    evidence: Evidence,
    answers: Estimates,
    part: Part,
    near_order: NDArray[np.int64] | None = None,
    turned_order: NDArray[np.int64] | None = None,
) -> Bools:
    """Which samples are correct in a part; compared with other samples' truths if ordered."""
    correct = np.ones(len(evidence), dtype=bool)
    if part != "rotation":
        correct &= evidence.near(answers, near_order)
    if part != "position":
        correct &= evidence.turned(answers, evidence.axes[None], turned_order)[0]
    return correct


# -- poses -----------------------------------------------------------------------------------


def _explain(evidence: Evidence, part: Part, category: str) -> Explanation | None:
    """The best explanation of a part of the poses, if it is believable."""
    if not len(evidence):
        return None
    searched = evidence
    if category == ALL:  # origins are fitted to each sample, and need them all
        searched = evidence.part(np.arange(len(evidence)) % (len(evidence) // _SEARCHED + 1) == 0)
    every = list(_candidates(searched, part, origins=category != ALL))
    usual = [pair for pair in every if not any(mistake.fitted for mistake in pair[0])]
    for candidates in (every, usual):
        best = _best(candidates, len(searched))
        found = _believed(evidence, part, category, best, len(every))
        if found is not None:
            return found
    return None


def _explain_flips(evidence: Evidence, category: str) -> Explanation | None:
    candidates = []
    for mistake in part_flips(evidence):
        correct = _correct(evidence, mistake.undo(evidence.answers), "pose")
        candidates.append(((mistake,), int(correct.sum())))
    best = _best(candidates, len(evidence))
    return _believed(evidence, "pose", category, best, len(candidates))


def _believed(
    evidence: Evidence, part: Part, category: str, best: _Best, tried: int
) -> Explanation | None:
    """The best of so many that were tried, if it is believable."""
    mistakes, ties = best
    before = _correct(evidence, evidence.answers, part)
    answers = _undone(evidence.answers, mistakes)
    after = _correct(evidence, answers, part)
    fitted = any(mistake.fitted for mistake in mistakes)
    if not _believable(evidence, part, before, answers, tried, _FITTED if fitted else REPAIRED):
        return None
    if fitted and not _general(evidence, before, after):
        return None
    return Explanation(
        category,
        part,
        mistakes,
        Count(int(before.sum()), evidence.total),
        Count(int(after.sum()), evidence.total),
        ties,
    )


def _best(candidates: Sequence[tuple[tuple[Mistake, ...], int]], size: int) -> _Best:
    """The explanation that makes most of ``size`` samples correct, and those that are as good.

    A mistake more must be worth it, a fitted number twice.
    """
    costs = [sum(1 + mistake.fitted for mistake in mistakes) for mistakes, _ in candidates]
    worth = [
        count - _WORTH * size * cost for (_, count), cost in zip(candidates, costs, strict=True)
    ]
    good = [i for i, value in enumerate(worth) if value >= max(worth) - _TIE * size]
    best = min(good, key=costs.__getitem__)
    ties = [candidates[i][0] for i in good if i != best and costs[i] == costs[best]]
    return candidates[best][0], tuple(_name(mistakes) for mistakes in ties)


def _name(mistakes: Sequence[Mistake]) -> str:
    return " + ".join(mistake.name for mistake in mistakes)


def _candidates(
    evidence: Evidence, part: Part, *, origins: bool
) -> Iterator[tuple[tuple[Mistake, ...], int]]:
    """Explanations of one or two mistakes, the usual ones first, and how many they make correct."""
    frames = object_frames(evidence) if part != "position" else []
    turns = np.stack([evidence.axes, *(frame.turn for frame in frames if frame.turn is not None)])
    readings = [m for m in READINGS if part != "position" or m.name == "pose-inverse"]
    seen = [m for m in cameras(evidence) if part == "pose" or not m.name.endswith(_other(part))]
    for reading, camera in itertools.product([None, *readings], [None, *seen]):
        first = tuple(m for m in (reading, camera) if m is not None)
        answers = _undone(evidence.answers, first)
        turned = np.ones((1, len(evidence)), dtype=bool)
        if part != "position":
            turned = evidence.turned(answers, turns if len(first) < 2 else turns[:1])
        lengths: list[Mistake] = []
        if part != "rotation" and len(first) < 2:
            lengths = [*units(), *fitted_lengths(evidence, answers)]
            if origins:
                lengths += fitted_offsets(evidence, answers)
        for length in (None, *lengths):
            second = first if length is None else (*first, length)
            near = np.ones(len(evidence), dtype=bool)
            if part != "rotation":
                near = evidence.near(_undone(answers, second[len(first) :]))
            counts = np.count_nonzero(turned & near, axis=1)
            for frame, count in zip([None, *frames], counts.tolist(), strict=False):
                mistakes = second if frame is None else (*second, frame)
                if 1 <= len(mistakes) <= 2:
                    yield mistakes, count


def _other(part: Part) -> str:
    return "-translation" if part == "rotation" else "-rotation"


def _chance(evidence: Evidence, answers: Estimates, part: Part, of: Bools) -> float:
    """The share of these samples that is correct if what was changed is compared with other
    samples' truths."""
    moved = not np.array_equal(answers.translation, evidence.answers.translation)
    turned = not np.array_equal(answers.rotation, evidence.answers.rotation)
    correct = 0
    for order in _orders(evidence):
        orders = order if moved else None, order if turned else None
        correct += int(_correct(evidence, answers, part, *orders)[of].sum())
    return (correct + 1) / (_SHUFFLES * int(of.sum()) + 2)


def _orders(evidence: Evidence) -> Iterator[NDArray[np.int64]]:
    """Ways to give every sample the truth of another one, of its category if there is one."""
    members = [np.flatnonzero(evidence.category == name) for name in np.unique(evidence.category)]
    groups = [group for group in members if len(group) > 1]
    groups.append(np.concatenate([group[: len(group) == 1] for group in members]))
    for shuffle in range(1, _SHUFFLES + 1):
        order = np.arange(len(evidence))
        for group in groups:
            # far apart, since neighbours are alike in a video
            order[group] = np.roll(group, max(1, len(group) * shuffle // (_SHUFFLES + 1)))
        yield order


def _believable(
    evidence: Evidence, part: Part, before: Bools, answers: Estimates, tried: int, least: float
) -> bool:
    """Whether ``answers`` repair enough, and more than any other object's would."""
    size, wrong = len(before), ~before
    after = _correct(evidence, answers, part)
    repaired, broken = int((after & wrong).sum()), int((before & ~after).sum())
    if not _worthwhile(repaired, broken, size, least):
        return False
    chance = _chance(evidence, answers, part, wrong)
    return repaired >= chance * int(wrong.sum()) + least * size and _significant(
        repaired, int(wrong.sum()), chance, tried
    )


def _general(evidence: Evidence, before: Bools, after: Bools) -> bool:
    """Whether most scenes gain: a fitted number can be the method's error in one of them."""
    if evidence.scene is None:
        return True
    scenes = [evidence.scene == name for name in np.unique(evidence.scene)]
    gaining = sum(int(after[scene].sum()) > int(before[scene].sum()) for scene in scenes)
    return gaining >= max(_SCENES, len(scenes) / 2)


def _worthwhile(repaired: int, broken: int, size: int, least: float) -> bool:
    return repaired - broken >= least * size and repaired >= _REPAIRED_PER_BROKEN * broken


def _significant(correct: int, size: int, chance: float, tried: int) -> bool:
    """Whether so many are hardly correct by chance, for any of the explanations tried."""
    return bool(tried * betainc(correct, size - correct + 1, chance) < _FALSE_ALARMS)


# -- boxes -----------------------------------------------------------------------------------


def _explain_boxes(evidence: Evidence) -> Explanation | None:
    """The best explanation of wrong extents, if it is believable."""
    given = finite(evidence.answers.extents)
    if not given.any():
        return None
    part = evidence.part(given)
    before = part.sized(part.answers.extents)
    candidates = [
        ((mistake,), int(part.sized(mistake.undo(part.answers).extents).sum()))
        for mistake in wrong_boxes(part)
    ]
    mistakes, ties = _best(candidates, len(part))
    answers = _undone(part.answers, mistakes)
    sized = part.sized(answers.extents)
    gained, lost = int((sized & ~before).sum()), int((before & ~sized).sum())
    if not _worthwhile(gained, lost, len(part), REPAIRED):
        return None
    # extents of a category are much alike, so that other samples' truths tell nothing: chance
    # repairs as often as it breaks
    if not _significant(gained, gained + lost, 0.5, len(candidates)):
        return None
    correct, repaired = (int(part.boxes(each).sum()) for each in (part.answers, answers))
    if repaired <= correct:
        return None
    before_after = Count(correct, evidence.total), Count(repaired, evidence.total)
    return Explanation(ALL, "box", mistakes, *before_after, ties)
