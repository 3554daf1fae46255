"""The loader of REAL275: a small tree of our own in the published layout, whole and damaged."""

import os
import pickle
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.metrics.surfaces import sample_surface
from pytest_cpas.types import ContractError

# scalar last; turns ShapeNet coordinates into NOCS ones (FACTS of the data set's publication)
NOCS = Rotation.from_quat([0, -np.sqrt(0.5), 0, np.sqrt(0.5)])
TURN = Rotation.from_rotvec([2.0, 0.3, -0.4])
EXTENTS_NOCS = np.array([0.1, 0.2, 0.3])


def test_samples_are_listed_and_read(tree):
    data = Real275(tree)
    assert [(s.id, s.category, s.scene, s.model) for s in data.samples] == [
        ("scene_1/0000/1", "bowl", "scene_1", "bowl_b"),
        ("scene_1/0000/5", "mug", "scene_1", "mug_a"),
        ("scene_1/0001/1", "bowl", "scene_1", "bowl_b"),
        ("scene_1/0001/5", "mug", "scene_1", "mug_a"),
    ]
    assert (data.missing, data.damaged) == ([], [])
    sample = data.load(data.samples[1])
    observed, truth = sample.observation, sample.truth
    assert observed.mask.sum() == 100 * 100
    assert observed.mask[300:400, 100:200].all()
    assert observed.depth[60, 0] == np.float32(1.234)
    assert observed.depth[0, 0] == 0
    np.testing.assert_allclose(observed.rgb, 0.2)
    # the second pose belongs to mask id 5: distractors have none
    np.testing.assert_allclose(truth.pose.translation, [-0.32, 0.2, 1.1])
    np.testing.assert_allclose(truth.pose.rotation, (TURN * NOCS).as_matrix(), atol=1e-12)
    # NOCS x is ShapeNet z
    np.testing.assert_allclose(truth.extents, EXTENTS_NOCS[[2, 1, 0]])
    low, high = truth.surface.bounds
    np.testing.assert_allclose(high - low, truth.extents)
    assert truth.symmetry.axis is None
    np.testing.assert_array_equal(data.load(data.samples[0]).truth.symmetry.axis, [0, 1, 0])


def test_parent_folder_is_accepted(tree):
    (tree / "all").mkdir()
    os.symlink(tree, tree / "all" / "real275", target_is_directory=True)
    assert len(Real275(tree / "all").samples) == 4


def test_the_layout_of_spd_is_the_same_data(tree):
    first = Real275(tree)
    masks = [first.load(ref).observation.mask for ref in first.samples]
    (tree / "Real").mkdir()
    (tree / "real_test").rename(tree / "Real/test")
    second = Real275(tree)
    assert (second.samples, second.digest) == (first.samples, first.digest)
    assert (second.missing, second.damaged) == ([], [])
    assert np.array_equal([second.load(ref).observation.mask for ref in second.samples], masks)


@pytest.mark.parametrize(
    "edit",
    [
        lambda text: b"\xef\xbb\xbf" + text,
        lambda text: text + b"\n\n",
        lambda text: text.replace(b"\n", b"\r\n") + b"\r\n",
        lambda text: text.rstrip(b"\n"),
        lambda text: text.replace(b" ", b"  "),
    ],
    ids=["BOM", "blank lines", "CRLF", "no end", "spaces"],
)
def test_meta_files_as_editors_leave_them(tree, edit):
    first = Real275(tree)
    for path in (tree / "real_test/scene_1").glob("*_meta.txt"):
        path.write_bytes(edit(path.read_bytes()))
    second = Real275(tree)
    assert (second.samples, second.damaged) == (first.samples, [])


def test_digest_tells_contents_apart(tree):
    first = Real275(tree).digest
    assert Real275(tree).digest == first
    truth = tree / "gts/real_test/results_real_test_scene_1_0000.pkl"
    poses = pickle.loads(truth.read_bytes())["gt_RTs"]
    poses[0, 0, 3] += 1e-6
    truth.write_bytes(pickle.dumps({"gt_RTs": poses}, protocol=3))
    second = Real275(tree).digest
    mesh = tree / "fixed_real_test_obj_models/mug_a.obj"
    mesh.write_text(mesh.read_text().replace("0.05", "0.051"))
    assert len({first, second, Real275(tree).digest}) == 3


