"""What the checks of a data set found, in the terminal and as a picture."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from pytest_cpas.checks.dataset.facts import Survey
from pytest_cpas.checks.dataset.orientations import REACH, lambert, up_axis_spread
from pytest_cpas.checks.dataset.verdicts import Verdict, Word
from pytest_cpas.report.terminal import print_table
from pytest_cpas.types import Array

__all__ = ["draw_up_axes", "print_survey"]

#: A survey of at most this many samples shows each of them.
_FEW = 20

_PANEL, _MARGIN, _SCALE = 400, 24, 2
_RADIUS = _PANEL // 2 - _MARGIN
_INK, _PALE, _DOT = (40, 40, 40), (190, 190, 190), (20, 90, 170)


def print_survey(
    terminal: pytest.TerminalReporter, survey: Survey, selected: int, verdicts: Sequence[Verdict]
) -> None:
    """Print a line per check, residuals per category, how the up axes are spread, and counts."""
    terminal.section(f"data set {survey.name}", bold=True)
    for line in survey.missing:
        terminal.write_line(f"missing: {line}")
    for verdict in verdicts:
        first, *rest = verdict.message.splitlines() or [""]
        more = f" (and {len(rest)} more lines above)" if rest else ""
        terminal.write_line(
            f"{verdict.check:13} {verdict.word.value:7} {first}{more}".rstrip(),
            red=verdict.word is Word.FAILED,
            green=verdict.word is Word.PASSED,
            yellow=verdict.word is Word.KNOWN,
        )
    terminal.write_line("")
    if survey.samples:
        if len(survey.samples) <= _FEW or terminal.config.get_verbosity() > 0:
            print_table(terminal, _sample_lines(survey))
        print_table(terminal, _category_lines(survey))
        spread = up_axis_spread(survey.up_axes)
        terminal.write_line(
            f"up axes: mean resultant length {spread.resultant:.3f}; within {REACH:.0f} deg of"
            f" {spread.coverage:.0%} of what {spread.count} uniform directions reach"
        )
    words = [verdict.word for verdict in verdicts]
    counts = ", ".join(f"{words.count(word)} {word.value}" for word in Word if word in words)
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
        groups["all"].append(facts.image)
    lines = [["category", "samples", "|depth| median", "95 %", "largest", "IoU median", "smallest"]]
    for category in (*sorted(groups.keys() - {"all"}), "all"):
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


def draw_up_axes(up_axes: Mapping[str, Array], path: Path) -> Path:
    """Draw where the up axes (n, 3, camera frame) of each data set point; returns ``path``.

    One disc per data set shows the whole sphere in Lambert's equal-area projection: its middle is
    the image's up (-y), its rim the image's down; to the right is the camera's right (+x), below
    the middle is what points towards the camera (-z). Rings are 30 degrees apart.
    """
    size = (_SCALE * _PANEL * max(1, len(up_axes)), _SCALE * (_PANEL + 3 * _MARGIN))
    picture = Image.new("RGB", size, "white")
    for index, (name, up) in enumerate(up_axes.items()):
        panel = _draw_panel(up)
        draw = ImageDraw.Draw(panel)
        spread = up_axis_spread(up) if len(up) else None
        words = "" if spread is None else f"mean resultant length {spread.resultant:.3f}, "
        words += "" if spread is None else f"coverage {spread.coverage:.0%}"
        middle = _SCALE * _PANEL // 2
        for text, row in ((f"{name}: {len(up)} samples", 1), (words, 2)):
            at = (middle, _SCALE * (_PANEL - _MARGIN // 2 + row * _MARGIN))
            draw.text(at, text, _INK, font=ImageFont.load_default(_SCALE * 14), anchor="mm")
        picture.paste(panel, (_SCALE * _PANEL * index, 0))
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    picture.resize((size[0] // _SCALE, size[1] // _SCALE), Image.Resampling.LANCZOS).save(
        unfinished, format="PNG"
    )
    unfinished.replace(path)
    return path


def _draw_panel(up: Array) -> Image.Image:
    """The disc of one data set, at :data:`_SCALE` times its size."""
    side, height = _SCALE * _PANEL, _SCALE * (_PANEL + 3 * _MARGIN)
    middle = side / 2
    canvas = Image.new("RGB", (side, height), "white")
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(_SCALE * 11)
    for angle in (30, 60, 90, 120, 150, 180):
        r = _SCALE * _RADIUS * np.sin(np.radians(angle) / 2)
        outline = _INK if angle in (90, 180) else _PALE
        draw.ellipse([middle - r, middle - r, middle + r, middle + r], outline=outline, width=2)
    canvas.paste(_DOT, (0, 0), Image.fromarray(_density(up, height, side)))
    r = _SCALE * _RADIUS / np.sqrt(2)
    for text, x, y, anchor in (
        ("up", 0.0, 0.0, "mm"),
        ("right", r, 0.0, "lm"),
        ("left", -r, 0.0, "rm"),
        ("away", 0.0, -r, "mb"),
        ("towards camera", 0.0, r, "mt"),
        ("rim: down", 0.0, r * np.sqrt(2), "mt"),
    ):
        draw.text((middle + x, middle + y), text, _INK, font=font, anchor=anchor)
    return canvas


def _density(up: Array, height: int, side: int) -> NDArray[np.uint8]:
    """Opacity (height, side) of dots at the projected directions."""
    places = np.round(side / 2 + _SCALE * _RADIUS * lambert(up)).astype(int)
    columns, rows = places.T
    counts = np.zeros((height, side))
    np.add.at(counts, (np.clip(rows, 0, height - 1), np.clip(columns, 0, side - 1)), 1)
    radius, opacity = (4, 0.8) if len(up) < 500 else (2, 0.25)
    span = np.arange(-_SCALE * radius, _SCALE * radius + 1)
    dot = (span[:, None] ** 2 + span[None, :] ** 2 <= (_SCALE * radius) ** 2).astype(float)
    covered = 1 - (1 - opacity) ** ndimage.convolve(counts, dot, mode="constant")
    shade: NDArray[np.uint8] = np.round(255 * covered).astype(np.uint8)
    return shade
