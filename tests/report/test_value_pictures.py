"""Pictures of a value on two sides: which values have some, what is drawn, and the numbers beside
them."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

from pytest_cpas.report.panels import RAMPS, ValuePictures
from pytest_cpas.report.value_pictures import CHANNELS, NOT_FINITE, SIDE, value_pictures

RANDOM = np.random.default_rng(0)


def pixels(panel):
    image = Image.open(io.BytesIO(base64.b64decode(panel.image)))
    assert image.format == "WEBP"
    assert image.size == (panel.width, panel.height)
    return np.asarray(image.convert("RGB")).astype(int)


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((20, 30), [""]),
        ((1, 1, 20, 30), [""]),
        ((20, 30, 3), ["colours along axis 2"]),
        ((1, 3, 20, 30), ["colours along axis 1"]),
        ((4, 20, 30, 3), ["index 2 along axis 0, of 4; colours along axis 3"]),
        (
            (5, 20, 30),
            [
                "index 2 along axis 0, of 5",
                "index 4 along axis 0, of 5",
                "index 0 along axis 0, of 5",
            ],
        ),
        ((20, 30, 2), ["index 1 along axis 2, of 2", "index 0 along axis 2, of 2"]),
        ((1, 20, 30, 1), ["index 0 along axis 3, of 1"]),
        (
            (3, 5, 20, 30),
            [f"index 2 along axis 0, of 3; index {i} along axis 1, of 5" for i in (4, 3, 2)],
        ),
        ((100, 3), [""]),
        ((3, 100), [""]),
        ((1, 100, 2), [""]),
        ((3, 100, 3), ["index 2 along axis 0, of 3"]),
        *(((), None), ((7,), None), ((100,), None), ((3, 3), None), ((2, 4, 4), None)),
        *(((4, 1000), None), ((8, 65), None), ((0, 20), None), ((0, 3), None)),
    ],
    ids=str,
)
def test_which_values_have_pictures(shape, words):
    reference = RANDOM.standard_normal(shape)
    apart = RANDOM.standard_normal(shape)
    # a later part differs more, but for the one in the middle, which differs most
    if len(shape) in (3, 4) and words:
        axes = [axis for axis, length in enumerate(shape) if length <= 5]
        for axis in axes:
            size = np.arange(shape[axis]) + 1.0
            size[2:3] += 10 if (axis, len(shape)) != (1, 4) else 0
            if shape == (5, 20, 30):
                size = np.array([3, 1, 9, 2, 5])
            apart *= size.reshape([-1 if a == axis else 1 for a in range(len(shape))])
    drawn = value_pictures(reference + apart, reference)
    assert (drawn and [row for row, _ in drawn.rows]) == words
    if drawn:
        assert all(len(panels) == 3 for _, panels in drawn.rows)
        assert len(drawn.rows) <= CHANNELS
        assert ValuePictures.of_plain(drawn.plain()) == drawn


def test_whole_numbers_are_no_points_and_truth_values_are_an_image():
    assert value_pictures(np.ones((100, 3), int), np.zeros((100, 3), int)) is None
    mask = np.zeros((20, 20), bool)
    mask[5:9, 5:9] = True
    wider = mask.copy()
    wider[4, 5:9] = True
    [(_, [theirs, ours, apart])] = value_pictures(wider, mask).rows
    assert (theirs.scale.low, theirs.scale.high) == (0, 1)
    times = SIDE // 20
    drawn = (pixels(theirs)[::times, ::times] > 0).all(axis=-1)
    assert np.array_equal(drawn, mask)
    assert np.array_equal((pixels(ours)[::times, ::times] > 0).all(axis=-1), wider)
    high, middle = RAMPS["differences"][-1], RAMPS["differences"][2]
    found = pixels(apart)[::times, ::times]
    assert (found[wider & ~mask] == high).all()
    assert (found[wider == mask] == middle).all()


def test_text_other_shapes_and_huge_ones_have_none():
    assert value_pictures(np.array([["x"] * 20] * 20), np.zeros((20, 20))) is None
    assert value_pictures(np.zeros((20, 20)), np.zeros((20, 21))) is None
    huge = np.broadcast_to(np.float32(0), (4096, 4096))
    assert value_pictures(huge, huge) is None


def test_scale_is_of_both_and_its_ends_are_drawn():
    reference = np.linspace(-2, 3, 400).reshape(20, 20)
    here = reference.copy()
    here[4, 7] = 5.0
    [(_, [theirs, ours, apart])] = value_pictures(here, reference).rows
    for panel in (theirs, ours):
        assert (panel.scale.ramp, panel.scale.low, panel.scale.high) == ("values", -2, 5)
    times = SIDE // 20
    grey = pixels(theirs)[::times, ::times, 0]
    assert np.abs(grey - 255 * (reference + 2) / 7).max() < 1
    most = 5 - reference[4, 7]
    assert (apart.scale.low, apart.scale.high) == (-most, most)
    assert (pixels(apart)[4 * times, 7 * times] == RAMPS["differences"][-1]).all()
    assert (np.abs(pixels(apart) - RAMPS["differences"][2]).sum(-1) > 0).sum() == times**2


def test_single_number_of_a_large_image_is_seen_and_said():
    reference = RANDOM.random((480, 640))
    here = reference.copy()
    here[301, 555] -= 3
    drawn = value_pictures(here, reference)
    [(_, [theirs, _, apart])] = drawn.rows
    assert (theirs.width, theirs.height) == (SIDE, SIDE * 3 // 4)
    found = np.argwhere((pixels(apart) == RAMPS["differences"][0]).all(axis=-1))
    assert found.tolist() == [[301 * SIDE // 640, 555 * SIDE // 640]]
    assert ["more numbers than pixels" in remark for remark in drawn.remarks] == [True]


def test_order_of_colours_is_seen():
    reference = np.zeros((3, 16, 16))
    reference[0] = 1.0
    [(_, [theirs, ours, apart])] = value_pictures(reference[::-1], reference).rows
    assert (pixels(theirs) == [255, 0, 0]).all()
    assert (pixels(ours) == [0, 0, 255]).all()
    assert (apart.scale.low, apart.scale.high) == (0, 1)


@pytest.mark.parametrize("shape", [(20, 20), (3, 20, 20)])
def test_what_is_not_finite_is_magenta(shape):
    reference = RANDOM.random(shape)
    here = reference.copy()
    here[..., 3, 3] = np.nan
    here[..., 4, 4] = np.inf
    drawn = value_pictures(here, reference)
    [(_, [theirs, ours, apart])] = drawn.rows
    times = SIDE // 20
    for panel in (ours, apart):
        for at in (3, 4):
            assert (pixels(panel)[at * times, at * times] == NOT_FINITE).all()
    assert not (pixels(theirs) == NOT_FINITE).all(axis=-1).any()
    assert np.isfinite([ours.scale.high, apart.scale.high]).all()
    assert drawn.remarks == ["numbers that are not finite are magenta"]
    nothing = np.full(shape, np.nan)
    assert value_pictures(nothing, nothing) is not None


@pytest.mark.parametrize("turned", [False, True])
def test_displaced_points_are_coloured(turned):
    reference = RANDOM.standard_normal((200, 3)) * [1, 5, 0.1]
    here = reference.copy()
    here[17] += [0, 2.0, 0]
    drawn = value_pictures(*(x.T if turned else x for x in (here, reference)))
    [(_, [theirs, ours, way])] = drawn.rows
    assert ours.scale == way.scale
    assert (ours.scale.low, ours.scale.high) == (0, pytest.approx(2))
    assert theirs.scale is None
    brightest = np.array(RAMPS["sizes"][-1])

    def coloured(panel):
        return np.argwhere((pixels(panel) == brightest).all(axis=-1))

    assert len(coloured(theirs)) == 0
    assert len(coloured(ours)) == 9
    # of 2 in a spread of about 30, along the first direction
    line = coloured(way)
    length = np.ptp(line[:, 1])
    span = np.ptp(reference[:, 1].tolist() + here[:, 1].tolist())
    assert length == pytest.approx(2 / span * (SIDE - 13) + 2, abs=3)
    assert np.ptp(line[:, 0]) <= 2
    assert drawn.remarks == [
        "seen from where the reference's points are spread widest, no perspective"
    ]


def test_points_that_are_many_or_not_finite():
    reference = RANDOM.random((10_000, 2))
    here = reference.copy()
    here[3] = np.nan
    drawn = value_pictures(here, reference)
    assert drawn.remarks == [
        "1 points with numbers that are not finite are not drawn",
        "every 4th of 9999 points is drawn",
    ]
    assert value_pictures(np.full((10, 3), np.nan), reference[:10].repeat(3, 1)[:, :3]) is None
    same = np.ones((10, 3))
    assert value_pictures(same, same) is not None
