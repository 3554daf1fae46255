"""REDWOOD75: the published annotations and meshes, with frames of our own beside them."""

import json
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from redwood_frames import WALL_MM, write_images
from scipy.spatial.transform import Rotation

from pytest_cpas.datasets import shapes
from pytest_cpas.datasets.redwood import REDWOOD_CAMERA, Redwood75
from pytest_cpas.datasets.rendering import render
from pytest_cpas.types import ContractError, Mesh, Pose, SampleRef

#: ShapeNet -> annotation axes, by what they are called: up is -y, and a mug's front (z) is x.
ANNOTATION = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])

#: A hand: a square of 6 cm, facing the camera.
HAND = Mesh(
    np.array([[-0.03, -0.03, 0], [0.03, -0.03, 0], [0.03, 0.03, 0], [-0.03, 0.03, 0]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
)


def write_frame(
    root: Path, category: str, sequence: str, pose: dict, mesh: Mesh
) -> tuple[np.ndarray, np.ndarray]:
    """Write an annotated pose's frame as published, a hand 5 cm in front and to the right.

    ``mesh`` is in annotation axes. Returns where the object is seen, and its rendered depth.
    """
    posed = Pose(Rotation.from_quat(pose["orientation"]).as_matrix(), pose["position"])
    near = posed.apply(mesh.vertices)[:, 2].min() - 0.05
    beside = posed.translation * near / posed.translation[2] + [0.04, 0, 0]
    beside[2] = near
    seen = render([(mesh, posed), (HAND, Pose(np.eye(3), beside))], REDWOOD_CAMERA)
    millimetres = np.round(1000 * seen.depth)
    millimetres[seen.instance < 0] = WALL_MM
    millimetres[::7] = 0
    write_images(root, category, sequence, pose, seen.instance, millimetres)
    # where nothing was measured, nobody can tell the hand from what it hides
    alone = render([(mesh, posed)], REDWOOD_CAMERA)
    return np.where(millimetres == 0, alone.instance == 0, seen.instance == 0), alone.depth


@pytest.fixture
def published(test_data: Path) -> Path:
    return test_data / "redwood75"


def test_published_annotations(published: Path) -> None:
    data = Redwood75(published)
    assert Counter(ref.category for ref in data.samples) == {"bottle": 25, "bowl": 25, "mug": 25}
    assert len({ref.scene for ref in data.samples}) == 15
    assert data.damaged == []
    assert Redwood75(published.parent).digest == data.digest
    for ref in data.samples:
        truth = data.truth(ref)
        low, high = truth.surface.bounds
        np.testing.assert_allclose(high - low, truth.extents, atol=2e-6)
        np.testing.assert_allclose(low + high, 0, atol=2e-6)
        assert (truth.symmetry.axis is None) == (ref.category == "mug")
        # the annotators held the objects in front of the camera
        assert 0.3 < truth.pose.translation[2] < 1.2
        u, v = REDWOOD_CAMERA.project(truth.pose.translation)
        assert 0 < u < 640
        assert 0 < v < 480


def test_published_meshes_stand_upright_in_shapenet_axes(published: Path) -> None:
    """Bowls are open towards +y, bottles are narrower at the top, mugs have their handle at -z."""
    data = Redwood75(published)
    for ref in data.samples[::5]:
        vertices = data.truth(ref).surface.vertices / data.truth(ref).extents
        top, bottom = vertices[vertices[:, 1] > 0.4], vertices[vertices[:, 1] < -0.4]
        radius = [np.median(np.hypot(end[:, 0], end[:, 2])) for end in (top, bottom)]
        if ref.category == "bowl":
            assert radius[0] > 1.3 * radius[1], ref
        elif ref.category == "bottle":
            assert radius[0] < radius[1], ref
        else:
            mean = vertices.mean(axis=0)
            assert mean[2] > 0.04 > abs(mean[0]), ref  # most of it is away from the handle


def test_without_frames_the_error_says_what_to_fetch(published: Path) -> None:
    data = Redwood75(published)
    assert len(data.absent) == 75
    (line,) = data.missing
    assert line.startswith("the frames of 75 samples")
    with pytest.raises(ContractError) as caught:
        data.load(data.samples[0])
    for text in (line, str(caught.value)):
        assert "redwood-3dscan/rgbd/01748.zip" in text
        assert "--cpas-data" in text


def test_run_without_frames_is_a_usage_error(cpas, published: Path, pytester) -> None:
    result = pytester.runpytest_inprocess(
        "--cpas-method=tiny:Perfect",
        "--cpas-dataset=redwood75",
        f"--cpas-data={published}",
        *("-p", "no:dash", "-p", "no:cacheprovider"),
    )
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    assert "redwood-3dscan/rgbd/01748.zip" in result.stderr.str()


def test_masks_and_depth_agree_with_rendered_frames(published: Path, tmp_path: Path) -> None:
    """One frame of each sequence, rendered from the published meshes at the annotated poses."""
    annotations = json.loads((published / "annotations.json").read_text())
    for file in published.iterdir():
        (tmp_path / file.name).symlink_to(file)
    expected = {}
    bare = Redwood75(published)
    for number, (sequence, entry) in enumerate(sorted(annotations.items())):
        index = number % 5
        surface = bare.truth(
            SampleRef(id=f"{sequence}/{index}", category=entry["category"], scene=sequence)
        ).surface
        mesh = Mesh(surface.vertices @ ANNOTATION.T, surface.triangles)
        pose = entry["pose_anns"][index]
        expected[f"{sequence}/{index}"] = write_frame(
            tmp_path, entry["category"], sequence, pose, mesh
        )
    data = Redwood75(tmp_path)
    assert len(data.samples) == 75
    assert len(data.absent) == 60
    hidden = []
    for ref in data.samples:
        if ref.id not in expected:
            continue
        seen, depth = expected[ref.id]
        sample = data.load(ref)
        observed = sample.observation
        # a pixel on the hand's edge may lie within 1 cm of a slanted object behind it
        assert np.count_nonzero(observed.mask != seen) <= 2, ref
        measured = observed.mask & (observed.depth > 0)
        np.testing.assert_allclose(observed.depth[measured], depth[measured], atol=6e-4)
        hidden.append(1 - observed.mask.sum() / np.count_nonzero(depth))
        # colour says the same of the inside of the mask, but for what JPEG smears
        red = observed.rgb[..., 0] > observed.rgb[..., 1]
        assert red[measured].mean() > 0.97, ref
    assert max(hidden) > 0.1


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Two sequences, a mug of one frame and a bowl of two, all with frames."""
    annotations = {}
    for sequence, category, count in (("00001", "mug", 1), ("00002", "bowl", 2)):
        shape = shapes.mean_shape(category)
        mesh = Mesh(shape.vertices @ ANNOTATION.T, shape.triangles)
        low, high = mesh.bounds
        lines = ["v {} {} {}".format(*v) for v in mesh.vertices]
        lines += ["f {} {} {}".format(*t) for t in mesh.triangles + 1]
        (tmp_path / f"{sequence}.obj").write_text("\n".join(lines))
        poses = [
            {
                "position": [0.05 * i, 0.02, 0.7],
                "orientation": Rotation.from_rotvec([0.3, 0.2 * i, 0.1]).as_quat().tolist(),
                "rgb_file": f"{i}.jpg",
                "depth_file": f"{i}.png",
            }
            for i in range(count)
        ]
        annotations[sequence] = {
            "category": category,
            "mesh": f"{sequence}.obj",
            "scale": ((high - low) / 2).tolist(),
            "pose_anns": poses,
        }
        for pose in poses:
            write_frame(tmp_path, category, sequence, pose, mesh)
    (tmp_path / "annotations.json").write_text(json.dumps(annotations))
    return tmp_path


def edit(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        content = json.loads(path.read_text())
        change(content["00001"])
        path.write_text(json.dumps(content))

    return damage


def edit_pose(**values: object) -> Callable[[Path], None]:
    return edit(lambda entry: entry["pose_anns"][0].update(values))


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


RGB, DEPTH = "mug/rgbd/00001/rgb/0.jpg", "mug/rgbd/00001/depth/0.png"


@pytest.mark.parametrize(
    ("file", "damage", "words"),
    [
        (RGB, truncate, "not a readable image"),
        (DEPTH, truncate, "not a readable image"),
        (
            DEPTH,
            lambda p: Image.fromarray(np.zeros((480, 640), np.uint8)).save(p),
            "mode is L, expected I;16",
        ),
        (
            DEPTH,
            lambda p: Image.fromarray(np.ones((480, 640), np.uint16)).save(p),
            "nothing is seen of the object",
        ),
        (
            RGB,
            lambda p: Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(p),
            "64 x 48 pixels, but the camera has 640 x 480",
        ),
        ("00001.obj", lambda p: p.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n"), "not a readable mesh"),
        ("00001.obj", Path.unlink, "no such file"),
        ("annotations.json", edit_pose(position=[0, 0, -1]), "nothing is seen of the object"),
        ("annotations.json", edit(lambda e: e.update(scale=[1, 2, -3])), "three positive side"),
    ],
)
def test_damage_is_named_and_the_other_samples_still_load(tree, file, damage, words) -> None:
    damage(tree / file)
    data = Redwood75(tree)
    assert [ref.id for ref in data.samples] == ["00001/0", "00002/0", "00002/1"]
    with pytest.raises(ContractError, match=words):
        data.load(data.samples[0])
    data.load(data.samples[1])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (edit(lambda e: e.pop("mesh")), "expected category, mesh, scale, pose_anns"),
        (edit(lambda e: e.update(category="camera")), "category 'camera', expected one of bottle"),
        (edit(lambda e: e.update(mesh="../../etc/passwd")), "leads out of"),
        (edit(lambda e: e.update(mesh=7)), "expected the name of a file"),
        (edit(lambda e: e.update(pose_anns=3)), "pose_anns is not a list"),
        (edit_pose(rgb_file="/dev/zero"), "leads out of"),
        (edit_pose(orientation=[0, 0, 0, 2]), "a unit quaternion"),
        (edit_pose(position=[0, float("nan"), 1]), "3 finite numbers"),
        (edit_pose(orientation="up"), "4 finite numbers"),
        (edit(lambda e: e["pose_anns"][0].pop("position")), "it lacks one of position"),
    ],
)
def test_damaged_sequence_is_named_and_the_others_are_listed(tree, damage, words) -> None:
    damage(tree / "annotations.json")
    data = Redwood75(tree)
    assert [ref.id for ref in data.samples] == ["00002/0", "00002/1"]
    (line,) = data.damaged
    assert words in line
    assert "sequence 00001" in line


@pytest.mark.parametrize("text", ["", "[]", "{", "\x00", "[" * 100_000])
def test_unreadable_annotations(tree, text) -> None:
    (tree / "annotations.json").write_text(text)
    with pytest.raises(ContractError, match=r"annotations\.json"):
        Redwood75(tree)


def test_digest_tells_contents_apart(tree) -> None:
    first = Redwood75(tree).digest
    shutil.copy(tree / "00002.obj", tree / "00001.obj")
    second = Redwood75(tree).digest
    edit_pose(position=[0, 0, 0.8])(tree / "annotations.json")
    assert len({first, second, Redwood75(tree).digest}) == 3


def test_without_a_folder_the_error_says_what_to_fetch(tmp_path: Path) -> None:
    for folder in (None, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"(?s)annotations\.json.*--cpas-data=DIR"):
            Redwood75(folder)
