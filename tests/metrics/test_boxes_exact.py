"""The oriented IoU against exact integer arithmetic, and the clipping's two paths."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from exact_boxes import KINDS, compare, exact_iou
from scipy.spatial.transform import Rotation

from pytest_cpas.metrics import _box_clipping

UPRIGHT = (0, 0, 0, 1)


def box(quaternion: tuple, centre: tuple, extents: tuple) -> tuple:
    return quaternion, tuple(map(Fraction, centre)), tuple(map(Fraction, extents))


def test_the_exact_reference_itself() -> None:
    cube = box(UPRIGHT, (0, 0, 0), (1, 1, 1))
    assert exact_iou(cube, cube) == 1
    assert exact_iou(cube, box(UPRIGHT, (1, 0, 0), (1, 1, 1))) == 0
    assert exact_iou(cube, box(UPRIGHT, (Fraction(1, 2),) * 3, (1, 1, 1))) == Fraction(1, 15)
    assert exact_iou(cube, box((1, 2, 3, 4), (0, 0, 0), (2, 2, 2))) == Fraction(1, 8)
    # turned about z by the angle of the 3-4-5 triangle: four corner triangles are cut off, with
    # legs p and q in the ratio 3 : 4 and perimeter 1 (closed form of two rotated squares)
    shared = 1 - 4 * Fraction(1, 2) * Fraction(3, 12) * Fraction(4, 12)
    assert exact_iou(cube, box((0, 0, 1, 3), (0, 0, 0), (1, 1, 1))) == shared / (2 - shared)


@pytest.mark.parametrize("kind", KINDS)
def test_oriented_iou_is_exact(kind: str) -> None:
    difference, _, overlapping = compare(kind, 400, seed=2)
    assert difference < (1e-10 if kind == "flat" else 1e-14)
    assert overlapping > (20 if kind in ("disjoint", "touching") else 200)


def random_boxes(n: int, seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(n, rng=rng).as_matrix()
    half_a, half_b = rng.uniform(0.02, 0.3, (2, n, 3))
    return rotation, rng.normal(size=(n, 3)) * 0.1, half_a, half_b


def numpy_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_box_clipping, "_kernel", lambda pairs: None)


def test_both_paths_give_the_same_volume_and_torque(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("numba")
    from pytest_cpas.metrics._box_kernel import clip_pairs

    numpy_path(monkeypatch)
    boxes = random_boxes(3000, 4)
    slow = _box_clipping.overlap_and_torque(*boxes)
    fast = clip_pairs(*boxes, _box_clipping._FACE_CORNERS)
    assert np.mean(slow[0] > 0) > 0.5
    for a, b in zip(slow, fast, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-15)


def test_the_torque_is_the_derivative_of_the_volume(monkeypatch: pytest.MonkeyPatch) -> None:
    numpy_path(monkeypatch)
    rotation, offset, half_a, half_b = random_boxes(300, 5)
    torque = _box_clipping.overlap_and_torque(rotation, offset, half_a, half_b)[1]
    step = 1e-6
    for axis in np.eye(3):
        volumes = [
            _box_clipping.overlap_and_torque(t @ rotation, offset @ t.T, half_a, half_b)[0]
            for t in Rotation.from_rotvec(np.outer((step, -step), axis)).as_matrix()
        ]
        slope = (volumes[0] - volumes[1]) / (2 * step)
        np.testing.assert_allclose(torque @ axis, slope, atol=1e-7)
        assert np.abs(slope).max() > 1e-4
