"""Answers of a published method, rewritten as adapters get them wrong: each mistake is named."""

import re
from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_cpas.diagnosis import Evidence, diagnose
from pytest_cpas.diagnosis.mistakes import READINGS, cameras, object_frames, units
from pytest_cpas.evaluation import Selection
from pytest_cpas.evaluation.estimates import Estimates, decode_estimates
from pytest_cpas.evaluation.predictions import StoredRun
from pytest_cpas.types import GroundTruth, MethodInfo, Pose, Symmetry

GL = np.diag([1.0, -1.0, -1.0])
#: Another source for NOCS's axes than the package: the quaternion, scalar last.
NOCS = Rotation.from_quat([0, -np.sqrt(0.5), 0, np.sqrt(0.5)]).as_matrix()
PLAIN = MethodInfo(
    name="m", categories=("mug",), needs=frozenset(), gives=frozenset(), licence="MIT"
)


@cache
def stored(folder):
    """Rows and truths of an even part of the file."""
    path = folder / "predictions" / "dualposenet_real275.npz"
    run = StoredRun(path, selection=Selection(limit=1000))
    rows = [run.judge(ref) for ref in run.samples]
    return rows, [run.truth(ref) for ref in run.samples]


@pytest.fixture
def original(test_data):
    """The evidence as it is, of a method that declares the standard frames."""
    return evidence(test_data, PLAIN)


def evidence(test_data, info):
    rows, truths = stored(test_data)
    answered = [i for i, row in enumerate(rows) if row.estimate is not None]
    return Evidence.of(
        [rows[i].category for i in answered],
        decode_estimates([rows[i].estimate for i in answered]),
        [truths[i] for i in answered],
        info,
        unanswered=Counter(row.category for row in rows if row.estimate is None),
        focal=591.0,
        scenes=[rows[i].sample.split("/")[0] for i in answered],
    )


@pytest.fixture
def correct(test_data):
    """How many rows are correct at 10 deg, 2 cm, as the metrics say."""
    rows, _ = stored(test_data)
    return sum(row.facts["rotation_deg"] <= 10 and row.facts["position_m"] <= 0.02 for row in rows)


@pytest.fixture
def boxes(test_data):
    """How many rows have an IoU of at least 0.5, as the metrics say."""
    return sum(row.facts["iou"] >= 0.5 for row in stored(test_data)[0])


def wrong(evidence, rotation=None, translation=None, extents=None):
    """The evidence with other answers."""
    old = evidence.answers
    answers = Estimates(
        old.rotation if rotation is None else rotation,
        old.translation if translation is None else translation,
        old.extents if extents is None else extents,
    )
    return replace(evidence, answers=answers)


def quaternions(evidence):
    return Rotation.from_matrix(evidence.answers.rotation).as_quat()


POSES = {
    "camera-frame-opengl": lambda e, r, t, s: (GL @ r, t @ GL, s),
    "camera-frame-opengl-rotation": lambda e, r, t, s: (GL @ r, t, s),
    "camera-frame-pytorch3d": lambda e, r, t, s: (
        np.diag([-1, -1, 1]) @ r,
        t * [-1, -1, 1],
        s,
    ),
    "camera-frame-robot": lambda e, r, t, s: (
        np.stack([r[:, 2], -r[:, 0], -r[:, 1]], axis=1),
        np.stack([t[:, 2], -t[:, 0], -t[:, 1]], axis=1),
        s,
    ),
    "translation-sign-y": lambda e, r, t, s: (r, t * [1, -1, 1], s),
    "translation-x-y-swapped": lambda e, r, t, s: (r, t[:, [1, 0, 2]], s),
    "object-frame-nocs": lambda e, r, t, s: (r @ NOCS.T, t, s[:, [2, 1, 0]]),
    "rotation-transposed": lambda e, r, t, s: (np.swapaxes(r, 1, 2), t, s),
    "pose-inverse": lambda e, r, t, s: (
        np.linalg.inv(r),
        -np.linalg.solve(r, t[..., None])[..., 0],
        s,
    ),
    "quaternion-order-wxyz": lambda e, r, t, s: (
        Rotation.from_quat(np.roll(quaternions(e), 1, axis=1)).as_matrix(),
        t,
        s,
    ),
    "quaternion-order-xyzw": lambda e, r, t, s: (
        # (x, y, z, w) handed to something that takes (w, x, y, z)
        Rotation.from_quat(quaternions(e), scalar_first=True).as_matrix(),
        t,
        s,
    ),
    "unit-mm": lambda e, r, t, s: (r, 1000 * t, s),
    "unit-cm": lambda e, r, t, s: (r, 100 * t, s),
    "depth-scale": lambda e, r, t, s: (r, t / 1.25, s),
    "principal-point": lambda e, r, t, s: (r, t + t[:, 2:] * [0.05, -0.03, 0], s),
    "camera-frame-opengl + unit-mm": lambda e, r, t, s: (GL @ r, 1000 * t @ GL, s),
    "camera-frame-opengl + object-frame-nocs": lambda e, r, t, s: (
        GL @ r @ NOCS.T,
        t @ GL,
        s[:, [2, 1, 0]],
    ),
    "rotation-transposed + unit-cm": lambda e, r, t, s: (np.swapaxes(r, 1, 2), 100 * t, s),
}


