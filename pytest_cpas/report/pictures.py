"""Pictures of flipped and bad samples: boxes in the colour image, and the shape over the depth."""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from pytest_cpas.documents import AgainstDocument, FlipDocument, RunDocument, SampleDocument
from pytest_cpas.evaluation import MergedRun, MethodRun, Row, Run
from pytest_cpas.evaluation.estimates import decode_estimates
from pytest_cpas.report.reconstruction import (
    ESTIMATE_COLOUR,
    GROUND,
    TRUTH_COLOUR,
    reconstruction,
)
from pytest_cpas.types import Array, Camera, ContractError, Sample, SampleRef

#: Pictures of one run, and of a report: a page of that many shall stay below 10 MB.
COUNT, TOTAL = 24, 200

#: The side of a panel, pixels, and its quality: as JPEG, dots would take three times as much.
_SIDE, _QUALITY = 256, 75

#: What is shown around the object, as a share of its size.
_AROUND = 0.35

#: No line is drawn to a corner further outside than this, pixels of the picture.
_FAR = 10 * _SIDE

_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))

#: The middles of the box, of its right and of its upper side: they tell a box that is turned round.
_AXES = np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]])

#: What is drawn between them: the edges, and the two axes.
_LINES = [
    *(
        (a, b)
        for a, b in itertools.combinations(range(8), 2)
        if (_CORNERS[a] != _CORNERS[b]).sum() == 1
    ),
    (8, 9),
    (8, 10),
]


def pictures(
    runs: Sequence[Run],
    rows: Mapping[Run, Mapping[str, Row]],
    documents: Sequence[RunDocument],
    against: AgainstDocument | None = None,
) -> dict[tuple[str, str], dict[str, bytes]]:
    """WebP pictures by method and data set: of lost and gained samples, then of the worst.

    ``documents``: those of the runs; ``against``: their comparison with others. Runs without
    images have none, and neither have perturbed data sets nor samples that cannot be read again.
    """
    shown = [
        (run, document, read)
        for run, document in zip(runs, documents, strict=True)
        if (read := _reader(run)) and not run.robustness_point
    ]
    count = min(COUNT, TOTAL // max(1, len(shown)))
    since = {
        (pair["method"], pair["dataset"]): pair["flips"]
        for pair in (against["pairs"] if against else ())
    }
    drawn: dict[tuple[str, str], dict[str, bytes]] = {}
    for run, document, read in shown:
        key = run.method, run.dataset
        refs = {ref.id: ref for ref in run.samples}
        drawn[key] = {}
        for name in _chosen(document, since.get(key, []))[:count]:
            row = rows[run][name]
            try:
                drawn[key][name] = draw(read(refs[name]), row.estimate, row.shape)
            except ContractError:  # judged when it was not yet damaged
                continue
    return drawn


def _reader(run: Run) -> Callable[[SampleRef], Sample] | None:
    """What reads the samples of a run, if they are at hand."""
    if isinstance(run, MethodRun):
        return run.read
    return run.images.load if isinstance(run, MergedRun) and run.images else None


def _chosen(document: RunDocument, since: Sequence[FlipDocument]) -> list[str]:
    """What was lost, also since another run, then what was gained, then what is worst."""
    flips = sorted([*document["flips"], *since], key=lambda flip: not flip["lost"])
    wrong = [
        (outcome.count("1"), sample)
        for sample in document["samples"]
        if (outcome := sample["outcome"]) and "0" in outcome
    ]
    wrong.sort(key=lambda entry: (entry[0], -_size(entry[1])))
    names = [*(flip["sample"] for flip in flips), *(sample["sample"] for _, sample in wrong)]
    return list(dict.fromkeys(names))


def _size(sample: SampleDocument) -> float:
    """How wrong a pose is, with 2 cm as bad as 10 degrees."""
    position, rotation = sample["position_m"], sample["rotation_deg"]
    if position is None or rotation is None:
        return math.inf
    return max(position / 0.02, rotation / 10)


def draw(sample: Sample, estimate: str | None, shape: str | None) -> bytes:
    """A WebP of two panels: the colour image around the object, with the box of the truth and that
    of the estimate, and beside it the reconstruction over the measured points.

    From the middle of a box lines go to its upper and to its right side (+y and +x).

    ``estimate``, ``shape`` as on a row; without, or without extents, the truth is drawn alone.
    """
    observation, truth = sample.observation, sample.truth
    camera = observation.camera
    true_box = _box(camera, truth.pose.rotation, truth.pose.translation, truth.extents)
    window = left, top, right, bottom = _window(observation.mask, true_box, camera)
    colour = np.round(255 * observation.rgb[top:bottom, left:right]).astype(np.uint8)
    scale = _SIDE / max(right - left, bottom - top)
    size = max(1, round(scale * (right - left))), max(1, round(scale * (bottom - top)))
    panel = Image.fromarray(colour).resize(size, Image.Resampling.BICUBIC)
    # pixel coordinates count from the middle of the first pixel
    shift = np.array([left, top]) - 0.5
    if true_box is not None:
        _draw_box(panel, scale * (true_box - shift), TRUTH_COLOUR, 3)
    if estimate is not None:
        answer = decode_estimates([estimate])
        box = _box(camera, answer.rotation[0], answer.translation[0], answer.extents[0])
        if box is not None:
            _draw_box(panel, scale * (box - shift), ESTIMATE_COLOUR, 3)
    image = Image.new("RGB", (2 * _SIDE, _SIDE), GROUND)
    image.paste(panel, ((_SIDE - size[0]) // 2, (_SIDE - size[1]) // 2))
    image.paste(reconstruction(sample, estimate, shape, window, _SIDE), (_SIDE, 0))
    file = io.BytesIO()
    image.save(file, "WEBP", quality=_QUALITY)
    return file.getvalue()


def _box(camera: Camera, rotation: Array, translation: Array, extents: Array) -> Array | None:
    """Corners and middles (11, 2) in pixels; None if one is not known or behind the camera."""
    if not all(np.isfinite(part).all() for part in (rotation, translation, extents)):
        return None
    corners = (np.concatenate([_CORNERS, _AXES]) * extents) @ rotation.T + translation
    if (corners[:, 2] <= 0).any():
        return None
    return camera.project(corners)


def _window(
    mask: NDArray[np.bool_], box: Array | None, camera: Camera
) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of what is shown: the mask and the true box, and some more."""
    rows, columns = np.nonzero(mask)
    parts = [np.stack([columns, rows], axis=1).astype(float)] if len(rows) else []
    parts += [box] if box is not None else []
    if not parts:
        return 0, 0, camera.width, camera.height
    points = np.concatenate(parts)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 1 + _AROUND * (high - low).max()
    limits = np.array([camera.width, camera.height])
    first = np.clip(np.floor(low - margin), 0, limits - 1).astype(int)
    last = np.clip(np.ceil(high + margin) + 1, first + 1, limits).astype(int)
    return int(first[0]), int(first[1]), int(last[0]), int(last[1])


def _draw_box(image: Image.Image, corners: Array, colour: tuple[int, int, int], width: int) -> None:
    draw = ImageDraw.Draw(image)
    for a, b in _LINES:
        ends = corners[[a, b]]
        if (abs(ends) < _FAR).all():
            draw.line([*ends.ravel().tolist()], fill=colour, width=width)
