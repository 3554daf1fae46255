"""Intersection over union of boxes, in its four meanings.

============================ ======================================================================
:func:`oriented_iou`         the boxes as they stand: the paper's IoU
:func:`symmetric_iou`        the same, largest over the true object's symmetry group
:func:`axis_aligned_box_iou` the camera-axis-aligned boxes around the eight posed *box corners*
:func:`iou_plus`             the camera-axis-aligned boxes around the posed *surfaces*: IoU+
:func:`nocs_legacy_iou`      what NOCS' published evaluation prints as 3D IoU; it is no IoU
============================ ======================================================================

A box is centred on its frame's origin. ``rotation`` (..., 3, 3) and ``translation`` (..., 3) in
metres take its frame to the camera's; ``extents`` (..., 3) are its side lengths in metres. All
arguments broadcast against each other. ``a`` is the estimate, ``b`` the truth. Every function
raises :class:`ContractError` for matrices that are not rotations, for NaN, for magnitudes above
1e100, and for extents that are not positive (at least 1e-100) or differ by a factor above 1e15.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pytest_cpas.metrics._box_ball import largest_overlap_of_ball
from pytest_cpas.metrics._box_clipping import expect, overlap_and_torque
from pytest_cpas.metrics._box_spin import largest_overlap
from pytest_cpas.metrics.pose import checked_rotations, checked_vectors
from pytest_cpas.types import ContractError, Mesh, Pose, Symmetry
from pytest_cpas.types._arrays import SMALLEST_OF_METRICS, check_sides, checked_integer

__all__ = [
    "axis_aligned_box_iou",
    "expect_pairs",
    "iou_plus",
    "nocs_legacy_iou",
    "of_unit_diagonal",
    "oriented_iou",
    "symmetric_iou",
]

Array = NDArray[np.float64]

#: More spins than that are a slip of the pen.
_MOST_SPINS = 10_000

#: How often a pair of boxes is clipped, about, if one of them is symmetric.
_CLIPPED = 30

#: The eight corners of a box in units of half its extents.
_CORNERS = np.stack(np.meshgrid((1, -1), (1, -1), (1, -1), indexing="ij"), axis=-1).reshape(8, 3)


def oriented_iou(
    rotation_a: ArrayLike,
    translation_a: ArrayLike,
    extents_a: ArrayLike,
    rotation_b: ArrayLike,
    translation_b: ArrayLike,
    extents_b: ArrayLike,
) -> Array:
    """Intersection over union of oriented boxes, exact but for rounding (about 1e-15).

    Boxes whose sides differ by a factor f lose log10(f) digits, as the input's own rounding does.

    Source: paper section 3.1 (IoU of the oriented boxes).
    """
    shape, a, b = _checked(
        rotation_a, translation_a, extents_a, rotation_b, translation_b, extents_b
    )
    return _oriented(*a, *b).reshape(shape)


def symmetric_iou(
    rotation_a: ArrayLike,
    translation_a: ArrayLike,
    extents_a: ArrayLike,
    rotation_b: ArrayLike,
    translation_b: ArrayLike,
    extents_b: ArrayLike,
    symmetry: Symmetry,
) -> Array:
    """The largest :func:`oriented_iou` of A with ``rotation_b @ S``, S in the symmetry group.

    The symmetry is that of the true object, box B: every pose in its group is equally true.
    (Published codes spin the estimate, which is another number unless the two axes coincide.) A
    discrete group is tried in full. A continuous axis is searched by branch and bound over the
    angle (``_box_spin`` says why that is sound), all rotations by ``_box_ball``; both come within
    1e-6 of the maximum, usually 1e-8, for boxes that are not thinner than 1e-4 of their length.
    Batches pay: a single pair costs milliseconds.

    Source: paper section 3.1 (rotations about the symmetry axis are ignored in the IoU).
    """
    shape, a, b = _checked(
        rotation_a, translation_a, extents_a, rotation_b, translation_b, extents_b
    )
    relative, offset = _relative(*a[:2], *b[:2])
    half_a, half_b = a[2] / 2, b[2] / 2
    # IoU = V / (sum - V) grows by at most 4 / sum per volume
    tolerance = 1e-8 * (a[2].prod(axis=-1) + b[2].prod(axis=-1)) / 4
    # of thin boxes this is less than the rounding of a volume, below which no search ends
    longest = np.maximum(a[2].max(axis=-1), b[2].max(axis=-1))
    tolerance = np.maximum(tolerance, 1e-14 * longest**3)
    if symmetry.sphere:
        return _ratio(
            largest_overlap_of_ball(relative, offset, half_a, half_b), a[2], b[2]
        ).reshape(shape)
    shared = np.zeros(len(offset))
    for element in _distinct(symmetry.rotations):
        turned = element.T @ relative, offset @ element
        if symmetry.axis is None:
            volume, _ = overlap_and_torque(*turned, half_a, half_b)
        else:
            axis = element.T @ symmetry.axis
            volume = largest_overlap(*turned, half_a, half_b, axis, tolerance)
        shared = np.maximum(shared, volume)
    return _ratio(shared, a[2], b[2]).reshape(shape)


def of_unit_diagonal(translation: Array, extents: Array) -> tuple[Array, Array]:
    """Boxes (..., 3) scaled about the camera until the diagonal of each is 1: both again.

    What LaPose compares (Zhang et al. 2024): how large and how far an object is can then not be
    told apart, as in a single colour image.
    """
    diagonal = np.linalg.norm(extents, axis=-1, keepdims=True)
    return translation / diagonal, extents / diagonal


def expect_pairs(pairs: int) -> None:
    """Load the compiled kernel now, if there is one and so many pairs of boxes make it pay.

    Otherwise it is loaded once numpy has worked for as long as that takes. The values are the same
    but for rounding.
    """
    expect(_CLIPPED * pairs)


def axis_aligned_box_iou(
    rotation_a: ArrayLike,
    translation_a: ArrayLike,
    extents_a: ArrayLike,
    rotation_b: ArrayLike,
    translation_b: ArrayLike,
    extents_b: ArrayLike,
    spins: int = 1,
) -> Array:
    """IoU of the boxes along the camera's axes that enclose the corners of boxes A and B.

    The box-only variant: it knows nothing of the shapes, unlike :func:`iou_plus`. It depends on
    the camera's axes, unlike :func:`oriented_iou`. ``spins`` > 1: the largest value over box A
    turned by multiples of 360/``spins`` degrees about its y axis; the NOCS protocol uses 20 for
    symmetric objects. This is what :func:`nocs_legacy_iou` set out to compute.
    """
    return _corner_iou(
        (rotation_a, translation_a, extents_a, rotation_b, translation_b, extents_b), spins, -2
    )


def nocs_legacy_iou(
    rotation_a: ArrayLike,
    translation_a: ArrayLike,
    extents_a: ArrayLike,
    rotation_b: ArrayLike,
    translation_b: ArrayLike,
    extents_b: ArrayLike,
    spins: int = 1,
) -> Array:
    """What the literature prints as 3D IoU on REAL275 and CAMERA25. It is *not* an IoU.

    NOCS' evaluation holds the corners as a (3, 8) array and takes the extremes over the axis of
    length 3: each corner's largest and smallest coordinate, instead of the box's extremes along
    x, y and z. The eight intervals that result are treated like the sides of an 8-dimensional
    box. The value changes when both boxes are moved together, and is 0 where a corner's coordinates
    are equal. Kept to reproduce published
    figures, with ``spins`` = 20 for the objects that the protocol calls symmetric (box A, the
    prediction, is turned about its y axis).
    """
    return _corner_iou(
        (rotation_a, translation_a, extents_a, rotation_b, translation_b, extents_b), spins, -1
    )


def iou_plus(
    surface_a: Mesh | ArrayLike, pose_a: Pose, surface_b: Mesh | ArrayLike, pose_b: Pose
) -> float:
    """IoU+: IoU of the boxes along the camera's axes that enclose the two posed surfaces.

    ``surface_a``, ``surface_b``: a :class:`Mesh` or points (N, 3) in the object frame, metres. It
    depends on the objects' shapes, not only on their boxes.

    Source: paper section 3.1. Raises :class:`ContractError` for a surface without volume in the
    camera's axes (all points in one coordinate plane) or without points.
    """
    low_a, high_a = _bounds(surface_a, pose_a)
    low_b, high_b = _bounds(surface_b, pose_b)
    volume_a, volume_b = np.prod(high_a - low_a), np.prod(high_b - low_b)
    shared = np.prod(np.maximum(np.minimum(high_a, high_b) - np.maximum(low_a, low_b), 0))
    return float(shared / (volume_a + volume_b - shared))


def _oriented(
    rotation_a: Array,
    translation_a: Array,
    extents_a: Array,
    rotation_b: Array,
    translation_b: Array,
    extents_b: Array,
) -> Array:
    relative, offset = _relative(rotation_a, translation_a, rotation_b, translation_b)
    shared, _ = overlap_and_torque(relative, offset, extents_a / 2, extents_b / 2)
    return _ratio(shared, extents_a, extents_b)


def _relative(
    rotation_a: Array, translation_a: Array, rotation_b: Array, translation_b: Array
) -> tuple[Array, Array]:
    """Rotation (N, 3, 3) and offset (N, 3) from A's frame to B's."""
    inverse = np.swapaxes(rotation_b, -1, -2)
    return inverse @ rotation_a, (inverse @ (translation_a - translation_b)[..., None])[..., 0]


def _distinct(rotations: Array) -> list[Array]:
    """The rotations without those that only add half turns about a box's own axes."""
    kept: list[Array] = []
    for rotation in rotations:
        if not any(np.abs(np.abs(k.T @ rotation) - np.eye(3)).max() < 1e-9 for k in kept):
            kept.append(rotation)
    return kept


