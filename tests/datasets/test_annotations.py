"""Annotations of other types than they should be: every one in turn, in every data set that has
JSON or pickles. Each is told of, or read rightly; nothing else comes out."""

import copy
import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pytest_cpas.datasets import _tree
from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._values import check_last_rows, intrinsics, steps_per_metre
from pytest_cpas.datasets.bop import Bop
from pytest_cpas.datasets.housecat import HouseCat6D
from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.datasets.phocal import PhoCaL
from pytest_cpas.datasets.redwood import Redwood75
from pytest_cpas.datasets.tod import read_target
from pytest_cpas.datasets.wild6d import Wild6D
from pytest_cpas.reading.numbers import numbers
from pytest_cpas.types import ContractError, DataError

EYE = np.eye(3).ravel().tolist()


def image(path: Path, mode: str = "RGB", size: tuple[int, int] = (4, 4)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = np.uint16 if mode == "I;16" else np.uint8
    shape = (*size[::-1], 3) if mode == "RGB" else size[::-1]
    Image.fromarray(np.ones(shape, kind)).save(path)


def images(folder: Path, colour: str, depth: str, mask: str) -> None:
    image(folder / colour)
    image(folder / depth, "I;16")
    image(folder / mask, "L")


def dumped(value: object) -> bytes:
    return pickle.dumps(value, protocol=2)


def bop(root: Path) -> None:
    scene = root / "test" / "000001"
    images(scene, "rgb/000001.png", "depth/000001.png", "mask_visib/000001_000000.png")


def housecat(root: Path) -> None:
    scene = root / "test_scene1"
    (root / "obj_models_small_size_final").mkdir(parents=True)
    images(scene, "rgb/000001.png", "depth/000001.png", "instance/000001.png")
    (scene / "intrinsics.txt").write_text("1 0 0 0 1 0 0 0 1")
    (scene / "meta.txt").write_text("1 3 can-x\n")


def phocal(root: Path) -> None:
    sequence = root / "sequence_1"
    images(sequence, "rgb/000001.png", "depth/000001.png", "mask/000001.png")
    np.savez(sequence / "train_test_split.npz", test_idxs=np.array([1]))


def redwood(root: Path) -> None:
    image(root / "mug/rgbd/s/rgb/a.jpg")


def wild6d(root: Path) -> None:
    images(root / "test_set/mug/1/2/images", "3.jpg", "3-depth.png", "3-mask.png")


#: Class, what it needs beside annotations, and by file the annotations.
LAYOUTS = {
    "bop": (
        Bop,
        bop,
        {
            "test/000001/scene_gt.json": {
                "1": [{"obj_id": 1, "cam_R_m2c": EYE, "cam_t_m2c": [0, 0, 1000]}]
            },
            "test/000001/scene_camera.json": {"1": {"cam_K": EYE, "depth_scale": 1}},
            "test/000001/scene_gt_info.json": {"1": [{"visib_fract": 1.0}]},
            "models/models_info.json": {
                "1": {
                    **{f"min_{axis}": -50 for axis in "xyz"},
                    **{f"size_{axis}": 100 for axis in "xyz"},
                    "symmetries_discrete": [np.eye(4).ravel().tolist()],
                    "symmetries_continuous": [{"axis": [0, 1, 0], "offset": [0, 0, 0]}],
                }
            },
            "test_targets_bop19.json": [{"scene_id": 1, "im_id": 1, "obj_id": 1}],
        },
    ),
    "housecat": (
        HouseCat6D,
        housecat,
        {
            "test_scene1/labels/000001_label.pkl": {
                "class_ids": [3],
                "instance_ids": [1],
                "rotations": [[[1, 0, 0], [0, 1, 0], [0, 0, 1]]],
                "translations": [[0, 0, 1.0]],
                "gt_scales": [[0.1, 0.1, 0.1]],
            }
        },
    ),
    "phocal": (
        PhoCaL,
        phocal,
        {
            "class_obj_taxonomy.json": {
                "1": {"class_name": "can", "objs": {"1": "x"}, "scales": {"1": [0.1, 0.1, 0.1]}}
            },
            "sequence_1/scene_camera.json": {
                "rgb": {"fx": 1, "fy": 1, "cx": 0, "cy": 0, "depth_scale": 1000}
            },
            "sequence_1/rgb_scene_gt.json": {
                "1": [{"class_id": 1, "inst_id": 1, "cam_R_m2c": EYE, "cam_t_m2c": [0, 0, 1]}]
            },
        },
    ),
    "redwood": (
        Redwood75,
        redwood,
        {
            "annotations.json": {
                "s": {
                    "category": "mug",
                    "mesh": "m.obj",
                    "scale": [1, 1, 1],
                    "pose_anns": [
                        {
                            "position": [0, 0, 1],
                            "orientation": [0, 0, 0, 1],
                            "rgb_file": "a.jpg",
                            "depth_file": "a.png",
                        }
                    ],
                }
            }
        },
    ),
    "wild6d": (
        Wild6D,
        wild6d,
        {
            "test_set/mug/1/2/metadata": {"K": EYE},
            "test_set/pkl_annotations/mug/mug-1-2.pkl": {
                "annotations": [
                    {
                        "name": "mug/1/2/3",
                        "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
                        "translation": [0, 0, 1],
                        "size": [0.1, 0.1, 0.1],
                    }
                ]
            },
        },
    ),
}

WRONG = (None, True, "x", "\ud800", [], {"a": 1}, -1.5, float("nan"), 10**40)


def write(root: Path, files: dict[str, object]) -> None:
    for name, value in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        pickled = name.endswith(".pkl")
        path.write_bytes(dumped(value) if pickled else json.dumps(value).encode())


def places(value: object, at: tuple = ()) -> list[tuple]:
    """Where there is a value, as keys; of the numbers in a list only the last."""
    found = [at] if at else []
    if isinstance(value, dict):
        found += [place for key in value for place in places(value[key], (*at, key))]
    elif isinstance(value, list) and value:
        found += places(value[-1], (*at, len(value) - 1))
    return found


def scanned(name, root, scan, sources):
    """The index of a tree, without looking for a kept one, which takes longer than all the rest."""
    seen = Scan(root)
    scan(seen)
    return seen.index()


def told(kind, root: Path) -> list[str]:
    """What is said about a tree; empty if its sample is read."""
    try:
        data = kind(root)
        said = [*data.damaged, *data.missing]
        for ref in data.samples:
            if ref.id not in data.absent:
                data.load(ref)
    except (ContractError, FileNotFoundError) as error:
        return [str(error)]
    return said + ([] if data.samples else ["no samples"])


#: What is not told of, since nothing hangs on it, or any value will do.
FREE = {
    ("models/models_info.json", ("1", "symmetries_continuous", 0, "offset")),
    ("models/models_info.json", ("1", "symmetries_continuous", 0, "offset", 2)),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_values_of_other_types(layout, tmp_path, monkeypatch):
    monkeypatch.setattr(_tree, "read_index", scanned)
    kind, make, files = LAYOUTS[layout]
    root = tmp_path / "tree"
    root.mkdir()
    make(root)
    write(root, files)
    sound = told(kind, root)
    for name, content in files.items():
        for place in places(content):
            for wrong in WRONG:
                changed = copy.deepcopy(content)
                *above, last = place
                inner = changed
                for key in above:
                    inner = inner[key]
                if inner[last] == wrong and type(inner[last]) is type(wrong):
                    continue
                inner[last] = wrong
                write(root, {name: changed})
                seen = told(kind, root)
                assert all(len(line) < 3000 for line in seen)
                if (name, place) not in FREE and not harmless(name, place, wrong):
                    assert seen != sound, (name, place, wrong)
        write(root, {name: content})


def harmless(name: str, place: tuple, wrong: object) -> bool:
    """Values that mean something, or nothing that is needed, where they stand."""
    last = place[-1]
    if isinstance(wrong, bool):  # which Python takes for 1
        return last not in ("obj_id", "scene_id", "im_id", "visib_fract", "class_ids")
    if isinstance(wrong, float | int):  # a place somewhere else
        return wrong == -1.5 and last not in ("obj_id", "class_id", "inst_id")
    if wrong == []:
        return last in ("symmetries_discrete", "symmetries_continuous")
    names = last in ("class_name", "mesh", "rgb_file", "depth_file") or place[1:2] == ("objs",)
    return wrong == "x" and names


@pytest.mark.parametrize("poses", [0, 1, 3])
def test_real275_has_a_pose_for_each_object(poses, tmp_path):
    frame = tmp_path / "real_test" / "scene_1"
    for kind, mode in (("color", "RGB"), ("depth", "I;16"), ("mask", "L")):
        image(frame / f"0000_{kind}.png", mode, (640, 480))
    mask = np.ones((480, 640), np.uint8)
    mask[:240] = 3
    Image.fromarray(mask).save(frame / "0000_mask.png")
    (frame / "0000_meta.txt").write_text("1 1 m\n2 0 box\n3 6 m\n")
    (tmp_path / "gts/real_test").mkdir(parents=True)
    matrices = np.tile(np.diag([0.2, 0.2, 0.2, 1.0]), (poses, 1, 1))
    truth = tmp_path / "gts/real_test/results_real_test_scene_1_0000.pkl"
    truth.write_bytes(dumped({"gt_RTs": matrices}))
    (tmp_path / "obj_models/real_test").mkdir(parents=True)
    (tmp_path / "obj_models/real_test/m.txt").write_text("0.1 0.1 0.1")
    [line] = Real275(tmp_path).damaged
    assert f"0000.pkl: {poses} poses, but the meta file lists 2 obj" in line
    matrices = np.tile(np.diag([0.2, 0.2, 0.2, 1.0]), (2, 1, 1))
    truth.write_bytes(dumped({"gt_RTs": matrices}))
    data = Real275(tmp_path)
    assert data.truth(data.samples[0]).pose.translation.tolist() == [0, 0, 0]
    for row in ((0, 0, 0, 5), (1, 0, 0, 1)):
        matrices[1, 3] = row
        truth.write_bytes(dumped({"gt_RTs": matrices}))
        with pytest.raises(DataError, match=r"0000\.pkl: gt_RTs: the last row of matrix 1 is"):
            Real275(tmp_path).truth(data.samples[0])


def test_ids_that_are_there_twice(tmp_path):
    _, _, files = LAYOUTS["bop"]
    bop(tmp_path)
    write(tmp_path, files)
    for name in ("scene_gt", "scene_camera", "scene_gt_info"):
        file = f"test/000001/{name}.json"
        write(tmp_path, {file: {**files[file], "01": files[file]["1"]}})
    models = files["models/models_info.json"]
    write(tmp_path, {"models/models_info.json": {**models, "001": models["1"]}})
    data = Bop(tmp_path)
    assert [ref.id for ref in data.samples] == ["000001/000001/0"]
    assert any("sample '000001/000001/0' is listed twice" in line for line in data.damaged)
    assert any("object 001: number 1 is there twice" in line for line in data.damaged)


@pytest.mark.parametrize(
    "matrix",
    [
        [[1, 9, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 1, 0], [5, 5, 1]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 2]],
        [[1, 0, 0], [7, 1, 0], [0, 0, 1]],
    ],
)
def test_camera_matrix(matrix):
    with pytest.raises(DataError, match=r"K: .*, expected fx, 0, cx; 0, fy, cy; 0, 0, 1"):
        intrinsics(matrix, "K")
    assert intrinsics([[1, 0, 3], [0, 2, 4], [0, 0, 1]], "K") == [1, 2, 3, 4]


@pytest.mark.parametrize("value", [0, -1, 1e-320, 1e29, 1e-9])
def test_steps_of_depth(value):
    for scale in (None, 1.0, 1000.0):
        with pytest.raises(DataError, match=r"d: .*steps of depth; expected 1 to 1e\+07"):
            steps_per_metre(value, "d", scale)
    assert steps_per_metre(1000, "d") == steps_per_metre(0.001, "d", 1.0) == 1000


def test_last_rows():
    check_last_rows(np.empty((0, 4, 4)), "it")
    with pytest.raises(DataError, match="it: the last row of matrix 0 is"):
        check_last_rows(np.zeros((1, 4, 4)), "it")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("camera {" + "a" * 300_000 + "}", "expected kp_target"),
        ("camera { fx: 1 fx: 9 } keypoints { u: 1 }", "a block gives a value twice"),
        (
            "camera { fx: 1 fy: 1 cx: 0 cy: 0 resx: 4.7 resy: 4 } keypoints { u: 1 v: 1 z: 1 }",
            "resx, resy: .4.7, 4.0., expected integers",
        ),
    ],
)
def test_targets_of_tod(text, words):
    with pytest.raises(DataError, match=rf"^x: {words}"):
        read_target(text, "x")


@pytest.mark.parametrize("shape", [(3, 2), (2, 1, 3), (2, 3, 1), (6,)])
def test_arrays_that_lie_on_their_side_are_refused(shape):
    array = np.arange(6.0).reshape(shape)
    if shape == (3, 2):
        with pytest.raises(DataError, match=r"t: shape \(3, 2\), expected \(2, 3\)"):
            numbers(array, (2, 3), "t")
    else:
        assert numbers(array, (2, 3), "t").tolist() == [[0, 1, 2], [3, 4, 5]]