@pytest.mark.parametrize(
    ("remove", "kind"),
    [
        ("real_test/scene_1/0001_color.png", "color.png"),
        ("real_test/scene_1/0001_depth.png", "depth.png"),
        ("real_test/scene_1/0001_mask.png", "mask.png"),
        ("real_test/scene_1/0001_meta.txt", "meta.txt"),
        ("gts/real_test/results_real_test_scene_1_0001.pkl", "ground truth"),
    ],
)
def test_missing_file_leaves_its_frame_out_and_is_named_once(tree, remove, kind):
    (tree / remove).unlink()
    data = Real275(tree)
    assert [s.id for s in data.samples] == ["scene_1/0000/1", "scene_1/0000/5"]
    assert len(data.missing) == 1
    assert data.missing[0].startswith(f"1 frames without {kind}")
    assert "scene_1/0001" in data.missing[0]
    assert data.damaged == []


def test_missing_mesh(tree):
    (tree / "fixed_real_test_obj_models/mug_a.obj").unlink()
    data = Real275(tree)
    assert data.missing == ["mesh mug_a.obj: shape metrics of 2 samples are n/a"]
    truth = data.load(data.samples[1]).truth
    assert truth.surface is None
    np.testing.assert_allclose(truth.extents, EXTENTS_NOCS[[2, 1, 0]])
    (tree / "obj_models/real_test/mug_a.txt").unlink()
    data = Real275(tree)
    assert data.missing == ["mesh obj_models/real_test/mug_a.obj and mug_a.txt: 2 samples left out"]
    assert {s.category for s in data.samples} == {"bowl"}


def test_original_meshes_are_used_with_a_word(tree):
    mesh = tree / "fixed_real_test_obj_models/mug_a.obj"
    mesh.rename(tree / "obj_models/real_test/mug_a.obj")
    (line,) = Real275(tree).missing
    assert "fixed_real_test_obj_models/ of mug_a" in line
    assert "bottoms are missing" in line


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def save(pixels: np.ndarray) -> Callable[[Path], None]:
    return lambda path: Image.fromarray(pixels).save(path)


def dump(content: object) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(pickle.dumps(content, protocol=4))


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)  # opening it would wait for ever


SCENE = "real_test/scene_1/0000"
TRUTH = "gts/real_test/results_real_test_scene_1_0000.pkl"
MESH = "fixed_real_test_obj_models/mug_a.obj"
MIRROR = np.diag([1.0, 1, -1, 1])[None].repeat(2, 0)


@pytest.mark.parametrize(
    ("file", "damage", "words"),
    [
        (f"{SCENE}_color.png", truncate, "not a readable image"),
        (f"{SCENE}_depth.png", truncate, "not a readable image"),
        (f"{SCENE}_mask.png", truncate, "not a readable image"),
        (f"{SCENE}_color.png", lambda p: p.write_bytes(b""), "not a readable image"),
        (f"{SCENE}_color.png", lambda p: p.write_text("<html>"), "not a readable image"),
        (f"{SCENE}_color.png", save(np.zeros((480, 640), np.uint8)), "mode is L, expected RGB"),
        (f"{SCENE}_depth.png", save(np.ones((480, 640), np.uint8)), "mode is L, expected I;16"),
        (f"{SCENE}_depth.png", save(np.ones((240, 320), np.uint16)), "320 x 240 pixels"),
        (f"{SCENE}_mask.png", save(np.ones((240, 320), np.uint8)), "320 x 240 pixels"),
        (f"{SCENE}_mask.png", save(np.ones((480, 640), np.uint16)), "expected 1 or L"),
        (TRUTH, truncate, "not a readable pickle"),
        (TRUTH, dump([]), "holds a list"),
        (TRUTH, dump({}), r"gt_RTs is not an array \(n, 4, 4\)"),
        (TRUTH, dump({"gt_RTs": np.zeros((2, 4, 4))}), "last row of matrix 0"),
        (TRUTH, dump({"gt_RTs": np.tile(np.diag([0, 0, 0, 1.0]), (2, 1, 1))}), "determinant 0"),
        (TRUTH, dump({"gt_RTs": np.full((2, 4, 4), np.nan)}), "finite numbers"),
        (TRUTH, dump({"gt_RTs": MIRROR}), "determinant -1"),
        (TRUTH, dump({"gt_RTs": np.diag([1.0, 2, 3, 1])[None].repeat(2, 0)}), "not orthonormal"),
        (TRUTH, dump({"gt_RTs": os.getcwd}), "the pickle names posix.getcwd"),
        (f"{SCENE}_color.png", pipe, "not a regular file"),
        (f"{SCENE}_depth.png", lambda p: p.write_bytes(b"%!PS\nquit"), "not a readable image"),
        (MESH, pipe, "not a regular file"),
        (MESH, lambda p: p.write_text(""), "not a readable mesh"),
        (MESH, lambda p: p.write_text("v 0 0 0\nf 1 2 3\n"), "not a readable mesh"),
        (MESH, lambda p: p.write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "NaN"),
    ],
)
def test_damage_is_named_and_the_other_samples_still_load(tree, file, damage, words):
    damage(tree / file)
    data = Real275(tree)
    assert len(data.samples) == 4
    with pytest.raises(ContractError, match=words) as caught:
        data.load(data.samples[1])
    assert len(str(caught.value).splitlines()) == 1
    data.load(data.samples[2])


