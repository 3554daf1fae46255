"""HouseCat6D, PhoCaL, Wild6D and TOD: trees of our own in the layouts that they should have."""

import dataclasses
import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from scipy.spatial.transform import Rotation
from trees import Frame, check, frame, save, save_obj

from pytest_cpas.datasets.housecat import HouseCat6D
from pytest_cpas.datasets.phocal import PhoCaL
from pytest_cpas.datasets.tod import Tod, read_target
from pytest_cpas.datasets.wild6d import Wild6D
from pytest_cpas.types import Camera, ContractError, DataError, Pose

CAMERA = Camera(160, 120, 150.0, 148.0, 80.5, 61.0)
MATRIX = "\n".join(" ".join(map(str, row)) for row in CAMERA.matrix)

#: Names of axes: z up -> y up, and NOCS -> ShapeNet, as rows of the new axes in the old.
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
FROM_NOCS = Rotation.from_quat([0, np.sqrt(0.5), 0, np.sqrt(0.5)]).as_matrix()


def extents(made: Frame, index: int) -> np.ndarray:
    return np.ptp(made.objects[index].mesh.vertices, axis=0)


def write_housecat6d(root: Path) -> list[tuple[str, Frame, int]]:
    """A cup (instance 2), a hidden box (3) and a can (5), each in two frames of test_scene1."""
    expected = []
    scene = root / "test_scene1"
    for number in range(2):
        made = frame(CAMERA, number)
        name = f"{number:06d}"
        save(scene / f"rgb/{name}.png", made.colour)
        save(scene / f"depth/{name}.png", made.millimetres)
        ids = np.choose(made.seen.instance + 1, [0, 2, 5]).astype(np.uint8)
        save(scene / f"instance/{name}.png", np.dstack([ids, ids * 0 + 9, ids * 0]))
        poses = [item.pose for item in made.objects]
        label = {
            "class_ids": [4, 1, 3],
            "instance_ids": [2, 3, 5],
            "rotations": np.stack([poses[0].rotation, np.eye(3), poses[1].rotation]),
            "translations": np.stack([poses[0].translation, [0, 0, 1], poses[1].translation]),
            "gt_scales": np.stack([extents(made, 0), [1, 1, 1], extents(made, 1)]),
        }
        (scene / "labels").mkdir(exist_ok=True)
        (scene / f"labels/{name}_label.pkl").write_bytes(pickle.dumps(label, protocol=3))
        expected += [(f"test_scene1/{name}/2", made, 0), (f"test_scene1/{name}/5", made, 1)]
    (scene / "intrinsics.txt").write_text(MATRIX)
    (scene / "meta.txt").write_text("2 4 cup-red\n3 1 box-tea\n5 3 can-fish\n")
    for index, name in enumerate(("cup/cup-red", "can/can-fish")):
        mesh = made.objects[index].mesh
        save_obj(root / f"obj_models_small_size_final/{name}.obj", mesh.vertices, mesh.triangles)
    (root / "scene01").mkdir()  # of the training scenes
    return expected


def write_phocal(root: Path) -> list[tuple[str, Frame, int]]:
    """Three frames of sequence_3, of which 0 and 2 are test images; the first object is hidden."""
    expected = []
    sequence = root / "sequence_3"
    truths = {}
    for number in range(3):
        made = frame(CAMERA, number)
        name = f"{number:06d}"
        save(sequence / f"rgb/{name}.png", made.colour)
        save(sequence / f"depth/{name}.png", (2 * made.millimetres).astype(np.uint16))
        save(
            sequence / f"mask/{name}.png", np.choose(made.seen.instance + 1, [0, 2, 3]).astype("u1")
        )
        hidden = {
            "class_id": 1,
            "inst_id": 0,
            "cam_R_m2c": np.eye(3).ravel().tolist(),
            "cam_t_m2c": [0, 0, 1],
        }
        truths[str(number)] = [hidden] + [
            {
                "class_id": class_id,
                "inst_id": 4,
                "cam_R_m2c": (item.pose.rotation @ Y_UP).ravel().tolist(),
                "cam_t_m2c": item.pose.translation.tolist(),
            }
            for item, class_id in zip(made.objects, (3, 2), strict=True)
        ]
        if number != 1:
            expected += [(f"sequence_3/{name}/2", made, 0), (f"sequence_3/{name}/3", made, 1)]
    (sequence / "rgb_scene_gt.json").write_text(json.dumps(truths))
    camera = {"fx": 150.0, "fy": 148.0, "cx": 80.5, "cy": 61.0, "depth_scale": 2000}
    (sequence / "scene_camera.json").write_text(json.dumps({"rgb": camera}))
    np.savez(sequence / "train_test_split.npz", train_idxs=[1], test_idxs=[0, 2])
    taxonomy: dict[str, Any] = {
        "1": {"class_name": "box", "objs": {"0": "box_tea"}, "scales": {"0": [1, 1, 1]}}
    }
    for index, (class_id, category) in enumerate((("3", "cup"), ("2", "can"))):
        mesh = made.objects[index].mesh
        taxonomy[class_id] = {
            "class_name": category,
            "objs": {"4": f"{category}_x"},
            "scales": {"4": np.abs(Y_UP.T @ extents(made, index)).tolist()},
        }
        path = root / f"obj_models_small_size/{category}/{category}_x.obj"
        save_obj(path, mesh.vertices @ Y_UP, mesh.triangles)
    (root / "class_obj_taxonomy.json").write_text(json.dumps(taxonomy))
    return expected