def _ratio(shared: Array, extents_a: Array, extents_b: Array) -> Array:
    volumes = extents_a.prod(axis=-1), extents_b.prod(axis=-1)
    shared = np.minimum(shared, np.minimum(*volumes))
    return np.asarray(shared / (volumes[0] + volumes[1] - shared))


def _corner_iou(boxes: tuple[ArrayLike, ...], spins: int, axis: int) -> Array:
    """IoU of the intervals between the corners' extremes over ``axis`` of (..., 8, 3)."""
    spins = checked_integer(spins, "spins, 1 for none", 1, _MOST_SPINS)
    shape, (rotation_a, centre_a, extents_a), (rotation_b, centre_b, extents_b) = _checked(*boxes)
    if axis == -2:  # where both boxes are does not matter, and of far ones small sides are rounded
        centre_a, centre_b = centre_a - centre_b, np.zeros_like(centre_b)
    # by a power of two, which rounds nothing, so that no product of eight sides is out of range
    largest = np.max(
        [np.abs(v).max(axis=-1) for v in (centre_a, centre_b, extents_a, extents_b)], 0
    )
    scale = np.exp2(np.round(np.log2(largest)))[:, None]
    centre_a, centre_b = centre_a / scale, centre_b / scale
    extents_a, extents_b = extents_a / scale, extents_b / scale
    corners_b = _posed_corners(rotation_b, centre_b, extents_b)
    low_b, high_b = corners_b.min(axis=axis), corners_b.max(axis=axis)
    best = np.zeros(len(centre_a))
    for angle in 2 * np.pi * np.arange(spins) / spins:
        sine, cosine = np.sin(angle), np.cos(angle)
        spin = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
        corners_a = _posed_corners(rotation_a @ spin, centre_a, extents_a)
        low_a, high_a = corners_a.min(axis=axis), corners_a.max(axis=axis)
        sides = np.minimum(high_a, high_b) - np.maximum(low_a, low_b)
        shared = np.where(sides.min(axis=-1) < 0, 0, sides.prod(axis=-1))
        union = (high_a - low_a).prod(axis=-1) + (high_b - low_b).prod(axis=-1) - shared
        # the legacy figure of boxes that are degenerate to it is 0 / 0
        best = np.maximum(best, np.divide(shared, union, out=np.zeros_like(union), where=union > 0))
    return best.reshape(shape)