def poses_of(tree):
    return pickle.loads((tree / TRUTH).read_bytes())["gt_RTs"]


def test_a_hidden_object_that_is_listed_has_no_pose(tree):
    """As in seven published frames: the others keep theirs."""
    sound = {ref.id: Real275(tree).truth(ref).pose.matrix for ref in Real275(tree).samples}
    with (tree / f"{SCENE}_meta.txt").open("a") as file:
        file.write("3 1 bottle_c\n4 0 thing\n")
    data = Real275(tree)
    assert (data.missing, data.damaged) == ([], [])
    assert [ref.id for ref in data.samples] == [*sound]
    for ref in data.samples:
        np.testing.assert_array_equal(data.load(ref).truth.pose.matrix, sound[ref.id])


def erased(tree, id_):
    mask = np.array(Image.open(tree / f"{SCENE}_mask.png"))
    mask[mask == id_] = 255
    Image.fromarray(mask).save(tree / f"{SCENE}_mask.png")


def test_an_object_that_is_erased_leaves_the_other_its_pose(tree):
    expected = Real275(tree).truth(Real275(tree).samples[1]).pose.matrix
    dump({"gt_RTs": poses_of(tree)[1:]})(tree / TRUTH)
    erased(tree, 1)
    data = Real275(tree)
    assert data.samples[0].id == "scene_1/0000/5"
    np.testing.assert_array_equal(data.load(data.samples[0]).truth.pose.matrix, expected)


@pytest.mark.parametrize(
    ("count", "words"),
    [(0, "0 poses, but the meta file lists 2 objects, of which 2"), (1, "1 poses"), (3, "3 poses")],
)
def test_poses_that_are_nobodys_are_refused(tree, count, words):
    poses = np.concatenate([poses_of(tree)] * 2)[:count].reshape(-1, 4, 4)
    dump({"gt_RTs": poses})(tree / TRUTH)
    data = Real275(tree)
    assert [ref.id for ref in data.samples] == ["scene_1/0001/1", "scene_1/0001/5"]
    (line,) = data.damaged
    assert words in line
    assert "its ids are 1, 2, 5, 255" in line


def moved(tree, *offset):
    poses = poses_of(tree)
    poses[1, :3, 3] += offset
    dump({"gt_RTs": poses})(tree / TRUTH)


def turned_round(tree):
    """Another object's poses, first to last."""
    dump({"gt_RTs": poses_of(tree)[::-1]})(tree / TRUTH)


def foreign(tree):
    """Erased is the bowl, and dropped the mug's pose: the mug would get the bowl's."""
    dump({"gt_RTs": poses_of(tree)[:1]})(tree / TRUTH)
    erased(tree, 1)


