"""CAMERA25 and real_train: trees of our own in the published layouts, poses from NOCS maps."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from trees import Frame, check, frame, save, save_obj

from pytest_cpas.datasets.nocs import REAL_CAMERA, NocsTree, Real275
from pytest_cpas.datasets.nocs_fitted import CAMERA_CAMERA, Camera25, FittedTree, RealTrain
from pytest_cpas.types import ContractError
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET

CLASS_IDS = {"bowl": 2, "mug": 6}
SYNSETS = {"bowl": "02880940", "mug": "03797390"}


#: The meshes of CAMERA25 need not be centred: where the box's centre is, NOCS axes and units.
CENTRE = np.array([0.03, -0.02, 0.04])


def coordinates(made: Frame, centre: np.ndarray) -> np.ndarray:
    """``coord.png``: red, green and blue are x, y and 1 - z of the NOCS map."""
    pixels = np.full((*made.seen.depth.shape, 3), 255, np.uint8)
    for index, item in enumerate(made.objects):
        low, high = item.mesh.bounds
        nocs = made.object_points(index) @ NOCS_FROM_SHAPENET.T / np.linalg.norm(high - low)
        nocs += centre + 0.5
        nocs[:, 2] = 1 - nocs[:, 2]
        pixels[made.mask(index)] = np.round(255 * nocs)
    return pixels


def write_camera25(root: Path) -> dict[str, Frame]:
    """Two frames with a mug (mask id 1), a hidden mug (2) and a bowl (4)."""
    frames = {}
    for number in range(2):
        made = frame(CAMERA_CAMERA, number)
        stem = f"val/0000{number}/0003"
        ids = np.choose(made.seen.instance + 1, [255, 1, 4]).astype(np.uint8)
        other = np.full_like(ids, 7)
        save(root / f"{stem}_mask.png", np.stack([ids, other, other, other + 248], axis=-1))
        save(root / f"{stem}_color.png", np.dstack([made.colour, other]))
        save(root / f"{stem}_coord.png", np.dstack([coordinates(made, CENTRE), other]))
        save(root / f"camera_full_depths/{stem}_composed.png", made.millimetres)
        lines = ["4 2 02880940 b", "1 6 03797390 m", "2 6 03797390 m", "3 0 00000000 thing"]
        (root / f"{stem}_meta.txt").write_text("\n".join(lines))
        frames[stem.removeprefix("val/")] = made
    for item, name in zip(made.objects, ("m", "b"), strict=True):
        low, high = item.mesh.bounds
        nocs = item.mesh.vertices @ NOCS_FROM_SHAPENET.T / np.linalg.norm(high - low) + CENTRE
        path = root / f"obj_models/val/{SYNSETS[item.category]}/{name}/model.obj"
        save_obj(path, nocs * [1, 1, -1], item.mesh.triangles[:, ::-1])
    return frames


def write_real_train(root: Path) -> dict[str, Frame]:
    made = frame(REAL_CAMERA, 3)
    stem = "real_train/scene_2/0010"
    save(root / f"{stem}_mask.png", np.choose(made.seen.instance + 1, [255, 1, 4]).astype(np.uint8))
    save(root / f"{stem}_color.png", made.colour)
    save(root / f"{stem}_coord.png", coordinates(made, np.zeros(3)))
    save(root / f"{stem}_depth.png", made.millimetres)
    (root / f"{stem}_meta.txt").write_text("1 6 mug_a\n4 2 bowl_b\n")
    for item, name in zip(made.objects, ("mug_a", "bowl_b"), strict=True):
        path = root / f"obj_models/real_train/{name}.obj"
        save_obj(path, item.mesh.vertices @ NOCS_FROM_SHAPENET.T, item.mesh.triangles)
    return {"scene_2/0010": made}


@pytest.mark.parametrize(
    ("write", "load"), [(write_camera25, Camera25), (write_real_train, RealTrain)]
)
def test_poses_are_those_that_were_rendered(tmp_path: Path, write, load) -> None:
    frames = write(tmp_path)
    data = load(tmp_path)
    expected = [(f"{name}/{i}", c) for name in frames for i, c in ((1, "mug"), (4, "bowl"))]
    assert [(ref.id, ref.category) for ref in data.samples] == expected
    assert data.damaged == []
    for ref in data.samples:
        made = frames[ref.id.rsplit("/", 1)[0]]
        index = 0 if ref.category == "mug" else 1
        # a NOCS map has steps of 1/255 of the diagonal, the depth has millimetres
        check(data.load(ref), made, index, angle=0.3, distance=0.001)


@pytest.mark.parametrize(
    ("write", "load", "published", "other"),
    [
        (write_camera25, Camera25, "val", "CAMERA/val"),
        (write_real_train, RealTrain, "real_train", "Real/train"),
    ],
)
def test_the_layout_of_spd_is_the_same_data(tmp_path: Path, write, load, published, other) -> None:
    write(tmp_path)
    first = load(tmp_path)
    poses = [first.load(ref).truth.pose.matrix for ref in first.samples]
    (tmp_path / other).parent.mkdir()
    (tmp_path / published).rename(tmp_path / other)
    second = load(tmp_path)
    assert (second.samples, second.digest) == (first.samples, first.digest)
    assert (second.missing, second.damaged) == (first.missing, [])
    assert np.array_equal([second.load(ref).truth.pose.matrix for ref in second.samples], poses)


def test_what_lacks_is_called_as_it_is_published(tmp_path: Path) -> None:
    write_camera25(tmp_path)
    (tmp_path / "camera_full_depths/val/00001/0003_composed.png").unlink()
    (tmp_path / "obj_models/val/02880940/b/model.obj").unlink()
    assert sorted(Camera25(tmp_path).missing) == [
        "1 frames without depth (camera_full_depths/val/SCENE/NNNN_composed.png), first 00001/0003:"
        " left out",
        "1 objects with fewer than 30 pixels of depth, first 00000/0003/2: left out",
        "mesh obj_models/val/02880940/b/model.obj: 1 samples left out",
    ]


def test_what_is_hidden_is_left_out_and_counted(tmp_path: Path) -> None:
    write_camera25(tmp_path)
    (line,) = Camera25(tmp_path).missing
    assert line == "2 objects with fewer than 30 pixels of depth, first 00000/0003/2: left out"


def test_outliers_in_the_map_do_not_move_the_pose(tmp_path: Path) -> None:
    """A third of the map wrong, as where rendering and depth disagree at edges."""
    made = write_real_train(tmp_path)["scene_2/0010"]
    path = tmp_path / "real_train/scene_2/0010_coord.png"
    pixels = np.array(Image.open(path))
    rng = np.random.default_rng(0)
    wrong = rng.random(pixels.shape[:2]) < 0.33
    pixels[wrong] = rng.integers(0, 256, (wrong.sum(), 3))
    save(path, pixels)
    data = RealTrain(tmp_path)
    check(data.load(data.samples[0]), made, 0, angle=1.0, distance=0.003)


def test_real_train_agrees_with_the_published_poses(test_data: Path, tmp_path: Path) -> None:
    """The real test frame read as a training frame: its map gives its published poses."""
    root = test_data / "real275"
    published = Real275(root)
    (tmp_path / "real_train/scene_1").mkdir(parents=True)
    for file in (root / "real_test/scene_1").glob("0000_*"):
        (tmp_path / "real_train/scene_1" / file.name).symlink_to(file)
    (tmp_path / "obj_models").mkdir()
    (tmp_path / "obj_models/real_train").symlink_to(root / "obj_models/real_test")
    fitted = RealTrain(tmp_path)
    assert [ref.id for ref in fitted.samples] == [ref.id for ref in published.samples]
    for ref in fitted.samples:
        ours, theirs = fitted.truth(ref).pose, published.truth(ref).pose
        assert np.linalg.norm(ours.translation - theirs.translation) < 0.02
        angle = np.degrees(np.arccos((np.trace(ours.rotation.T @ theirs.rotation) - 1) / 2))
        # the can lies 16 mm off its map, whose depth its label reflects
        assert angle < (10 if ref.category == "can" else 6), ref


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:200])


def fill(value: int, dtype: type = np.uint16) -> Callable[[Path], None]:
    return lambda path: save(path, np.full((480, 640), value, dtype))


def noise(path: Path) -> None:
    save(path, np.random.default_rng(1).integers(0, 256, (480, 640, 3)).astype(np.uint8))


MASK, COORD = "val/00000/0003_mask.png", "val/00000/0003_coord.png"
DEPTH = "camera_full_depths/val/00000/0003_composed.png"


@pytest.mark.parametrize(
    ("file", "damage", "words"),
    [
        (MASK, truncate, "not a readable image"),
        (DEPTH, truncate, "not a readable image"),
        (DEPTH, fill(5, np.uint8), "mode is L, expected I;16"),
        ("val/00000/0003_meta.txt", lambda p: p.write_text("1 6 m\n"), "mask_id class_id synset"),
        (
            "val/00000/0003_meta.txt",
            lambda p: p.write_text("1 6 03797390 ../m\n"),
            "mask_id class_id synset",
        ),
    ],
)
def test_damaged_frame_is_named_and_the_others_are_listed(tmp_path, file, damage, words) -> None:
    write_camera25(tmp_path)
    damage(tmp_path / file)
    data = Camera25(tmp_path)
    assert [ref.id for ref in data.samples] == ["00001/0003/1", "00001/0003/4"]
    (line,) = data.damaged
    assert words in line


@pytest.mark.parametrize(
    ("file", "damage", "words"),
    [
        (DEPTH, fill(0), "fewer than 30 pixels of depth"),
        (DEPTH, fill(40_000), "a depth of over 32 m"),
        (DEPTH, Path.unlink, "frames without depth"),
        (COORD, Path.unlink, "frames without coord.png"),
    ],
)
def test_frame_that_cannot_be_fitted_is_left_out(tmp_path, file, damage, words) -> None:
    write_camera25(tmp_path)
    damage(tmp_path / file)
    data = Camera25(tmp_path)
    assert [ref.id for ref in data.samples] == ["00001/0003/1", "00001/0003/4"]
    assert any(words in line for line in data.missing)


@pytest.mark.parametrize(
    ("file", "damage", "words"),
    [
        (COORD, truncate, "not a readable image"),
        (COORD, fill(7, np.uint8), "mode is L, expected RGB"),
        (COORD, noise, "correspondences"),
        (COORD, lambda p: save(p, np.full((480, 640, 3), 9, np.uint8)), "correspondences"),
        ("obj_models/val/03797390/m/model.obj", truncate, "not a readable mesh"),
    ],
)
def test_damaged_map_or_mesh_is_named(tmp_path, file, damage, words) -> None:
    write_camera25(tmp_path)
    damage(tmp_path / file)
    data = Camera25(tmp_path)
    with pytest.raises(ContractError, match=words):
        data.load(data.samples[0])
    data.load(data.samples[3])


def test_digest_tells_maps_apart(tmp_path: Path) -> None:
    write_real_train(tmp_path)
    first = RealTrain(tmp_path).digest
    noise(tmp_path / "real_train/scene_2/0010_coord.png")
    assert RealTrain(tmp_path).digest != first


@pytest.mark.parametrize("load", [Camera25, RealTrain])
def test_without_a_folder_the_error_says_what_to_fetch(tmp_path, load) -> None:
    assert issubclass(load, FittedTree)
    assert issubclass(load, NocsTree)
    for folder in (None, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"(?s)orion/nocs/.*\.zip.*--cpas-data=DIR"):
            load(folder)
