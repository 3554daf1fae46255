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

from collections.abc import Callable

import numpy as np

from pytest_cpas.datasets._mug import mug
from pytest_cpas.datasets._rings import refine, solid, solid_of_revolution
from pytest_cpas.types import CATEGORIES, Array, Mesh

__all__ = ["RANGES", "make", "mean_shape", "solid_of_revolution"]

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


def _ranges(category: str) -> dict[str, tuple[float, float]]:
    if category not in RANGES:
        raise ValueError(f"no shapes of category {category!r}; there are {', '.join(CATEGORIES)}")
    return RANGES[category]


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
    return solid_of_revolution(refine(profile, 0.02))


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
    return solid_of_revolution(refine(profile, 0.02))


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
    return solid(np.concatenate([x[..., None], sections], axis=-1))


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
    return solid(np.stack(rings))


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


_BUILDERS: dict[str, Callable[..., Mesh]] = {
    "bottle": _bottle,
    "bowl": _bowl,
    "camera": _camera,
    "can": _can,
    "laptop": _laptop,
    "mug": mug,
}
