"""Properties of pose errors of known objects: ADD, ADD-S, MSSD, MSPD; and of sampled surfaces."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.exact import largest_distance, nearest
from pytest_cpas.checks.metrics.properties import close, expect, prop
from pytest_cpas.checks.metrics.strategies import Rows, as_symmetry, turned
from pytest_cpas.checks.metrics.subject import Subject

Array = NDArray[np.float64]

FINE = 1e-9
ADD, ADD_S, MSSD, MSPD = "add", "add_s", "mssd", "mspd"

_PLACES = st.lists(some.real(0.4, 1.5), min_size=3, max_size=3)
_POSES = {
    "cloud": some.clouds(2, 10),
    "turns": st.tuples(some.rotations, some.rotations).map(list),
    "places": st.tuples(_PLACES, _PLACES).map(list),
}
_CLOUD = [[0.25, 0, 0], [0, 0.125, 0], [0, 0, -0.375], [-0.125, 0.0625, 0.25], [0.1, 0.2, -0.1]]


def _cases() -> Iterator[dict[str, Any]]:
    turns = [turned(*x).tolist() for x in (([1, 2, -4], 1.1), ([1, 2, -4], 1.3), ([0, 1, 0], 2.9),
                                           ([2, 0, 1], math.pi), ([1, 0, 0], 0.0))]  # fmt: skip
    for one in turns:
        for other in turns[:3]:
            yield {"cloud": _CLOUD, "turns": [one, other],
                   "places": [[0.1, -0.05, 1.0], [0.12, 0.03, 1.1]]}  # fmt: skip
    yield {"cloud": _CLOUD, "turns": [turns[0]] * 2, "places": [[0.0, 0.0, 1.0]] * 2}
    yield {"cloud": _CLOUD[:1] * 2, "turns": turns[:2], "places": [[0.0, 0.0, 1.0]] * 2}


def _posed(
    cloud: Rows, turns: list[Rows], places: list[list[float]]
) -> tuple[tuple[Array, ...], Array, Array]:
    """The arguments, and the points under the estimated and the true pose."""
    points, (r, r_true), (t, t_true) = np.array(cloud, dtype=float), turns, places
    args = *(np.array(x, dtype=float) for x in (r, t, r_true, t_true)), points
    return args, points @ args[0].T + args[1], points @ args[2].T + args[3]


@prop(ADD, reason="each point is compared with itself; near it is often another one",
      given=_POSES, corners=_cases)  # fmt: skip
def mean_of_each_point(subject: Subject, cloud: Rows, turns: Any, places: Any) -> None:
    """ADD is the mean distance of each point to itself under the other pose."""
    args, estimated, true = _posed(cloud, turns, places)
    expected = float(np.linalg.norm(estimated - true, axis=1).mean())
    close(subject(ADD, *args), expected, FINE)


@prop(ADD_S, reason="from each true point to the nearest estimated one, not the other way",
      given=_POSES, corners=_cases)  # fmt: skip
def mean_of_the_nearest(subject: Subject, cloud: Rows, turns: Any, places: Any) -> None:
    """ADD-S is the mean distance of the points under the true pose to the nearest estimated one."""
    args, estimated, true = _posed(cloud, turns, places)
    close(subject(ADD_S, *args), float(nearest(true, estimated).mean()), FINE)


#: Group, and element after which the truth looks the same.
_GROUPS = st.one_of(some.discrete, st.just(["n-fold", [0, 1, 0], 1]))


def _with_groups() -> Iterator[dict[str, Any]]:
    groups = (["n-fold", [0, 1, 0], 1], ["box", [0, 1, 0], 1], ["n-fold", [0, 1, 0], 5],
              ["n-fold", [1, 2, -4], 3])  # fmt: skip
    for i, case in enumerate(_cases()):
        yield {**case, "group": groups[i % 4]}
        yield {**case, "group": groups[(i + 1) % 4]}


@prop(MSSD, reason="the largest distance of a point, at the best of all symmetries: one for all "
      "points", given=_POSES | {"group": _GROUPS}, corners=_with_groups, weight=0.5)  # fmt: skip
def least_of_the_largest(
    subject: Subject, cloud: Rows, turns: Any, places: Any, group: list[Any]
) -> None:
    """MSSD is the least, over the group, of the largest distance of a point to itself."""
    args, estimated, _ = _posed(cloud, turns, places)
    symmetry = as_symmetry(group)
    expected = min(
        float(np.linalg.norm(estimated - args[4] @ (args[2] @ s).T - args[3], axis=1).max())
        for s in symmetry.rotations
    )
    close(subject(MSSD, *args, symmetry), expected, FINE)


@prop(MSSD, reason="a continuous symmetry is tried in steps of a hundredth of the diameter at most",
      given=_POSES | {"spin": some.real(0, 6.28)}, weight=0.25, corners=lambda: (
          {**case, "spin": 2.0} for case in _cases()
      ))  # fmt: skip
def spun_about_an_axis(subject: Subject, cloud: Rows, turns: Any, places: Any, spin: float) -> None:
    """A spin about the axis of a round object costs at most a hundredth of its diameter."""
    args, *_ = _posed(cloud, turns, places)
    estimate = args[2] @ turned([0, 1, 0], spin)
    symmetry = as_symmetry(["axis", [0, 1, 0], 1])
    value = subject(MSSD, estimate, args[3], *args[2:], symmetry)
    most = 0.01 * largest_distance(args[4]) + 0.01 * float(np.linalg.norm(args[4], axis=1).max())
    expect(
        0 <= value <= most + FINE, f"MSSD is {value!r} of a spun object, expected {most!r} at most"
    )


_CAMERAS = ([600.0, 590.0, 320.0, 240.0, 640], [1000.0, 1000.0, 500.0, 300.0, 1280],
            [300.0, 320.0, 150.0, 120.0, 320])  # fmt: skip


@prop(MSPD, reason="distances in the image, of a width of 640 pixels: the best symmetry there need "
      "not be that in space", given=_POSES | {
          "group": _GROUPS, "camera": st.sampled_from(_CAMERAS),
      }, corners=lambda: (
          {**case, "camera": _CAMERAS[i % 3]} for i, case in enumerate(_with_groups())
      ), weight=0.5)  # fmt: skip
def least_of_the_largest_in_pixels(
    subject: Subject, cloud: Rows, turns: Any, places: Any, group: list[Any], camera: list[float]
) -> None:
    """MSPD is the least, over the group, of the largest distance in an image 640 pixels wide."""
    args, estimated, _ = _posed(cloud, turns, places)
    symmetry = as_symmetry(group)
    *intrinsics, width = camera

    def projected(points: Array) -> Array:
        fx, fy, cx, cy = intrinsics
        pixels = points[:, :2] / points[:, 2:] * [fx, fy] + [cx, cy]
        return np.asarray(pixels * 640 / width)

    posed = [args[4] @ (args[2] @ s).T + args[3] for s in symmetry.rotations]
    if min(p[:, 2].min() for p in (*posed, estimated)) < 0.05:
        return
    expected = min(
        float(np.linalg.norm(projected(estimated) - projected(p), axis=1).max()) for p in posed
    )
    close(subject(MSPD, *args, symmetry, np.array(intrinsics), int(width)), expected, 1e-6)


# -- sampling of surfaces ----------------------------------------------------------------------

SAMPLE = "sample_surface"

#: A tetrahedron with faces of very different areas, and one without any area.
_MESH = (
    [[0.0, 0, 0], [0.4, 0, 0], [0, 0.1, 0], [0, 0, 0.3]],
    [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3], [0, 0, 1]],
)
#: Two triangles, of which one is nine times the other; and a long one.
_FLAT = (
    [[0.0, 0, 1], [0.3, 0, 1], [0, 0.3, 1], [1, 1, 1], [1.1, 1, 1], [1, 1.1, 1]],
    [[0, 1, 2], [3, 4, 5]],
)
_LONG = ([[0.0, 0, 0], [2.0, 0.1, 0], [0, 0, 0.01]], [[0, 1, 2]])
#: Three triangles in general position.
_GENERAL = (
    [[0.31, -0.12, 0.07], [-0.22, 0.35, 0.18], [0.14, 0.21, -0.4], [-0.09, -0.33, 0.26],
     [0.4, 0.1, 0.5]],
    [[0, 1, 2], [1, 3, 2], [0, 4, 3]],
)  # fmt: skip
_MESHES = {"general": _GENERAL, "tetrahedron": _MESH, "flat": _FLAT, "long": _LONG}

_COUNT = 4000


@prop(SAMPLE, reason="sampled by triangle instead of by area, or towards a corner, a surface is "
      "another one: every distance to it changes",
      given={"kind": st.sampled_from(sorted(_MESHES)), "seed": st.integers(0, 2**16)},
      weight=0.05, corners=lambda: ({"kind": kind, "seed": 1} for kind in _MESHES))  # fmt: skip
def uniform_by_area(subject: Subject, kind: str, seed: int) -> None:
    """Means and second moments of many points are those of the surface, to 6 standard errors."""
    vertices, triangles = np.array(_MESHES[kind][0]), np.array(_MESHES[kind][1])
    points = np.array(subject(SAMPLE, vertices, triangles, _COUNT, seed))
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    weights = areas / areas.sum()
    mean = weights @ ((a + b + c) / 3)
    # over a triangle the mean of x_i x_j is (sum of both at the corners, and at their sum) / 12
    total = a + b + c
    moments = sum(x[:, :, None] * x[:, None, :] for x in (a, b, c, total))
    second = np.einsum("t,tij->ij", weights, moments) / 12
    spread = np.sqrt(np.diag(second) - mean**2) + 1e-12
    for i in range(3):
        close(points[:, i].mean(), mean[i], 6 * spread[i] / math.sqrt(_COUNT), "a mean")
        for j in range(i + 1):
            products = points[:, i] * points[:, j]
            error = 6 * (products.std() + 1e-12) / math.sqrt(_COUNT)
            close(products.mean(), second[i, j], error, "a second moment")


@prop(SAMPLE, reason="points beside the surface add to every distance",
      given={"kind": st.sampled_from(sorted(_MESHES)), "count": st.integers(1, 60),
             "seed": st.integers(0, 2**16)},
      weight=0.25, corners=lambda: (
          {"kind": kind, "count": count, "seed": 5} for kind in _MESHES for count in (1, 200)
      ))  # fmt: skip
def on_the_surface(subject: Subject, kind: str, count: int, seed: int) -> None:
    """So many points as are asked for lie in a triangle each; one seed gives the same ones."""
    vertices, triangles = np.array(_MESHES[kind][0]), np.array(_MESHES[kind][1])
    found = subject(SAMPLE, vertices, triangles, count, seed)
    expect(len(found) == count, f"{len(found)} points, expected {count}")
    points = np.array(found)
    inside = np.zeros(count, dtype=bool)
    for a, b, c in vertices[triangles]:
        normal = np.cross(b - a, c - a)
        if not normal.any():
            continue
        frame = np.stack([b - a, c - a, normal], axis=1)
        u, v, off = np.linalg.solve(frame, (points - a).T)
        inside |= (u > -1e-9) & (v > -1e-9) & (u + v < 1 + 1e-9) & (np.abs(off) < 1e-9)
    expect(inside.all(), f"{count - inside.sum()} of {count} points are not on the surface")
    expect(subject(SAMPLE, vertices, triangles, count, seed) == found, "others with the same seed")
    if count > 1:
        expect(subject(SAMPLE, vertices, triangles, count, seed + 1) != found,
               "the same points with another seed")  # fmt: skip
