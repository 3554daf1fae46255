"""Up axes in a report: directions of known rotations, and where the disc shows them."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import tiny
from report_schema import follow_schema
from scipy.spatial.transform import Rotation
from tables import CPAS, a_run, rows, table

from pytest_cpas.datasets.perturbed import RobustnessPoint
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.evaluation.estimates import encode_estimate
from pytest_cpas.report.document import document, run_document
from pytest_cpas.report.page import page
from pytest_cpas.report.sphere import disc
from pytest_cpas.report.up_axes import SHOWN, up_axes
from pytest_cpas.types import ContractError, Hypothesis


def judged(method=tiny.Perfect, data=None):
    run = MethodRun(method(), data or tiny.Tiny(None))
    return run, [run.judge(ref) for ref in run.samples]


def with_estimate(row, estimate):
    return replace(row, answers=(replace(row.answers[0], estimate=estimate),))


def test_directions_are_those_of_truth_and_answer():
    run, found = judged(tiny.Biased)
    told = up_axes(run, found)
    up = [0, 1, 0]
    turned = Rotation.from_euler("z", 7, degrees=True).apply(up)  # in mugs alone
    true = [Rotation.from_matrix(tiny.truth(i).pose.rotation) for i in range(tiny.COUNT)]
    for side, axes in (
        ("truth", [up] * tiny.COUNT),
        ("estimate", [turned if i % 2 else up for i in range(tiny.COUNT)]),
    ):
        expected = [rotation.apply(axis) for rotation, axis in zip(true, axes, strict=True)]
        assert told[side]["count"] == tiny.COUNT
        np.testing.assert_allclose(told[side]["directions"], expected, atol=6e-4)
        length = np.linalg.norm(np.mean(expected, axis=0))
        assert told[side]["resultant"] == pytest.approx(length, abs=1e-6)


def test_what_is_not_known():
    run, found = judged()
    assert up_axes(a_run(), rows()) == {"truth": None, "estimate": None}
    failed = [with_estimate(row, None) for row in found]
    assert up_axes(run, failed)["estimate"] is None
    assert up_axes(run, failed)["truth"]["count"] == tiny.COUNT
    run.robustness_point = RobustnessPoint("tiny", "occlusion", 1)
    assert up_axes(run, found) is None


def test_truth_that_cannot_be_read_again_is_left_out(monkeypatch):
    run, found = judged()

    def read(ref):
        if ref.id == run.samples[3].id:
            raise ContractError("torn since")
        return tiny.truth(int(ref.id.split("/")[1]))

    monkeypatch.setattr(run, "truth", read)
    assert up_axes(run, found)["truth"]["count"] == tiny.COUNT - 1


def test_images_are_not_all_read_again(monkeypatch):
    """Where a truth costs an image, those of 500 samples stand for more of them."""
    run, found = judged()
    read = []

    def truth(ref):
        read.append(ref)
        return tiny.truth(int(ref.id.split("/")[1]))

    monkeypatch.setattr(run, "truth", truth)
    many = [found[i % tiny.COUNT] for i in range(50 * tiny.COUNT)]
    run.quick_truth = False
    axes = up_axes(run, many)
    assert (axes["truth"]["count"], axes["estimate"]["count"], len(read)) == (500, 600, 500)
    run.quick_truth = True
    assert up_axes(run, many)["truth"]["count"] == 600


def test_only_some_directions_of_a_large_run_are_kept():
    run, found = judged()
    rotations = Rotation.random(1000, rng=np.random.default_rng(0)).as_matrix()
    many = [
        with_estimate(
            found[0], encode_estimate(Hypothesis(rotation=rotation, translation=[0, 0, 1]))
        )
        for rotation in rotations
    ]
    told = up_axes(run, many)["estimate"]
    assert (told["count"], len(told["directions"])) == (1000, SHOWN)
    length = np.linalg.norm(rotations[:, :, 1].mean(axis=0))
    assert told["resultant"] == pytest.approx(length, abs=1e-5)
    assert told["coverage"] == pytest.approx(1, abs=0.05)  # uniform directions


@pytest.mark.parametrize(
    ("direction", "place"),
    [
        ([0, -1, 0], (0, 0)),  # the image's up
        ([1, 0, 0], (math.sqrt(0.5), 0)),
        ([0, 0, 1], (0, -math.sqrt(0.5))),  # away
        ([0, 0, -1], (0, math.sqrt(0.5))),
        ([0, -math.cos(math.radians(60)), math.sin(math.radians(60))], (0, -0.5)),
        ([-math.sin(math.radians(120)), 0.5, 0], (-math.sin(math.radians(60)), 0)),
    ],
)
def test_disc_has_equal_areas(direction, place):
    """Up in the middle; the radius is the sine of half the angle."""
    side = {"count": 1, "resultant": 1.0, "coverage": 1.0, "directions": [direction]}
    figure = disc(side, "truth", estimate=False)
    (path,) = figure.iter("path")
    x, y = map(float, re.fullmatch(r"M([\d.]+) ([\d.]+)h0", path.get("d")).groups())
    rim = max(float(circle.get("r")) for circle in figure.iter("circle"))
    middle = float(next(figure.iter("circle")).get("cx"))
    assert ((x - middle) / rim, (y - middle) / rim) == pytest.approx(place, abs=0.002)


def test_page_shows_the_truth_once_and_every_estimate():
    run, found = judged()
    axes = up_axes(run, found)
    told = [
        run_document(
            a_run(),
            table(),
        )
        | {"method": name, "up_axes": axes}
        for name in ("a", "</script><b>", "c")
    ]
    content = document(told, 0, CPAS)
    follow_schema(content)
    text = page(content, {})
    escaped = "&lt;/script&gt;&lt;b&gt;"
    assert re.findall(r"<figcaption>(.*?)<small>", text) == ["truth", "a", escaped, "c"]
