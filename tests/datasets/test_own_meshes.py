"""``synthetic:DIR``: a folder of meshes of one's own, rendered; what is wrong with it is told."""

import dataclasses
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from docs_pages import blocks, text
from harness import RUN
from test_symmetries import BALL, STRAIGHT, TAPERED, box, lathe, lying
from trees import save_obj

from pytest_cpas import registry
from pytest_cpas.datasets import _scenes, own_meshes, synthetic
from pytest_cpas.datasets._mesh_folder import MeshFolder
from pytest_cpas.datasets._mesh_stock import MeshStock, read_models
from pytest_cpas.datasets._scenes import Model
from pytest_cpas.datasets.own_meshes import OwnHandheld, OwnTabletop
from pytest_cpas.datasets.rendering import camera_rays
from pytest_cpas.reading.meshes import read_mesh
from pytest_cpas.types import Array, ContractError, DataError, Mesh, Pose, Sample

NAME = "meshes.toml"
TABLE = 'unit = "m"\nup = "y"\n'


def save(path: Path, mesh: Mesh, scale: float = 1.0) -> None:
    save_obj(path, scale * mesh.vertices, mesh.triangles)


def parts(root: Path, table: str = TABLE, **meshes: Mesh) -> Path:
    """A folder of meshes by category, one file each, with a table."""
    for category, mesh in meshes.items():
        save(root / category / "a.obj", mesh)
    root.mkdir(exist_ok=True)
    (root / "meshes.toml").write_text(table)
    return root


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    """One scene of one frame, or as many as there are meshes, in a cache of the test's own."""
    monkeypatch.setattr(synthetic, "_ATTEMPTS", 5)
    for kind in (OwnTabletop, OwnHandheld):
        split = dataclasses.replace(kind.split, scenes=1, frames=1)
        monkeypatch.setattr(kind, "split", split)


def join(first: Mesh, second: Mesh, *, apart: float) -> Mesh:
    """Two meshes in one, their centres so far apart along x."""
    shift = np.array([apart / 2, 0, 0])
    return Mesh(
        np.concatenate([first.vertices - shift, second.vertices + shift]),
        np.concatenate([first.triangles, second.triangles + len(first.vertices)]),
    )


def only(data: OwnTabletop | OwnHandheld) -> Sample:
    (ref,) = data.samples
    return data.load(ref)


# -- what is rendered ---------------------------------------------------------------------------


def depth_of_box(sample: Sample, sides: Array) -> Array:
    """Where the rays of an image meet a box first, metres along the optical axis; inf elsewhere."""
    r, t = sample.truth.pose.rotation, sample.truth.pose.translation
    rays = camera_rays(sample.observation.camera) @ r
    with np.errstate(divide="ignore"):
        planes = [(sign * sides / 2 + t @ r) / rays for sign in (-1, 1)]
    near, far = np.minimum(*planes).max(axis=-1), np.maximum(*planes).min(axis=-1)
    return np.where(near < far, near, np.inf)


def depth_of_cylinder(sample: Sample, radius: float, height: float) -> Array:
    """The same of a cylinder about y."""
    r, t = sample.truth.pose.rotation, sample.truth.pose.translation
    rays, start = camera_rays(sample.observation.camera) @ r, -t @ r
    a = rays[..., 0] ** 2 + rays[..., 2] ** 2
    b = rays[..., 0] * start[0] + rays[..., 2] * start[2]
    root = np.sqrt(np.maximum(b**2 - a * (start[0] ** 2 + start[2] ** 2 - radius**2), 0))
    side = np.where(b**2 > a * (start[0] ** 2 + start[2] ** 2 - radius**2), 1.0, np.nan)
    caps = np.sort([(sign * height / 2 - start[1]) / rays[..., 1] for sign in (-1, 1)], axis=0)
    near, far = np.fmax((-b - root) / a * side, caps[0]), np.fmin((-b + root) / a * side, caps[1])
    return np.where(np.isfinite(side) & (near < far), near, np.inf)