@pytest.mark.parametrize("name", POSES)
def test_wrong_poses_are_named_and_counts_restored(original, correct, name):
    answers = original.answers
    rewritten = POSES[name](original, answers.rotation, answers.translation, answers.extents)
    (found,) = diagnose(wrong(original, *rewritten))
    assert found.name == name
    assert found.category == "all"
    assert found.before.correct < 0.75 * correct
    assert found.after.total == 1000
    # what is estimated restores nearly all
    slack = 10 if found.mistakes[0].fitted else 0
    assert abs(found.after.correct - correct) <= slack


@pytest.mark.parametrize("index", range(24))
def test_all_object_frames(original, correct, index):
    axes = np.round(Rotation.create_group("O").as_matrix()[index])  # a method's from ShapeNet's
    if np.array_equal(axes, np.eye(3)):
        assert diagnose(original) == []
        return
    extents = original.answers.extents @ np.abs(axes).T
    (found,) = diagnose(wrong(original, original.answers.rotation @ axes.T, extents=extents))
    (mistake,) = found.mistakes
    np.testing.assert_array_equal(mistake.turn, axes)
    assert (mistake.name == "object-frame-nocs") == np.allclose(axes, NOCS)
    assert found.after.correct == correct


def test_declared_frames_are_where_mistakes_are_looked_for(test_data, correct):
    declared = MethodInfo(
        name="m",
        categories=("mug",),
        needs=frozenset(),
        gives=frozenset(),
        licence="MIT",
        object_frame="nocs",
        camera_frame="opengl",
    )
    sound = evidence(test_data, declared)
    assert diagnose(sound) == []
    answers = sound.answers
    (transposed,) = diagnose(wrong(sound, np.swapaxes(answers.rotation, 1, 2)))
    assert transposed.name == "rotation-transposed"
    shapenet = wrong(sound, answers.rotation @ NOCS, extents=answers.extents[:, [2, 1, 0]])
    (object_frame,) = diagnose(shapenet)
    assert object_frame.name == "object-frame-shapenet"
    assert "your object frame is ShapeNet's, not NOCS's" in object_frame.lines()[0]
    assert object_frame.lines()[1] == '  change: object_frame="shapenet" in MethodInfo'
    (camera,) = diagnose(wrong(sound, GL @ answers.rotation, answers.translation @ GL))
    assert camera.name == "camera-frame-opencv"
    assert {transposed.after, object_frame.after, camera.after} == {transposed.after}
    assert camera.after.correct == correct


def test_three_mistakes_are_found_one_after_the_other(original, correct):
    answers = original.answers
    found = diagnose(
        wrong(
            original,
            GL @ answers.rotation @ NOCS.T,
            1000 * answers.translation @ GL,
            answers.extents[:, [2, 1, 0]],
        )
    )
    names = " + ".join(finding.name for finding in found).split(" + ")
    assert sorted(names) == ["camera-frame-opengl", "object-frame-nocs", "unit-mm"]
    assert found[-1].after.correct == correct


EXTENTS = {
    "extents-halved": lambda s: s / 2,
    "extents-scaled-twice": lambda s: s * np.linalg.norm(s, axis=1, keepdims=True),
    "extents-doubled": lambda s: s * 2,
    "extents-mm": lambda s: s * 1000,
    "extents-cm": lambda s: s * 100,
    "extents-order-zyx": lambda s: s[:, [2, 1, 0]],
    "extents-order-yxz": lambda s: s[:, [1, 0, 2]],
    "extents-order-xzy": lambda s: s[:, [0, 2, 1]],
    "extents-order-zxy": lambda s: s[:, [1, 2, 0]],
    "extents-order-yzx": lambda s: s[:, [2, 0, 1]],
}


