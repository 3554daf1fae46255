"""Every usual mistake is named where it was made, and where none was, none is."""

import numpy as np
import pytest

from pytest_cpas.traces.explaining import explain
from pytest_cpas.traces.steps import RESIZINGS
from pytest_cpas.traces.values import Value

RANDOM = np.random.default_rng(0)
IMAGE = RANDOM.standard_normal((3, 24, 32))
POINTS = RANDOM.uniform(-0.5, 0.5, (200, 3))
FEATURES = RANDOM.standard_normal((1, 40, 50)).astype(np.float32)
QUATERNION = np.array([0.1, 0.5, -0.3, 0.8])
BEFORE = RANDOM.standard_normal((1, 40, 50))
SMALL = RANDOM.standard_normal((1, 4, 6, 6))


def value(array, name="x"):
    return Value.of(name, 1, "tap", "", np.asarray(array))


def found(own, theirs, *before):
    return explain(value(own), value(theirs), [(value(x, n), value(x, n)) for n, x in before])


def softmax(x, axis):
    share = np.exp(x)
    return share / share.sum(axis=axis, keepdims=True)


KEPT = RANDOM.random(POINTS.shape) > 0.4
DOT = np.zeros((12, 12), bool)
DOT[5, 6] = True
CROSS = DOT.copy()
CROSS[4:7, 6] = CROSS[5, 5:8] = True
SQUARE = np.zeros((12, 12), np.uint8)
SQUARE[3:8, 4:9] = 1
LARGE = {name: resize(SMALL, (12, 18)) for name, resize in RESIZINGS.items()}
ALIGNED, LOOSE, NEAREST = LARGE.values()