def other_class_ids(tree):
    dump({"gt_RTs": poses_of(tree), "gt_class_ids": np.array([6, 2])})(tree / TRUTH)


def other_scale(tree):
    """The models are told apart by their size alone: the poses are the other's."""
    (tree / "fixed_real_test_obj_models/bowl_b.obj").unlink()
    (tree / "obj_models/real_test/bowl_b.txt").write_text("0.05 0.1 0.15")
    poses = poses_of(tree)
    poses[1, :3, :3] /= 2
    dump({"gt_RTs": poses})(tree / TRUTH)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (turned_round, "pose 0 0 % of object 1 (bowl, 10000 pixels) and that of pose 1 19 % of"),
        (turned_round, "or more; none fit"),
        (foreign, "1 poses for the 1 objects of the mask"),
        (
            lambda tree: moved(tree, 2, 0, 0),
            "pose 1 0 % of object 5 (mug, 10000 pixels), expected 90 %",
        ),
        (lambda tree: moved(tree, 2, 0, 0), "2 poses for the 2 objects of the mask"),
        (lambda tree: moved(tree, 2, 0, 0), "or more; objects 1 fit. Which pose is whose cannot"),
        (lambda tree: moved(tree, 0.3, 0, 0), "of object 5 (mug"),
        (lambda tree: moved(tree, 0, 0, -2.5), "pose 1 0 % of object 5"),
        (
            other_class_ids,
            "gt_class_ids are [6, 2], but the classes of these objects in real_test/",
        ),
        (other_class_ids, "0000_meta.txt are [2, 6]"),
        (other_scale, "pose 0 has the scale 0.3742 m, which is the box diagonal of mug_a, and"),
        (other_scale, "would be that of object 1, bowl_b, whose diagonal is 0.1871 m"),
    ],
)
def test_a_frame_with_a_pose_that_cannot_be_its_objects_is_refused(tree, damage, words):
    """All of it: if one pose is another's, so may be the next; not the frames beside it."""
    damage(tree)
    data = Real275(tree)
    refused = [ref for ref in data.samples if ref.id.startswith("scene_1/0000/")]
    assert refused
    for ref in refused:
        for read in (data.load, data.truth):
            with pytest.raises(ContractError, match=re.escape(words)):
                read(ref)
    if damage is not other_scale:  # whose models have changed
        for ref in data.samples[len(refused) :]:
            data.load(ref)


@pytest.mark.parametrize(
    "harmless",
    [
        lambda tree: moved(tree, 0.01, 0.01, 0.05),
        lambda tree: in_millimetres(tree),  # which the check "poses" says
        lambda tree: mostly_hidden(tree, 5),
        lambda tree: dump({"gt_RTs": poses_of(tree), "gt_class_ids": np.array([2, 6])})(
            tree / TRUTH
        ),
    ],
    ids=["a little", "all in millimetres", "nine tenths hidden", "class ids"],
)
def test_a_frame_whose_poses_can_be_the_objects_is_read(tree, harmless):
    harmless(tree)
    data = Real275(tree)
    for ref in data.samples:
        data.load(ref)


def in_millimetres(tree):
    poses = poses_of(tree)
    poses[:, :3, 3] *= 1000
    dump({"gt_RTs": poses})(tree / TRUTH)


def mostly_hidden(tree, id_):
    """All but a strip at its side."""
    mask = np.array(Image.open(tree / f"{SCENE}_mask.png"))
    rows, columns = np.nonzero(mask == id_)
    gone = columns > columns.min() + 9
    mask[rows[gone], columns[gone]] = 255
    Image.fromarray(mask).save(tree / f"{SCENE}_mask.png")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("5 6\n", "expected 'mask_id class_id model'"),
        ("a b c\n", "expected 'mask_id class_id model'"),
        ("5 7 mug_a\n", "a class id of 0 to 6"),
        ("5 6 ../../mug_a\n", "expected 'mask_id class_id model'"),
        ("5 6 ..\n", "expected 'mask_id class_id model'"),
        ("255 6 mug_a\n", "a mask id of 0 to 254"),
        ("5 6 mug_a\n5 2 bowl_b\n", "a mask id occurs twice"),
        ("\x00\xff\x00", "expected 'mask_id"),
    ],
)
def test_damaged_meta_is_reported_as_damage(tree, text, words):
    (tree / f"{SCENE}_meta.txt").write_text(text, encoding="latin1")
    data = Real275(tree)
    assert [s.id for s in data.samples] == ["scene_1/0001/1", "scene_1/0001/5"]
    (line,) = data.damaged
    assert words in line
    assert "scene_1/0000" in line


