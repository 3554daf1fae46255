"""``bop:DIR``: a tree of our own in BOP format, whole and damaged, and the way back to BOP."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import RUN
from scipy.spatial.transform import Rotation
from trees import Frame, check, frame, save, save_obj

from pytest_cpas import cli, registry
from pytest_cpas.datasets.bop import Bop
from pytest_cpas.datasets.rendering import render
from pytest_cpas.reading.meshes import read_mesh
from pytest_cpas.types import Camera, ContractError
from pytest_cpas.types.datasets import mask_box

CAMERA = Camera(160, 120, 150.0, 148.0, 80.5, 61.0)

#: Object numbers, and where the centre of the model's box is in BOP's frame, millimetres.
NUMBERS = (1, 7)
CENTRES = np.array([[3.0, -20.0, 1.5], [0.0, 0.0, 0.0]])


GT, CAMERAS = "test/000002/scene_gt.json", "test/000002/scene_camera.json"


def write_ply(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
    lines = ["{:.6f} {:.6f} {:.6f}".format(*v) for v in vertices]
    lines += ["3 {} {} {}".format(*t) for t in triangles]
    path.write_text("\n".join([*head, "end_header", *lines]) + "\n")


def write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_bop(root: Path) -> dict[str, Frame]:
    """Scenes 2 and 10 with images 0 and 3; a mug is object 1 and a bowl object 7."""
    frames = {}
    for scene in (2, 10):
        folder = root / f"test/{scene:06d}"
        cameras, truths, infos = {}, {}, {}
        for image in (0, 3):
            made = frame(CAMERA, image)
            save(folder / f"rgb/{image:06d}.png", made.colour)
            save(folder / f"depth/{image:06d}.png", (made.millimetres * 4).astype(np.uint16))
            objects = []
            for index, (item, number) in enumerate(zip(made.objects, NUMBERS, strict=True)):
                mask = 255 * made.mask(index).astype(np.uint8)
                save(folder / f"mask_visib/{image:06d}_{index:06d}.png", mask)
                origin = 1000 * item.pose.translation - item.pose.rotation @ CENTRES[index]
                objects.append(
                    {
                        "cam_R_m2c": item.pose.rotation.ravel().tolist(),
                        "cam_t_m2c": origin.tolist(),
                        "obj_id": number,
                    }
                )
            hidden = {"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 9], "obj_id": 7}
            truths[str(image)] = [*objects, hidden]
            infos[str(image)] = [{"visib_fract": v} for v in (0.9, 0.5, 0.05)]
            cameras[str(image)] = {
                "cam_K": CAMERA.matrix.ravel().tolist(),
                "depth_scale": 0.25,
            }
            frames[f"{scene:06d}/{image:06d}"] = made
        write_json(folder / "scene_gt.json", truths)
        write_json(folder / "scene_gt_info.json", infos)
        write_json(folder / "scene_camera.json", cameras)
    models = {}
    for item, number, centre in zip(made.objects, NUMBERS, CENTRES, strict=True):
        vertices = 1000 * item.mesh.vertices + centre
        write_ply(root / f"models_eval/obj_{number:06d}.ply", vertices, item.mesh.triangles)
        low, size = vertices.min(axis=0), np.ptp(vertices, axis=0)
        models[str(number)] = {
            **{f"min_{axis}": v for axis, v in zip("xyz", low.tolist(), strict=True)},
            **{f"size_{axis}": v for axis, v in zip("xyz", size.tolist(), strict=True)},
            "diameter": float(np.linalg.norm(size)),
        }
    models["7"]["symmetries_continuous"] = [{"axis": [0, 1, 0], "offset": [0, 0, 0]}]
    write_json(root / "models_eval/models_info.json", models)
    return frames


def test_samples_are_those_that_were_rendered(tmp_path: Path) -> None:
    root = tmp_path / "ours"
    frames = write_bop(root)
    data = Bop(root)
    assert data.name == "bop-ours-test"
    assert (data.missing, data.damaged) == ([], [])
    assert [ref.id for ref in data.samples] == [f"{name}/{i}" for name in frames for i in (0, 1)]
    for ref in data.samples:
        name, _, index = ref.id.rpartition("/")
        assert ref.model == ref.category == ("obj_000001", "obj_000007")[int(index)]
        check(data.load(ref), frames[name], int(index), category=ref.category)
    # scenes in the order of their numbers, one symmetry for all samples of an object
    assert [ref.scene for ref in data.samples[::4]] == ["000002", "000010"]
    assert data.truth(data.samples[1]).symmetry is data.truth(data.samples[3]).symmetry


def symmetries(tmp_path: Path, **given: Any) -> Any:
    edit("models_eval/models_info.json", lambda models: models["1"].update(given))(tmp_path)
    data = Bop(tmp_path)
    return data.truth(data.samples[0]).symmetry


def edit(file: str, change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        content = json.loads((root / file).read_text())
        change(content)
        write_json(root / file, content)

    return damage


def test_symmetries_of_the_models(tmp_path: Path) -> None:
    write_bop(tmp_path)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 180, degrees=True).as_matrix()
    turn[:3, 3] = [1, 2, 0]
    two = symmetries(tmp_path, symmetries_discrete=[turn.ravel().tolist()])
    np.testing.assert_allclose(two.rotations, [np.eye(3), turn[:3, :3]])
    both = symmetries(tmp_path, symmetries_continuous=[{"axis": [0, 0, 1], "offset": [0, 0, 0]}])
    assert len(both.rotations) == 2
    assert both.axis.tolist() == [0, 0, 1]
    axes = [{"axis": [0, 0, 1]}, {"axis": [0, 1, 0]}]
    assert symmetries(tmp_path, symmetries_continuous=axes).sphere


def test_split_is_found_or_named(tmp_path: Path) -> None:
    write_bop(tmp_path)
    expected = Bop(tmp_path).samples
    assert Bop(tmp_path / "test").samples == expected
    assert registry.resolve("dataset", f"bop:{tmp_path}/test")(None).samples == expected
    (tmp_path / "test").rename(tmp_path / "test_kinect")
    assert Bop(tmp_path).samples == expected
    (tmp_path / "test_other/000001").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match="splits are test_kinect, test_other; name one"):
        Bop(tmp_path)
    assert Bop(tmp_path / "test_kinect").samples == expected


def test_only_the_targets_of_a_test_split_are_listed(tmp_path: Path) -> None:
    write_bop(tmp_path)
    target = {"scene_id": 10, "im_id": 3, "obj_id": 7, "inst_count": 1}
    write_json(tmp_path / "test_targets_bop19.json", [target])
    assert [ref.id for ref in Bop(tmp_path).samples] == ["000010/000003/1"]
    (tmp_path / "test").rename(tmp_path / "train")
    assert len(Bop(tmp_path / "train").samples) == 8


def test_mask_is_rendered_where_there_is_none(tmp_path: Path) -> None:
    made = write_bop(tmp_path)["000002/000000"]
    (tmp_path / "test/000002/mask_visib/000000_000000.png").unlink()
    data = Bop(tmp_path)
    mask = data.load(data.samples[0]).observation.mask
    assert np.count_nonzero(mask != made.mask(0)) <= 2


def test_without_models_shape_is_not_known(tmp_path: Path) -> None:
    made = write_bop(tmp_path)["000002/000000"]
    (tmp_path / "models_eval/obj_000001.ply").unlink()
    data = Bop(tmp_path)
    check(data.load(data.samples[0]), made, 0, mesh=False, category="obj_000001")
    assert data.missing == [
        "models of 1 objects, first models_eval/obj_000001.ply: shape metrics of 4 samples are n/a"
    ]


def test_whole_masks_are_taken_less_what_is_in_front(tmp_path: Path) -> None:
    """mask/ of a bowl of which the left half is behind something that was measured."""
    made = write_bop(tmp_path)["000002/000000"]
    item = made.objects[1]
    whole = render([(item.mesh, item.pose)], CAMERA).depth > 0
    hidden = whole & (np.arange(CAMERA.width) < np.flatnonzero(whole.any(axis=0)).mean())
    measured = np.where(hidden, made.millimetres // 2, made.millimetres)
    save(tmp_path / "test/000002/depth/000000.png", (measured * 4).astype(np.uint16))
    name = "000000_000001.png"
    (tmp_path / "test/000002/mask_visib" / name).unlink()
    save(tmp_path / "test/000002/mask" / name, 255 * whole.astype(np.uint8))
    digest = Bop(tmp_path).digest
    data = Bop(tmp_path)
    ref = data.samples[1]
    mask = data.load(ref).observation.mask
    assert (mask == whole & ~(hidden & (measured > 0))).all()
    assert data.box_of(ref).tolist() == mask_box(mask).tolist()
    (derived,) = data.derived
    assert derived.part == "mask"
    assert derived.samples == {ref.id}
    assert "amodal" in derived.how
    assert "mask_visib/ has none of it" in derived.how  # there are those of others
    (tmp_path / "test/000002/mask" / name).unlink()
    assert Bop(tmp_path).digest != digest


def test_visibility_that_is_not_said_is_named(tmp_path: Path) -> None:
    write_bop(tmp_path)
    (tmp_path / "test/000010/scene_gt_info.json").unlink()
    data = Bop(tmp_path)
    assert len(data.samples) == 10  # with the two that are hidden
    assert data.missing[-1].startswith("scene_gt_info.json of 1 scenes, first 000010: which")


MILLIMETRES, METRES = 1.0, 0.001


def as_obj(root: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Object 1 as an OBJ file instead."""
    ply = root / "models_eval/obj_000001.ply"
    mesh = read_mesh(ply)
    ply.unlink()
    save_obj(ply.with_suffix(".obj"), change(mesh.vertices), mesh.triangles)