@pytest.mark.parametrize("name", EXTENTS)
def test_wrong_extents_are_named_and_counts_restored(original, boxes, name):
    (found,) = diagnose(wrong(original, extents=EXTENTS[name](original.answers.extents)))
    assert (found.name, found.part) == (name, "box")
    assert found.before.correct < found.after.correct
    assert abs(found.after.correct - boxes) <= 2


@pytest.mark.parametrize(
    ("name", "length"),
    [
        ("extents-normalised-diagonal", lambda s: np.linalg.norm(s, axis=1, keepdims=True)),
        ("extents-normalised-max", lambda s: s.max(axis=1, keepdims=True)),
    ],
)
def test_normalised_extents(original, boxes, name, length):
    extents = original.answers.extents
    (found,) = diagnose(wrong(original, extents=extents / length(extents)))
    assert found.name == name
    # the true length is better than the method's, of which nothing is left
    assert found.before.correct < 0.1 * boxes
    assert found.after.correct > 0.95 * boxes


def test_wrong_pose_and_wrong_extents(original, correct, boxes):
    answers = original.answers
    frame, size = diagnose(
        wrong(original, answers.rotation @ NOCS.T, extents=answers.extents[:, [2, 1, 0]] / 2)
    )
    assert (frame.name, size.name) == ("object-frame-nocs", "extents-halved")
    assert frame.after.correct == correct
    assert abs(size.after.correct - boxes) <= 2


def test_frame_of_one_category(original):
    """A mug's origin in the axis of its body; bowls upside down."""
    answers, categories = original.answers, original.category
    gone = np.where((categories == "mug")[:, None], answers.rotation @ [0, 0, 0.03], 0)
    (found,) = diagnose(wrong(original, translation=answers.translation + gone))
    assert (found.category, found.name) == ("mug", "object-origin")
    assert "-30.] mm" in found.lines()[0]  # where the centre lies from the wrong origin
    assert found.before.correct < 0.1 * found.after.correct
    turned = np.where(
        (categories == "bowl")[:, None, None], answers.rotation @ GL, answers.rotation
    )
    (found,) = diagnose(wrong(original, turned))
    assert found.category == "bowl"
    assert found.mistakes[0].turn[1] == pytest.approx([0, -1, 0])
    # spun about their axis, bowls look the same
    assert sum(name.startswith("object-frame") for name in found.ties) == 3


def test_half_of_the_laptops_flipped(original):
    answers = original.answers
    laptops = np.flatnonzero(original.category == "laptop")[::2]
    flipped = answers.rotation.copy()
    flipped[laptops] = flipped[laptops] @ np.diag([-1.0, 1.0, -1.0])
    (found,) = diagnose(wrong(original, flipped))
    assert (found.category, found.name) == ("laptop", "part-flip-y")


def noise(evidence, rng):
    n = len(evidence)
    return wrong(
        evidence,
        Rotation.random(n, rng=rng).as_matrix(),
        rng.uniform([-0.3, -0.3, 0.5], [0.3, 0.3, 1.5], (n, 3)),
        rng.uniform(0.05, 0.3, (n, 3)),
    )


def bad(evidence, rng):
    n, old = len(evidence), evidence.answers
    return wrong(
        evidence,
        old.rotation @ Rotation.from_rotvec(rng.normal(0, 0.4, (n, 3))).as_matrix(),
        old.translation + rng.normal(0, 0.03, (n, 3)),
        old.extents * rng.uniform(0.5, 1.5, (n, 3)),
    )


def shuffled(evidence, rng):
    order, old = rng.permutation(len(evidence)), evidence.answers
    return wrong(evidence, old.rotation[order], old.translation[order], old.extents[order])


def shuffled_within_categories(evidence, rng):
    order = np.arange(len(evidence))
    for category in np.unique(evidence.category):
        members = np.flatnonzero(evidence.category == category)
        order[members] = rng.permutation(members)
    old = evidence.answers
    return wrong(evidence, old.rotation[order], old.translation[order], old.extents[order])


def random_rotations(evidence, rng):
    return wrong(evidence, Rotation.random(len(evidence), rng=rng).as_matrix())


def no_rotation(evidence, rng):
    return wrong(evidence, np.broadcast_to(np.eye(3), (len(evidence), 3, 3)))


