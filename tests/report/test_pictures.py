"""The pictures of a report: where things are drawn, of which samples, and how large they are."""

import io
import math
from dataclasses import replace

import numpy as np
import pytest
import tiny
from made_documents import a_run_document
from PIL import Image
from tables import CPAS, FACTS

from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.evaluation import Answer, MethodRun, Row
from pytest_cpas.evaluation.estimates import encode_estimate, encode_shape
from pytest_cpas.report.document import document
from pytest_cpas.report.page import page
from pytest_cpas.report.pictures import draw, pictures
from pytest_cpas.report.reconstruction import ESTIMATE_COLOUR, GROUND, TRUTH_COLOUR
from pytest_cpas.types import (
    Camera,
    GroundTruth,
    Hypothesis,
    Observation,
    Pose,
    Sample,
    SampleRef,
    Symmetry,
)


def a_sample(pose: Pose, extents: list[float]) -> Sample:
    """Grey, 200 x 160, the mask in the middle."""
    camera = Camera(200, 160, 220.0, 220.0, 99.5, 79.5)
    mask = np.zeros((160, 200), bool)
    mask[70:90, 90:110] = True
    rgb = np.full((160, 200, 3), 0.5, np.float32)
    observation = Observation(
        category="mug", rgb=rgb, depth=np.ones((160, 200), np.float32), mask=mask, camera=camera
    )
    ref = SampleRef(id="s/00", category="mug", scene="s")
    return Sample(
        ref,
        observation,
        GroundTruth(pose=pose, extents=extents, symmetry=Symmetry.none(), surface=None),
    )


def panels(picture: bytes) -> tuple[np.ndarray, np.ndarray]:
    """The colour crop of a picture, without what fills its square up, and what is beside it."""
    image = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)
    side = image.shape[0]
    assert image.shape == (side, 2 * side, 3)
    filled = np.argwhere(abs(image[:, :side] - GROUND).max(axis=2) > 30)
    (top, left), (bottom, right) = filled.min(axis=0), filled.max(axis=0) + 1
    return image[top:bottom, left:right], image[:, side:]


def coloured(picture: bytes, colour: tuple[int, int, int]) -> np.ndarray:
    """Left, top, right and bottom of a colour, as shares of the colour crop."""
    image, _ = panels(picture)
    rows, columns = np.nonzero(abs(image - colour).max(axis=2) < 60)
    height, width = image.shape[:2]
    ends = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    return np.array(ends) / (width, height, width, height)


def test_boxes_are_drawn_where_the_corners_project():
    """Facing the camera, the nearer face of a box is its outline: by similar triangles."""
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.1, 0.2])
    moved = encode_estimate(
        Hypothesis(rotation=np.eye(3), translation=[0.03, 0.02, 1.0], extents=[0.1, 0.06, 0.1])
    )
    picture = draw(sample, moved, None)
    # 0.9 m in front: half 0.1 m and 0.05 m wide; what is shown is 35 % wider on either side
    across, up = 220 * 0.1 / 0.9, 220 * 0.05 / 0.9
    margin = 1 + 0.35 * 2 * across
    left, top = np.floor(99.5 - across - margin), np.floor(79.5 - up - margin)
    right, bottom = np.ceil(99.5 + across + margin) + 1, np.ceil(79.5 + up + margin) + 1
    size = np.array([right - left, bottom - top])

    def shares(x, y, half_width, half_height, distance):
        middle = np.array([99.5, 79.5]) + 220 * np.array([x, y]) / distance
        half = 220 * np.array([half_width, half_height]) / distance
        # the middle of a pixel is half a pixel from its edge
        return np.concatenate([middle - half, middle + half]) + 0.5

    for colour, expected in (
        (TRUTH_COLOUR, shares(0, 0, 0.1, 0.05, 0.9)),
        (ESTIMATE_COLOUR, shares(0.03, 0.02, 0.05, 0.03, 0.95)),
    ):
        told = (expected - [left, top, left, top]) / [*size, *size]
        assert coloured(picture, colour) == pytest.approx(told, abs=0.02), colour