@pytest.mark.parametrize("unit", [MILLIMETRES, METRES])
def test_obj_models_with_the_described_box_are_read(tmp_path: Path, unit: float) -> None:
    made = write_bop(tmp_path)["000002/000000"]
    as_obj(tmp_path, lambda vertices: unit * vertices)
    data = Bop(tmp_path)
    assert (data.missing, data.damaged) == ([], [])
    check(data.load(data.samples[0]), made, 0, category="obj_000001")


@pytest.mark.parametrize(
    "change",
    [lambda v: v[:, [0, 2, 1]] * [1, 1, -1], lambda v: v / 25.4, lambda v: v - v.mean(axis=0)],
    ids=["y up", "inches", "moved"],
)
def test_obj_models_of_another_box_are_refused(tmp_path: Path, change) -> None:
    made = write_bop(tmp_path)["000002/000000"]
    as_obj(tmp_path, change)
    data = Bop(tmp_path)
    (line,) = data.damaged
    assert "obj_000001.obj: its box is (" in line
    assert "trimesh.load('obj_000001.obj').export('obj_000001.ply')" in line
    assert data.missing[0].startswith("models of 1 objects")
    check(data.load(data.samples[0]), made, 0, mesh=False, category="obj_000001")


def test_images_that_are_not_annotated_are_counted(tmp_path: Path) -> None:
    write_bop(tmp_path)
    edit(GT, lambda gt: gt.pop("3"))(tmp_path)
    data = Bop(tmp_path)
    assert len(data.samples) == 6
    (line,) = data.missing
    assert line == (
        "1 images that scene_gt.json does not list, first test/000002/rgb/000003.png: left out"
    )