#: Files of the same box, 50 mm wide, 160 mm high and 90 mm deep, in other units and axes.
BOX = np.array([0.05, 0.16, 0.09])
FILES = {
    "metres": ('unit = "m"\nup = "y"', BOX),
    "millimetres, z up": ('unit = "mm"\nup = "z"', 1000 * BOX[[0, 2, 1]]),
    "z up, front x": ('unit = "cm"\nup = "z"\nfront = "x"', 100 * BOX[[2, 0, 1]]),
    "x down": ('unit = "in"\nup = "-x"\nfront = "z"', BOX[[1, 0, 2]] / 0.0254),
    "metres as a number": ('unit = 0.5\nup = "-y"', 2 * BOX),
}


@pytest.mark.parametrize(
    ("kind", "name"), [(OwnTabletop, "metres"), *((OwnHandheld, name) for name in FILES)]
)
def test_depth_of_a_box_is_that_of_a_closed_form(
    tmp_path: Path, kind: type[OwnTabletop] | type[OwnHandheld], name: str
) -> None:
    table, sides = FILES[name]
    moved = box(*sides)
    moved = Mesh(moved.vertices + 3 * sides.max(), moved.triangles)
    sample = only(kind(parts(tmp_path / "kit", table, block=moved)))
    np.testing.assert_allclose(sample.truth.extents, BOX, atol=2e-7)
    expected = depth_of_box(sample, BOX)
    seen = sample.observation.mask & (sample.observation.depth > 0)
    assert np.isfinite(expected[seen]).mean() > 0.999
    errors = sample.observation.depth[seen] - expected[seen]
    # the noise of the sensor at up to 1.3 m, and less than that of the mean
    assert np.quantile(np.abs(errors), 0.95) < 0.008
    assert abs(np.median(errors)) < 0.0005
    if kind is OwnTabletop:  # it stands upright, seen from above
        assert sample.truth.pose.rotation[1, 1] < -0.4


def test_depth_of_a_cylinder_is_that_of_a_closed_form(tmp_path: Path) -> None:
    mesh = lathe(STRAIGHT, 48)
    sample = only(OwnHandheld(parts(tmp_path / "kit", tube=lying(mesh, 2, 0, 1))))
    assert sample.truth.symmetry.axis is not None
    np.testing.assert_allclose(sample.truth.symmetry.axis, [0, 0, 1])
    sample = only(OwnHandheld(parts(tmp_path / "kit2", tube=mesh)))
    expected = depth_of_cylinder(sample, 0.04, 0.1)
    seen = sample.observation.mask & (sample.observation.depth > 0)
    seen &= np.isfinite(expected)
    errors = sample.observation.depth[seen] - expected[seen]
    assert np.quantile(np.abs(errors), 0.9) < 0.005
    assert abs(np.median(errors)) < 0.0005


def test_axes_are_turned_and_never_mirrored(tmp_path: Path) -> None:
    """A mesh whose corners all differ: z up and front x is a turn of the thirds."""
    mesh = box(0.05, 0.09, 0.16)
    vertices = mesh.vertices.copy()
    vertices[-1] *= 0.6  # the corner at +x, +y, +z: behind, left and above for who looks along x
    table = 'unit = "m"\nup = "z"\nfront = "x"\n'
    data = OwnHandheld(parts(tmp_path / "kit", table, block=Mesh(vertices, mesh.triangles)))
    truth = only(data).truth
    assert isinstance(truth.surface, Mesh)
    # x is to our -z and z to y, so that y is to our -x
    ours = truth.surface.vertices[np.abs(truth.surface.vertices).sum(axis=1).argmin()]
    np.testing.assert_allclose(ours, 0.6 * np.array([-0.045, 0.08, -0.025]), atol=1e-7)
    volume = np.einsum("ij,ij->", *(truth.surface.vertices[truth.surface.triangles[:, i]]
        if i < 1 else np.cross(*(truth.surface.vertices[truth.surface.triangles[:, k]]
        for k in (1, 2))) for i in (0, 1)))  # fmt: skip
    assert volume > 0


