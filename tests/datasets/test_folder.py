"""``folder:DIR``: a table of samples, whole and damaged."""

import csv
import os
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from harness import RUN
from scipy.spatial.transform import Rotation
from trees import Frame, check, frame, save, save_obj

from pytest_cpas import registry
from pytest_cpas.datasets import shapes
from pytest_cpas.datasets.folder import Folder, parse_symmetry
from pytest_cpas.types import Camera, ContractError

CAMERA = Camera(160, 120, 150.0, 148.0, 80.5, 61.0)

Line = dict[str, object]


def write_table(root: Path, lines: list[Line]) -> None:
    with (root / "samples.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for line in lines for key in line)))
        writer.writeheader()
        writer.writerows(lines)


def write_folder(root: Path) -> tuple[Frame, list[Line]]:
    """A frame of a mug, with mask and mesh, and a bowl, with mask and extents alone."""
    made = frame(CAMERA, 0)
    save(root / "a/rgb.png", made.colour)
    save(root / "a/depth.png", (made.millimetres * 2).astype(np.uint16))
    save(root / "a/ids.png", (made.seen.instance + 1).astype(np.uint8))
    lines: list[Line] = []
    for index, item in enumerate(made.objects):
        line: Line = {
            "id": f"kitchen/{index}",
            "category": item.category,
            "scene": "kitchen",
            "model": f"my-{item.category}",
            "rgb": "a/rgb.png",
            "depth": "a/depth.png",
            "depth_unit": 0.0005,
            "mask": "a/ids.png",
            "mask_id": index + 1,
            **{key: getattr(CAMERA, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
        }
        quaternion = Rotation.from_matrix(item.pose.rotation).as_quat()
        line |= dict(zip(("qx", "qy", "qz", "qw"), quaternion, strict=True))
        line |= dict(zip(("tx", "ty", "tz"), item.pose.translation, strict=True))
        low, high = item.mesh.bounds
        if index == 0:
            line["mesh"] = "meshes/mug.obj"
            save_obj(root / "meshes/mug.obj", item.mesh.vertices, item.mesh.triangles)
        else:
            line |= dict(zip(("extent_x", "extent_y", "extent_z"), high - low, strict=True))
        lines.append(line)
    write_table(root, lines)
    return made, lines


def test_samples_are_those_of_the_table(tmp_path: Path) -> None:
    root = tmp_path / "my captures"
    made, _ = write_folder(root)
    data = Folder(root)
    assert data.name == "folder-my-captures"
    assert (data.missing, data.damaged) == ([], [])
    assert [(r.id, r.category, r.scene, r.model) for r in data.samples] == [
        ("kitchen/0", "mug", "kitchen", "my-mug"),
        ("kitchen/1", "bowl", "kitchen", "my-bowl"),
    ]
    check(data.load(data.samples[0]), made, 0)
    check(data.load(data.samples[1]), made, 1, mesh=False)


def test_mask_is_rendered_where_there_is_none(tmp_path: Path) -> None:
    made, lines = write_folder(tmp_path)
    lines[0] |= {"mask": "", "mask_id": ""}
    write_table(tmp_path, lines)
    data = Folder(tmp_path)
    mask = data.load(data.samples[0]).observation.mask
    assert np.count_nonzero(mask != made.mask(0)) <= 2


def test_binary_mask_and_given_symmetry(tmp_path: Path) -> None:
    made, lines = write_folder(tmp_path)
    save(tmp_path / "a/mug.png", made.mask(0))  # one bit per pixel
    lines[0] |= {"mask": "a/mug.png", "mask_id": "", "symmetry": "z/2"}
    write_table(tmp_path, lines)
    data = Folder(tmp_path)
    sample = data.load(data.samples[0])
    np.testing.assert_array_equal(sample.observation.mask, made.mask(0))
    assert sorted(np.round(sample.truth.symmetry.rotations.trace(axis1=1, axis2=2), 9)) == [-1, 3]


@pytest.mark.parametrize(
    ("text", "elements", "axis"),
    [
        ("none", 1, None),
        ("y", 1, [0, 1, 0]),
        ("x", 1, [1, 0, 0]),
        ("y/4", 4, None),
        ("z/1", 1, None),
        ("box", 4, None),
    ],
)
def test_symmetry_words(text, elements, axis) -> None:
    symmetry = parse_symmetry(text)
    assert len(symmetry.rotations) == elements
    assert (None if symmetry.axis is None else symmetry.axis.tolist()) == axis
    assert parse_symmetry("sphere").sphere


@pytest.mark.parametrize("text", ["", "w", "y/0", "y/x", "y/-1", "y/1.5", "y/99999999999"])
def test_unknown_symmetry(text) -> None:
    with pytest.raises(ContractError, match=r"expected none, y, y/4 .*, box or sphere"):
        parse_symmetry(text)


def change(**values: object) -> Callable[[Path, list[Line]], None]:
    def damage(root: Path, lines: list[Line]) -> None:
        write_table(root, [lines[0] | values, lines[1]])

    return damage


def append(text: str) -> Callable[[Path, list[Line]], None]:
    def damage(root: Path, lines: list[Line]) -> None:
        table = (root / "samples.csv").read_text().splitlines()
        (root / "samples.csv").write_text("\n".join([table[0], text, table[2]]))

    return damage


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (change(tx="nan"), "tx, ty, tz"),
        (change(qw="inf"), "qx, qy, qz, qw"),
        (change(qw=7), "a unit quaternion"),
        (change(fx="wide"), "6 finite numbers"),
        (change(fx=-500), "fx and fy positive"),
        (change(width=160.5), "image size is 160.5"),
        (change(height=0), "image size is 160 x 0"),
        (change(id="kitchen/1"), "occurs twice"),
        (change(id=""), "is empty"),
        (change(rgb="../../etc/passwd"), "leads out of"),
        (change(depth="/dev/zero"), "leads out of"),
        (change(mesh="C:\\mug.obj"), "leads out of"),
        (change(mask_id=300), "mask_id '300', expected 0 to 255"),
        (change(mesh=""), "neither extents nor a mesh"),
        (change(mesh="", mask="", extent_x=1, extent_y=1, extent_z=1), "neither a mask nor a mesh"),
        (change(extent_x=0.1), "extent_x, extent_y, extent_z"),
        (change(depth_unit=0), "depth_unit, metres of one step: 0, by which"),
        (change(symmetry="round"), "symmetry 'round'"),
        (append("kitchen/0,mug"), "as many values"),
        (append('"a,b'), "not a table"),
    ],
)
def test_damaged_line_is_named_and_the_others_are_listed(tmp_path, damage, words) -> None:
    _, lines = write_folder(tmp_path)
    damage(tmp_path, lines)
    if words == "not a table":  # an open quote swallows what follows
        with pytest.raises(ContractError, match=words):
            Folder(tmp_path)
        return
    data = Folder(tmp_path)
    (line,) = data.damaged
    assert words in line
    assert "samples.csv, line " in line
    assert len(line.splitlines()) == 1
    assert len(data.samples) == 1
    data.load(data.samples[0])


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def loop(path: Path) -> None:
    path.unlink()
    path.symlink_to(path)


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize(
    ("file", "damage", "words"),
    [
        ("a/rgb.png", pipe, "not a regular file"),
        ("a/depth.png", loop, "symbolic links"),
        ("a/ids.png", folder, "not a regular file"),
        ("meshes/mug.obj", pipe, "not a regular file"),
        ("a/ids.png", lambda p: save(p, np.zeros((120, 160), np.uint8)), "nothing is seen"),
        ("a/rgb.png", lambda p: save(p, np.zeros((121, 160, 3), np.uint8)), "160 x 121 pixels"),
        ("a/depth.png", lambda p: p.write_bytes(p.read_bytes()[:300]), "not a readable image"),
        ("a/depth.png", lambda p: p.write_bytes(b"GIF89a" + bytes(99)), "not a readable image"),
        ("meshes/mug.obj", lambda p: save_obj(p, np.eye(3), np.empty((0, 3), int)), "no triangles"),
        (
            "meshes/mug.obj",
            lambda p: save_obj(p, np.eye(3), np.array([[0, 1, 2]])),
            "expected a mesh centred",
        ),
    ],
)
def test_damaged_file_is_named_and_the_others_load(tmp_path, file, damage, words) -> None:
    _, lines = write_folder(tmp_path)
    for kind in ("rgb", "depth", "mask"):  # the other sample has files of its own
        name = str(lines[1][kind])
        shutil.copy(tmp_path / name, tmp_path / f"{name}.copy.png")
        lines[1][kind] = f"{name}.copy.png"
    write_table(tmp_path, lines)
    damage(tmp_path / file)
    data = Folder(tmp_path)
    assert len(data.samples) == 2
    with pytest.raises(ContractError, match=words):
        data.load(data.samples[0])
    data.load(data.samples[1])


def huge(path: Path) -> None:
    """A PNG that claims 60000 x 60000 pixels; decoding it would take 10 GB."""
    whole = bytearray(path.read_bytes())
    whole[16:24] = (60000).to_bytes(4, "big") * 2
    whole[29:33] = zlib.crc32(whole[12:29]).to_bytes(4, "big")
    path.write_bytes(whole)


def test_huge_image_is_not_decoded(tmp_path: Path) -> None:
    write_folder(tmp_path)
    huge(tmp_path / "a/rgb.png")
    data = Folder(tmp_path)
    with pytest.raises(ContractError, match=r"rgb\.png"):
        data.load(data.samples[0])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "columns lacking: id, category"),
        (b"id;category;rgb\n1;mug;a", "separated by commas"),
        (b"\xff\xfe\x00", "line 1: not text in UTF-8"),
        (b"id,category\n", "columns lacking: rgb, depth"),
    ],
)
def test_unreadable_table(tmp_path, content, words) -> None:
    (tmp_path / "samples.csv").write_bytes(content)
    with pytest.raises(ContractError, match=words):
        Folder(tmp_path)


