"""Answers as text on rows."""

import struct
from base64 import b64decode, b64encode
from pathlib import Path

import numpy as np
import pytest
import tiny
from scipy.spatial.transform import Rotation

from pytest_cpas.evaluation import MethodRun, read_results
from pytest_cpas.evaluation.estimates import (
    SHAPE_POINTS,
    decode_estimates,
    decode_shape,
    encode_estimate,
    encode_shape,
)
from pytest_cpas.types import Hypothesis, Mesh

TURN = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix()


def test_layout():
    text = encode_estimate(
        Hypothesis(rotation=TURN, translation=[0.1, -0.2, 1.5], extents=[0.1, 0.2, 0.3])
    )
    assert len(text) == 80
    assert struct.unpack("<15f", b64decode(text)) == pytest.approx(
        [*TURN.ravel(), 0.1, -0.2, 1.5, 0.1, 0.2, 0.3], rel=1e-6
    )


def test_round_trip_with_and_without_extents():
    texts = [
        encode_estimate(
            Hypothesis(rotation=TURN, translation=[0.1, -0.2, 1.5], extents=[0.1, 0.2, 0.3])
        ),
        encode_estimate(Hypothesis(rotation=np.eye(3), translation=[1e30, 0, 1])),
    ]
    found = decode_estimates(texts)
    np.testing.assert_allclose(found.rotation, [TURN, np.eye(3)], atol=1e-7)
    np.testing.assert_allclose(found.translation, [[0.1, -0.2, 1.5], [1e30, 0, 1]], rtol=1e-7)
    np.testing.assert_allclose(found.extents, [[0.1, 0.2, 0.3], [np.nan] * 3], rtol=1e-7)


def test_no_estimates():
    assert decode_estimates([]).rotation.shape == (0, 3, 3)


@pytest.mark.parametrize("text", ["", "AAAA", "not base64"])
def test_other_text_is_refused(text):
    with pytest.raises(ValueError, match="base64"):
        decode_estimates([text])


@pytest.mark.parametrize(
    "values",
    [
        [0] * 9 + [0, 0, 1] + [1] * 3,
        [1, 0, 0, 0, 1, 0, 0, 0, -1] + [0, 0, 1] + [1] * 3,
        [2, 0, 0, 0, 2, 0, 0, 0, 2] + [0, 0, 1] + [1] * 3,
        [3e38] * 9 + [0, 0, 1] + [1] * 3,
        [1, 0, 0, 0, 1, 0, 0, 0, 1] + [0, 0, 3e38] + [1] * 3,
        [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 1, 0, 1],
        [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 1, -1, 1],
    ],
)
def test_what_is_no_pose_is_refused(values):
    with pytest.raises(ValueError, match=r"rotation is none|translation is beyond"):
        decode_estimates([b64encode(struct.pack("<15f", *values)).decode()])


@pytest.mark.parametrize("name", ["Perfect", "OtherFrames"])
def test_rows_hold_the_answer_in_standard_frames(name):
    run = MethodRun(getattr(tiny, name)(), tiny.Tiny(None))
    found = decode_estimates([run.judge(ref).estimate for ref in run.samples])
    truths = [tiny.truth(index) for index in range(tiny.COUNT)]
    np.testing.assert_allclose(found.rotation, [t.pose.rotation for t in truths], atol=1e-6)
    np.testing.assert_allclose(found.translation, [t.pose.translation for t in truths], atol=1e-6)
    np.testing.assert_allclose(found.extents, [t.extents for t in truths], atol=1e-6)


def test_failed_prediction_has_none():
    run = MethodRun(tiny.Refuses(), tiny.Tiny(None))
    assert run.judge(run.samples[3]).estimate is None


@pytest.mark.parametrize("where", [[], ["-n2"]])
def test_results_files_keep_it(cpas, pytester, where):
    cpas("Perfect", "--cpas-results=out", *where)
    (path,) = Path(pytester.path / "out").iterdir()
    rows = read_results(path).rows.values()
    found = decode_estimates([row.estimate for row in sorted(rows, key=lambda r: r.sample)])
    assert found.translation[5] == pytest.approx(tiny.truth(5).pose.translation)


@pytest.mark.parametrize("count", [1, 2, SHAPE_POINTS, SHAPE_POINTS + 1, 10_000])
def test_shape_keeps_points_to_half_a_step_of_its_box(count):
    size = np.array([0.3, 0.02, 0.1])
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) * size + [0, 5, 0]
    found = decode_shape(encode_shape(points))
    assert min(count, SHAPE_POINTS // 2) <= len(found) <= SHAPE_POINTS
    assert len(encode_shape(points)) == len(b64encode(bytes(24 + 3 * len(found))))
    nearest = (abs(found[:, None] - points[None]) / size).max(axis=2).argmin(axis=1)
    assert (abs(found - points[nearest]) <= size / 510 + 1e-6).all()


def test_shape_of_a_mesh_lies_on_it():
    """A square at y = 0.2 of two triangles."""
    corners = np.array([[0, 0.2, 0], [1, 0.2, 0], [1, 0.2, 1], [0, 0.2, 1]])
    found = decode_shape(encode_shape(Mesh(corners, [[0, 1, 2], [0, 2, 3]])))
    assert found.shape == (SHAPE_POINTS, 3)
    np.testing.assert_allclose(found[:, 1], 0.2, rtol=1e-6)
    # a quarter of the points in each quarter of the square: four standard deviations
    quarters = np.unique(found[:, ::2] > 0.5, axis=0, return_counts=True)[1]
    assert abs(quarters - SHAPE_POINTS / 4).max() < 4 * np.sqrt(SHAPE_POINTS * 3 / 16)


def test_absurd_shape_stays_finite():
    assert np.isfinite(decode_shape(encode_shape(np.array([[-1e29, 0, 1], [1e29, 0, 0]])))).all()


@pytest.mark.parametrize("text", ["", "AAAA", "not base64!", b64encode(bytes(24)).decode()])
def test_other_text_is_no_shape(text):
    with pytest.raises(ValueError, match=r"shape|base64|[Pp]adding"):
        decode_shape(text)


def test_shapes_are_kept_of_samples_that_are_not_correct_everywhere():
    data = tiny.Tiny(None)
    kept = {
        ref.category: row.shape
        for ref in data.samples
        if (row := MethodRun(tiny.Biased(), data, keeps_shapes=True).judge(ref))
    }
    assert kept["bowl"] is None
    assert abs(decode_shape(kept["mug"]) - tiny.POINTS).max() < 1e-3
    assert MethodRun(tiny.Biased(), data).judge(data.samples[1]).shape is None