def test_symmetries_are_declared_or_those_of_the_field_or_found(tmp_path: Path) -> None:
    table = TABLE + '[category.block]\nsymmetry = "y/2"\n[mesh."can/b.obj"]\nsymmetry = "found"\n'
    table += '[mesh."block/b.obj"]\nsymmetry = "x/2"\n'
    can = lathe(STRAIGHT, 48)
    root = parts(tmp_path / "kit", table, block=box(0.1, 0.2, 0.1), can=can)
    save(root / "block/b.obj", box(0.1, 0.3, 0.1))
    save(root / "can/b.obj", lathe(TAPERED, 4))
    save(root / "cone/a.obj", lathe(TAPERED, 48))
    data = OwnHandheld(root)
    found = {data.load(ref).ref.model: data.load(ref).truth.symmetry for ref in data.samples}
    assert {name: len(symmetry.rotations) for name, symmetry in found.items()} == {
        "block_a": 2,
        "block_b": 2,
        "can_a": 1,
        "can_b": 4,
        "cone_a": 1,
    }
    assert [found[name].axis is not None for name in ("can_a", "cone_a")] == [True, True]
    first, *lines = data.notes
    assert "1.0 % counts" in first
    assert lines == [
        "block: x/2, declared: block_b 0.0 %",
        "block: y/2, declared: block_a 0.0 %",
        "can: y, as the field takes the category: can_a 0.1 %",
        f"can: y/4, found: can_b 0.0 % (next {lines[3].partition('next ')[2]}",
        f"cone: y, found: cone_a 0.1 % (next {lines[4].partition('next ')[2]}",
    ]


def test_categories_and_names(tmp_path: Path) -> None:
    root = parts(tmp_path / "my parts +1", TABLE, block=box(0.1, 0.2, 0.15), tube=lathe(TAPERED, 9))
    save(root / "tube/left part (2).obj", lathe(BALL, 12))
    (root / "tube/notes.txt").write_text("what is no mesh is not looked at")
    (root / "pictures").mkdir()
    data = OwnHandheld(root)
    assert data.name == "synthetic-handheld-my-parts--1"
    assert Counter(ref.category for ref in data.samples) == {"block": 1, "tube": 2}
    assert {ref.model for ref in data.samples} == {"block_a", "tube_a", "tube_left-part--2-"}
    assert data.class_names == ["block", "tube"]
    assert (data.missing, data.damaged) == ([], [])
    table = OwnTabletop(root)
    assert table.name == "synthetic-tabletop-my-parts--1"
    assert {ref.category for ref in table.samples} <= {"block", "tube"}
    assert len({ref.model for ref in table.samples}) >= 2
    assert table.digest != data.digest


def test_every_mesh_is_shown_often_enough(tmp_path: Path) -> None:
    class Folder:
        def __init__(self, count: int) -> None:
            self.files = [None] * count

    split = dataclasses.replace(OwnTabletop.split, scenes=6)
    for count in (1, 5, 7, 18, 40):
        stock = MeshStock(list(range(count)))
        for kind, shown in ((OwnTabletop, stock.on_table), (OwnHandheld, lambda n: [1])):
            kind.split = dataclasses.replace(kind.split, scenes=split.scenes)
            scenes = kind._scenes(Folder(count))
            assert scenes >= 6
            if kind is OwnTabletop:
                times = Counter(m for n in range(scenes) for m in shown(n + 1))
                assert set(times) == set(range(count))
                assert min(times.values()) >= 2
            else:
                held = Counter(stock.in_hand(n + 1) for n in range(scenes))
                assert len(held) == count
                assert len(set(held.values())) == 1


class Middle:
    """Draws the middle of every range."""

    def uniform(self, low: float, high: float) -> float:
        return (low + high) / 2

    def choice(self, values: list[int]) -> int:
        return values[0]


