"""The changed images of the equivariances, against the points that they hold."""

import numpy as np
import pytest

from pytest_cpas.checks.contract.equivariance import (
    half_resolution,
    mirrored,
    moved_away,
    rolled,
    shifted,
)
from pytest_cpas.types import Camera, Observation

# nothing is square, central or even
CAMERA = Camera(61, 47, 70.0, 66.0, 27.3, 21.8)


@pytest.fixture
def seen():
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:47, :61]
    mask = (abs(u - 20) < 8) & (abs(v - 30) < 6)
    depth = np.where(mask, 0.7 + 0.001 * u, 1.5).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = 0
    rgb = rng.random((47, 61, 3), np.float32)
    return Observation(category="can", rgb=rgb, depth=depth, mask=mask, camera=CAMERA)


def points(observation):
    found = observation.camera.back_project(observation.depth, observation.mask)
    return found[np.lexsort(np.round(found, 9).T)]


@pytest.mark.parametrize("change", [shifted, mirrored, rolled])
def test_every_point_goes_where_it_is_said_to_go(seen, change):
    changed = change(seen)
    expected = points(seen) @ changed.turn.T + changed.shift
    expected = expected[np.lexsort(np.round(expected, 9).T)]
    np.testing.assert_allclose(points(changed.observation), expected, atol=1e-12)
    assert not np.array_equal(changed.observation.depth, seen.depth)


def test_colour_goes_along(seen):
    for change in (shifted, mirrored, rolled):
        colours = [np.sort(o.rgb[o.mask].ravel()) for o in (seen, change(seen).observation)]
        np.testing.assert_array_equal(*colours)


def test_half_of_the_points_stay_where_they_are(seen):
    all_points = {tuple(p) for p in np.round(points(seen), 9)}
    changed = half_resolution(seen)
    kept = {tuple(p) for p in np.round(points(changed.observation), 9)}
    assert kept < all_points
    assert 0.2 < len(kept) / len(all_points) < 0.3
    np.testing.assert_array_equal(changed.turn, np.eye(3))


def test_points_that_moved_away_are_seen_where_they_then_are(seen):
    changed = moved_away(seen)
    step = changed.shift[2]
    assert step == pytest.approx(0.1 * np.median(seen.depth[seen.mask & (seen.depth > 0)]))
    true = points(seen) + changed.shift
    found = points(changed.observation)
    assert 0.7 < len(found) / len(true) < 0.9  # 1.1 ** -2 of the pixels
    nearest = np.linalg.norm(found[:, None] - true[None], axis=2).min(axis=1)
    assert nearest.max() < 0.71 * 0.8 / 66  # half a pixel, diagonally