def write_wild6d(root: Path) -> list[tuple[str, Frame, int]]:
    """A mug and a bowl, each with images 0, 1 and, without a mask, 2."""
    expected = []
    for index, category in enumerate(("bowl", "mug")):
        folder = root / f"test_set/{category}/0007/2"
        annotations = []
        for number in range(3):
            made = frame(CAMERA, number, (category,))
            item = made.objects[0]
            save(folder / f"images/{number}.jpg", made.colour)
            save(folder / f"images/{number}-depth.png", made.millimetres)
            if number < 2:
                mask = 255 * made.mask(0).astype(np.uint8)
                save(folder / f"images/{number}-mask.png", np.dstack([mask, mask, mask]))
                expected.append((f"{category}/0007/2/{number}", made, 0))
            annotations.append(
                {
                    "name": f"{'cup' if index else category}/0007/2/{number:04d}",
                    "class_id": 6,
                    "rotation": item.pose.rotation @ FROM_NOCS,
                    "translation": item.pose.translation,
                    "size": np.abs(FROM_NOCS.T @ extents(made, 0)),
                }
            )
        matrix = CAMERA.matrix.T.ravel().tolist()
        (folder / "metadata").write_text(json.dumps({"K": matrix, "fps": 60}))
        path = root / f"test_set/pkl_annotations/{category}/{category}-0007-2.pkl"
        path.parent.mkdir(parents=True)
        path.write_bytes(pickle.dumps({"annotations": annotations, "num_frames": 3}))
    return expected


def save_exr(path: Path, depth: np.ndarray, channel: str = "D") -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {channel: np.ascontiguousarray(depth, np.float32)}) as file:
        file.write(str(path))


def write_tod(root: Path) -> list[tuple[str, Frame, int]]:
    """A bottle with two keypoints and a mug with three, each in two frames of a sequence."""
    expected = []
    for category in ("bottle", "mug"):
        sequence = root / f"data/{category}_0/texture_5_pose_0"
        for number in range(2):
            made = frame(CAMERA, number, (category,))
            item = made.objects[0]
            name = f"{number:06d}"
            save(sequence / f"{name}_L.png", made.colour)
            save(sequence / f"{name}_mask.png", 255 * made.mask(0).astype(np.uint8))
            depth = made.millimetres / 1000
            depth[5::10] = np.nan
            depth[6::10] = -1
            save_exr(sequence / f"{name}_Dt.exr", depth)
            made.millimetres[5::10] = made.millimetres[6::10] = 0
            low, high = item.mesh.bounds
            keypoints = np.array([[0, high[1], 0], [0, low[1], 0], [0, 0, low[2]]])
            keypoints = keypoints[: 2 if category == "bottle" else 3]
            seen = item.pose.apply(keypoints)
            points = np.column_stack([CAMERA.project(seen), seen[:, 2]])
            blocks = ["  camera {\n fx: 150.0\n fy: 148.0\n cx: 80.5\n cy: 61.0\n baseline: 0.1"]
            blocks[0] += "\n resx: 160.0\n resy: 120.0\n }"
            blocks += ["  keypoints {{\n u: {}\n v: {}\n z: {}\n }}".format(*p) for p in points]
            other = "proj_targets {\n camera {\n fx: 1.0\n }\n keypoints {\n u: 1.0\n }\n}"
            text = "kp_target {\n transform {\n element: 1.0\n }\n" + "\n".join(blocks)
            (sequence / f"{name}_L.pbtxt").write_text(text + "\n}\n" + other)
            expected.append((f"{category}_0/texture_5_pose_0/{name}", made, 0))
        lines = ["o mesh"]
        shift = np.array([0.01, 0.02, -0.03])
        lines += ["v {} {} {}".format(*v) for v in item.mesh.vertices @ Y_UP + shift]
        for index, point in enumerate(keypoints @ Y_UP + shift):
            lines.append(f"o kp.{index:03d}")
            for side in (-0.001, 0.001):
                lines.append("v {} {} {}".format(*(point + side)))
        (root / "objects").mkdir(exist_ok=True)
        (root / f"objects/{category}_0.obj").write_text("\n".join(lines))
    return expected