@pytest.mark.parametrize(
    "translation", [[0, 0, -1.0], [0, 0, 1e-30], [1e30, 0, 1.0], [0, 0, 1e29], [50.0, 0, 0.2]]
)
def test_absurd_estimates_leave_the_truth(translation):
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.1, 0.2])
    extents = [0.1, 1e13 if translation[0] == 50 else 0.1, 0.1]
    estimate = encode_estimate(
        Hypothesis(rotation=np.eye(3), translation=translation, extents=extents)
    )
    for shape in (None, encode_shape(np.eye(3)), encode_shape(np.eye(3) * 1e29)):
        assert coloured(draw(sample, estimate, shape), TRUTH_COLOUR) == pytest.approx(
            coloured(draw(sample, None, None), TRUTH_COLOUR), abs=0.01
        )


def test_axes_tell_a_box_that_is_turned_round():
    """The lines of a box point to its right and its upper side, wherever that has gone."""
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.2, 0.2])
    for turn in (np.diag([-1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, -1.0]), np.eye(3)):
        estimate = encode_estimate(
            Hypothesis(rotation=turn, translation=[0, 0, 1.0], extents=[0.2, 0.2, 0.2])
        )
        image, _ = panels(draw(sample, estimate, None))
        found = abs(image - ESTIMATE_COLOUR).max(axis=2) < 70
        # between the middle and the nearest edge of the further face
        for axis in (0, 1):
            for side in (-1, 1):
                point = np.array([0.5, 0.5])
                point[axis] += side * 0.08
                x, y = (image.shape[0] * point).astype(int)
                there = found[y - 4 : y + 5, x - 4 : x + 5].any()
                assert there == (turn[axis, axis] == side), (turn, axis, side)


def test_reconstruction_is_seen_from_the_right_and_from_above():
    """What lies beyond the truth by 6 cm appears where an orbit of the camera puts it."""
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.1, 0.2])
    ball = np.random.default_rng(0).normal(size=(400, 3))
    ball *= 0.01 / np.linalg.norm(ball, axis=1)[:, None]
    sample = replace(sample, truth=replace(sample.truth, surface=ball))
    moved = encode_estimate(
        Hypothesis(rotation=np.eye(3), translation=[0, 0, 1.06], extents=[0.1, 0.1, 0.1])
    )
    _, image = panels(draw(sample, moved, encode_shape(ball)))

    def middle(colour):
        rows, columns = np.nonzero(abs(image - 0.75 * np.array(colour)).max(axis=2) < 45)
        return np.array([columns.mean(), rows.mean()])

    # 50 degrees to the right, 25 up; a camera on that sphere sees "away" as right and as up
    right, up = math.sin(math.radians(50)), math.cos(math.radians(50)) * math.sin(math.radians(25))
    pixels = 128 / (1.15 * math.hypot(0.1, 0.05, 0.1))
    expected = 0.06 * pixels * np.array([right, -up])
    assert middle(ESTIMATE_COLOUR) - middle(TRUTH_COLOUR) == pytest.approx(expected, abs=2)
    assert middle(TRUTH_COLOUR) == pytest.approx([128, 128], abs=2)


def test_nearer_surfaces_hide_further_ones():
    """Two discs across the line of sight, the estimated one in front and then behind."""
    a, b = math.radians(50), math.radians(25)
    sight = np.array([-math.sin(a) * math.cos(b), math.sin(b), math.cos(a) * math.cos(b)])
    across = np.cross(sight, [0, 1, 0])
    across /= np.linalg.norm(across)
    spots = np.random.default_rng(0).uniform(-0.03, 0.03, (4000, 2, 1))
    plate = spots[:, 0] * across + spots[:, 1] * np.cross(sight, across)
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.1, 0.2])
    blind = replace(sample.observation, depth=np.zeros((160, 200), np.float32))
    sample = replace(
        sample, observation=blind, truth=replace(sample.truth, surface=plate.astype(float))
    )

    def orange(shift):
        moved = encode_estimate(
            Hypothesis(
                rotation=np.eye(3), translation=[0, 0, 1.0] + shift * sight, extents=[0.1] * 3
            )
        )
        _, image = panels(draw(sample, moved, encode_shape(plate)))
        return int((image[:, :, 0] > image[:, :, 2] + 60).sum())

    assert orange(-0.05) > 5 * orange(0.05)


