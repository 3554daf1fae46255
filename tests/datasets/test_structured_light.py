"""The depth sensor of the embedded data sets with the closer pictures, and its random fields."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from pytest_cpas.datasets import _structured_light as sensor
from pytest_cpas.datasets._fields import bell, blobs, cells, smooth_bell
from pytest_cpas.datasets._scenes import box
from pytest_cpas.datasets._structured_light import draw_shift, measure
from pytest_cpas.datasets.rasterising import rasterise
from pytest_cpas.datasets.rendering import Rendering, render
from pytest_cpas.types import Camera, Pose

CAMERA = Camera(160, 120, 520.0, 610.0, 79.5, 59.5)
NO_SHIFT = (0, 0)


def card_and_wall(card: float = 0.8, wall: float = 1.0) -> tuple[Rendering, NDArray[np.bool_]]:
    """A card in front of a wall, metres away, and where it is (H, W)."""
    pieces = [
        (box(np.array([4.0, 4.0, 0.2])), Pose(np.eye(3), [0, 0, wall + 0.1])),
        (box(np.array([0.08, 0.06, 0.002])), Pose(np.eye(3), [0, 0, card + 0.001])),
    ]
    seen = render(pieces, CAMERA, rasterise)
    return seen, seen.instance == 1


def wall(distance: float) -> Rendering:
    pieces = [(box(np.array([4.0, 4.0, 0.2])), Pose(np.eye(3), [0, 0, distance + 0.1]))]
    return render(pieces, CAMERA, rasterise)


def measured(
    seen: Rendering,
    infrared: float = 0.6,
    gloss: float = 0.0,
    shift: tuple[int, int] = NO_SHIFT,
    seed: int = 0,
) -> NDArray[np.uint16]:
    shape = (CAMERA.height, CAMERA.width)
    rng = np.random.default_rng(seed)
    return measure(seen, np.full(shape, infrared), np.full(shape, gloss), CAMERA, shift, rng)


@pytest.mark.parametrize("distance", [0.6, 1.0, 1.6])
def test_depth_has_the_steps_of_disparity(distance: float) -> None:
    depth = measured(wall(distance))
    found = depth[depth > 0] / 1000
    steps = 1 / found / sensor.STEP
    # rounding to millimetres moves a step a little
    assert np.abs(steps - np.round(steps)).max() < 0.00052 / distance**2 / sensor.STEP
    assert found.mean() == pytest.approx(distance, abs=0.001 * distance**2)
    spread = np.hypot(sensor.NOISE, sensor.STEP / np.sqrt(12)) * distance**2
    assert found.std() == pytest.approx(spread, rel=0.25)  # of one distance, one rounding
    # neighbours are alike, as far as a window reaches
    error = depth[20:110, 100:150] / 1000 - distance
    near, far = (np.mean(error[:, :-n] * error[:, n:]) / np.var(error) for n in (1, 10))
    assert near > 0.5
    assert far < 0.25


@pytest.mark.parametrize("shift", [(4, 0), (-3, 2), (0, -2)])
def test_depth_lies_beside_colour_by_the_shift(shift: tuple[int, int]) -> None:
    seen, card = card_and_wall()
    depth = measured(seen, shift=shift)
    near = (depth > 0) & (depth < 900)
    centre = [np.mean(np.nonzero(part), axis=1)[::-1] for part in (near, card)]
    # a border that is lost on one side moves the centre by less than a pixel
    np.testing.assert_allclose(centre[0] - centre[1], shift, atol=0.8)


def test_the_projector_does_not_reach_left_of_what_is_in_front() -> None:
    seen, card = card_and_wall()
    lost = measured(seen) == 0
    rows, columns = np.nonzero(card)
    row = (rows.min() + rows.max()) // 2
    wide = CAMERA.fx * sensor.BASELINE * (1 / 0.8 - 1 / 1.0)  # 6.5 pixels
    left, right = columns.min(), columns.max()
    assert lost[row - 8 : row + 8, left - int(wide) + 1 : left].mean() > 0.9
    assert lost[row - 8 : row + 8, right + 3 : right + 12].mean() < 0.05
    assert lost[row - 8 : row + 8, left - int(wide) - 8 : left - int(wide) - 3].mean() < 0.05


@pytest.mark.parametrize(
    ("what", "least", "most"),
    [
        ({"infrared": 0.6}, 0.0, 0.01),
        ({"infrared": 0.04}, 0.15, 0.7),  # dark
        ({"infrared": 0.01}, 0.7, 1.0),
        ({"infrared": 0.6, "gloss": 0.95}, 0.2, 0.8),  # glass that faces the projector
        ({"infrared": 0.6, "gloss": 0.5}, 0.0, 0.01),
    ],
    ids=str,
)
def test_dark_and_glass_are_lost_in_patches(
    what: dict[str, float], least: float, most: float
) -> None:
    seen = wall(1.0)
    inside = (slice(5, 110), slice(20, 155))
    lost = np.stack([(measured(seen, **what, seed=seed) == 0)[inside] for seed in range(4)])
    assert least <= lost.mean() <= most
    if 0.1 < lost.mean() < 0.9:
        label, _ = ndimage.label(lost[0])
        sizes = np.bincount(label.ravel())[1:]
        assert sizes[sizes >= 20].sum() > 0.8 * sizes.sum()


def test_borders_and_nothing_are_lost() -> None:
    seen, _ = card_and_wall()
    depth = measured(seen)
    assert not depth[:, : sensor.BORDERS[0]].any()
    assert not depth[-sensor.BORDERS[1] :].any()
    away = render([(box(np.ones(3)), Pose(np.eye(3), [0, 0, -2.0]))], CAMERA, rasterise)
    assert not measured(away).any()


@pytest.mark.parametrize(("degrees", "least", "most"), [(60, 0, 0.02), (89, 0.95, 1)])
def test_steep_surfaces_are_lost(degrees: float, least: float, most: float) -> None:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    turn = np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    tilted = [(box(np.array([9.0, 9, 0.001])), Pose(turn, [0, 0, 1.0]))]
    lost = (measured(render(tilted, CAMERA, rasterise)) == 0)[58:62, 20:]
    assert least <= lost.mean() <= most


def test_shifts_are_as_long_as_is_said() -> None:
    rng = np.random.default_rng(3)
    drawn = np.array([draw_shift(rng) for _ in range(400)])
    length = np.hypot(*drawn.T)
    assert length.min() == pytest.approx(np.sqrt(2))
    assert length.max() == pytest.approx(np.sqrt(20))
    assert np.abs(drawn.mean(axis=0)).max() < 0.5


def test_fields_are_what_they_say() -> None:
    rng = np.random.default_rng(5)
    values = bell((300, 400), rng)
    assert values.mean() == pytest.approx(0, abs=0.01)
    assert values.std() == pytest.approx(1, abs=0.01)
    smooth = smooth_bell((300, 400), (4, 6), rng)
    assert smooth.shape == (300, 400)
    assert smooth.std() == pytest.approx(1, abs=0.05)
    # a window's overlap with itself, shifted: (1 - 3 / 6) along the columns, (1 - 1 / 4) down
    assert np.mean(smooth[:, :-3] * smooth[:, 3:]) == pytest.approx(0.5, abs=0.06)
    assert np.mean(smooth[:-1] * smooth[1:]) == pytest.approx(0.75, abs=0.06)
    patchy = blobs((300, 400), 10, rng)
    assert 0 <= patchy.min() < 0.1
    assert 0.9 < patchy.max() <= 1
    assert np.abs(np.diff(patchy, axis=1)).max() <= (2 / 10 + 1 / 5) / 3 + 1e-12
    x, y = (rng.uniform(-50, 50, 40_000) for _ in range(2))
    hashed = cells(7, x, y)
    assert hashed.mean() == pytest.approx(0.5, abs=0.02)
    assert hashed.std() == pytest.approx(12**-0.5, abs=0.02)
    np.testing.assert_array_equal(hashed, cells(7, np.floor(x) + 0.9, np.floor(y)))
    assert np.mean(hashed == cells(8, x, y)) < 0.01
    assert np.mean(hashed == cells(7, x + 1, y)) < 0.01