def test_depth_of_no_known_unit_is_refused(tmp_path: Path) -> None:
    """The format has no default."""
    write_bop(tmp_path)
    edit(CAMERAS, lambda cameras: cameras["3"].pop("depth_scale"))(tmp_path)
    data = Bop(tmp_path)
    (line,) = data.damaged
    assert line.startswith(f"{tmp_path / CAMERAS}: 1 of 2 images have no depth_scale")
    assert '"depth_scale": 1.0 if depth is in millimetres' in line
    assert len(data.samples) == 4


@pytest.mark.parametrize(
    "damage",
    [{"cam_K": [1, 2]}, {"depth_scale": 0}, {"depth_scale": "x"}],
    ids=str,
)
def test_what_is_wrong_with_a_camera_names_its_file(tmp_path: Path, damage: dict) -> None:
    write_bop(tmp_path)
    edit(CAMERAS, lambda cameras: cameras["0"].update(damage))(tmp_path)
    (line,) = Bop(tmp_path).damaged
    assert line.startswith(f"{tmp_path / CAMERAS}: image 0: ")


def text(file: str, content: str) -> Callable[[Path], object]:
    return lambda root: (root / file).write_text(content)


@pytest.mark.parametrize(
    ("damage", "words", "left"),
    [
        (text(GT, "{"), "not readable JSON", 4),
        (text(GT, "[]"), "holds a list, expected a dict", 4),
        (text(CAMERAS, ""), "not readable JSON", 4),
        (edit(GT, lambda gt: gt.update({"0": 3})), "a int, expected a list", 6),
        (edit(GT, lambda gt: gt.update({"x": []})), "not an image number", 8),
        (edit(GT, lambda gt: gt["0"][0].update(obj_id=99)), "obj_id 99 is not in", 7),
        (edit(GT, lambda gt: gt["0"].__setitem__(0, "mug")), "obj_id: NoneType, expected an", 7),
        (edit(GT, lambda gt: gt["0"].insert(0, gt["0"][0])), "has 3 entries, and 4 objects", 6),
        (edit(GT, lambda gt: gt["0"][0].update(cam_t_m2c=[0, 0])), "3 finite numbers", 7),
        (
            edit(GT, lambda gt: gt["0"][0].update(cam_t_m2c=[0, 0, float("nan")])),
            "3 finite numbers",
            7,
        ),
        (edit(GT, lambda gt: gt["0"][0].update(cam_R_m2c=[2] * 9)), "not orthonormal", 7),
        (
            edit(GT, lambda gt: gt["0"][0].update(cam_R_m2c=[-1, 0, 0, 0, 1, 0, 0, 0, 1])),
            "determinant -1",
            7,
        ),
        (edit(CAMERAS, lambda c: c["0"].pop("cam_K")), "cam_K: None, expected 9", 6),
        (
            edit(CAMERAS, lambda c: c["0"].update(depth_scale=0)),
            "depth_scale, millimetres of a step: 0",
            6,
        ),
        (edit(CAMERAS, lambda c: c.pop("3")), "entry in scene_camera.json", 6),
        (text("test/000002/rgb/000000.png", "<html>"), "not a readable image", 6),
        (
            edit("models_eval/models_info.json", lambda m: m["1"].update(size_x=-1)),
            "expected positive millimetres",
            4,
        ),
        (
            edit("models_eval/models_info.json", lambda m: m["1"].update(min_x="low")),
            "min_x, min_y, min_z",
            4,
        ),
        (
            edit(
                "models_eval/models_info.json",
                lambda m: m["7"].update(symmetries_discrete=[np.diag([2, 2, 2, 1]).tolist()]),
            ),
            "proper rotation",
            4,
        ),
    ],
)
def test_damage_is_named_and_the_rest_is_listed(tmp_path, damage, words, left) -> None:
    write_bop(tmp_path)
    damage(tmp_path)
    data = Bop(tmp_path)
    assert data.damaged
    assert any(words in line for line in data.damaged), data.damaged
    assert all(str(tmp_path) in line and len(line.splitlines()) == 1 for line in data.damaged)
    assert len(data.samples) == left
    data.load(data.samples[-1])