@pytest.mark.parametrize("surface", [None, np.zeros((1, 3))])
def test_reconstruction_without_depth_or_shapes(surface):
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.1, 0.2])
    blind = replace(sample.observation, depth=np.zeros((160, 200), np.float32))
    truth = replace(sample.truth, surface=surface)
    _, image = panels(draw(replace(sample, observation=blind, truth=truth), None, None))
    lit = abs(image - GROUND).max(axis=2) > 60
    assert lit.sum() < 20
    assert lit.any() == (surface is not None)


def test_page_of_two_hundred_pictures_is_below_ten_megabytes(monkeypatch):
    """Textured images, noisy depth all over, and a shape in each."""
    rng = np.random.default_rng(0)
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.15, 0.2])
    points = rng.uniform(-0.1, 0.1, (2000, 3))
    rgb = rng.random((40, 50, 3), np.float32).repeat(4, axis=0).repeat(4, axis=1)
    depth = (0.95 + 0.02 * rng.random((160, 200))).astype(np.float32)
    observation = replace(sample.observation, rgb=rgb, depth=depth)
    sample = replace(sample, observation=observation, truth=replace(sample.truth, surface=points))
    estimate = encode_estimate(
        Hypothesis(rotation=np.eye(3), translation=[0.01, 0, 1.02], extents=[0.2, 0.15, 0.2])
    )
    monkeypatch.setattr(MethodRun, "read", lambda run, ref: sample)
    facts = {**FACTS, "position_m": 0.5, "rotation_deg": 40.0, "iou": 0.1, "fscore_1cm": 0.2}
    judged = [
        Row(
            sample=f"s/{i:03d}",
            category="mug",
            answers=(Answer(facts=facts, estimate=estimate),),
            shape=encode_shape(points),
        )
        for i in range(30)
    ]
    data = tiny.Tiny(None)
    data.samples = [SampleRef(id=row.sample, category="mug", scene="s") for row in judged]
    runs = [MethodRun(tiny.Perfect(), data) for _ in range(12)]
    for index, run in enumerate(runs):
        run.method = f"m{index}"
    told = [a_run_document(run, judged) for run in runs]
    by_sample = {row.sample: row for row in judged}
    drawn = pictures(runs, dict.fromkeys(runs, by_sample), told)
    assert sum(map(len, drawn.values())) == 192  # as many of each, and 200 at most
    text = page(document(told, 0, CPAS), drawn)
    assert text.count("data:image/webp") == 192
    assert len(text.encode()) < 10e6


def test_flipped_samples_are_drawn_before_the_worst():
    """Lost ones first, also those that were lost since another run; gained ones too."""
    run = MethodRun(tiny.Biased(), tiny.Tiny(None))
    judged = {ref.id: run.judge(ref) for ref in run.samples}
    ids = [ref.id for ref in run.samples]
    told = a_run_document(run, list(judged.values()))
    told["flips"] = [
        {"sample": ids[0], "lost": [], "gained": ["x"]},
        {"sample": ids[2], "lost": ["x"], "gained": []},
    ]
    since = [{"sample": ids[4], "lost": ["x"], "gained": []}]
    pair = {"method": run.method, "dataset": run.dataset, "flips": since}
    (drawn,) = pictures([run], {run: judged}, [told], {"pairs": [pair]}).values()
    mugs = [name for name in ids if judged[name].category == "mug"]
    assert list(drawn)[:3] == [ids[2], ids[4], ids[0]]
    assert sorted(list(drawn)[3:]) == mugs


def test_pictures_of_real_images_are_small_enough(test_data):
    """Two hundred like those of a frame of REAL275, in base64."""
    data = Real275(test_data / "real275")
    sizes = []
    for ref in data.samples:
        if not ref.id.startswith("scene_1/0000/"):
            continue
        sample = data.load(ref)
        true = sample.truth
        moved = true.pose.translation + np.array([0.01, 0.02, 0.03])
        estimate = encode_estimate(
            Hypothesis(rotation=true.pose.rotation, translation=moved, extents=true.extents)
        )
        shape = None if true.surface is None else encode_shape(true.surface)
        sizes.append(len(draw(sample, estimate, shape)))
    assert len(sizes) == 5
    assert 200 * np.mean(sizes) * 4 / 3 < 8e6
