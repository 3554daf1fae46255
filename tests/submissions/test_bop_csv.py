"""BOP's table, about known objects whose models have origins of their own."""

import json

import forms
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_cpas.datasets.bop import Bop
from pytest_cpas.evaluation import SampleError, StoredRun
from pytest_cpas.submissions import read_submission
from pytest_cpas.submissions.pairing import assign_by_position
from pytest_cpas.types import DataError

#: Centres of the models' boxes, millimetres, by number; model 7 is there twice in image 3.
CENTRES = {1: [3.0, -20.0, 1.5], 7: [0.0, 0.0, 40.0]}
OBJECTS = {(2, 0): [1, 7], (2, 3): [1, 7, 7], (10, 0): [7]}


def pose(*seed):
    made = np.eye(4)
    made[:3, :3] = Rotation.random(random_state=sum(seed)).as_matrix()
    made[:3, 3] = np.random.default_rng(seed).uniform((-0.3, -0.3, 0.7), (0.3, 0.3, 1.3))
    return made


def truths():
    """Pose of each object in the model's frame, by scene, image, place, and number."""
    return {
        (scene, image, place, number): pose(scene, image, place)
        for (scene, image), numbers in OBJECTS.items()
        for place, number in enumerate(numbers)
    }


@pytest.fixture
def dataset(tmp_path):
    root = tmp_path / "tiny"
    for scene in (2, 10):
        folder = root / f"test/{scene:06d}"
        for kind in ("rgb", "depth"):
            (folder / kind).mkdir(parents=True)
        images = [image for s, image in OBJECTS if s == scene]
        for image in images:
            for kind in ("rgb", "depth"):
                forms.png(folder / f"{kind}/{image:06d}.png", (120, 160))
        found = {
            str(image): [
                {
                    "obj_id": number,
                    "cam_R_m2c": made[:3, :3].ravel().tolist(),
                    "cam_t_m2c": (1000 * made[:3, 3]).tolist(),
                }
                for (s, i, _, number), made in truths().items()
                if (s, i) == (scene, image)
            ]
            for image in images
        }
        (folder / "scene_gt.json").write_text(json.dumps(found))
        camera = {"cam_K": [150, 0, 80, 0, 150, 60, 0, 0, 1], "depth_scale": 1}
        (folder / "scene_camera.json").write_text(json.dumps({str(i): camera for i in images}))
    models = {
        str(number): {f"min_{a}": c - 50 for a, c in zip("xyz", centre, strict=True)}
        | {f"size_{a}": 100.0 for a in "xyz"}
        for number, centre in CENTRES.items()
    }
    (root / "models").mkdir()
    (root / "models/models_info.json").write_text(json.dumps(models))
    for number in CENTRES:
        (root / f"models/obj_{number:06d}.ply").write_text(forms.PLY)
    return Bop(root)


def written(path, change=lambda place, made: made, score=0.5):
    found = [
        ((scene, image, number), score, change(place, made))
        for (scene, image, place, number), made in truths().items()
    ]
    return forms.bop(path, found[::-1])


def aside(place, made):
    """A turn by 10 degrees and a step of 2 cm, in the model's frame."""
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec([0, np.radians(10), 0]).as_matrix()
    step[:3, 3] = [0.02, 0, 0]
    return made @ step


def test_round_trip(dataset, tmp_path):
    """Errors are those of our object frame, whose origin is the centre of the box."""
    run = StoredRun(written(tmp_path / "m_tiny-test.csv"), dataset=dataset)
    assert len(run.samples) == 6
    for ref in run.samples:
        assert run.judge(ref).facts["position_m"] < 1e-9
        assert run.judge(ref).facts["iou"] is None
    assert run.notes == []
    run = StoredRun(written(tmp_path / "m_tiny-test.csv", aside), dataset=dataset)
    for ref in run.samples:
        centre = np.append(np.array(CENTRES[int(ref.category[-1])]) / 1000, 1)
        moved = np.linalg.norm((aside(0, np.eye(4)) @ centre - centre)[:3])
        facts = run.judge(ref).facts
        assert facts["position_m"] == pytest.approx(moved, abs=1e-9)
        assert facts["rotation_deg"] == pytest.approx(10, abs=1e-9)


