from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pytest_cpas.metrics.boxes import (
    axis_aligned_box_iou,
    iou_plus,
    nocs_legacy_iou,
    oriented_iou,
)
from pytest_cpas.types import ContractError, Mesh, Pose

I = np.eye(3)  # noqa: E741
O = np.zeros(3)  # noqa: E741
ONE = np.ones(3)


def turn(*degrees: float) -> np.ndarray:
    return Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()


@pytest.mark.parametrize(
    ("box_a", "box_b", "expected"),
    [
        ((I, O, ONE), (I, O, ONE), 1),
        ((I, O, ONE), (I, (0.5, 0, 0), ONE), 1 / 3),
        ((I, O, ONE), (I, (0.5, 0.5, 0.5), ONE), 0.125 / 1.875),
        ((I, O, ONE), (I, (1, 0, 0), ONE), 0),  # a shared face
        ((I, O, ONE), (I, (1, 1, 0), ONE), 0),  # a shared edge
        ((I, O, ONE), (I, (1, 1, 1), ONE), 0),  # a shared corner
        ((I, O, ONE), (I, (5, 0, 0), ONE), 0),
        ((I, O, ONE), (turn(20, 30, 40), O, 0.1 * ONE), 1e-3),  # nested
        # a square and itself turned by 45 degrees share a regular octagon: 2 (sqrt 2 - 1)
        ((I, O, ONE), (turn(0, 0, 45), O, ONE), (2**0.5 - 1) / (1 - (2**0.5 - 1))),
        ((I, O, (1, 2, 3)), (turn(0, 90, 0), O, (3, 2, 1)), 1),
        # a cube standing on a corner, cut by the thin slab through its centre: a regular hexagon
        (
            (Rotation.align_vectors([[0, 0, 1]], [[1, 1, 1]])[0].as_matrix(), O, ONE),
            (I, O, (9, 9, 1e-9)),
            0.75 * 3**0.5 * 1e-9 / (81e-9 + 1),
        ),
    ],
)
def test_closed_forms(box_a: tuple, box_b: tuple, expected: float) -> None:
    assert oriented_iou(*box_a, *box_b) == pytest.approx(expected, rel=1e-12, abs=1e-15)
    assert oriented_iou(*box_b, *box_a) == pytest.approx(expected, rel=1e-7, abs=1e-15)


def test_the_value_does_not_depend_on_frame_order_or_batch() -> None:
    rng = np.random.default_rng(1)
    n = 500
    a = (Rotation.random(n, rng=rng).as_matrix(), rng.normal(size=(n, 3)) * 0.1)
    b = (Rotation.random(n, rng=rng).as_matrix(), rng.normal(size=(n, 3)) * 0.1)
    extents_a, extents_b = rng.uniform(0.1, 0.4, (2, n, 3))
    values = oriented_iou(*a, extents_a, *b, extents_b)
    assert 0.5 < np.mean(values > 0) < 1
    np.testing.assert_allclose(oriented_iou(*b, extents_b, *a, extents_a), values, atol=1e-14)
    frame = Rotation.random(rng=rng).as_matrix()
    moved = [(frame @ r, t @ frame.T + (3, -2, 5)) for r, t in (a, b)]
    np.testing.assert_allclose(
        oriented_iou(*moved[0], extents_a, *moved[1], extents_b), values, atol=1e-13
    )
    single = [
        oriented_iou(a[0][i], a[1][i], extents_a[i], b[0][i], b[1][i], extents_b[i])
        for i in range(20)
    ]
    np.testing.assert_allclose(single, values[:20], atol=1e-15)
    grid = oriented_iou(
        a[0][:5, None], a[1][:5, None], extents_a[:5, None], b[0][:5], b[1][:5], extents_b[:5]
    )
    assert grid.shape == (5, 5)
    np.testing.assert_allclose(np.diagonal(grid), values[:5], atol=1e-15)
    assert oriented_iou(np.empty((0, 3, 3)), O, ONE, I, O, ONE).shape == (0,)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.floats(-16, 0.5), min_size=3, max_size=3),
    st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3),
    st.lists(st.floats(-9, 4), min_size=6, max_size=6),
    st.lists(st.sampled_from([0, 0.25, 0.5, 1, 1 + 1e-15]), min_size=3, max_size=3),
)
def test_nothing_crashes_and_every_value_is_an_iou(
    log_angles: list, centre: list, log_sides: list, steps: list
) -> None:
    rotation = Rotation.from_rotvec(10.0 ** np.array(log_angles)).as_matrix()
    extents = 10.0 ** np.array(log_sides).reshape(2, 3)
    start = turn(10, 200, 80)
    offset = start @ (np.array(steps) * extents.mean(axis=0))
    for box_b in (extents[1], extents[0]):
        value = oriented_iou(start, centre, extents[0], start @ rotation, centre + offset, box_b)
        assert 0 <= value <= 1