def _posed_corners(rotation: Array, translation: Array, extents: Array) -> Array:
    corners = _CORNERS * (extents / 2)[:, None, :]
    return np.asarray(corners @ np.swapaxes(rotation, -1, -2) + translation[:, None, :])


def _bounds(surface: Mesh | ArrayLike, pose: Pose) -> tuple[Array, Array]:
    if isinstance(surface, Mesh):
        surface = surface.vertices[np.unique(surface.triangles)]
    points = checked_vectors(surface, "surface points (metres)").reshape(-1, 3)
    if len(points) == 0:
        raise ContractError("surface: it has no points")
    posed = pose.apply(points)
    low, high = posed.min(axis=0), posed.max(axis=0)
    if (high - low).min() < SMALLEST_OF_METRICS:
        raise ContractError(
            f"surface: its {len(points)} points span {(high - low).tolist()} m along the camera's"
            " axes, so they enclose no volume; expected points in more than one plane"
        )
    return low, high


def _checked(
    rotation_a: ArrayLike,
    translation_a: ArrayLike,
    extents_a: ArrayLike,
    rotation_b: ArrayLike,
    translation_b: ArrayLike,
    extents_b: ArrayLike,
) -> tuple[tuple[int, ...], tuple[Array, Array, Array], tuple[Array, Array, Array]]:
    """Validate, broadcast and flatten: the result's shape, box A (N, ...), box B (N, ...)."""
    rotations = [
        checked_rotations(rotation_a, "rotation of box a"),
        checked_rotations(rotation_b, "rotation of box b"),
    ]
    vectors = [
        checked_vectors(translation_a, "translation of box a (metres)"),
        checked_vectors(translation_b, "translation of box b (metres)"),
        _checked_extents(extents_a, "extents of box a (metres)"),
        _checked_extents(extents_b, "extents of box b (metres)"),
    ]
    try:
        shape = np.broadcast_shapes(
            *(r.shape[:-2] for r in rotations), *(v.shape[:-1] for v in vectors)
        )
    except ValueError as error:
        raise ContractError(f"boxes: the arguments do not broadcast ({error})") from None
    rotation_a, rotation_b = (
        np.broadcast_to(r, (*shape, 3, 3)).reshape(-1, 3, 3) for r in rotations
    )
    centre_a, centre_b, extents_a, extents_b = (
        np.broadcast_to(v, (*shape, 3)).reshape(-1, 3) for v in vectors
    )
    return shape, (rotation_a, centre_a, extents_a), (rotation_b, centre_b, extents_b)


def _checked_extents(value: ArrayLike, what: str) -> Array:
    extents = checked_vectors(value, what)
    check_sides(extents, what, SMALLEST_OF_METRICS)
    return extents
