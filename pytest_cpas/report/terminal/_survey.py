"""What the checks of a data set measured, and their verdicts."""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from pytest_cpas.checks.dataset.facts import SampleFacts, Survey
from pytest_cpas.checks.dataset.orientations import REACH, up_axis_spread
from pytest_cpas.checks.dataset.verdicts import DatasetWord
from pytest_cpas.reading.text import WIDTH
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
    if survey.derived_note:
        terminal.write_line(f"note: {survey.derived_note}")
    for line in survey.notes:
        for part in textwrap.wrap(f"note: {line}", WIDTH, subsequent_indent="  "):
            terminal.write_line(part)
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
        if image is not None and image.iou is not None and _published_mask(survey, facts):
            cells[2] = f"{image.iou:.3f}"
        lines.append([facts.sample, facts.category, *cells])
    return lines


def _category_lines(survey: Survey) -> list[list[str]]:
    groups = defaultdict(list)
    for facts in survey.samples.values():
        groups[facts.category].append(facts)
        groups[ALL].append(facts)
    lines = [["category", "samples", "|depth| median", "95 %", "largest", "IoU median", "smallest"]]
    for category in (*sorted(groups.keys() - {ALL}), ALL):
        images = [facts.image for facts in groups[category] if facts.image is not None]
        published = [f.image for f in groups[category] if f.image and _published_mask(survey, f)]
        residuals = [image.residual for image in images if image.residual is not None]
        ious = [image.iou for image in published if image.iou is not None]
        cells = ["n/a"] * 5
        if residuals:
            cells[:3] = [f"{1000 * q:.1f} mm" for q in np.quantile(residuals, [0.5, 0.95, 1])]
        if ious:
            cells[3:] = [f"{q:.3f}" for q in np.quantile(ious, [0.5, 0])]
        lines.append([category, str(len(groups[category])), *cells])
    return lines


def _published_mask(survey: Survey, facts: SampleFacts) -> bool:
    """Whether the mask is another thing than the silhouette that it would be compared with."""
    return not survey.compares_itself(facts.sample, "mask")