@pytest.mark.parametrize(
    ("made", "rods"),
    [
        (box(0.1, 0.1, 0.1), 4),
        # between its two parts, which are seen by as many rays, a hand finds nothing to hold
        (join(box(0.04, 0.1, 0.1), box(0.04, 0.1, 0.1), apart=0.2), 4),
        (box(0.0002, 0.2, 0.0002), 0),  # between two rays
    ],
    ids=["one part", "two parts", "wire"],
)
def test_a_hand_holds_what_it_finds(made: Mesh, rods: int) -> None:
    model = Model(made, "thing", 1, "band")
    scene = _scenes.HandheldScene(MeshStock([model]), 1, 1, 1, OwnHandheld.split.camera)
    held = _scenes.Item(made, Pose(np.eye(3), [0, 0, 0.6]), np.ones((2, 3)), "band", 1, "thing")
    assert len(scene._hand(held, Middle())) == rods


# -- the cache and the digest -------------------------------------------------------------------


def test_it_is_made_once_and_again_when_something_has_changed(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    generate = own_meshes.generate

    def counted(split: own_meshes.Split, root: Path) -> None:
        made.append(split.name)
        generate(split, root)

    monkeypatch.setattr(own_meshes, "generate", counted)
    root = parts(tmp_path / "kit", block=box(0.05, 0.16, 0.09))
    first = OwnHandheld(root)
    assert OwnHandheld(root).digest == first.digest
    assert len(made) == 1
    elsewhere = Path(shutil.copytree(root, tmp_path / "other" / "kit"))
    assert OwnHandheld(elsewhere).digest == first.digest
    assert len(made) == 1
    # what says the same makes no other data set, but nobody knows before it is made
    (root / "meshes.toml").write_text(TABLE + "# a word\n")
    assert OwnHandheld(root).digest == first.digest
    (root / "meshes.toml").write_text(TABLE + 'symmetry = "y/2"\n')
    declared = OwnHandheld(root)
    save(root / "block/a.obj", box(0.05, 0.16, 0.1))
    other = OwnHandheld(root)
    assert len({first.digest, declared.digest, other.digest}) == 3
    # also where the models' names stay, in which a blank is "-"
    (root / "block").rename(root / "a brick")
    brick = OwnHandheld(root)
    (root / "a brick").rename(root / "a-brick")
    assert len({data.digest for data in (first, declared, other, brick, OwnHandheld(root))}) == 5
    assert len(made) == 6
    assert sorted(p.name[:22] for p in cache.iterdir() if "kit" in p.name) == (
        ["synthetic-handheld-kit"] * 6
    )


def test_files_that_change_while_they_are_read_are_told(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = parts(tmp_path / "kit", block=box(0.05, 0.16, 0.09))
    generate = own_meshes.generate

    def meanwhile(*given: object) -> None:
        generate(*given)
        save(root / "block/a.obj", box(0.05, 0.16, 0.1))

    monkeypatch.setattr(own_meshes, "generate", meanwhile)
    with pytest.raises(DataError, match="its files changed while they were read; run it again"):
        OwnHandheld(root)
    assert [p for p in cache.iterdir() if "kit" in p.name] == []


# -- how it is named ----------------------------------------------------------------------------


def test_one_name_is_both_data_sets(tmp_path: Path) -> None:
    root = parts(tmp_path / "kit", block=box(0.05, 0.16, 0.09))
    both = registry.open_datasets([f"synthetic:{root}"], None)
    assert [data.name for data in both] == ["synthetic-tabletop-kit", "synthetic-handheld-kit"]
    assert [data.name for data in registry.open_datasets(["synthetic"], root)] == [
        data.name for data in both
    ]
    for name in ("tabletop", "handheld"):
        one = registry.open_dataset(f"synthetic-{name}:{root}", None)
        assert one.name == f"synthetic-{name}-kit"
    with pytest.raises(DataError, match=r"is two data sets.*; name synthetic-tabletop:.* or synth"):
        registry.open_dataset(f"synthetic:{root}", None)
    for opened in (registry.open_dataset, lambda *given: registry.open_datasets(given[:1], None)):
        with pytest.raises(FileNotFoundError, match="name their folder: synthetic:DIR"):
            opened("synthetic", None)


# -- what is wrong is told ----------------------------------------------------------------------

Damage = Callable[[Path], object]


def write(name: str, text: str | bytes) -> Damage:
    def damage(root: Path) -> None:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())

    return damage


def table(text: str) -> Damage:
    return write("meshes.toml", text)


def link(path: Path, to: str) -> None:
    """A link to what is called ``to`` beside the folder."""
    path.symlink_to(path.parents[path.parts[::-1].index("kit") - 1] / to)


def mesh(made: Mesh, name: str = "block/a.obj", scale: float = 1.0) -> Damage:
    return lambda root: save(root / name, made, scale)


BLOCK = box(0.05, 0.16, 0.09)
OPEN = Mesh(BLOCK.vertices, BLOCK.triangles[1:])

FAULTS: dict[str, tuple[Damage, str]] = {
    "no folder": (shutil.rmtree, r"kit: no such folder; expected one with a folder per category"),
    "empty": (lambda root: shutil.rmtree(root / "block"), r"kit: no meshes; .*kit/mug/a\.obj"),
    "no table": (
        lambda root: (root / "meshes.toml").unlink(),
        r"block/a\.obj: no up is said of it; expected which of its axes points up",
    ),
    "no unit": (
        lambda root: [table('up = "y"')(root), mesh(BLOCK, scale=500)(root)],
        r"its box is 25 x 80 x 45, and no unit is said.*probably it is in mm: unit = \"mm\"",
    ),
    "no unit, but metres would do": (
        table('up = "y"'),
        r"its box is 0\.05 x 0\.16 x 0\.09, and no unit is said.*unit = \"m\" in meshes\.toml",
    ),
    "a mug of 80 m": (
        mesh(BLOCK, scale=1000),
        r"its box is 50 x 160 x 90 of m, 190 m across; expected 0\.05 to 0\.6 m.*\"mm\"",
    ),
    "size in the axes of the file": (
        lambda root: [
            table('unit = "mm"\nup = "z"\nfront = "x"')(root),
            mesh(box(1, 2, 3))(root),
        ],
        r"its box is 1 x 2 x 3 of mm",
    ),
    "normalised": (mesh(box(0.001, 0.002, 0.001)), r"of m, 0\.00245 m across.*unit = 0\.12"),
    "unit": (table('unit = "feet"\nup = "y"'), r"unit is 'feet'; expected one of m, dm, cm, mm"),
    "unit of nothing": (table('unit = 0\nup = "y"'), r"unit is 0; expected one of m, dm, cm"),
    "units": (table('unit = ["m"]\nup = "y"'), r"unit is \['m'\]; expected one of m, dm, cm"),
    "unit is no number": (table('unit = nan\nup = "y"'), r"unit is nan; expected one of m, dm"),
    "ups": (table('unit = "m"\nup = ["y"]'), r"up is \['y'\]; expected which of its axes"),
    "unit yes": (table('unit = true\nup = "y"'), r"unit is True; expected one of m, dm, cm"),
    "up": (table('unit = "m"\nup = "up"'), r"up is 'up'; expected which of its axes points up"),
    "front along up": (
        table('unit = "m"\nup = "y"\nfront = "-y"'),
        r"front is '-y'; expected an axis across up, one of x, z, -x, -z",
    ),
    "front of a mug": (
        lambda root: (root / "block").rename(root / "mug"),
        r"mug/a\.obj: no front is said.* the handle points to: front = \"-z\" in meshes",
    ),
    "symmetry": (table(TABLE + 'symmetry = "round"'), r"symmetry is 'round'; expected found, none"),
    "open is no word": (table(TABLE + 'open = "yes"'), r"open is 'yes'; expected true or false"),
    "key": (table(TABLE + "units = 1"), r"meshes\.toml: 'units' is not known. Did you mean 'unit'"),
    "key of a mesh": (
        table(TABLE + '[mesh."block/a.obj"]\nUp = "z"'),
        r"\[mesh\.block/a\.obj\]: 'Up' is not known\. Did you mean 'up'",
    ),
    "category": (
        table(TABLE + '[category.blok]\nup = "z"'),
        r"\[category\.blok\]: there is no such category\. Did you mean 'block'\? There are block",
    ),
    "mesh": (table(TABLE + '[mesh."a.obj"]\nup = "z"'), r"there is no such mesh.*block/a\.obj"),
    "no tables": (table(TABLE + "mesh = 3"), r"mesh is 3, expected a table"),
    "no table of a mesh": (table(TABLE + "[mesh]\n'block/a.obj' = 3"), r"3, expected a table of"),
    "no TOML": (table("unit: m"), r"meshes\.toml: "),
    "name": (table('name = "../out"\n' + TABLE), r"'\.\./out': a name becomes a folder"),
    "name with +": (table('name = "a+b"\n' + TABLE), r"expected one without '\+'"),
    "name is none": (table("name = 3\n" + TABLE), r"name is 3, expected a text"),
    "unreadable": (write("block/b.obj", "v 1 2\n"), r"block/b\.obj: not a readable mesh: .*again"),
    "empty mesh": (write("block/b.obj", ""), r"block/b\.obj: .*(no triangles|empty)"),
    "cut off": (write("block/b.stl", b"solid"), r"block/b\.stl: not a readable mesh"),
    "not closed": (mesh(OPEN), r"its surface is not closed: 3 edges are open.*say open = true"),
    "there twice": (
        mesh(Mesh(BLOCK.vertices, np.vstack([BLOCK.triangles, BLOCK.triangles[:1]]))),
        r"closed: 3 edges are of three triangles or more, an odd number \(is a triangle there",
    ),
    "flat": (mesh(Mesh(BLOCK.vertices * [1, 1, 0], BLOCK.triangles)), r"0 of m, flat; expected"),
    "far away": (
        mesh(Mesh(BLOCK.vertices + 50, BLOCK.triangles)),
        r"its centre is 86.6 from the origin, where digits are lost; move it there",
    ),
    "alike": (
        mesh(Mesh(BLOCK.vertices[::-1], 7 - BLOCK.triangles[::-1]), "x/b.obj"),
        r"x/b\.obj: the same surface as block/a\.obj; remove one",
    ),
    "format": (write("block/b.STEP", "ISO"), r"\.step is not read; export it as \.obj, \.off, \.p"),
    "category of none": (write("b.stl", "x"), r"b\.stl: it is in no category; .*kit/mug/b\.stl"),
    "too deep": (write("block/b/c.obj", "x"), r"block/b/c\.obj: meshes lie directly.*block/c\.obj"),
    "reserved": (mesh(BLOCK, "all/b.obj"), r"kit/all: category 'all', by which tables"),
    "same name in other letters": (
        lambda root: [save(root / f"block/{n}.obj", box(0.1, 0.1, 0.1)) for n in ("b c", "B-c")],
        r"it would be called block_b-c, as block/B-c\.obj is; rename one",
    ),
    "link out": (
        lambda root: [mesh(BLOCK, "../b.obj")(root), link(root / "block/b.obj", "../b.obj")],
        r"block/b\.obj: it leads to .*b\.obj, out of .*kit; copy it there",
    ),
    "category that leads out": (
        lambda root: [mesh(BLOCK, "../o/b.obj")(root), link(root / "o", "../o")],
        r"kit/o: it leads to .*out of .*kit; copy it there",
    ),
    "table that leads out": (
        lambda root: [(root / NAME).rename(root.parent / "t"), link(root / NAME, "../t")],
        r"meshes\.toml: it leads to .*out of .*kit",
    ),
    "link to itself": (
        lambda root: link(root / "block/b.obj", "block/b.obj"),
        r"block/b\.obj: ",
    ),
    "a folder, no mesh": (
        lambda root: (root / "block/b.obj").mkdir(),
        r"block/b\.obj: not a regular file",
    ),
    "link to nothing": (
        lambda root: link(root / "block/b.obj", "none.obj"),
        r"block/b\.obj: ",
    ),
    "too thin to be seen": (
        mesh(box(0.001, 0.09, 0.001)),
        r"handheld-kit, scene 1: of block_a, 1 are never seen well at once, in 5 views: with 500",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_fault_is_told(tmp_path: Path, cache: Path, name: str) -> None:
    damage, words = FAULTS[name]
    root = parts(tmp_path / "kit", block=BLOCK)
    damage(root)
    with pytest.raises((ContractError, FileNotFoundError), match=words) as told:
        OwnHandheld(root)
    assert "kit" in str(told.value) or name == "name"
    assert [p for p in cache.iterdir() if "kit" in p.name] == []


def test_a_name_that_is_no_text(tmp_path: Path) -> None:
    root = parts(tmp_path / "kit")
    name = os.fsdecode(b"b\xff\x1b[31m.obj")
    try:
        save(root / "block" / name, BLOCK)
    except OSError:
        pytest.skip("a file system that knows names of text alone")
    (found,) = MeshFolder(root).files
    assert found.name == "block_b---31m"


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    root = parts(tmp_path / "kit", block=BLOCK)
    for number in range(5):
        save(root / f"tube/{number}.obj", box(50, 80, 60 + number))
    save(root / "block/b.obj", OPEN)
    with pytest.raises(DataError) as told:
        OwnHandheld(root)
    lines = str(told.value).splitlines()
    assert [re.sub(r"^.*kit/", "", line)[:12] for line in lines] == [
        "block/b.obj:",
        *(f"tube/{n}.obj: " for n in range(3)),
        "and 2 more l",
    ]


def test_what_is_declared_open_is_rendered(tmp_path: Path) -> None:
    root = parts(tmp_path / "kit", TABLE + "[category.block]\nopen = true\n", block=OPEN)
    assert len(OwnHandheld(root).samples) == 1


def test_a_left_and_a_right_part_are_two(tmp_path: Path) -> None:
    vertices = BLOCK.vertices.copy()
    vertices[-1] *= 0.6
    left = Mesh(vertices, BLOCK.triangles)
    root = parts(tmp_path / "kit", block=left)
    save(root / "block/b.obj", Mesh(vertices * [-1, 1, 1], BLOCK.triangles[:, ::-1]))
    assert len(MeshFolder(root).files) == len(read_models(MeshFolder(root))[0]) == 2


def test_meshes_that_are_wound_inwards_are_turned(tmp_path: Path) -> None:
    inwards = Mesh(BLOCK.vertices, BLOCK.triangles[:, ::-1])
    turned = OwnHandheld(parts(tmp_path / "kit", block=inwards))
    assert turned.digest != ""
    surface = only(turned).truth.surface
    assert isinstance(surface, Mesh)
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    assert np.sum(a * np.cross(b, c)) > 0


# -- runs ---------------------------------------------------------------------------------------


def test_check_and_run_from_the_command_line(pytester: pytest.Pytester, tmp_path: Path) -> None:
    parts(pytester.path / "kit", TABLE, block=BLOCK, can=lathe(STRAIGHT, 48))
    result = pytester.runpytest_inprocess(*RUN, "--cpas-check-dataset", "synthetic:kit")
    result.stdout.fnmatch_lines(
        [
            "*data set synthetic-tabletop-kit*",
            "note: symmetries, and by how much*",
            "note: block: box, found: block_a 0.0 % (next *",
            "note: can: y, as the field takes the category: can_a 0.1 %",
            "counts * n/a",
            "mesh-closed * passed",
            "* checks: 9 passed, 4 n/a",
            "*data set synthetic-handheld-kit*",
        ]
    )
    assert result.ret == 0


BLIND = """
import numpy as np
from pytest_cpas import Hypothesis, MethodInfo, Prediction

class Blind:
    info = MethodInfo(
        name="blind",
        categories=("can",),
        needs=frozenset({"depth"}),
        gives=frozenset(),
        licence="MIT",
    )

    def load(self, assets, device): ...

    def predict(self, batch, seed):
        return [self.answer(seen) for seen in batch]

    def answer(self, seen):
        points = seen.camera.back_project(seen.depth, seen.mask)
        if not len(points):
            return Prediction.failed("nothing was measured")
        return Prediction((Hypothesis(rotation=np.eye(3), translation=points.mean(axis=0)),))
"""


def test_run_with_golden_tables(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(blind=BLIND)
    parts(pytester.path / "kit", TABLE, block=BLOCK, can=lathe(STRAIGHT, 48))
    run = (*RUN, "--cpas-method", "blind:Blind", "--cpas-dataset")
    assert pytester.runpytest_inprocess(*run, "synthetic:kit", "--snapshot-update").ret == 0
    tables = sorted(path.name for path in (pytester.path / "golden/recorded/blind").iterdir())
    assert tables == ["synthetic-handheld-kit", "synthetic-tabletop-kit"]
    one = "synthetic-handheld:kit"
    again = pytester.runpytest_inprocess(*run, one, "--cpas-require-golden")
    again.stdout.fnmatch_lines(
        [
            "missing: blind does not know block: * left out",
            "note: can: y, as the field takes the category: can_a 0.1 %",
            "golden: MATCHES*",
        ]
    )
    assert again.ret == 0
    table(TABLE + '[category.can]\nsymmetry = "none"\n')(pytester.path / "kit")
    other = pytester.runpytest_inprocess(*run, one)
    other.stdout.fnmatch_lines(["*golden: STALE*data*"])
    assert other.ret == 1


def test_no_category_that_the_method_knows(pytester: pytest.Pytester) -> None:
    parts(pytester.path / "kit", block=BLOCK)
    run = ("--cpas-method", "icp", "--cpas-dataset", "synthetic:kit")
    result = pytester.runpytest_inprocess(*RUN, *run)
    result.stderr.fnmatch_lines(
        ["*icp on synthetic-tabletop-kit: no samples*", "icp does not know block: *"]
    )
    assert result.ret == 4


@pytest.mark.minutes
def test_the_page_as_it_is_written(
    pytester: pytest.Pytester, test_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five scanned meshes, what the page says to write and to type, and what it says comes out."""
    monkeypatch.setattr(synthetic, "_ATTEMPTS", 200)
    for kind, whole in ((OwnTabletop, synthetic.TABLETOP), (OwnHandheld, synthetic.HANDHELD)):
        monkeypatch.setattr(kind, "split", whole)
    page = text("own-meshes.md")
    toml, *names = re.findall(r"^ {4}(parts/.*)$", page, re.MULTILINE)
    for name in names:
        path = pytester.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(test_data / "redwood75" / path.name, path)
    (pytester.path / toml).write_text(blocks(page, "toml")[0])
    commands = re.findall(r"^ {4}pytest (.*)$", page, re.MULTILINE)
    assert len(commands) == 3
    printed = []
    for command in commands:
        result = pytester.runpytest_inprocess(*RUN, *command.split())
        assert result.ret == 0, command
        printed.append(result.stdout.str())
    checked, faults = blocks(page, "")
    assert checked in printed[0]
    assert "146 of 146 samples examined, with 5 meshes" in printed[0]
    assert "140 of 140 samples examined, with 5 meshes" in printed[0]
    assert printed[1].count("golden: RECORDED") == 2
    assert printed[2].count("golden: MATCHES (bottle, bowl, mug)") == 2
    # the second mug in millimetres, and another one that has lost a triangle
    path = pytester.path / names[-1]
    lines = path.read_text().splitlines()
    path.with_name("b.obj").write_text("\n".join(lines[:-1]))
    broken = read_mesh(path)
    save(path, Mesh(broken.vertices, broken.triangles), 1000)
    result = pytester.runpytest_inprocess(*RUN, *commands[0].split())
    assert result.ret == 4
    assert faults in result.stderr.str()