WRITERS = [
    (write_housecat6d, HouseCat6D),
    (write_phocal, PhoCaL),
    (write_wild6d, Wild6D),
    (write_tod, Tod),
]


@pytest.mark.parametrize(("write", "load"), WRITERS[:2])
def test_objects_with_meshes(tmp_path: Path, write, load) -> None:
    expected = write(tmp_path)
    data = load(tmp_path)
    assert [ref.id for ref in data.samples] == [name for name, _, _ in expected]
    assert data.damaged == []
    assert any("2 objects that are hidden" in line for line in data.missing)
    for ref, (_, made, index) in zip(data.samples, expected, strict=True):
        assert ref.category == ("cup", "can")[index]
        # a bowl is symmetric, and so is the can that it plays; a cup has a handle
        check(data.load(ref), made, index, category=ref.category)


def test_wild6d(tmp_path: Path) -> None:
    expected = write_wild6d(tmp_path)
    data = Wild6D(tmp_path)
    assert [ref.id for ref in data.samples] == [name for name, _, _ in expected]
    assert data.damaged == []
    (line,) = data.missing
    assert line.startswith("2 annotated images without colour, depth or mask")
    for ref, (_, made, _) in zip(data.samples, expected, strict=True):
        check(data.load(ref), made, 0, mesh=False, lossless=False)
    (tmp_path / "test_set/test_list_mug.txt").write_text("x/mug/0007/2/rgbd/1.jpg\n")
    assert [ref.id for ref in Wild6D(tmp_path).samples][2:] == ["mug/0007/2/1"]


def test_tod(tmp_path: Path) -> None:
    expected = write_tod(tmp_path)
    data = Tod(tmp_path)
    assert [ref.id for ref in data.samples] == [name for name, _, _ in expected]
    assert (data.missing, data.damaged) == ([], [])
    for ref, (_, made, _) in zip(data.samples, expected, strict=True):
        sample, item = data.load(ref), made.objects[0]
        assert ref.category == item.category
        # two keypoints leave a turn about the axis open
        turn = item.pose.rotation.T @ sample.truth.pose.rotation
        assert (np.degrees(np.arccos(np.clip(turn[1, 1], -1, 1)))) < 0.01
        np.testing.assert_allclose(sample.truth.surface, item.mesh.vertices, atol=1e-6)
        truth = dataclasses.replace(sample.truth, surface=None)
        if ref.category == "bottle":
            pose = Pose(item.pose.rotation, truth.pose.translation)
            truth = dataclasses.replace(truth, pose=pose)
        check(dataclasses.replace(sample, truth=truth), made, 0, mesh=False, distance=1e-4)


@pytest.mark.parametrize("key", ["z", "u"])
def test_keypoints_that_fit_no_model_are_damage(tmp_path: Path, key: str) -> None:
    write_tod(tmp_path)
    target = min(tmp_path.glob("data/mug*/*/*_L.pbtxt"))
    head, mark, rest = target.read_text().partition(f" {key}: ")
    number, end, rest = rest.partition("\n")
    value = 1.1 * float(number) if key == "z" else float(number) + 60
    target.write_text(f"{head}{mark}{value}{end}{rest}")
    data = Tod(tmp_path)
    [line] = data.damaged
    assert target.name in line
    assert "mm from where the model has it, at most 10 mm are taken" in line


