"""What the checks of a data set measured, and their verdicts."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from pytest_cpas.checks.dataset.facts import Survey
from pytest_cpas.checks.dataset.orientations import REACH, up_axis_spread
from pytest_cpas.checks.dataset.verdicts import DatasetWord
from pytest_cpas.report.terminal._table import FEW, Terminal
from pytest_cpas.types import Verdict
from pytest_cpas.types.samples import ALL


def print_survey(
    terminal: Terminal, survey: Survey, selected: int, verdicts: Sequence[Verdict]
) -> None:
    """Print a line per check, residuals per category, how the up axes are spread, and counts."""
    terminal.section(f"data set {survey.name}")
    for line in survey.missing:
        terminal.write_line(f"missing: {line}")
    for verdict in verdicts:
        first, *rest = verdict.details.splitlines() or [""]
        more = f" (and {len(rest)} more lines above)" if rest else ""
        terminal.write_line(
            f"{verdict.subject:13} {verdict.word.value:7} {first}{more}".rstrip(),
            red=verdict.word is DatasetWord.FAILED,
            green=verdict.word is DatasetWord.PASSED,
            yellow=verdict.word is DatasetWord.KNOWN,
        )
    terminal.write_line("")
    if survey.samples:
        if len(survey.samples) <= FEW or terminal.config.get_verbosity() > 0:
            terminal.write_table(_sample_lines(survey))
        terminal.write_table(_category_lines(survey))
        spread = up_axis_spread(survey.up_axes)
        terminal.write_line(
            f"up axes: mean resultant length {spread.resultant:.3f}; within {REACH:.0f} deg of"
            f" {spread.coverage:.0%} of what {spread.count} uniform directions reach"
        )
    words = [verdict.word for verdict in verdicts]
    counts = ", ".join(f"{words.count(word)} {word.value}" for word in DatasetWord if word in words)
    part = f" ({selected} selected)" if selected < len(survey.refs) else ""
    terminal.write_line(
        f"{survey.name}: {survey.examined} of {len(survey.refs)} samples{part} examined, with"
        f" {len(survey.meshes)} meshes; {len(verdicts)} checks: {counts}"
    )


def _sample_lines(survey: Survey) -> list[list[str]]:
    lines = [["sample", "category", "|depth| median", "signed", "IoU"]]
    for facts in survey.samples.values():
        image = facts.image
        cells = ["n/a"] * 3
        if image is not None and image.residual is not None and image.offset is not None:
            cells[:2] = [f"{1000 * image.residual:.1f} mm", f"{1000 * image.offset:+.1f} mm"]
        if image is not None and image.iou is not None:
            cells[2] = f"{image.iou:.3f}"
        lines.append([facts.sample, facts.category, *cells])
    return lines


def _category_lines(survey: Survey) -> list[list[str]]:
    groups = defaultdict(list)
    for facts in survey.samples.values():
        groups[facts.category].append(facts.image)
        groups[ALL].append(facts.image)
    lines = [["category", "samples", "|depth| median", "95 %", "largest", "IoU median", "smallest"]]
    for category in (*sorted(groups.keys() - {ALL}), ALL):
        images = groups[category]
        residuals = [i.residual for i in images if i is not None and i.residual is not None]
        ious = [i.iou for i in images if i is not None and i.iou is not None]
        cells = ["n/a"] * 5
        if residuals:
            cells[:3] = [f"{1000 * q:.1f} mm" for q in np.quantile(residuals, [0.5, 0.95, 1])]
        if ious:
            cells[3:] = [f"{q:.3f}" for q in np.quantile(ious, [0.5, 0])]
        lines.append([category, str(len(images)), *cells])
    return lines
