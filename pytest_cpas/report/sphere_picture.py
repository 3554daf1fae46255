"""Where up axes point, as a picture: the PNG of ``--cpas-pictures``."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from pytest_cpas._files import write_file
from pytest_cpas.checks.dataset.orientations import lambert, up_axis_spread
from pytest_cpas.report.sphere import DIRECTIONS, RINGS, STRONGER
from pytest_cpas.types import Array

_PANEL, _MARGIN, _SCALE = 400, 24, 2
_RADIUS = _PANEL // 2 - _MARGIN
_INK, _PALE, _DOT = (40, 40, 40), (190, 190, 190), (20, 90, 170)

#: On which side of its place, of Pillow's anchors, the name of a direction stands.
_ANCHORS = {"up": "mm", "right": "lm", "left": "rm", "away": "mb", "towards camera": "mt"}


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
        lines = [f"{name}: {len(up)} samples", ""]
        if spread is not None:
            length, coverage = f"{spread.resultant:.3f}", f"{spread.coverage:.0%}"
            lines[1] = f"mean resultant length {length}, coverage {coverage}"
        middle = _SCALE * _PANEL // 2
        for row, text in enumerate(lines, 1):
            at = (middle, _SCALE * (_PANEL - _MARGIN // 2 + row * _MARGIN))
            draw.text(at, text, _INK, font=ImageFont.load_default(_SCALE * 14), anchor="mm")
        picture.paste(panel, (_SCALE * _PANEL * index, 0))
    small = picture.resize((size[0] // _SCALE, size[1] // _SCALE), Image.Resampling.LANCZOS)
    content = io.BytesIO()
    small.save(content, format="PNG")
    write_file(path, content.getvalue())
    return path


def _draw_panel(up: Array) -> Image.Image:
    """The disc of one data set, at :data:`_SCALE` times its size."""
    side, height = _SCALE * _PANEL, _SCALE * (_PANEL + 3 * _MARGIN)
    middle = side / 2
    canvas = Image.new("RGB", (side, height), "white")
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(_SCALE * 11)
    for angle in RINGS:
        r = _SCALE * _RADIUS * np.sin(np.radians(angle) / 2)
        outline = _INK if angle in STRONGER else _PALE
        draw.ellipse([middle - r, middle - r, middle + r, middle + r], outline=outline, width=2)
    canvas.paste(_DOT, (0, 0), Image.fromarray(_density(up, height, side)))
    r = _SCALE * _RADIUS / np.sqrt(2)
    for name, across, down in DIRECTIONS:
        at = (middle + r * across, middle + r * down)
        draw.text(at, name, _INK, font=font, anchor=_ANCHORS[name])
    rim = (middle, middle + _SCALE * _RADIUS)
    draw.text(rim, "rim: down", _INK, font=font, anchor="mt")
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
