"""From answers to facts, in batches."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence

from pytest_cpas.facts.answers import AnswerBatch
from pytest_cpas.facts.catalogue import fact
from pytest_cpas.facts.fact import Facts
from pytest_cpas.types import Camera, GroundTruth, Hypothesis, Symmetry

__all__ = ["failed_facts", "measure_facts"]


def measure_facts(
    names: Collection[str],
    truths: Sequence[GroundTruth],
    estimates: Sequence[Hypothesis],
    gives: Collection[str],
    cameras: Sequence[Camera | None] | None = None,
    others: Sequence[Sequence[Hypothesis]] | None = None,
) -> list[dict[str, float | None]]:
    """The facts of those ``names`` of every estimate, which is in the standard frames.

    ``gives``: what the method declares to give; a fact that needs more is None. ``cameras``: of
    each image, None where it is not known; ``others``: further hypotheses of each answer. Raises
    :class:`pytest_cpas.types.AnswerError` for an estimate that lacks what is declared, or that has
    a surface without area; :class:`pytest_cpas.types.DataError` for such a truth.
    """
    measured: list[dict[str, float | None]] = [dict.fromkeys(names) for _ in truths]
    wanted = [made for name in names if (made := fact(name)).needs <= set(gives)]
    groups: dict[tuple[Symmetry, Symmetry], list[int]] = defaultdict(list)
    for index, truth in enumerate(truths):
        groups[truth.symmetry, truth.symmetry_in_view or truth.symmetry].append(index)
    for symmetries, members in groups.items():
        batch = AnswerBatch(
            [truths[i] for i in members],
            [estimates[i] for i in members],
            *symmetries,
            cameras=[cameras[i] if cameras else None for i in members],
            others=[others[i] if others else () for i in members],
        )
        for made in wanted:
            for i, value in zip(members, made.compute(batch), strict=True):
                measured[i][made.name] = value
    return measured


def failed_facts(
    names: Collection[str],
    truth: GroundTruth,
    gives: Collection[str],
    camera: Camera | None = None,
) -> Facts:
    """The facts of a sample without an answer: no limit is met, and what is n/a stays so."""
    parts = {"shape": truth.surface, "camera": camera}
    known = {name for name, part in parts.items() if part is not None}
    return {
        name: made.failed
        if (made := fact(name)).needs <= set(gives) and made.knows <= known
        else None
        for name in names
    }
