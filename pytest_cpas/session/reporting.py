"""What is made of judged runs for people: documents, the report's folder, the terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pytest_cpas.documents import RunDocument
from pytest_cpas.report.against import against
from pytest_cpas.report.document import document, run_document
from pytest_cpas.report.files import write_report
from pytest_cpas.report.terminal import Terminal, print_robustness, print_run
from pytest_cpas.report.up_axes import up_axes
from pytest_cpas.session.collected import CollectedRun
from pytest_cpas.session.judging import JudgedRun
from pytest_cpas.types import Required

__all__ = ["Reporter"]


@dataclass(frozen=True, kw_only=True)
class Reporter:
    """How runs are reported.

    ``folder``: where the report goes, if one is asked for; ``others``: the documents of the runs to
    compare with; ``lists``: whether each of so many samples is named on the terminal.
    """

    require_golden: Required
    folder: Path | None
    others: Sequence[RunDocument]
    lists: Callable[[int], bool]

    def document(self, judged: JudgedRun) -> RunDocument:
        """The document of one run."""
        collected = judged.collected
        return run_document(
            judged.run,
            judged.table,
            errors=collected.errors,
            verdicts=judged.verdicts,
            require_golden=self.require_golden,
            contract=collected.contract.values(),
            findings=judged.explanations,
            golden=judged.golden,
            speed=collected.speed,
            parity=collected.parity,
            # a large run has too many samples to list them for nobody
            samples=self.folder is not None or self.lists(len(judged.table.samples)),
        )

    def write(
        self, collected: Sequence[CollectedRun], documents: Sequence[RunDocument], failed_items: int
    ) -> Path | None:
        """Write the report and return its page; :class:`OSError` if a disk does not take it.

        ``documents``: those of the ``collected`` runs; ``failed_items`` counts the items of the
        session that have failed. None if no report is asked for.
        """
        if self.folder is None:
            return None
        from pytest_cpas.report.pictures import pictures  # Pillow, for a report only

        documents = [
            {**told, "up_axes": up_axes(each.run, each.ordered_rows)}
            for each, told in zip(collected, documents, strict=True)
        ]
        content = document(documents, failed_items, collected[0].run.protocols if collected else ())
        if self.others:
            content["against"] = against(content["runs"], self.others)
        rows = {each.run: each.rows for each in collected}
        drawn = pictures(list(rows), rows, documents, content.get("against"))
        values = {
            (each.run.method, each.run.dataset): each.value_pictures
            for each in collected
            if each.value_pictures
        }
        write_report(content, self.folder, drawn, values)
        return self.folder / "report.html"

    def print(
        self,
        terminal: Terminal,
        collected: Sequence[CollectedRun],
        documents: Sequence[RunDocument],
    ) -> None:
        """Print tables and verdicts of runs, and where their rows come from; of perturbed data that
        passes, only its curves."""
        points = [each.run.robustness_point for each in collected]
        shown = list(zip(points, documents, strict=False))  # not all are judged if that broke off
        for each, (point, run) in zip(collected, shown, strict=False):
            sound = not any(verdict["outcome"] == "failed" for verdict in run["verdicts"])
            if point and sound and terminal.config.get_verbosity() <= 0:
                continue  # a point of the curves below
            print_run(terminal, run, each.origin)
        print_robustness(terminal, shown)