def test_tod_camera_and_keypoints_of_a_published_target() -> None:
    """bottle_0/texture_5_pose_0/000001_L.pbtxt: keypoints as far apart as in bottle_0.obj."""
    text = """kp_target { camera { fx: 675.61713 fy: 675.61713 cx: 632.1181 cy: 338.28537
      baseline: 0.120007 resx: 1280.0 resy: 720.0 }
      keypoints { u: 417.01191 v: 412.04999 x: 0.32579056 y: 0.57229166 z: 0.75923024 visible: 1.0 }
      keypoints { u: 417.13662 v: 479.85671 x: 0.32588799 y: 0.66646765 z: 0.78489091 visible: 1.0 }
    } proj_targets { }"""
    camera, points = read_target(text, "here")
    assert camera == [1280, 720, 675.61713, 675.61713, 632.1181, 338.28537]
    assert np.linalg.norm(points[0] - points[1]) == pytest.approx(0.048 + 0.040, abs=0.003)


def label(**values: object) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        content = pickle.loads(path.read_bytes())
        path.write_bytes(pickle.dumps(content | values, protocol=3))

    return damage


def edit(change: Callable[[Any], object]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return damage


def annotation(**values: object) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        content = pickle.loads(path.read_bytes())
        content["annotations"][0] |= values
        path.write_bytes(pickle.dumps(content))

    return damage


def replace(old: str, new: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(path.read_text().replace(old, new))


def content(data: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(data)


LABEL = "test_scene1/labels/000000_label.pkl"
GT = "sequence_3/rgb_scene_gt.json"
PKL = "test_set/pkl_annotations/bowl/bowl-0007-2.pkl"
PBTXT = "data/bottle_0/texture_5_pose_0/000000_L.pbtxt"


@pytest.mark.parametrize(
    ("which", "file", "damage", "words", "left"),
    [
        (0, LABEL, content(b"\x80\x04N."), "holds a NoneType", 2),
        (0, LABEL, content(pickle.dumps(os.getcwd)), "the pickle names posix.getcwd", 2),
        (0, LABEL, label(rotations=np.full((3, 3, 3), np.nan)), "27 finite numbers", 2),
        (0, LABEL, label(class_ids=[4, 1, 11]), "of class 11", 2),
        (0, LABEL, label(instance_ids=[2, 3, 6]), "instance 6", 2),
        (0, LABEL, label(instance_ids=[2]), "expected 1 finite numbers", 2),
        (0, "test_scene1/meta.txt", content(b"2 4 ../../cup"), "CATEGORY-NAME", 0),
        (0, "test_scene1/intrinsics.txt", content(b"1 2 3"), "9 finite numbers", 0),
        (0, "test_scene1/instance/000000.png", content(b"<html>"), "not a readable image", 2),
        (0, "test_scene1/rgb/000000.png", content(b""), "not a readable image", 2),
        (1, GT, content(b"{"), "not readable JSON", 0),
        (1, GT, edit(lambda gt: gt["0"][1].pop("cam_t_m2c")), "cam_t_m2c", 2),
        (1, GT, edit(lambda gt: gt["0"][1].update(class_id=99)), "'99'", 2),
        (1, GT, edit(lambda gt: gt.update({"0": 5})), "image 0: a int, expected a list", 2),
        (1, "sequence_3/train_test_split.npz", content(b"PK\x03\x04"), "not a readable .npz", 0),
        (1, "sequence_3/scene_camera.json", edit(lambda c: c.pop("rgb")), "5 finite numbers", 0),
        (1, "sequence_3/mask/000002.png", content(b"\x89PNG"), "not a readable image", 2),
        (2, PKL, content(pickle.dumps({"annotations": 3})), "annotations is not a list", 2),
        (2, PKL, content(pickle.dumps({"annotations": [os.getcwd]})), "posix.getcwd", 2),
        (2, PKL, annotation(rotation=[1, 2]), "rotation: [1, 2], expected 9", 3),
        (2, PKL, annotation(translation=[0, 0, np.inf]), "expected 3 finite", 3),
        (2, PKL, annotation(name="../../x"), "expected CATEGORY/OBJECT/SEQUENCE/N", 3),
        (2, "test_set/bowl/0007/2/metadata", content(b"[]"), "holds a list", 2),
        (3, PBTXT, replace("keypoints", "points"), "a camera and keypoints", 3),
        (3, PBTXT, replace("z: 0", "z: -0"), "behind the camera", 3),
        (3, PBTXT, replace("fx: 150.0", "fx: wide"), "6 finite numbers", 3),
        (3, "objects/mug_0.obj", content(b"o mesh\nv 0 0 0\n"), "kp.000", 2),
        (3, "objects/mug_0.obj", content(b"o mesh\nv 0 0 0\no kp.1\nv 0 0 0\n"), "kp.000", 2),
        (3, "objects/mug_0.obj", content(b"o mesh\nv 0 0\no kp.000\nv 0 0 0\n"), "finite", 2),
    ],
)
def test_damage_is_named_and_the_rest_is_listed(tmp_path, which, file, damage, words, left) -> None:
    write, load = WRITERS[which]
    write(tmp_path)
    damage(tmp_path / file)
    data = load(tmp_path)
    assert any(words in line for line in data.damaged), data.damaged
    assert all(len(line.splitlines()) == 1 for line in data.damaged)
    assert len(data.samples) == left
    for ref in data.samples[-1:]:
        data.load(ref)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (content(b"v/1\x01"), "not a readable image"),
        (lambda path: path.write_bytes(path.read_bytes()[:400]), "not a readable image"),
        (lambda path: save_exr(path, np.ones((121, 160))), "160 x 121 pixels"),
        (lambda path: save_exr(path, np.ones((120, 160)), "Z"), "channels ['Z'], expected D"),
        (lambda path: (path.unlink(), os.mkfifo(path)), "not a regular file"),
    ],
)
def test_damaged_exr(tmp_path, damage, words) -> None:
    write_tod(tmp_path)
    damage(tmp_path / "data/bottle_0/texture_5_pose_0/000000_Dt.exr")
    data = Tod(tmp_path)
    with pytest.raises(ContractError) as caught:
        data.load(data.samples[0])
    assert words in str(caught.value)
    data.load(data.samples[1])


def test_glass_is_symmetric(tmp_path: Path) -> None:
    write_housecat6d(tmp_path)
    label(class_ids=[4, 1, 8])(tmp_path / LABEL)
    meta = tmp_path / "test_scene1" / "meta.txt"
    meta.write_text(meta.read_text().replace("can-", "glass-"))
    data = HouseCat6D(tmp_path)
    assert data.samples[1].category == "glass"
    assert data.truth(data.samples[1]).symmetry.axis.tolist() == [0, 1, 0]
    assert data.truth(data.samples[0]).symmetry.axis is None


def test_pickles_may_hold_more_than_is_read(tmp_path: Path) -> None:
    """Of any kind of value that pickles are read for."""
    more = {"bbox": np.ones((3, 4)), "notes": ["a", b"b", {1, 2}, None, 1j], "deep": {"er": [{}]}}
    for write, load, file in ((write_housecat6d, HouseCat6D, LABEL), (write_wild6d, Wild6D, PKL)):
        write(tmp_path)
        path = tmp_path / file
        path.write_bytes(pickle.dumps(pickle.loads(path.read_bytes()) | more))
        data = load(tmp_path)
        assert (len(data.samples), data.damaged) == (4, [])
        data.load(data.samples[0])


def test_missing_meshes_are_named_once(tmp_path: Path) -> None:
    write_housecat6d(tmp_path)
    (tmp_path / "obj_models_small_size_final/cup/cup-red.obj").unlink()
    data = HouseCat6D(tmp_path)
    assert "mesh cup-red.obj: shape metrics of 2 samples are n/a" in data.missing
    assert data.load(data.samples[0]).truth.surface is None


@pytest.mark.parametrize(("write", "load"), WRITERS)
def test_parent_folder_is_accepted_or_told_what_to_fetch(tmp_path, write, load) -> None:
    for given in (None, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"(?s)https://.*--cpas-data=DIR"):
            load(given)
    write(tmp_path / "tree")
    data = load(tmp_path / "tree")
    shutil.move(tmp_path / "tree", tmp_path / data.name)
    assert load(tmp_path).samples == data.samples
    assert load(tmp_path).digest == data.digest


@pytest.mark.parametrize("body", ["a" * 300_000, "a " * 150_000, "a" + " " * 300_000])
def test_a_target_of_many_letters_is_refused_at_once(body):
    with pytest.raises(DataError, match="expected"):
        read_target(f"camera {{{body}}} keypoints {{{body}}}", "x")
