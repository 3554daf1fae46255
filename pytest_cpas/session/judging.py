"""A collected run is judged: its table against the golden one, and what explains a bad verdict.

Plain values in, a :class:`JudgedRun` out; what is reported of it is
:mod:`pytest_cpas.session.reporting`'s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pytest_cpas.checks.contract import CONTRACT
from pytest_cpas.diagnosis import Explanation
from pytest_cpas.diagnosis.running import diagnose_run, expected_precision
from pytest_cpas.evaluation import Run, named
from pytest_cpas.golden import (
    ALARM,
    GoldenError,
    RunTable,
    Word,
    compare,
    compare_published,
    find_golden,
    left_over,
    published_cells,
    read_tables,
    record,
    recorded_words,
)
from pytest_cpas.report.intervals import interval_table
from pytest_cpas.session.collected import CollectedRun
from pytest_cpas.types import Verdict
from pytest_cpas.types.samples import ALL

__all__ = ["JudgedRun", "judge", "record_run"]


@dataclass(frozen=True, kw_only=True, eq=False)
class JudgedRun:
    """A run, its table and its verdicts.

    ``golden``: the golden table it was compared with; ``explanations``: the usual mistakes that
    explain a table far below the expected one. Both are lacking in a run that was interrupted.
    """

    collected: CollectedRun
    table: RunTable
    golden: RunTable | None = None
    verdicts: Sequence[Verdict] = ()
    explanations: Sequence[Explanation] = ()

    @classmethod
    def unjudged(cls, collected: CollectedRun) -> JudgedRun:
        """What there is of a run that was interrupted."""
        return cls(collected=collected, table=RunTable.of(collected.run, collected.ordered_rows))

    @property
    def run(self) -> Run:
        """What was judged."""
        return self.collected.run


def judge(collected: CollectedRun, folder: Path, *, alarm: float = ALARM) -> JudgedRun:
    """Compare a run with its golden table below ``folder``; if there is none, with the paper.

    ``alarm``: see :func:`pytest_cpas.golden.compare`.
    """
    table = RunTable.of(collected.run, collected.ordered_rows)
    golden, damage = _golden(collected.run, folder)
    verdicts = [damage] if damage else _verdicts(collected, table, golden, alarm)
    hint = _more_seeds_needed(collected.run, golden) if golden else []
    verdicts = [
        verdict
        if verdict.passed
        else replace(verdict, details="\n  ".join([verdict.details, *hint]))
        for verdict in verdicts
    ]
    return _explained(collected, table, golden, verdicts)


def record_run(
    collected: CollectedRun, folder: Path, *, failed_items: int, alarm: float = ALARM
) -> JudgedRun:
    """Record the table of a run as its golden one below ``folder``, or say why not.

    ``failed_items`` counts the items of the session that have failed. The verdict says which losses
    the table can show with ``alarm``.
    """
    table = RunTable.of(collected.run, collected.ordered_rows)
    golden, _ = _golden(collected.run, folder)
    run = collected.run
    try:
        if failed_items or run.damaged:
            raise GoldenError(f"{failed_items} items failed; a golden table needs none to")
        if run.under_contract and len(collected.contract) < len(CONTRACT):
            raise GoldenError("the contract of the method was not checked; leave out -k")
        changed = [name for name, told in run.changed_meanwhile(thoroughly=True).items() if told]
        if changed:
            raise GoldenError(
                f"{named(changed)}: changed since the run began, so nobody knows which program's"
                " table this is; run the same command again"
            )
        written = record(folder, table)
        lines = [str(written), *recorded_words(read_tables(written)[run.dataset], alarm)]
        lines += _more_seeds_needed(run, table)
        if left := left_over(folder, run.method, run.dataset):
            lines.append(f"note: {left} is read no more, and could not be removed; remove it")
        verdict = Verdict(Word.RECORDED, ALL, "\n  ".join(lines))
    except GoldenError as error:
        verdict = Verdict(Word.NOT_RECORDED, ALL, str(error))
    return _explained(collected, table, golden, [verdict])


def _golden(run: Run, folder: Path) -> tuple[RunTable | None, Verdict | None]:
    """The golden table of a run, or the verdict that it is damaged."""
    try:
        return find_golden(folder, run.method, run.dataset), None
    except GoldenError as error:
        return None, Verdict(Word.DAMAGED, ALL, str(error))


def _verdicts(
    collected: CollectedRun, table: RunTable, golden: RunTable | None, alarm: float
) -> list[Verdict]:
    """Against the golden table; where there is none, against the published counts."""
    run = collected.run
    excluded = collected.excluded({*run.listed, *(golden.listed if golden else ())})
    if golden is None and table.samples:
        cells = published_cells(run.dataset, run.method)
        if excluded:  # and then a figure over all categories is none over those that were asked for
            cells = [cell for cell in cells if cell.category not in {*excluded, ALL}]
        if verdicts := compare_published(cells, table.table, interval_table(table)):
            return verdicts
    return compare(golden, table, alarm=alarm, excluded=excluded)


def _explained(
    collected: CollectedRun,
    table: RunTable,
    golden: RunTable | None,
    verdicts: Sequence[Verdict],
) -> JudgedRun:
    """The judged run; its bad verdicts say what explains them."""
    run = collected.run
    expected = expected_precision(golden, run)
    explanations = diagnose_run(run, collected.ordered_rows, table, expected)
    return JudgedRun(
        collected=collected,
        table=table,
        golden=golden,
        verdicts=[_with_reasons(verdict, explanations) for verdict in verdicts],
        explanations=explanations,
    )


def _more_seeds_needed(run: Run, golden: RunTable) -> list[str]:
    """What to do about a table of one seed of a method whose answers vary."""
    if run.info is None or run.info.deterministic or golden.seeds > 1:
        return []
    return [
        f"note: {run.method} declares deterministic=False, and the golden table is of one seed,"
        " beside which no flip is allowed; record several seeds of the same program (--cpas-jitter"
        " 10 --snapshot-update)"
    ]


def _with_reasons(verdict: Verdict, explanations: Sequence[Explanation]) -> Verdict:
    if verdict.passed:
        return verdict
    lines = [
        f"\n  {line}"
        for explanation in explanations
        if ALL in (explanation.category, verdict.category)
        or explanation.category == verdict.category
        for line in explanation.lines()
    ]
    return replace(verdict, details=verdict.details + "".join(lines))
