"""Small pictures of a value and of the reference's: what is like an image, and points.

An image is what has two long axes; of more channels than colours have those are drawn that differ
most. Points are a list of two or three coordinates. All else has no picture.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from pytest_cpas.report.panels import RAMPS, Panel, Scale, ValuePictures
from pytest_cpas.report.reconstruction import GROUND

__all__ = ["value_pictures"]

Real = NDArray[np.float64]
Colours = NDArray[np.uint8]

#: The longer side of a picture, pixels.
SIDE = 256
#: The shorter axis of an image at least; the longer is at most so many times as long.
FEWEST, LONGEST = 8, 8
#: Channels that are drawn.
CHANNELS = 3
#: Points that are drawn.
POINTS = 3000
#: Numbers of a value that is drawn.
MOST_NUMBERS = 2**23
#: Larger differences are as good as infinite.
_HUGE = 1e100
#: What is drawn of a number that is none.
NOT_FINITE = (255, 0, 255)


def value_pictures(here: NDArray[Any], reference: NDArray[Any]) -> ValuePictures | None:
    """The reference's value, ours and their difference; None of what is no image and no points.

    Both are whole arrays.
    """
    with np.errstate(all="ignore"):  # they may hold anything
        return _drawn(here, reference)


def _drawn(here: NDArray[Any], reference: NDArray[Any]) -> ValuePictures | None:
    if here.shape != reference.shape or not 0 < here.size <= MOST_NUMBERS:
        return None
    if here.dtype.kind not in "biuf" or reference.dtype.kind not in "biuf":
        return None
    a, b = here.astype(float), reference.astype(float)
    axes = list(range(a.ndim))
    place: list[str] = []
    while a.ndim > 2 and (a.shape[0] == 1 or a.ndim > 3 or _are_lists(a)):
        at = _furthest(a, b)[0]
        if len(a) > 1:
            place.append(_at(at, axes[0], len(a)))
        a, b, axes = a[at], b[at], axes[1:]
    if "f" in (here.dtype.kind, reference.dtype.kind) and _are_points(a):
        return _points(a, b, place)
    rows = list(_images(a, b, axes, place))
    if not rows:
        return None
    remarks = []
    if max(a.shape) > SIDE:
        remarks.append(
            "there are more numbers than pixels: of those at one place the first is drawn, and of"
            " differences the largest"
        )
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        remarks.append("numbers that are not finite are magenta")
    return ValuePictures(rows=rows, remarks=remarks)


def _at(index: int, axis: int, length: int) -> str:
    return f"index {index} along axis {axis}, of {length}"


def _furthest(a: Real, b: Real) -> list[int]:
    """The places of the first axis, those that differ most first."""
    apart = np.abs(a - b).reshape(len(a), -1)
    sizes = (np.where(apart < _HUGE, apart, _HUGE) ** 2).sum(1)
    return [int(index) for index in np.argsort(-sizes, kind="stable")]


def _are_points(x: Real) -> bool:
    """(N, 2), (N, 3) or (3, N)."""
    if x.ndim != 2:
        return False
    rows, columns = map(int, x.shape)
    return (columns in (2, 3) and rows >= FEWEST) or (rows == 3 and columns >= FEWEST)


def _are_lists(x: Real) -> bool:
    """Several lists of points."""
    return x.ndim == 3 and _are_points(x[0]) and not _is_image(x.shape[:2])


def _is_image(shape: tuple[int, ...]) -> bool:
    return min(shape) >= FEWEST and max(shape) <= LONGEST * min(shape)


# -- images -------------------------------------------------------------------------------------


def _images(
    a: Real, b: Real, axes: list[int], place: list[str]
) -> Iterator[tuple[str, list[Panel]]]:
    """The rows of pictures of one with two or three axes; none of what is no image."""
    if a.ndim == 2 and _is_image(a.shape):
        yield "; ".join(place), _row(a, b)
    if a.ndim != 3:
        return
    if _is_image(a.shape[1:]):
        channels = 0
    elif _is_image(a.shape[:2]):
        channels = 2
    else:
        return
    if a.shape[2] == 3 and _is_image(a.shape[:2]):
        channels = 2
    a, b = np.moveaxis(a, channels, 0), np.moveaxis(b, channels, 0)
    if len(a) == 3:
        words = f"colours along axis {axes[channels]}"
        yield "; ".join([*place, words]), _colours(a, b)
        return
    for index in _furthest(a, b)[:CHANNELS]:
        where = _at(index, axes[channels], len(a))
        yield "; ".join([*place, where]), _row(a[index], b[index])


def _row(a: Real, b: Real) -> list[Panel]:
    """Reference, here and their difference, as grey images and a coloured one."""
    scale = _scale(a, b)
    apart = _largest(a - b)
    most = _most(apart)
    of_difference = Scale(ramp="differences", low=0 - most, high=most)
    return [
        _image("reference", _coloured(_thin(b), scale), scale),
        _image("here", _coloured(_thin(a), scale), scale),
        _image("here less reference", _coloured(apart, of_difference), of_difference),
    ]


def _colours(a: Real, b: Real) -> list[Panel]:
    """The same of (3, H, W), as colours; of the difference its largest part."""
    scale = _scale(a, b)
    apart = np.abs([_largest(x - y) for x, y in zip(a, b, strict=True)]).max(axis=0)
    of_difference = Scale(ramp="sizes", low=0.0, high=_most(apart))
    panels = []
    for title, x in (("reference", b), ("here", a)):
        parts = [_coloured(_thin(part), scale) for part in x]
        drawn = np.stack([part[..., 0] for part in parts], axis=-1)
        drawn[~np.isfinite([_thin(part) for part in x]).all(axis=0)] = NOT_FINITE
        panels.append(_image(title, drawn, scale))
    drawn = _coloured(apart, of_difference)
    return [*panels, _image("size of the difference", drawn, of_difference)]


def _scale(a: Real, b: Real) -> Scale:
    """From the least to the greatest number of both."""
    both = np.concatenate([x[np.isfinite(x)] for x in (a, b)])
    low, high = (float(both.min()), float(both.max())) if both.size else (0.0, 0.0)
    return Scale(ramp="values", low=low, high=high)


def _most(apart: Real) -> float:
    return float(np.abs(apart[np.isfinite(apart)]).max(initial=0.0))


def _starts(shape: tuple[int, ...]) -> list[NDArray[np.intp]]:
    """Along both axes, where the numbers of each pixel begin."""
    longest = max(*shape, SIDE)
    counts = [max(1, length * SIDE // longest) if longest > SIDE else length for length in shape]
    return [np.arange(n) * length // n for n, length in zip(counts, shape, strict=True)]


def _thin(x: Real) -> Real:
    return x[np.ix_(*_starts(x.shape))]


def _largest(x: Real) -> Real:
    """Of the numbers of each pixel the largest, whatever its sign; not finite where one is not."""
    rows, columns = _starts(x.shape)
    ends = []
    for most in (np.maximum, np.minimum):
        reached = most.reduceat(x, rows, axis=0)
        ends.append(most.reduceat(reached, columns, axis=1))
    largest: Real = np.where(np.abs(ends[0]) >= np.abs(ends[1]), *ends)
    return largest


def _coloured(x: Real, scale: Scale) -> Colours:
    """(..., 3): the colours of numbers."""
    ramp = np.array(RAMPS[scale.ramp], float)
    width = scale.high - scale.low
    above = np.where(np.isfinite(x), x, scale.low) - scale.low
    share = above / width if width > 0 else np.full(x.shape, 0.5)
    places = np.linspace(0, 1, len(ramp))
    parts = [np.interp(share, places, ramp[:, part]) for part in range(3)]
    drawn = np.round(np.stack(parts, axis=-1)).astype(np.uint8)
    drawn[~np.isfinite(x)] = NOT_FINITE
    return drawn


def _image(title: str, drawn: Colours, scale: Scale | None) -> Panel:
    times = max(1, SIDE // max(drawn.shape[:2]))
    return _finished(title, Image.fromarray(drawn.repeat(times, 0).repeat(times, 1)), scale)


def _finished(title: str, image: Image.Image, scale: Scale | None) -> Panel:
    file = io.BytesIO()
    image.save(file, "WEBP", lossless=True)
    content = base64.b64encode(file.getvalue()).decode()
    return Panel(title=title, image=content, width=image.width, height=image.height, scale=scale)


# -- points -------------------------------------------------------------------------------------


def _points(a: Real, b: Real, place: list[str]) -> ValuePictures | None:
    """Where the reference has them, where they are here, and the way between."""
    if a.shape[1] not in (2, 3):
        a, b = a.T, b.T
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    remarks = []
    if not known.all():
        remarks.append(
            f"{len(a) - known.sum()} points with numbers that are not finite are not drawn"
        )
    a, b = a[known], b[known]
    if not len(a):
        return None
    if len(a) > POINTS:
        step = -(-len(a) // POINTS)
        remarks.append(f"every {step}th of {len(a)} points is drawn")
        a, b = a[::step], b[::step]
    apart = np.linalg.norm(a - b, axis=1)
    if a.shape[1] == 3:
        remarks.append("seen from where the reference's points are spread widest, no perspective")
        a, b = _projected(a, b)
    scale = Scale(ramp="sizes", low=0.0, high=float(apart.max()))
    colours = _coloured(apart, scale)
    both = np.concatenate([a, b])
    low, high = both.min(axis=0), both.max(axis=0)
    margin, size = 6, max(float((high - low).max()), np.finfo(float).tiny)
    a, b = (
        margin + (x - (low + high) / 2 + size / 2) / size * (SIDE - 1 - 2 * margin) for x in (a, b)
    )
    plain = np.full((len(a), 3), (225, 225, 225), np.uint8)
    panels = [
        _finished("reference", _dots(b, b, plain), None),
        _finished("here, coloured by the distance", _dots(a, a, colours), scale),
        _finished("from the reference to here", _dots(b, a, colours), scale),
    ]
    return ValuePictures(rows=[("; ".join(place), panels)], remarks=remarks)


def _projected(a: Real, b: Real) -> tuple[Real, Real]:
    """(N, 2) of both: along the two directions in which those of ``b`` are spread most."""
    centre = b.mean(axis=0)
    *_, directions = np.linalg.svd(b - centre, full_matrices=False)
    largest = np.abs(directions).argmax(axis=1)
    directions = directions * np.sign(directions[np.arange(len(directions)), largest])[:, None]
    return (a - centre) @ directions[:2].T, (b - centre) @ directions[:2].T


def _dots(starts: Real, ends: Real, colours: Colours) -> Image.Image:
    """Lines with a dot at their end, the brightest last."""
    image = Image.new("RGB", (SIDE, SIDE), GROUND)
    draw = ImageDraw.Draw(image)
    for index in np.argsort(colours.sum(axis=1, dtype=int), kind="stable"):
        (x, y), (u, v) = starts[index], ends[index]
        colour = tuple(colours[index].tolist())
        if (x, y) != (u, v):
            draw.line([x, y, u, v], fill=colour)
        draw.rectangle([u - 1, v - 1, u + 1, v + 1], fill=colour)
    return image
