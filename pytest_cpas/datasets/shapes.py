"""Parametric meshes of the six categories: watertight, metric, in the ShapeNet frame.

The frame: y up, origin in the centre of the bounding box, and what a category calls its front
towards -z, which is NOCS's +x. As in the data sets (seen in the meshes of REAL275, those of
REDWOOD75 turned by its annotations, and in the mean shapes that SPD-like methods share):

* mug: the handle points to -z;
* camera: the lens points to -z, the photographer's right hand (the grip) is at +x;
* laptop: the keyboard opens to -z, the screen stands at +z;
* bottle, bowl, can: symmetric about y.

Every mesh is one closed surface without inner walls, so that points sampled on it lie where a
scanner would find them. All are made from one primitive, a stack of rings. Vertices are rounded to
0.1 micrometre, which makes them the same on every processor.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.types import CATEGORIES, Array, Mesh

__all__ = ["RANGES", "make", "mean_shape", "solid_of_revolution"]

_SEGMENTS = 48

#: Smallest and largest value of each category's parameters: metres, degrees or ratios. The sizes
#: are those of everyday objects and enclose the ones that REAL275 and REDWOOD75 show.
RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "bottle": {
        "height": (0.16, 0.28),
        "radius": (0.028, 0.044),
        "neck_radius": (0.30, 0.45),  # of the radius
        "shoulder": (0.45, 0.65),  # height at which the shoulder starts, of the height
        "neck": (0.75, 0.85),  # height at which the neck starts, of the height
    },
    "bowl": {
        "height": (0.05, 0.085),
        "radius": (0.06, 0.09),
        "foot": (0.35, 0.55),  # radius of the foot, of the radius
        "belly": (0.35, 0.65),  # how early the wall turns upwards: exponent of its profile
        "wall": (0.003, 0.006),
    },
    "camera": {
        "width": (0.115, 0.145),
        "height": (0.065, 0.085),
        "depth": (0.035, 0.055),
        "lens_radius": (0.024, 0.034),
        "lens_length": (0.03, 0.075),
        "grip": (0.012, 0.022),  # how far the grip protrudes
        "hump": (0.012, 0.025),  # height of the viewfinder above the body
    },
    "can": {
        "height": (0.09, 0.16),
        "radius": (0.026, 0.038),
        "lid": (0.82, 0.92),  # radius of the lid, of the radius
        "taper": (0.004, 0.012),  # height of the cones at both ends
    },
    "laptop": {
        "width": (0.26, 0.36),
        "base_depth": (0.19, 0.25),
        "screen_height": (0.8, 1.0),  # of the base's depth
        "thickness": (0.010, 0.018),
        "opening": (95.0, 130.0),  # angle between keyboard and screen, degrees
    },
    "mug": {
        "height": (0.08, 0.12),
        "radius": (0.035, 0.047),
        "foot": (0.80, 1.0),  # radius at the bottom, of the radius
        "wall": (0.003, 0.005),
        "handle_reach": (0.025, 0.036),  # from the wall to the middle of the handle
        "handle_height": (0.50, 0.65),  # of the height, between the middles of its two ends
        "handle_thickness": (0.007, 0.011),
    },
}


def make(category: str, rng: np.random.Generator) -> Mesh:
    """An instance of ``category``, its parameters drawn evenly from :data:`RANGES`.

    Raises :class:`ValueError` for a category that is none of the six.
    """
    values = {name: rng.uniform(*limits) for name, limits in _ranges(category).items()}
    return _BUILDERS[category](**values)


def mean_shape(category: str) -> Mesh:
    """The instance of ``category`` in the middle of all ranges (a shape prior).

    Raises :class:`ValueError` for a category that is none of the six.
    """
    values = {name: (low + high) / 2 for name, (low, high) in _ranges(category).items()}
    return _BUILDERS[category](**values)


def solid_of_revolution(profile: Array) -> Mesh:
    """The solid about the y axis through ``profile`` (M, 2): radius and height, metres.

    Both ends are closed by a disc. Like every shape it is centred on its bounding box.
    """
    return _solid(_revolve(profile))


def _ranges(category: str) -> dict[str, tuple[float, float]]:
    if category not in RANGES:
        raise ValueError(f"no shapes of category {category!r}; there are {', '.join(CATEGORIES)}")
    return RANGES[category]


def _finish(vertices: Array, triangles: NDArray[np.int64]) -> Mesh:
    """Drop unused vertices, centre on the bounding box, round, orient the triangles outwards."""
    used, triangles = np.unique(triangles, return_inverse=True)
    vertices, triangles = vertices[used], triangles.reshape(-1, 3)
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices = np.round(vertices, 7) + 0.0  # no -0.0
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    if np.sum(a * np.cross(b, c)) < 0:
        triangles = triangles[:, ::-1]
    return Mesh(vertices, triangles)


def _side(first: int, second: int, count: int, skip: int = 0) -> NDArray[np.int64]:
    """Triangles between two rings of ``count`` vertices, less the first ``skip`` quads."""
    j = np.arange(skip, count)
    k = (j + 1) % count
    lower = np.stack([first + j, first + k, second + k], axis=1)
    upper = np.stack([first + j, second + k, second + j], axis=1)
    return np.concatenate([lower, upper])


def _loft(rings: Array) -> tuple[Array, list[NDArray[np.int64]]]:
    """A closed surface through rings (M, N, 3), both ends closed at the middle of their ring."""
    m, n, _ = rings.shape
    vertices = np.concatenate(
        [rings.reshape(-1, 3), rings[0].mean(0)[None], rings[-1].mean(0)[None]]
    )
    j = np.arange(n)
    k = (j + 1) % n
    start = np.stack([np.full(n, m * n), k, j], axis=1)
    end = np.stack([np.full(n, m * n + 1), (m - 1) * n + j, (m - 1) * n + k], axis=1)
    sides = [_side(i * n, (i + 1) * n, n) for i in range(m - 1)]
    return vertices, [start, *sides, end]


def _revolve(profile: Array, columns: int = _SEGMENTS) -> Array:
    """Rings (M, columns, 3) about the y axis through profile points (M, 2) of radius and height.

    The first column lies at -z, the following ones towards +x.
    """
    angles = 2 * np.pi * np.arange(columns) / columns
    radius, height = profile[:, 0, None], profile[:, 1, None]
    return np.stack(
        np.broadcast_arrays(radius * np.sin(angles), height, -radius * np.cos(angles)), axis=-1
    )


def _refine(profile: Array, step: float) -> Array:
    """Points on the straight lines between profile points, at most ``step`` apart."""
    pieces = [profile[:1]]
    for a, b in itertools.pairwise(profile):
        count = max(1, int(np.ceil(np.sqrt(np.sum((b - a) ** 2)) / step)))
        pieces.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(pieces)


def _solid(rings: Array) -> Mesh:
    vertices, triangles = _loft(rings)
    return _finish(vertices, np.concatenate(triangles))


def _bottle(height: float, radius: float, neck_radius: float, shoulder: float, neck: float) -> Mesh:
    r_neck = neck_radius * radius
    u = np.arange(9) / 8
    blend = u * u * (3 - 2 * u)  # the shoulder leaves the body and meets the neck smoothly
    shoulders = np.stack(
        [radius + (r_neck - radius) * blend, height * (shoulder + (neck - shoulder) * u)], axis=1
    )
    cap = height - 0.018
    profile = np.concatenate(
        [
            [[0.6 * radius, 0.004], [0.8 * radius, 0.0], [0.94 * radius, 0.001], [radius, 0.006]],
            shoulders,
            [
                [r_neck, cap],
                [1.15 * r_neck, cap],
                [1.15 * r_neck, height - 0.001],
                [1.05 * r_neck, height],
            ],
        ]
    )
    return solid_of_revolution(_refine(profile, 0.02))


def _bowl(height: float, radius: float, foot: float, belly: float, wall: float) -> Mesh:
    r_foot, ring = foot * radius, 0.006
    u = np.arange(11) / 10
    widening = (u**belly)[:, None]
    outer = np.concatenate(
        [r_foot + (radius - r_foot) * widening, ring + (height - ring) * u[:, None]], axis=1
    )
    floor = ring + wall
    inner = np.concatenate(
        [
            r_foot + (radius - wall - r_foot) * widening,
            floor + (height - floor) * u[:, None],
        ],
        axis=1,
    )[::-1]
    below = [[r_foot - 2 * wall, ring / 2], [r_foot - wall, 0.0], [r_foot, 0.0]]
    lip = [[radius - wall / 2, height + wall / 4]]
    return solid_of_revolution(np.concatenate([below, outer, lip, inner, [[r_foot / 2, floor]]]))


def _can(height: float, radius: float, lid: float, taper: float) -> Mesh:
    r_lid, rim = lid * radius, 0.002
    profile = np.array(
        [
            [0.7 * r_lid, 0.006],
            [r_lid - rim, 0.0],
            [r_lid, 0.0],
            [radius, taper],
            [radius, height - taper],
            [r_lid, height - rim],
            [r_lid, height],
            [r_lid - rim, height],
            [r_lid - 1.5 * rim, height - 0.004],
        ]
    )
    return solid_of_revolution(_refine(profile, 0.02))


def _laptop(
    width: float, base_depth: float, screen_height: float, thickness: float, opening: float
) -> Mesh:
    """A strip that runs from the front edge to the hinge and up the screen, extruded along x."""
    length = screen_height * base_depth
    lean = np.deg2rad(opening - 90)
    up = np.array([np.cos(lean), np.sin(lean)])  # (y, z) along the screen
    back = np.array([-np.sin(lean), np.cos(lean)])  # (y, z) out of the screen's back
    hinge = np.array([thickness, base_depth])
    screen = 0.5 * thickness
    # pairs of points (y, z): on the inside (keyboard, display) and on the outside
    front = np.array([[thickness, 0.0], [0.25 * thickness, 0.0]])
    edge = np.array([hinge, [0.0, base_depth]])
    foot = np.array([hinge, hinge + screen * back])
    top = foot + length * up
    path = np.concatenate(
        [
            [front],
            [np.array([[thickness, 0.01], [0.0, 0.01]])],
            [edge],
            [foot],
            [foot + (length - 0.005) * up],
            [np.array([top[0] + 0.25 * screen * back, top[1] - 0.25 * screen * back])],
        ]
    )
    # the wedge between base and screen at the hinge shares the inner point: split it for a ring
    path[3, 0] += 0.002 * up
    path[2, 0, 1] -= 0.002
    steps = np.linspace(-width / 2, width / 2, 9)
    inside, outside = path[:, :1], path[:, 1:]
    sections = np.concatenate(
        [np.repeat(inside, len(steps), axis=1), np.repeat(outside, len(steps), axis=1)], axis=1
    )
    x = np.broadcast_to(np.concatenate([steps, steps[::-1]]), sections.shape[:2])
    return _solid(np.concatenate([x[..., None], sections], axis=-1))


def _camera(
    width: float,
    height: float,
    depth: float,
    lens_radius: float,
    lens_length: float,
    grip: float,
    hump: float,
) -> Mesh:
    """Rings about the lens axis: back, outline with viewfinder, front with grip, lens barrel."""
    columns = 96
    angles = 2 * np.pi * np.arange(columns) / columns
    ray = np.stack([np.sin(angles), np.cos(angles)], axis=1)  # (x, y), from the top towards +x
    outline = _outline(ray, width / 2, height / 2, 0.36 * width / 2, hump)

    def ring(points: Array, z: Array | float) -> Array:
        return np.concatenate([points, np.broadcast_to(np.asarray(z), (columns,))[:, None]], axis=1)

    def front(points: Array) -> Array:
        """The front surface: flat, with the grip bulging towards -z beside the lens."""
        start = 0.5 * width / 2
        u = np.clip((points[:, 0] - start) / (0.17 * width), 0, 1)
        return -depth / 2 - grip * (u * u * (3 - 2 * u))

    bevel = 0.94 * outline
    rings = [ring(0.5 * outline, depth / 2), ring(bevel, depth / 2)]
    rings += [ring(outline, depth / 2 - 0.004), ring(outline, front(outline) + 0.004)]
    barrel = lens_radius * ray
    rings += [
        ring(points, front(points))
        for points in (barrel + (bevel - barrel) * u for u in np.arange(16, -1, -1) / 16)
    ]
    z0 = -depth / 2
    rings += [
        ring(barrel, z0 - 0.35 * lens_length),
        ring(1.06 * barrel, z0 - 0.4 * lens_length),
        ring(1.06 * barrel, z0 - 0.9 * lens_length),
        ring(barrel, z0 - lens_length),
        ring(0.86 * barrel, z0 - lens_length),
        ring(0.78 * barrel, z0 - lens_length + 0.006),
        ring(0.4 * barrel, z0 - lens_length + 0.004),
    ]
    return _solid(np.stack(rings))


def _outline(
    ray: Array, half_width: float, half_height: float, hump_half: float, hump: float
) -> Array:
    """Where rays (N, 2) from the lens axis leave the body: a box with a trapezoid on top."""
    # a nearly square superellipse has the rounded corners of a body, and is met in closed form
    x, y = np.abs(ray[:, 0]) / half_width, np.abs(ray[:, 1]) / half_height
    body = (x**12 + y**12) ** (-1 / 12)
    # the trapezoid: below its top, and within sides that narrow upwards
    top = half_height + hump
    slope = 0.4 * hump_half / hump
    with np.errstate(divide="ignore"):
        to_top = np.where(ray[:, 1] > 0, top / ray[:, 1], 0.0)
    narrowing = np.abs(ray[:, 0]) + slope * ray[:, 1]
    to_side = np.where(
        ray[:, 1] > 0, (hump_half + slope * half_height) / np.maximum(narrowing, 1e-12), 0.0
    )
    return np.maximum(body, np.minimum(to_top, to_side))[:, None] * ray


def _mug(
    height: float,
    radius: float,
    foot: float,
    wall: float,
    handle_reach: float,
    handle_height: float,
    handle_thickness: float,
) -> Mesh:
    """A hollow body; the handle is a tube that grows out of two holes in its outer wall."""
    wide, tall, rows = 4, 2, 17  # a handle's end is wide x tall quads of the wall
    half = handle_height * height / 2
    # rows of the outer wall, so that two pairs of them enclose the handle's ends
    ends = [(rows // 2) + side * 5 for side in (-1, 1)]
    knots = [0, ends[0] - 1, ends[0] + 1, ends[1] - 1, ends[1] + 1, rows - 1]
    thick = handle_thickness / 2
    mid = height / 2
    levels = np.interp(
        np.arange(rows),
        knots,
        [
            0.004,
            mid - half - thick,
            mid - half + thick,
            mid + half - thick,
            mid + half + thick,
            height,
        ],
    )
    widening = foot + (1 - foot) * levels / height
    outer = np.stack([radius * widening, levels], axis=1)
    inner_levels = np.array([height, 0.66 * height, 0.33 * height, 2.5 * wall])
    inner = np.stack(
        [radius * (foot + (1 - foot) * inner_levels / height) - wall, inner_levels], axis=1
    )
    r_foot = foot * radius
    profile = np.concatenate(
        [
            [[0.85 * r_foot, 0.002], [0.9 * r_foot, 0.0], [r_foot - 0.002, 0.0]],
            outer,
            [[radius - wall / 2, height + wall / 4]],
            inner,
            [[r_foot - 3 * wall, 1.5 * wall]],
        ]
    )
    # columns are counted from half a handle's width before -z
    rings = np.roll(_revolve(profile), wide // 2, axis=1)
    vertices, parts = _loft(rings)
    first = 3  # the first row of the outer wall
    for row in ends:
        for ring in range(first + row - tall // 2, first + row + tall // 2):
            # part 0 closes the bottom, so the quads above ring i are part i + 1
            parts[ring + 1] = _side(ring * _SEGMENTS, (ring + 1) * _SEGMENTS, _SEGMENTS, skip=wide)
    loops = [_patch_boundary(first + row, wide, tall) for row in ends]
    tube, sides = _handle(vertices, loops, handle_reach, handle_thickness)
    return _finish(np.concatenate([vertices, tube]), np.concatenate([*parts, *sides]))


def _patch_boundary(row: int, wide: int, tall: int) -> NDArray[np.int64]:
    """Vertices around the hole that is centred on ring ``row``: counter-clockwise from below."""
    low, high = row - tall // 2, row + tall // 2
    cells = (
        [(low, c) for c in range(wide)]
        + [(r, wide) for r in range(low, high)]
        + [(high, c) for c in range(wide, 0, -1)]
        + [(r, 0) for r in range(high, low, -1)]
    )
    return np.array([r * _SEGMENTS + c for r, c in cells])


def _handle(
    vertices: Array, loops: list[NDArray[np.int64]], reach: float, thickness: float
) -> tuple[Array, list[NDArray[np.int64]]]:
    """Rings of a tube from the upper hole's boundary to the lower one's, and its triangles."""
    lower, upper = loops
    n = len(lower)
    boundary = vertices[upper]
    middle = {name: vertices[loop].mean(axis=0) for name, loop in (("low", lower), ("up", upper))}
    # elliptic cross-sections; their vertices keep the bearings that they have on the boundary
    bearing = np.arctan2(
        (boundary[:, 1] - middle["up"][1]) / np.ptp(boundary[:, 1]),
        (boundary[:, 0] - middle["up"][0]) / np.ptp(boundary[:, 0]),
    )
    across, along = np.cos(bearing) * 0.8 * thickness, np.sin(bearing) * 0.5 * thickness
    t = np.linspace(0, np.pi, 19)[1:-1]
    # half a superellipse: squarer than a circle, as handles are
    power = 0.75
    y = np.sign(np.cos(t)) * np.abs(np.cos(t)) ** power
    centre_y = middle["low"][1] + (middle["up"][1] - middle["low"][1]) * (1 + y) / 2
    base_z = middle["low"][2] + (middle["up"][2] - middle["low"][2]) * (1 + y) / 2
    path = np.stack([base_z - reach * np.sin(t) ** power, centre_y], axis=1)  # (z, y)
    ends = np.array([[middle[k][2], middle[k][1]] for k in ("up", "low")])
    tangent = np.diff(np.concatenate([ends[:1], path, ends[1:]]), axis=0)
    tangent = tangent[:-1] + tangent[1:]
    tangent /= np.sqrt(np.sum(tangent**2, axis=1))[:, None]
    # at the upper end the tangent is -z and "up" in the cross-section is +y
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)  # (z, y)
    rings = np.stack(
        [
            np.broadcast_to(across, (len(t), n)),
            path[:, 1, None] + normal[:, 1, None] * along,
            path[:, 0, None] + normal[:, 0, None] * along,
        ],
        axis=-1,
    )
    # walked outwards and back the section turns over: the lower boundary is met mirrored
    mirrored = np.array([int(np.argmin(np.abs(_wrap(bearing + b)))) for b in bearing])
    start = len(vertices)
    sequence = [upper, *(start + i * n + np.arange(n) for i in range(len(t))), lower[mirrored]]
    sides = []
    for a, b in itertools.pairwise(sequence):
        quad = np.stack([a, np.roll(a, -1), np.roll(b, -1), b], axis=1)
        sides += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return rings.reshape(-1, 3), sides


def _wrap(angle: Array) -> Array:
    wrapped: Array = (angle + np.pi) % (2 * np.pi) - np.pi
    return wrapped


_BUILDERS: dict[str, Callable[..., Mesh]] = {
    "bottle": _bottle,
    "bowl": _bowl,
    "camera": _camera,
    "can": _can,
    "laptop": _laptop,
    "mug": _mug,
}