@pytest.mark.parametrize(
    ("file", "words"),
    [
        (GT, "1 scenes without scene_gt.json, first 000002"),
        (CAMERAS, "1 scenes without scene_camera.json, first 000002"),
        ("test/000002/rgb/000003.png", "1 images without colour"),
        ("test/000002/depth/000003.png", "1 images without depth"),
    ],
)
def test_missing_file_is_named_once(tmp_path, file, words) -> None:
    write_bop(tmp_path)
    (tmp_path / file).unlink()
    data = Bop(tmp_path)
    (line,) = data.missing
    assert words in line
    assert data.damaged == []


def test_unreadable_models_or_targets(tmp_path: Path) -> None:
    write_bop(tmp_path)
    (tmp_path / "test_targets_bop19.json").write_text('[{"scene": 1}]')
    with pytest.raises(ContractError, match="expected a list of scene_id"):
        Bop(tmp_path)
    (tmp_path / "models_eval/models_info.json").write_text("{")
    with pytest.raises(ContractError, match=r"models_info\.json: not readable JSON"):
        Bop(tmp_path)
    (tmp_path / "models_eval/models_info.json").unlink()
    with pytest.raises(FileNotFoundError, match="has no models_info"):
        Bop(tmp_path)
    for folder in (None, tmp_path / "nowhere"):
        with pytest.raises(FileNotFoundError, match="bop:DIR"):
            Bop(folder)


