"""Answers as text on rows."""

import struct
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest
import tiny
from scipy.spatial.transform import Rotation

from pytest_cpas.estimates import decode_estimates, encode_estimate
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.results import read_results
from pytest_cpas.types import Hypothesis

TURN = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix()


def test_layout():
    text = encode_estimate(Hypothesis(TURN, [0.1, -0.2, 1.5], [0.1, 0.2, 0.3]))
    assert len(text) == 80
    assert struct.unpack("<15f", b64decode(text)) == pytest.approx(
        [*TURN.ravel(), 0.1, -0.2, 1.5, 0.1, 0.2, 0.3], rel=1e-6
    )


def test_round_trip_with_and_without_extents():
    texts = [
        encode_estimate(Hypothesis(TURN, [0.1, -0.2, 1.5], [0.1, 0.2, 0.3])),
        encode_estimate(Hypothesis(np.eye(3), [1e300, 0, 1])),
    ]
    found = decode_estimates(texts)
    np.testing.assert_allclose(found.rotation, [TURN, np.eye(3)], atol=1e-7)
    np.testing.assert_allclose(found.translation, [[0.1, -0.2, 1.5], [np.inf, 0, 1]], rtol=1e-7)
    np.testing.assert_allclose(found.extents, [[0.1, 0.2, 0.3], [np.nan] * 3], rtol=1e-7)


def test_no_estimates():
    assert decode_estimates([]).rotation.shape == (0, 3, 3)


@pytest.mark.parametrize("text", ["", "AAAA", "not base64"])
def test_other_text_is_refused(text):
    with pytest.raises(ValueError, match="base64"):
        decode_estimates([text])


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