def mean_rotation(evidence, rng):
    mean = Rotation.from_matrix(evidence.truth.rotation).mean().as_matrix()
    return wrong(evidence, np.broadcast_to(mean, (len(evidence), 3, 3)))


def upright_but_spun(evidence, rng):
    spin = Rotation.from_euler("y", rng.uniform(0, 360, (len(evidence), 1)), degrees=True)
    return wrong(evidence, evidence.answers.rotation @ spin.as_matrix())


SIMPLY_BAD = (
    noise, bad, shuffled, shuffled_within_categories, random_rotations, no_rotation, mean_rotation,
    upright_but_spun,
)  # fmt: skip


@pytest.mark.parametrize("make", SIMPLY_BAD)
def test_nothing_is_said_of_a_method_that_is_simply_bad(original, make):
    assert diagnose(make(original, np.random.default_rng(0))) == []


@pytest.mark.parametrize("start", range(0, 800, 160))
def test_a_method_that_is_off_in_one_scene_is_not_explained_by_it(original, start):
    """In a few frames of one scene each object is off by an offset of its own."""
    assert diagnose(original.part(abs(np.arange(len(original)) - start - 40) < 40)) == []


def test_the_usual_mistakes_need_no_scenes(original):
    few = original.part(np.arange(len(original)) < 40)
    (found,) = diagnose(wrong(few, translation=1000 * few.answers.translation))
    assert found.name == "unit-mm"


def test_position_alone_is_explained_where_the_rotation_is_bad(original):
    """A method without any rotation, in millimetres: the unit is named all the same."""
    flat = np.broadcast_to(np.eye(3), (len(original), 3, 3))
    (found,) = diagnose(wrong(original, flat, 1000 * original.answers.translation))
    assert (found.part, found.name) == ("position", "unit-mm")


@pytest.mark.parametrize("size", [0, 1, 3])
def test_next_to_no_samples_prove_nothing(original, size):
    few = original.part(np.arange(len(original)) < size)
    assert diagnose(wrong(few, translation=1000 * few.answers.translation)) == []


def test_a_dozen_samples_can_be_enough():
    rng = np.random.default_rng(0)
    rotation = Rotation.random(12, rng=rng).as_matrix()
    truths = [
        GroundTruth(
            pose=Pose(r, [*rng.uniform(-0.2, 0.2, 2), 1]),
            extents=[0.1, 0.2, 0.3],
            symmetry=Symmetry.none(),
        )
        for r in rotation
    ]
    poses = Estimates(
        rotation @ NOCS.T,
        np.array([t.pose.translation for t in truths]),
        np.full((12, 3), np.nan),
    )
    (found,) = diagnose(Evidence.of(["mug"] * 12, poses, truths, PLAIN))
    assert found.name == "object-frame-nocs"
    assert found.after.correct == 12


def test_one_sample_of_each_category_can_be_enough(original):
    """Other samples' truths are then those of other categories."""
    first = [np.flatnonzero(original.category == name)[0] for name in np.unique(original.category)]
    answers = original.truth
    six = replace(original, answers=answers).part(np.isin(np.arange(len(original)), first))
    (found,) = diagnose(wrong(six, GL @ six.answers.rotation, six.answers.translation @ GL))
    assert found.name == "camera-frame-opengl"
    assert found.after.correct == 6


def test_infinite_answers_are_unanswered(original):
    far = original.answers.translation.copy()
    far[:100] = np.inf
    rebuilt = Evidence.of(
        original.category.tolist(),
        Estimates(original.answers.rotation, far, original.answers.extents),
        [
            GroundTruth(pose=Pose(r, t), extents=e, symmetry=s)
            for r, t, e, s in zip(
                original.truth.rotation,
                original.truth.translation,
                original.truth.extents,
                original.symmetry,
                strict=True,
            )
        ],
        PLAIN,
    )
    assert len(rebuilt) == len(original) - 100
    assert rebuilt.total == len(original)


def test_a_file_has_no_code_of_a_method(original):
    """What to change in a file speaks of numbers alone, of all that the fix changes."""
    for mistake in [*READINGS, *units(), *cameras(original), *object_frames(original)]:
        assert not re.search("MethodInfo|Hypothesis|\\.\\.\\.", mistake.fix_of_numbers), (
            mistake.name
        )
        for name in ("rotation", "translation", "extents"):
            if f"{name}={name}," not in mistake.fix and f"{name}=" in mistake.fix:
                assert f"{name} = " in mistake.fix_of_numbers, mistake.name