def test_metres_are_noticed(dataset, tmp_path):
    near = written(tmp_path / "x.csv", lambda place, made: made * [[1, 1, 1, 0.001]])
    assert "are the translations in metres?" in StoredRun(near, dataset=dataset).notes[0]


def test_without_header_and_with_several_estimates(dataset, tmp_path):
    path = written(tmp_path / "x.csv")
    right = path.read_text().splitlines()[1:]
    wrong = written(path, aside, score=0.6).read_text().splitlines()[1:]
    path.write_text("\n".join([*right, *wrong, ""]))
    run = StoredRun(path, dataset=dataset)
    assert {round(run.judge(r).facts["rotation_deg"], 6) for r in run.samples} == {10}, "the surest"
    worse = [line.replace(",0.6,", ",0.4,") for line in wrong]
    path.write_text("\n".join([*right, *worse]))
    run = StoredRun(path, dataset=dataset)
    assert max(run.judge(r).facts["rotation_deg"] for r in run.samples) < 1e-6


def test_failed_estimates_count(dataset, tmp_path):
    run = StoredRun(
        written(tmp_path / "x.csv", lambda place, made: made * (np.nan if place == 1 else 1)),
        dataset=dataset,
    )
    failed = {ref.id: run.judge(ref).failure for ref in run.samples}
    assert {key for key, why in failed.items() if why} == {"000002/000000/1", "000002/000003/1"}
    assert set(failed.values()) == {None, "the stored pose is not finite"}


@pytest.mark.parametrize("factor", [1.0001, 1.02])
def test_rotations_that_are_nearly_some(factor, dataset, tmp_path):
    """As in the ground truth of LM-O; BOP's own evaluation does not mind."""
    scaled = np.diag([factor, 1, 1, 1])
    run = StoredRun(written(tmp_path / "x.csv", lambda place, made: made @ scaled), dataset=dataset)
    if factor > 1.01:
        with pytest.raises(SampleError, match="not orthonormal"):
            run.judge(run.samples[0])
        return
    assert run.notes[0] == "6 rotations are none, by little: the nearest ones are judged"
    assert max(run.judge(r).facts["rotation_deg"] for r in run.samples) < 0.01


def test_nearest_of_one_class():
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    found = np.array([[0.4, 0, 0], [0.1, 0, 0], [9, 0, 0], [np.nan] * 3])
    same = np.array([[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 1]], bool)
    # the nearer one is about the first object, so that the other is about the second
    assert assign_by_position(positions, found, same) == [[1], [0], [2, 3]]
    assert assign_by_position(positions, found[:0], same[:, :0]) == [[], [], []]
    assert assign_by_position(positions[:0], found, same[:0]) == []
    found[0] = [0.2, 0, 0]
    assert assign_by_position(positions[:1], found, same[:1]) == [[1, 0]]


LINE = "2,0,1,0.5,1 0 0 0 1 0 0 0 1,0 0 900,-1"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("2,0,1,0.5", "line 2: 4 values with commas between, expected scene_id,im_id,obj_id"),
        (LINE.replace("2,0", "2,x", 1), "line 2: im_id is 'x', expected a number"),
        (LINE.replace("0,1", "0,3", 1), "line 2: obj_id 3 is none of the data set's 2 models"),
        (LINE.replace("0.5", "high"), "line 2: score is 'high', expected a finite number"),
        (LINE.replace("0.5", "nan"), "line 2: score is 'nan', expected a finite number"),
        (LINE.replace("1 0 0 0 1", "1 0 0 0"), "line 2: R is .*, expected 9 numbers with blanks"),
        (LINE.replace("0 0 900", "0 0 1_0"), "line 2: t is '0 0 1_0', expected 3 numbers"),
        ("", "no estimates, expected a line with scene_id"),
        (f"\n{LINE}\n" * 301, "line 603: more than 300 estimates of image 000002/000000"),
    ],
)
def test_damaged_tables(line, words, dataset, tmp_path):
    path = tmp_path / "x.csv"
    path.write_text(f"scene_id,im_id,obj_id,score,R,t,time\n{line}")
    with pytest.raises(DataError, match=rf"x\.csv.*{words}"):
        read_submission(path, dataset)


def test_the_data_set_is_needed(tmp_path):
    with pytest.raises(DataError, match=r"x\.csv: a table of BOP .*: --cpas-dataset bop:DIR"):
        read_submission(written(tmp_path / "x.csv"))
