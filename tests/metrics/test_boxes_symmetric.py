"""The symmetric IoU against closed forms and dense searches of our own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_cpas.metrics import _box_ball
from pytest_cpas.metrics.boxes import oriented_iou, symmetric_iou
from pytest_cpas.types import Symmetry

I = np.eye(3)  # noqa: E741
O = np.zeros(3)  # noqa: E741
Y = Symmetry.about((0, 1, 0))
SEARCHED = 1e-6


def about_y(angle: float) -> np.ndarray:
    return Rotation.from_rotvec((0, angle, 0)).as_matrix()


@pytest.mark.parametrize("angle", [0, 1e-9, 0.3, np.pi / 4, 1.234, 2.5, -3])
def test_a_spun_box_is_found_again(angle: float) -> None:
    # three sides that differ, so that one angle (and its half turn) is right, at a kink
    for extents in ((1, 2, 3), (0.05, 0.2, 0.051), (1, 1e-3, 5), (1e-3, 1, 0.5)):
        box = (about_y(angle), (0.3, -2, 5), extents)
        assert symmetric_iou(*box, I, box[1], extents, Y) == pytest.approx(1, abs=1e-9)


def test_a_quarter_turn_swaps_the_sides() -> None:
    assert symmetric_iou(I, O, (1, 2, 3), I, O, (3, 2, 1), Y) == pytest.approx(1, abs=1e-9)
    assert symmetric_iou(I, O, (1, 2, 3), I, O, (3, 2, 1), Symmetry.none()) == pytest.approx(0.2)


def test_the_best_spin_of_a_plank_over_a_square_is_known() -> None:
    # A plank of width w, longer than a unit square's diagonal, covers w / cos(phi) of it while it
    # crosses two opposite sides, and most on the diagonal: all but two corner triangles whose legs
    # are 1 - w / sqrt 2.
    width = 0.1
    leg = 1 - width / 2**0.5
    shared = 1 - leg**2
    expected = shared / (1 + 3 * width - shared)
    value = symmetric_iou(I, O, (1, 1, 1), about_y(0.2), O, (width, 1, 3), Y)
    assert value == pytest.approx(expected, abs=1e-8)


def test_offset_squares_meet_corner_on() -> None:
    # a small square slides beside a long side: the best spin turns its corner over the edge
    for gap in (0.05, 0.1, 0.2):
        side, half = 0.4, 0.2
        depth = half * 2**0.5 - gap  # of the corner's triangle
        flat = (half - gap) * side
        corner = depth**2
        value = symmetric_iou(I, O, (2, 1, 2), about_y(0.1), (1 + gap, 0, 0), (side, 1, side), Y)
        shared = value * (4 + side**2) / (1 + value)
        assert shared >= max(flat, corner) - 1e-8


def random_pairs(kind: str, n: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    rotation_b = Rotation.random(n, rng=rng)
    extents_b = rng.uniform(0.05, 0.3, (n, 3))
    extents_a = extents_b * rng.uniform(0.8, 1.25, (n, 3))
    tilt = Rotation.from_rotvec(rng.normal(size=(n, 3)) * 0.1)
    spin = Rotation.from_rotvec(rng.uniform(0, 6, (n, 1)) * np.array([[0, 1, 0]]))
    offset = rng.normal(size=(n, 3)) * 0.01
    if kind == "random":
        tilt = Rotation.random(n, rng=rng)
        extents_a = rng.uniform(0.05, 0.3, (n, 3))
        offset *= 4
    elif kind == "square":
        extents_b[:, 2] = extents_b[:, 0]
    elif kind == "upright":
        tilt = Rotation.identity(n)
    elif kind == "same box moved":
        tilt, extents_a = Rotation.identity(n), extents_b
        offset *= 10 ** rng.uniform(-4, 0, (n, 1))
    elif kind == "thin":
        extents_b[:, 0] *= 10 ** rng.uniform(-1.5, 0, n)
        extents_a[:, rng.integers(3)] *= 10 ** rng.uniform(-1.5, 0, n)
    elif kind == "sizes":
        extents_a *= 10 ** rng.uniform(-1, 1, (n, 1))
        tilt = Rotation.random(n, rng=rng)
    return [
        (rotation_b * tilt * spin).as_matrix(), offset, extents_a,
        rotation_b.as_matrix(), np.zeros((n, 3)), extents_b,
    ]  # fmt: skip


def dense_maximum(pair: list[np.ndarray], axis: np.ndarray, samples: int) -> float:
    """Samples over the whole circle, then golden sections around the five best."""

    def value(angles: np.ndarray) -> np.ndarray:
        turned = pair[3] @ Rotation.from_rotvec(angles[:, None] * axis).as_matrix()
        return oriented_iou(pair[0], pair[1], pair[2], turned, pair[4], pair[5])

    grid = 2 * np.pi * np.arange(samples) / samples
    sampled = value(grid)
    peaks = np.flatnonzero(
        (sampled >= np.roll(sampled, 1)) & (sampled >= np.roll(sampled, -1)) & (sampled > 0)
    )
    if len(peaks) == 0:
        return 0.0
    centre = grid[peaks[np.argsort(-sampled[peaks])[:5]]]
    low, high = centre - 2 * np.pi / samples, centre + 2 * np.pi / samples
    for _ in range(36):
        a, b = high - 0.618034 * (high - low), low + 0.618034 * (high - low)
        left = value(a) > value(b)
        low, high = np.where(left, low, a), np.where(left, b, high)
    return float(max(sampled.max(), value((low + high) / 2).max()))


KINDS = ("near", "random", "square", "upright", "same box moved", "thin", "sizes")


@pytest.mark.parametrize("axis", [(0, 1, 0), (1, 2, 3)])
@pytest.mark.parametrize("kind", KINDS)
def test_the_spin_reaches_the_maximum(kind: str, axis: tuple) -> None:
    symmetry = Symmetry.about(axis)
    pairs = random_pairs(kind, 40, seed=6)
    found = symmetric_iou(*pairs, symmetry)
    expected = [dense_maximum([p[i] for p in pairs], symmetry.axis, 1440) for i in range(40)]
    shortfall = np.array(expected) - found
    assert shortfall.max() < SEARCHED
    # the dense search, whose grid is coarse, must not be much better off either
    assert np.median(np.abs(shortfall)) < SEARCHED


def test_flip_only_matters_about_an_oblique_axis() -> None:
    pairs = random_pairs("random", 30, seed=7)
    once = symmetric_iou(*pairs, Y)
    np.testing.assert_allclose(
        symmetric_iou(*pairs, Symmetry.about((0, 1, 0), flip=True)), once, atol=1e-15
    )
    oblique = symmetric_iou(*pairs, Symmetry.about((1, 2, 3)))
    flipped = symmetric_iou(*pairs, Symmetry.about((1, 2, 3), flip=True))
    assert np.all(flipped >= oblique)
    assert np.any(flipped > oblique + 0.01)


@pytest.mark.parametrize(
    "symmetry",
    [
        Symmetry.none(),
        Symmetry.box(),
        Symmetry.n_fold((0, 1, 0), 6),
        Symmetry(rotations=Rotation.create_group("T").as_matrix()),
    ],
)
def test_discrete_groups_are_tried_in_full(symmetry: Symmetry) -> None:
    pairs = random_pairs("random", 50, seed=8)
    expected = np.max(
        [
            oriented_iou(*pairs[:3], pairs[3] @ element, *pairs[4:])
            for element in symmetry.rotations
        ],
        axis=0,
    )
    np.testing.assert_allclose(symmetric_iou(*pairs, symmetry), expected, atol=1e-15)


def test_the_symmetry_turns_box_b() -> None:
    # a rod along its own y axis only rolls; one along z may sweep to where the other lies
    lying = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    rod = (0.1, 1, 0.1)
    lying_box, other = (lying, O, rod), (about_y(np.pi / 2) @ lying, O, rod)
    assert symmetric_iou(*other, *lying_box, Y) < 0.1
    assert symmetric_iou(about_y(0.4), O, (0.1, 0.1, 1), I, O, (0.1, 0.1, 1), Y) > 1 - 1e-9


def test_a_sphere_may_turn_in_any_way() -> None:
    rng = np.random.default_rng(9)
    full = Symmetry.full()
    for rotation in Rotation.random(4, rng=rng).as_matrix():
        assert symmetric_iou(rotation, O, (1, 2, 3), I, O, (3, 1, 2), full) == pytest.approx(1)
        assert symmetric_iou(rotation, O, (1, 1, 1), I, O, (0.5, 0.5, 0.5), full) == pytest.approx(
            1 / 8, abs=1e-9
        )
    # a rod in a cube lies along the space diagonal, and sticks out
    value = symmetric_iou(I, O, (1, 1, 1), I, O, (1e-3, 1e-3, 9), full)
    shared = value * (1 + 9e-6) / (1 + value)
    assert 3**0.5 * 1e-6 * 0.995 < shared < 3**0.5 * 1e-6


def test_a_sphere_beats_every_sampled_rotation() -> None:
    pairs = [p[:6] for p in random_pairs("random", 6, seed=10)]
    found = symmetric_iou(*pairs, Symmetry.full())
    turns = Rotation.random(20000, rng=11).as_matrix()
    for i, value in enumerate(found):
        a, b = [p[i] for p in pairs[:3]], [p[i] for p in pairs[3:]]
        sampled = oriented_iou(*a, b[0] @ turns, b[1], b[2]).max()
        assert sampled <= value + 1e-12
        assert value < sampled + 0.05


def test_a_sphere_is_searched_as_well_as_from_more_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    # boxes that are nearly cubes have 24 maxima of nearly the same height
    rng = np.random.default_rng(13)
    side = rng.uniform(0.1, 0.3, (5, 1)) * np.ones(3)
    a = (Rotation.random(5, rng=rng).as_matrix(), rng.normal(size=(5, 3)) * 0.01)
    pairs = (*a, side * rng.uniform(0.9, 1.1, (5, 3)), I, O, side)
    found = symmetric_iou(*pairs, Symmetry.full())
    monkeypatch.setattr(_box_ball, "_COVER", 4000)
    monkeypatch.setattr(_box_ball, "_CLIMBERS", 100)
    np.testing.assert_allclose(symmetric_iou(*pairs, Symmetry.full()), found, rtol=0, atol=1e-6)


def test_shapes_and_refusals() -> None:
    pairs = random_pairs("near", 6, seed=12)
    boxes = [p.reshape(2, 3, *p.shape[1:]) for p in pairs]
    for symmetry in (Y, Symmetry.box(), Symmetry.full()):
        assert symmetric_iou(*boxes, symmetry).shape == (2, 3)
        assert symmetric_iou(*(p[0] for p in pairs), symmetry).shape == ()
        assert symmetric_iou(*(p[:0] for p in pairs), symmetry).shape == (0,)
        with pytest.raises(ValueError, match="positive"):
            symmetric_iou(I, O, (0, 1, 1), I, O, (1, 1, 1), symmetry)