def test_unknown_column_is_named(tmp_path: Path) -> None:
    _, lines = write_folder(tmp_path)
    write_table(tmp_path, [{**line, "colour": "x"} for line in lines])
    with pytest.raises(ContractError, match="unknown: colour"):
        Folder(tmp_path)


def test_table_saved_by_a_spreadsheet_is_read(tmp_path: Path) -> None:
    write_folder(tmp_path)
    path = tmp_path / "samples.csv"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_text().replace("\n", "\r\n").encode())
    assert len(Folder(tmp_path).samples) == 2


def test_worked_example_of_the_page(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/datasets.md").read_text()
    table = page.split("```\n")[1]
    (tmp_path / "samples.csv").write_text(table)
    for line in csv.DictReader(table.splitlines()):
        save(tmp_path / line["rgb"], np.zeros((480, 640, 3), np.uint8))
        save(tmp_path / line["depth"], np.full((480, 640), 700, np.uint16))
        save(tmp_path / line["mask"], np.tile(np.arange(480) % 3, (640, 1)).T.astype(np.uint8))
        mesh = shapes.mean_shape(line["category"])
        save_obj(tmp_path / line["mesh"], mesh.vertices, mesh.triangles)
    data = Folder(tmp_path)
    assert (data.missing, data.damaged) == ([], [])
    for ref in data.samples:
        up = data.load(ref).truth.pose.rotation[:, 1]
        assert up[1] < -0.8  # upright: the camera's y points down
    assert len(data.samples) == 2


def test_missing_files_are_named_once(tmp_path: Path) -> None:
    write_folder(tmp_path)
    (tmp_path / "a/depth.png").unlink()
    data = Folder(tmp_path)
    assert data.samples == []
    (line,) = data.missing
    assert line.startswith("2 samples without their depth file, first kitchen/0 (a/depth.png)")


def test_name_with_a_folder(tmp_path: Path) -> None:
    write_folder(tmp_path)
    data = registry.resolve("dataset", f"folder:{tmp_path}")(None)
    assert len(data.samples) == 2
    for given in (None, tmp_path / "a"):
        with pytest.raises(FileNotFoundError, match="folder:DIR"):
            registry.resolve("dataset", "folder")(given)


def test_run_on_a_folder(cpas, pytester, tmp_path: Path) -> None:
    """No code of one's own: a method that comes with the plugin, a relative folder."""
    write_folder(pytester.path / "captures")
    result = pytester.runpytest_inprocess(
        *RUN,
        "--cpas-method=tiny:OnlyPose",
        "--cpas-dataset=folder:captures",
        "--collect-only",
        "-q",
    )
    assert result.ret == 0
    result.stdout.fnmatch_lines(["*only-pose-folder-captures-mug-kitchen/0*"])


def test_run_over_damage_ends_in_words_and_goes_on(cpas, pytester) -> None:
    """A damaged line, a damaged image, a pipe: each is said in words, and the rest is judged."""
    _, lines = write_folder(pytester.path / "captures")
    root = pytester.path / "captures"
    for name, values in {
        "bad-line": {"tx": "nan"},
        "bad-image": {"depth": "a/bad.png"},
        "pipe": {"rgb": "a/pipe.png"},
    }.items():
        lines.append(lines[0] | {"id": name} | values)
    (root / "a/bad.png").write_bytes(b"\x89PNG")
    os.mkfifo(root / "a/pipe.png")
    write_table(root, lines)
    names = ("--cpas-method=tiny:OnlyPose", "--cpas-dataset=folder:captures")
    result = pytester.runpytest_inprocess(*RUN, *names, "-k", "test_sample or test_listing")
    assert result.ret == 1
    out = result.stdout.str()
    assert "Traceback" not in out
    for words in ("line 4: tx, ty, tz", "bad.png: not a readable image", "pipe.png: not a regular"):
        assert words in out
    outcomes = result.parseoutcomes()
    assert (outcomes["passed"], outcomes["failed"]) == (2, 3)
    assert "2 of 4 samples judged" in out