def test_an_absurdly_large_box_is_no_overflow() -> None:
    assert oriented_iou(I, O, 1e100 * ONE, I, O, 1e100 * ONE) == 1
    assert oriented_iou(I, O, 1e-100 * ONE, I, O, 1e-100 * ONE) == 1


@pytest.mark.parametrize("function", [oriented_iou, axis_aligned_box_iou, nocs_legacy_iou])
@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (2, (1, 0, 1), "positive"),
        (5, (1, -1, 1), r"extents of box b.*\[1.0, -1.0, 1.0\].*positive"),
        (2, (1, np.nan, 1), "NaN"),
        (1, (np.inf, 0, 0), "translation of box a.*infinite"),
        (0, 2 * I, "rotation of box a.*orthonormal"),
        (3, np.diag((1, 1, -1)), "rotation of box b.*reflection"),
        (4, np.zeros((2, 2)), "shape"),
        (4, np.zeros((2, 3)), None),
    ],
)
def test_bad_boxes_are_refused(function, place: int, value: object, words: str | None) -> None:
    arguments = [I, O, ONE, I, O, ONE]
    arguments[place] = value
    if words is None:
        arguments[1] = np.zeros((3, 3))
        words = "broadcast"
    with pytest.raises(ContractError, match=words):
        function(*arguments)


def test_bad_extents_are_found_in_a_batch() -> None:
    extents = np.ones((4, 3))
    extents[2, 1] = -0.5
    with pytest.raises(ContractError, match=r"\[1.0, -0.5, 1.0\]"):
        oriented_iou(I, O, extents, I, O, ONE)


def test_axis_aligned_boxes_enclose_the_corners() -> None:
    # a unit cube turned by 45 degrees about z spans sqrt 2 x sqrt 2 x 1
    assert axis_aligned_box_iou(turn(0, 0, 45), O, ONE, I, O, ONE) == pytest.approx(1 / 2)
    assert axis_aligned_box_iou(I, O, ONE, I, (0.5, 0, 0), ONE) == pytest.approx(1 / 3)
    assert axis_aligned_box_iou(I, O, ONE, I, (2, 2, 0), ONE) == 0
    # about its y axis, a box that is turned by 45 degrees is put right by one of 8 spins
    assert axis_aligned_box_iou(turn(0, 45, 0), O, ONE, I, O, ONE, spins=8) == pytest.approx(1)
    with pytest.raises(ContractError, match="spins"):
        axis_aligned_box_iou(I, O, ONE, I, O, ONE, spins=0)


def test_legacy_value_of_two_cubes_by_hand() -> None:
    # A corner's interval runs from its smallest to its largest coordinate. For a unit cube at
    # (0, 0, 2) that is [-.5 or .5, 1.5 or 2.5]; moved by (0, 0, .5) it ends at 2 or 3.
    low = {True: 0.5, False: -0.5}  # both x and y positive, or not
    own_a, own_b, shared = 1.0, 1.0, 1.0
    for both in (True, False, False, False):
        for end in (1.5, 2.5):
            own_a *= end - low[both]
            own_b *= end + 0.5 - low[both]
            shared *= end - low[both]
    expected = shared / (own_a + own_b - shared)
    value = nocs_legacy_iou(I, (0, 0, 2), ONE, I, (0, 0, 2.5), ONE)
    assert value == pytest.approx(expected, rel=1e-12)
    # no overlap of the intervals counts as 0, and identical boxes as 1
    assert nocs_legacy_iou(I, (0, 0, 2), ONE, I, (9, 9, 9), ONE) == 0
    assert nocs_legacy_iou(I, (0, 0, 2), ONE, I, (0, 0, 2), ONE) == pytest.approx(1)