@pytest.mark.parametrize("file", [f"{SCENE}_meta.txt", TRUTH])
@pytest.mark.parametrize("damage", [pipe, lambda path: (path.unlink(), path.mkdir())])
def test_frame_with_something_else_than_files_is_damaged(tree, file, damage):
    damage(tree / file)
    data = Real275(tree)
    assert [s.id for s in data.samples] == ["scene_1/0001/1", "scene_1/0001/5"]
    (line,) = data.damaged
    assert "not a regular file" in line


def test_extents_that_stand_in_for_a_mesh_are_part_of_the_digest(tree):
    (tree / MESH).unlink()
    first = Real275(tree).digest
    (tree / "obj_models/real_test/mug_a.txt").write_text("0.1\n0.2\n0.31\n")
    assert Real275(tree).digest != first


def test_damaged_extents_file(tree):
    (tree / MESH).unlink()
    extents = tree / "obj_models/real_test/mug_a.txt"
    extents.write_bytes(b"\xff\xfe0")
    with pytest.raises(ContractError, match=r"mug_a\.txt, line 1: not text in UTF-8"):
        Real275(tree).load(Real275(tree).samples[1])
    extents.write_text("0.1 0.2")
    data = Real275(tree)
    with pytest.raises(ContractError, match=r"mug_a\.txt: extents .* expected 3 finite"):
        data.load(data.samples[1])


def test_without_a_folder_the_error_says_what_to_fetch(tmp_path):
    for folder in (None, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"(?s)gts\.zip.*--cpas-data=DIR"):
            Real275(folder)


def test_real_frame(test_data):
    """The published frame: meshes at the loaded poses lie on the measured depth."""
    data = Real275(test_data)
    assert [s.category for s in data.samples] == ["bowl", "can", "camera", "mug", "laptop"]
    assert any("laptop_air_xin_norm.obj" in line for line in data.missing)
    for ref in data.samples[:4]:
        sample = data.load(ref)
        observed, truth = sample.observation, sample.truth
        seen = observed.camera.back_project(observed.depth, observed.mask)
        posed = truth.pose.apply(sample_surface(truth.surface, 20_000, 0))
        median = np.median(cKDTree(posed).query(seen)[0])
        # the can's label reflects the infrared pattern
        assert median < (0.015 if ref.category == "can" else 0.006), ref


@pytest.mark.parametrize("number", [0, 3, 6])
def test_an_id_that_the_mask_lacks_swaps_no_poses(tree, number):
    """The meta file calls the mug 0, 3 or 6, and the mask 5."""
    (tree / f"{SCENE}_meta.txt").write_text(f"{number} 6 mug_a\n2 0 thing\n1 2 bowl_b\n")
    [line] = Real275(tree).damaged
    assert "2 poses, but the meta file lists 2 objects, of which 1 have pixels" in line


def test_an_object_that_lost_its_pixels_has_no_box(tree):
    data = Real275(tree)
    erased(tree, 5)  # since the index was made
    assert data.box_of(data.samples[1]) is None


@pytest.mark.parametrize("text", ["", "\n \n"])
def test_an_empty_meta_file_is_damage(tree, text):
    (tree / f"{SCENE}_meta.txt").write_text(text)
    data = Real275(tree)
    assert len(data.samples) == 2
    assert any("scene_1/0000_meta.txt: it is empty" in line for line in data.damaged)


def test_a_link_to_nothing_is_no_missing_mesh(tree):
    (tree / MESH).unlink()
    (tree / MESH).symlink_to("nowhere.obj")
    data = Real275(tree)
    with pytest.raises(ContractError, match=r"mug_a\.obj"):
        data.load(data.samples[1])