METHOD = """
import numpy as np
from pathlib import Path
from pytest_cpas.datasets.bop import Bop
from pytest_cpas.datasets.rendering import render
from pytest_cpas.reading.meshes import read_mesh
from pytest_cpas.types import Hypothesis, MethodInfo, Prediction

class Knows:
    info = MethodInfo(
        name="knows",
        categories=("obj_000001", "obj_000007"),
        needs=frozenset(),
        gives=frozenset(),
        licence="MIT",
    )

    def load(self, assets, device):
        data = Bop(Path("ours"))
        self.truths = [(s.observation.mask, s.truth.pose) for s in map(data.load, data.samples)]

    def predict(self, batch, seed):
        def answer(seen):
            (pose,) = {id(p): p for m, p in self.truths if np.array_equal(m, seen.mask)}.values()
            return Prediction([Hypothesis(rotation=pose.rotation, translation=pose.translation)])
        return [answer(seen) for seen in batch]
"""


def test_export_gives_back_the_annotated_poses(pytester, monkeypatch, capsys) -> None:
    """Results of a method that knows the truth, exported: the numbers of scene_gt.json."""
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    root = pytester.path / "ours"
    write_bop(root)
    for file in (root / "test").glob("*/scene_gt.json"):
        if "000002" not in str(file):  # the same masks twice
            file.unlink()
    (pytester.path / "knows.py").write_text(METHOD)
    names = ("--cpas-method=knows:Knows", "--cpas-dataset=bop:ours", "--cpas-results=out")
    assert pytester.runpytest_inprocess(*RUN, *names).ret == 0
    (results,) = (pytester.path / "out").iterdir()
    out = pytester.path / "knows_ours-test.csv"
    assert cli.main(["export-bop", str(results), "--bop", str(root), "--to", str(out)]) == 0
    assert "4 estimates" in capsys.readouterr().out
    lines = out.read_text().splitlines()
    assert lines[0] == "scene_id,im_id,obj_id,score,R,t,time"
    truths = json.loads((root / GT).read_text())
    written = {}
    for line in lines[1:]:
        scene, image, number, score, rotation, translation, time = line.split(",")
        assert (scene, score, time) == ("2", "1", "-1")
        written[image, int(number)] = np.array([*rotation.split(), *translation.split()], float)
    assert len(written) == 4
    for image, objects in truths.items():
        for entry in objects[:2]:
            expected = [*entry["cam_R_m2c"], *entry["cam_t_m2c"]]
            # float32 of metres
            np.testing.assert_allclose(written[image, entry["obj_id"]], expected, atol=2e-4)


def test_export_of_other_results_is_refused(cpas, pytester, tmp_path, capsys) -> None:
    write_bop(tmp_path)
    assert cpas("Perfect", "--cpas-results=out").ret == 0
    (results,) = (pytester.path / "out").iterdir()
    arguments = ["--bop", str(tmp_path), "--to", str(tmp_path / "out.csv")]
    assert cli.main(["export-bop", str(results), *arguments]) == 1
    assert "of tiny" in capsys.readouterr().err
    assert cli.main(["export-bop", str(tmp_path / "none.jsonl"), *arguments]) == 1
    assert not os.path.exists(tmp_path / "out.csv")