MISTAKES = {
    "sign": (-POINTS, POINTS, "every sign is the other one"),
    "transposed": (IMAGE.transpose(1, 2, 0), IMAGE, "axes in the order [1, 2, 0]"),
    "square transposed": (np.eye(3)[[1, 2, 0]], np.eye(3)[[2, 0, 1]], "transposed"),
    "reshaped": (POINTS.reshape(100, 6), POINTS, "as (100, 6) for (200, 3)"),
    "colours": (IMAGE[::-1], IMAGE, "reversed along axis 0, of 3; of colours, BGR for RGB"),
    "order": (POINTS[RANDOM.permutation(200)], POINTS, "in another order along axis 0, of 200"),
    "quaternion": (QUATERNION[[3, 0, 1, 2]], QUATERNION, "scalar first for scalar last"),
    "quaternion back": (QUATERNION[[1, 2, 3, 0]], QUATERNION, "scalar last for scalar first"),
    "crop": (np.roll(IMAGE, 1, 1)[:, 1:23], IMAGE[:, 1:23], "shifted by [-1, 0] along axes [1, 2]"),
    "one sign": (POINTS * [-1, -1, 1], POINTS, "along axis 1 the sign of [0, 1] is the other one"),
    "scale": (1.02 * POINTS, POINTS, "scaled by 1.02"),
    "units": (1000 * POINTS, POINTS, "scaled by 1000: millimetres for metres"),
    "colour range": (IMAGE / 255, IMAGE, "scaled by 0.00392157: 0..1 for 0..255"),
    "offset": (POINTS + 0.3, POINTS, "+0.3 is added to every number"),
    "focal length": (POINTS * [0.9, 0.95, 1], POINTS, "scaled along axis 1 by 0.9, 0.95, 1"),
    "centre": (POINTS + np.array([0.1, 0, -0.2]), POINTS, "along axis 1, +0.1, "),
    "normalised": (
        IMAGE * np.array([2, 3, 4])[:, None, None] + np.array([1, 2, 3])[:, None, None],
        IMAGE,
        "scaled and offset along axis 0, each of 3 on its own (a mean",
    ),
    "normalised colours": (
        IMAGE[::-1] * np.array([2, 3, 4])[:, None, None] + np.array([1, 2, 3])[:, None, None],
        IMAGE,
        "in the order [2, 1, 0] along axis 0 (of colours, BGR for RGB)",
    ),
    "half": (
        FEATURES.astype(np.float16).astype(np.float32),
        FEATURES,
        "ones of half precision (float16)",
    ),
    "bfloat16": (
        (FEATURES.view(np.uint32) & 0xFFFF0000).view(np.float32),
        FEATURES,
        "ones of bfloat16",
    ),
    "sigmoid missing": (POINTS, 1 / (1 + np.exp(-POINTS)), "the sigmoid of this, which is left"),
    "exponential too many": (np.exp(POINTS), POINTS, "it is the exponential of the reference's"),
    "root": (np.abs(POINTS), POINTS**2, "the reference is the square of this"),
    "dropout": (
        2 * POINTS * KEPT,
        POINTS,
        f"{600 - KEPT.sum()} of its 600 numbers are 0, where the reference's are not, and the"
        " others 2 times those: dropout is on",
    ),
    "mask dilated": (CROSS, DOT, "dilated by 1 pixel, with the neighbours beside"),
    "mask dilated by 2": (SQUARE, DOT, "dilated by 2 pixels, with the neighbours beside and diag"),
    "mask eroded": (DOT, CROSS, "eroded by 1 pixel, with the neighbours beside"),
    "activation missing": (FEATURES, np.maximum(FEATURES, 0), "a ReLU is missing"),
    "activation too many": (
        np.maximum(FEATURES, 0),
        FEATURES,
        "a ReLU that the reference does not",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_is_named(name):
    own, theirs, words = MISTAKES[name]
    assert any(words in each for each in found(own, theirs).fits), found(own, theirs)


@pytest.mark.parametrize(
    ("own", "theirs", "before", "words"),
    [
        (FEATURES, FEATURES + BEFORE, BEFORE, "prior is added in the reference, and not here"),
        (FEATURES + BEFORE, FEATURES, BEFORE, "prior is added here, and not in the reference"),
        (BEFORE, BEFORE * FEATURES, BEFORE, "it is prior unchanged: a step is left out"),
        (
            softmax(BEFORE, 1),
            softmax(BEFORE, 2),
            BEFORE,
            "the softmax of prior along axis 1, in the reference along 2",
        ),
        (
            np.log(softmax(BEFORE, 1)),
            np.log(softmax(BEFORE, 2)),
            BEFORE,
            "the logarithm of the softmax of prior along axis 1, in the reference along 2",
        ),
        (
            ALIGNED,
            LOOSE,
            SMALL,
            "prior resized bilinearly with corners aligned, in the reference bilinearly with",
        ),
        (NEAREST, LOOSE, SMALL, "prior resized to the nearest, in the reference bilinearly"),
        (
            BEFORE.mean(2),
            BEFORE.max(2),
            BEFORE,
            "the mean of prior along axis 2, in the reference the largest",
        ),
        (
            BEFORE.sum(1, keepdims=True),
            BEFORE.mean(1, keepdims=True),
            BEFORE,
            "the sum of prior along axis 1, in the reference the mean",
        ),
    ],
)
def test_mistake_is_named_by_what_came_before(own, theirs, before, words):
    assert any(words in each for each in found(own, theirs, ("prior", before)).fits)


def test_resizings_are_those_of_torch():
    torch = pytest.importorskip("torch")
    x = torch.from_numpy(SMALL)
    for own, keywords in (
        (ALIGNED, {"mode": "bilinear", "align_corners": True}),
        (LOOSE, {"mode": "bilinear", "align_corners": False}),
        (NEAREST, {"mode": "nearest"}),
    ):
        theirs = torch.nn.functional.interpolate(x, (12, 18), **keywords)
        np.testing.assert_allclose(own, theirs.numpy(), atol=1e-12)


@pytest.mark.parametrize("shape", [(3,), (3, 3), (1024, 3), (3, 24, 32), (1, 40, 50), (2, 4)])
def test_nothing_is_said_of_other_numbers(shape):
    random = np.random.default_rng(1)
    for _ in range(20):
        own, theirs = random.standard_normal((2, *shape))
        assert not found(own, theirs, ("before", random.standard_normal(shape))).fits


def test_nothing_that_fits_a_constant_is_told_from_noise():
    """A nearly constant value hides whatever is done to it."""
    theirs = 1 + 1e-4 * RANDOM.standard_normal((40, 50))
    own = 1 + 1e-4 * RANDOM.standard_normal((40, 50))
    assert not found(own, theirs).fits


def test_all_that_fit_are_named():
    own, theirs = np.zeros((4, 3)), np.ones((4, 3))
    own[:] = 2
    assert set(found(own, theirs).fits) == {
        "scaled by 2",
        "+1 is added to every number",
    }


def test_values_of_its_shape_are_looked_at_however_long_ago():
    others = [(f"x{i}", RANDOM.standard_normal((3, 3))) for i in range(300)]
    told = found(FEATURES, FEATURES + BEFORE, ("prior", BEFORE), *others)
    assert told.fits == ["prior is added in the reference, and not here"]


def test_part_that_differs_is_named():
    own = FEATURES.copy()
    own[0, 30:, 7] += RANDOM.standard_normal(10)
    told = found(own, FEATURES)
    assert not told.fits
    assert "along axis 1, of 40, it differs at 30 to 39 alone" in told.near
    assert "along axis 2, of 50, it differs at 7 alone" in told.near
    assert "10 of its 2000 numbers differ" in told.near


@pytest.mark.parametrize(
    ("step", "words"), [(1, "whole numbers"), (0.001, "thousandths"), (1 / 255, "255ths")]
)
def test_another_rounding_is_known(step, words):
    exact = RANDOM.uniform(0, 300, (20, 30))
    own, theirs = ((step * f(exact)).astype(np.float32) for f in (np.floor, np.rint))
    told = f"all are {words}, and none is off by more than one, as if rounded another way"
    assert told in found(own, theirs).near
    assert told not in found(own + np.float32(2 * step) * (exact > 290), theirs).near
    assert not any("rounded" in each for each in found(exact, exact + 0.3 * step).near)
    # of a mask everything is off by one
    assert not any("rounded" in each for each in found(exact > 5, exact > 7).near)


def test_part_of_a_pixel_is_measured():
    v, u = np.mgrid[:40, :50] / 6
    smooth = [np.sin(v + 0.05 * dv) * np.cos(u) for dv in (0, 1)]
    told = found(smooth[1], smooth[0])
    assert any("moved by [0.3, " in each or "moved by [0.29, " in each for each in told.near)


def test_size_of_a_rounding_is_no_more_than_that():
    own = FEATURES * (1 + 2e-4 * RANDOM.standard_normal(FEATURES.shape)).astype(np.float32)
    told = found(own, FEATURES)
    assert not told.fits
    assert any("no more than one rounding to half precision" in each for each in told.near)


def test_what_is_not_finite_and_what_is_thinned():
    own = FEATURES.copy()
    own[0, 0, :3] = np.nan
    assert found(own, FEATURES).near == ["3 of its 2000 numbers are not finite"]
    thin = explain(value(-FEATURES).thinned(7), value(FEATURES).thinned(7))
    assert thin.near == ["only a part of its numbers was kept, so nothing was tried"]


PLACE = np.array([0.1, -0.2, 0.8])
ROWS = RANDOM.standard_normal((1, 8, 32, 32)).astype(np.float32)


@pytest.mark.parametrize(
    ("own", "theirs"),
    [
        pytest.param(PLACE + np.array([0, 0, 3e-5]), PLACE, id="a small offset of one axis"),
        pytest.param(POINTS + np.array([0, 0, 3e-5]), POINTS + 1, id="beside a large offset"),
        pytest.param(FEATURES * np.float32(1 + 1e-6), FEATURES, id="float noise"),
        pytest.param(np.zeros((3, 5, 3)), RANDOM.random((3, 5, 3)), id="constant"),
        pytest.param(ROWS * (1 + 0.001 * (np.arange(32) == 7)), ROWS, id="one column alone"),
        pytest.param(np.where(np.arange(32) == 5, 0, ROWS), ROWS, id="one column of zeros"),
    ],
)
def test_what_only_nearly_explains_is_not_named(own, theirs):
    fits = found(own, theirs).fits
    assert not [words for words in fits if "scaled" in words or "order" in words], fits


def test_a_constant_is_told():
    assert found(np.full(9, 0.5), POINTS[:3].ravel()).near == [
        "it is 0.5 everywhere, the reference is not constant"
    ]


def test_bfloat16_is_not_half_precision():
    bits = FEATURES.view(np.uint32) & np.uint32(0xFFFF0000)
    [words] = found(bits.view(np.float32), FEATURES).fits
    assert "ones of bfloat16" in words
    [words] = found(FEATURES.astype(np.float16).astype(np.float32), FEATURES).fits
    assert "ones of half precision" in words