def test_legacy_value_is_no_iou() -> None:
    apart = [
        nocs_legacy_iou(I, (0, 0, z), ONE, I, (0.3, 0, z), ONE) for z in (2.0, 4.0)
    ]  # the same two boxes, both moved
    assert abs(apart[0] - apart[1]) > 0.01
    # boxes that do not touch score
    assert nocs_legacy_iou(I, (0, 0, 5), ONE, I, (1.1, 0, 5), ONE) > 0.3


def test_legacy_spins_turn_box_a() -> None:
    a = (turn(0, 36, 0), (0.1, 0, 2), (1, 2, 1.5))
    b = (I, (0.1, 0, 2), (1, 2, 1.5))
    assert nocs_legacy_iou(*a, *b, spins=20) == pytest.approx(1)
    assert nocs_legacy_iou(*a, *b) < 0.99
    assert nocs_legacy_iou(*a, *b, spins=20) >= nocs_legacy_iou(*a, *b, spins=4)


CUBE = np.array(np.meshgrid((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5))).reshape(3, -1).T


def test_iou_plus_depends_on_the_shape() -> None:
    ball = Rotation.random(20000, rng=3).apply((0, 0, 0.5))
    tilted = Pose(turn(0, 0, 45), O)
    upright = Pose(I, O)
    # a ball's box does not grow when it turns, a cube's does
    assert iou_plus(ball, tilted, ball, upright) == pytest.approx(1, abs=2e-3)
    assert iou_plus(CUBE, tilted, CUBE, upright) == pytest.approx(0.5)
    # for the corners of a box it is the box-only variant
    assert iou_plus(CUBE, tilted, CUBE, upright) == pytest.approx(
        float(axis_aligned_box_iou(tilted.rotation, O, ONE, I, O, ONE))
    )


def test_iou_plus_of_meshes_ignores_unused_vertices() -> None:
    triangles = np.array([(0, 1, 2), (3, 4, 5), (6, 7, 0)])
    mesh = Mesh(CUBE, triangles)
    with_stray = Mesh(np.concatenate([CUBE, [(9, 9, 9)]]), triangles)
    pose = Pose(turn(10, 20, 30), (1, 2, 3))
    assert iou_plus(with_stray, pose, mesh, pose) == 1
    assert iou_plus(CUBE, pose, mesh, pose) == 1
    moved = Pose(pose.rotation, pose.translation + np.array([9, 0, 0]))
    assert iou_plus(mesh, pose, mesh, moved) == 0


@pytest.mark.parametrize(
    ("surface", "words"),
    [
        (np.empty((0, 3)), "no points"),
        (np.zeros((4, 3)), "enclose no volume"),
        (np.full((4, 3), np.nan), "NaN"),
        (np.zeros((4, 2)), "shape"),
    ],
)
def test_iou_plus_refuses_what_has_no_volume(surface: np.ndarray, words: str) -> None:
    pose = Pose(I, O)
    with pytest.raises(ContractError, match=words):
        iou_plus(surface, pose, CUBE, pose)
    with pytest.raises(ContractError, match=words):
        iou_plus(CUBE, pose, surface, pose)


def test_a_small_first_use_imports_no_compiler() -> None:
    code = """if True:
        import sys, numpy as np
        from pytest_cpas.metrics.boxes import oriented_iou, symmetric_iou
        from pytest_cpas.types import Symmetry
        box = np.eye(3), np.zeros(3), np.ones(3)
        for _ in range(20):
            assert oriented_iou(*box, *box) == 1
            assert symmetric_iou(*box, *box, Symmetry.about((0, 1, 0))) == 1
        heavy = {"numba", "torch", "open3d", "trimesh"} & set(sys.modules)
        assert not heavy, heavy
    """
    subprocess.run([sys.executable, "-c", code], check=True)
