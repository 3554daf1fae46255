"""Average precision against that of a golden table, and the detections that changed sides."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pytest_cpas.golden.pairing import first_few, mean_the_same
from pytest_cpas.golden.tables import RunTable
from pytest_cpas.protocols import Ranking

__all__ = ["RankingChange", "ranking_changes"]

#: Average precisions that differ by less are sums of the same numbers in another order.
_SAME = 1e-12


@dataclass(frozen=True)
class RankingChange:
    """What changed in a column that ranks detections: by how much it is better, in words."""

    gain: float
    lines: Sequence[str]


def ranking_changes(golden: RunTable, new: RunTable, category: str) -> Iterator[RankingChange]:
    """The columns of both tables whose average precision, or whose detections, are other ones."""
    if golden.ranking is None or new.ranking is None:
        return
    old = {column.key: (index, column) for index, column in enumerate(golden.ranking_columns)}
    for index, column in enumerate(new.ranking_columns):
        if column.key not in old or not mean_the_same(golden, new, old[column.key][1], column):
            continue
        before, after = (t.scores.get(category, {}).get(column.key) for t in (golden, new))
        if before is None or after is None:
            if before is not after:
                yield RankingChange(0.0, [f"{column.label}: n/a changed"])
            continue
        moved = _moved(golden.ranking, new.ranking, category, (old[column.key][0], index))
        gain = after.value - before.value
        if abs(gain) < _SAME and before.samples == after.samples and not moved:
            continue
        counted = "" if before.samples == after.samples else f" of {before.samples}"
        head = (
            f"{column.label}: {100 * before.value:.4g} %{counted} -> {100 * after.value:.4g} % of"
            f" {after.samples} objects"
        )
        yield RankingChange(0.0 if abs(gain) < _SAME else gain, [head, *moved])


def _moved(golden: Ranking, new: Ranking, category: str, index: tuple[int, int]) -> list[str]:
    """The detections that changed sides, in words; those of one ranking alone are wrong in the
    other."""
    sides: dict[str, list[str]] = {"lost": [], "gained": []}
    names = {
        name
        for ranking in (golden, new)
        for name, detection in ranking.detections.items()
        if detection.category == category
    }
    for name in sorted(names):
        was, now = (
            name in ranking.detections and ranking.detections[name].outcome[i] == "1"
            for ranking, i in zip((golden, new), index, strict=True)
        )
        if was != now:
            sides["lost" if was else "gained"].append(name)
    lines = []
    for what, moved in sides.items():
        if moved:
            lines.append(f"    {what}: {first_few(moved)}")
    return lines
