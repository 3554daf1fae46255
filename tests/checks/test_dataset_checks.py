"""Each sanity check finds its fault, planted in a rendered tree, and no other check does."""

import dataclasses
import itertools
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pytest_cpas.datasets
from pytest_cpas.checks.dataset import CHECKS, Problem
from pytest_cpas.checks.dataset.facts import Survey, survey
from pytest_cpas.checks.dataset.orientations import up_axis_spread
from pytest_cpas.checks.dataset.verdicts import DatasetWord, judge
from pytest_cpas.checks.known import LESS_IS_WORSE, MEASURING, KnownFailure, read_known
from pytest_cpas.datasets.nocs import NocsTree, Real275
from pytest_cpas.datasets.synthetic import HANDHELD, TABLETOP, generate
from pytest_cpas.types import Camera, SampleRef

CAMERA = HANDHELD.camera
STEM = Path("real_test/scene_1/0000_depth.png")


@pytest.fixture(scope="module")
def sane(tmp_path_factory) -> Path:
    """Two frames of each category in a hand."""
    root = tmp_path_factory.mktemp("handheld") / "tree"
    generate(dataclasses.replace(HANDHELD, frames=2), root, range(1, 7))
    return root


@pytest.fixture
def tree(sane, tmp_path) -> Path:
    return Path(shutil.copytree(sane, tmp_path / "tree"))


def failing(measured: Survey) -> dict[str, list[Problem]]:
    found = {name: check(measured) for name, check in CHECKS.items()}
    return {name: problems for name, problems in found.items() if problems}


class Own(NocsTree):
    """A tree with a camera and a name of the test's."""

    def __init__(self, root: Path, camera: Camera = CAMERA, name: str = "own") -> None:
        super().__init__(name, root, camera)

    def _sound(self, frame, listed, posed, truth, poses, ids):
        """Nothing is refused here that the checks, which are for any reader, are to find."""
        return posed


def test_sane_data_passes(sane):
    measured = survey(Own(sane))
    assert failing(measured) == {}
    assert len(measured.samples) == 12
    judged = {name for name, check in CHECKS.items() if check(measured) is not None}
    # no counts known; 12 are too few; the extents are those of the meshes, the poses published
    assert set(CHECKS) - judged == {"counts", "orientations", "extents", "fits"}


# -- planted faults: change the tree, return how to read it -------------------------------------


def edit_image(path: Path, change) -> None:
    with Image.open(path) as image:
        pixels = np.array(image)
    Image.fromarray(change(pixels)).save(path)


def edit_pose(tree: Path, change) -> None:
    path = tree / "gts/real_test/results_real_test_scene_1_0000.pkl"
    content = pickle.loads(path.read_bytes())
    change(content["gt_RTs"][0])
    path.write_bytes(pickle.dumps(content, protocol=3))


def edit_mesh(tree: Path, change) -> None:
    path = tree / "fixed_real_test_obj_models" / "mug_0.obj"
    lines = [line.split() for line in path.read_text().splitlines()]
    vertices = np.array([line[1:] for line in lines if line[0] == "v"], dtype=float)
    faces = np.array([line[1:] for line in lines if line[0] == "f"], dtype=int)
    vertices, faces = change(vertices, faces)
    text = ["v {} {} {}".format(*v) for v in vertices] + ["f {} {} {}".format(*f) for f in faces]
    path.write_text("\n".join(text))


def truncated_image(tree):
    path = tree / STEM
    path.write_bytes(path.read_bytes()[:1000])
    return "readable", "depth.png: not a readable image"


def behind_the_camera(tree):
    def change(pose):
        pose[2, 3] *= -1

    edit_pose(tree, change)
    return "poses", "behind the camera"


def millimetres(tree):
    def change(pose):
        pose[:3, 3] *= 1000

    edit_pose(tree, change)
    return "poses", "is the translation in millimetres?"


def beside_the_image(tree):
    def change(pose):
        pose[0, 3] += 5

    edit_pose(tree, change)
    return "poses", "outside of 640 x 480"


def not_a_number(tree):
    def change(pose):
        pose[0, 3] = np.nan

    edit_pose(tree, change)
    return "readable", "finite"


def mesh_in_millimetres(tree):
    edit_mesh(tree, lambda vertices, faces: (1000 * vertices, faces))
    return "mesh-metric", "mug_0: its box has a diagonal of 1"


def mesh_normalised(tree):
    def change(vertices, faces):
        return vertices / np.linalg.norm(np.ptp(vertices, axis=0)), faces

    edit_mesh(tree, change)
    return "mesh-metric", "it seems to be normalised"


def mesh_off_centre(tree):
    edit_mesh(tree, lambda vertices, faces: (vertices + np.array([0, 0.02, 0]), faces))
    return "mesh-centred", "mug_0: the centre of its box is 20.0 mm from the origin"


def mesh_without_bottom(tree):
    def change(vertices, faces):
        heights = vertices[faces - 1][:, :, 1]
        return vertices, faces[heights.max(axis=1) > vertices[:, 1].min() + 0.0005]

    edit_mesh(tree, change)
    return "mesh-closed", "mug_0: it has no closed bottom"


def mesh_inside_out(tree):
    edit_mesh(tree, lambda vertices, faces: (vertices, faces[:, ::-1]))
    return "mesh-closed", "wound inside out"


def mesh_with_a_face_twice(tree):
    edit_mesh(tree, lambda vertices, faces: (vertices, np.vstack([faces, faces[:1]])))
    return "mesh-closed", "mug_0: 3 edges are of three triangles or more"


def mesh_without_faces(tree):
    edit_mesh(tree, lambda vertices, faces: (vertices, faces[:0]))
    return "readable", "mug_0.obj"


def extents_of_nothing(tree):
    (tree / "fixed_real_test_obj_models" / "mug_0.obj").unlink()
    (tree / "obj_models" / "real_test" / "mug_0.obj").unlink()
    (tree / "obj_models" / "real_test" / "mug_0.txt").write_text("0.1 0 0.1")
    return "readable", "extents (metres): "


def depth_that_is_off(tree):
    edit_image(tree / STEM, lambda depth: np.where(depth > 0, depth + 25, 0).astype(depth.dtype))
    return "depth", "median difference +2"


def depth_in_another_unit(tree):
    edit_image(tree / STEM, lambda depth: (depth * 10).astype(depth.dtype))
    return (
        "depth",
        "is about 10 times as far as the object: is a step of the depth image of another",
    )


def mask_of_a_part(tree):
    def change(mask):
        columns = np.flatnonzero((mask == 1).any(axis=0))
        mask[:, columns[len(columns) // 2] :] = 255
        return mask

    edit_image(tree / "real_test/scene_1/0000_mask.png", change)
    return "masks", "IoU with the rendered silhouette is 0."


def frame_twice(tree):
    for path in (tree / "real_test/scene_1").glob("0000_*"):
        shutil.copy(path, path.with_name(path.name.replace("0000", "0001")))
    truth = tree / "gts/real_test/results_real_test_scene_1_0000.pkl"
    shutil.copy(truth, truth.with_name(truth.name.replace("0000", "0001")))
    return "duplicates", "scene_1/0001/1 (bottle, bottle_0): its colour image and mask are those of"


PLANTED = [
    truncated_image,
    not_a_number,
    mesh_without_faces,
    extents_of_nothing,
    behind_the_camera,
    millimetres,
    beside_the_image,
    mesh_in_millimetres,
    mesh_normalised,
    mesh_off_centre,
    mesh_without_bottom,
    mesh_inside_out,
    mesh_with_a_face_twice,
    depth_that_is_off,
    depth_in_another_unit,
    mask_of_a_part,
    frame_twice,
]


@pytest.mark.parametrize("plant", PLANTED, ids=lambda plant: plant.__name__)
def test_planted_fault_fails_its_check_only(tree, plant):
    check, words = plant(tree)
    found = failing(survey(Own(tree)))
    assert list(found) == [check]
    assert words in str(found[check][0])


def test_intrinsics_of_another_resolution(sane):
    wrong = Camera(640, 480, 1050.0, 1050.0, 639.5, 479.5)
    found = failing(survey(Own(sane, wrong)))
    assert list(found) == ["intrinsics"]
    assert "principal point (639.5, 479.5) in images of 640 x 480" in str(found["intrinsics"][0])
    for fx, fy, words in (
        (40.0, 40.0, "field of view of 166 deg"),
        (525.0, 300.0, "square pixels"),
    ):
        found = failing(survey(Own(sane, Camera(640, 480, fx, fy, 319.5, 239.5))))
        assert list(found) == ["intrinsics"]
        assert words in str(found["intrinsics"][0])


def test_counts_of_a_complete_copy(sane):
    found = failing(survey(Own(sane, name="redwood75")))
    assert list(found) == ["counts"]
    assert "2 samples of mug, and nothing is missing; the published data set has 25" in {
        problem.message for problem in found["counts"]
    }


def test_half_extents(sane):
    class Half(Own):
        def __init__(self, root):
            super().__init__(root)
            self.derived = ()

        def load(self, ref):
            sample = super().load(ref)
            truth = dataclasses.replace(sample.truth, extents=sample.truth.extents / 2)
            return dataclasses.replace(sample, truth=truth)

    found = failing(survey(Half(sane)))
    assert list(found) == ["extents"]
    assert len(found["extents"]) == 12
    assert "are they half extents?" in str(found["extents"][0])
    lines = judge(survey(Half(sane)), "extents").details.splitlines()
    assert len(lines) == 11
    assert lines[-1].startswith("and 2 more; of all 12: ")
    assert "mug_0 2" in lines[-1]


def test_without_meshes_the_mask_is_held_against_the_box(sane):
    class Bare(Own):
        shift = 0.0

        def load(self, ref):
            sample = super().load(ref)
            pose = sample.truth.pose
            pose = dataclasses.replace(
                pose, translation=pose.translation + np.eye(3)[0] * self.shift
            )
            truth = dataclasses.replace(sample.truth, surface=None, pose=pose)
            return dataclasses.replace(sample, truth=truth)

    measured = survey(Bare(sane))
    assert failing(measured) == {}
    for name in ("mesh-closed", "mesh-metric", "mesh-centred", "extents", "depth"):
        assert CHECKS[name](measured) is None
    Bare.shift = 0.12
    found = failing(survey(Bare(sane)))
    assert list(found) == ["masks"]
    assert "of it in the projected box" in str(found["masks"][0])


def test_upright_objects_are_constrained(tmp_path):
    generate(TABLETOP, tmp_path / "tree", [1])
    measured = survey(Own(tmp_path / "tree", TABLETOP.camera))
    assert len(measured.samples) >= 20
    assert list(failing(measured)) == ["orientations"]
    (problem,) = CHECKS["orientations"](measured)
    for limit, word in ((problem.value, "KNOWN"), (problem.value + 1e-6, "FAILED")):
        known = KnownFailure(check="orientations", reason="made so", worst=limit)
        assert judge(measured, "orientations", [known]).word is DatasetWord[word]


def test_data_set_that_cannot_be_listed():
    measured = Survey(
        "x", [SampleRef(id="a", category="mug", scene="s")], damaged=["a_meta.txt: line 'x'"]
    )
    assert [str(p) for p in CHECKS["readable"](measured)] == ["a_meta.txt: line 'x'"]


# -- how free orientations are ------------------------------------------------------------------


def test_spread_of_known_distributions():
    rng = np.random.default_rng(0)
    uniform = rng.normal(size=(5000, 3))
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
    assert up_axis_spread(uniform).coverage == pytest.approx(1, abs=0.001)
    assert up_axis_spread(uniform).resultant < 0.05
    few = [up_axis_spread(uniform[i : i + 75]).coverage for i in range(0, 3000, 75)]
    assert np.mean(few) == pytest.approx(1, abs=0.02)  # the expectation for 75 directions
    # one direction many times: a cap of 15 degrees
    same = np.tile([[0.6, 0.0, 0.8]], (1000, 1))
    cap = (1 - np.cos(np.radians(15))) / 2
    assert up_axis_spread(same).coverage == pytest.approx(cap, abs=0.001)
    assert up_axis_spread(same).resultant == pytest.approx(1)
    # up and down alike: they cancel, and are as constrained as one direction times two
    both = np.concatenate([same, -same])
    assert up_axis_spread(both).coverage == pytest.approx(2 * cap, abs=0.002)
    assert up_axis_spread(both).resultant == pytest.approx(0, abs=1e-12)


# -- known faults -------------------------------------------------------------------------------


def test_known_faults_are_strict(tree):
    frame_twice(tree)
    measured = survey(Own(tree))
    entry = {"check": "duplicates", "reason": "the recorder stalled"}
    assert judge(measured, "duplicates").word is DatasetWord.FAILED
    for patterns in ({}, {"sample": "scene_1/*"}, {"category": "bottle", "model": "bottle_?"}):
        verdict = judge(measured, "duplicates", [KnownFailure(**entry, **patterns)])
        assert verdict.word is DatasetWord.KNOWN
        assert verdict.details.endswith("Known: the recorder stalled")
    for patterns in ({"sample": "scene_2/*"}, {"category": "mug"}):
        verdict = judge(measured, "duplicates", [KnownFailure(**entry, **patterns)])
        assert verdict.word is DatasetWord.FAILED
        assert "scene_1/0001/1 (bottle, bottle_0): its colour image" in verdict.details
        assert "known fault does not happen any more" in verdict.details
    # the entry of another check says nothing, and a part of the samples does not disprove one
    assert judge(measured, "depth", [KnownFailure(**entry)]).word is DatasetWord.PASSED
    depth = KnownFailure(check="depth", reason="the lens is shiny", category="camera")
    assert judge(measured, "depth", [depth]).word is DatasetWord.FAILED
    part = survey(Own(tree), measured.refs[:3])
    assert judge(part, "depth", [depth]).word is DatasetWord.PASSED


@pytest.mark.parametrize("plant", PLANTED, ids=lambda plant: plant.__name__)
def test_a_known_fault_is_as_large_as_it_was_seen(tree, plant):
    """Of a check that measures something, one that is worse is a fault of its own."""
    check, _ = plant(tree)
    measured = survey(Own(tree))
    problems = CHECKS[check](measured)
    assert {problem.value is not None for problem in problems} == {check in MEASURING}
    if check not in MEASURING:
        return
    step = -1e-6 if check in LESS_IS_WORSE else 1e-6
    worst = (min if check in LESS_IS_WORSE else max)(problem.value for problem in problems)
    for limit, word in ((worst, "KNOWN"), (worst + step, "KNOWN"), (worst - step, "FAILED")):
        known = KnownFailure(check=check, reason="seen", worst=limit)
        assert judge(measured, check, [known]).word is DatasetWord[word]


def test_shipped_known_faults_are_read_and_narrow():
    """A fault of depth, masks or poses was seen somewhere, with some size."""
    folder = Path(pytest_cpas.datasets.__file__).parent
    read = {path.name: read_known(path, "dataset", CHECKS) for path in folder.glob("*.known.toml")}
    assert {"real275", "camera25", "real_train"} <= {name.partition(".")[0] for name in read}
    for fault in itertools.chain(*read.values()):
        if fault.check in ("depth", "masks", "extents", "mesh-centred"):
            assert fault.worst is not None
            assert fault.sample != "*"


# -- the real frame -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real(test_data) -> Survey:
    return survey(Real275(test_data))


def test_real_frame_agrees_with_its_meshes(real):
    """All but the can; IoU printed with -s."""
    images = {facts.category: facts.image for facts in real.samples.values()}
    for category, image in images.items():
        print(category, image.residual, image.iou)
    for category in ("bowl", "camera", "mug"):
        assert images[category].residual < 0.01
        assert images[category].iou > 0.95
    assert images["laptop"].residual is None  # its mesh is not there
    (problem,) = CHECKS["depth"](real)
    assert problem.model == "can_arizona_tea_norm"
    assert "16.3 mm (median difference -14.4 mm)" in problem.message
    assert CHECKS["masks"](real) == []


def test_residuals_are_those_of_the_published_nocs_map(real, test_data):
    """The published map of object coordinates, posed, without any rendering of ours."""
    data = Real275(test_data)
    with Image.open(data.root / "real_test/scene_1/0000_coord.png") as image:
        coordinates = np.asarray(image)[:, :, :3] / 255
    coordinates[:, :, 2] = 1 - coordinates[:, :, 2]
    for facts in real.samples.values():
        if facts.image.offset is None:
            continue
        sample = data.load(next(ref for ref in real.refs if ref.id == facts.sample))
        seen, truth = sample.observation, sample.truth
        pixels = seen.mask & (seen.depth > 0)
        nocs = (coordinates[pixels] - 0.5) * np.linalg.norm(truth.extents)
        # ShapeNet x is NOCS z, ShapeNet z is NOCS -x
        points = truth.pose.apply(np.stack([nocs[:, 2], nocs[:, 1], -nocs[:, 0]], axis=-1))
        offset = np.median(seen.depth[pixels] - points[:, 2])
        assert facts.image.offset == pytest.approx(offset, abs=0.001)


def test_original_real275_meshes_have_no_bottoms(real):
    problems = {problem.model: problem.message for problem in CHECKS["mesh-closed"](real)}
    assert len(problems) == 4
    for message in problems.values():
        assert message.startswith("it has no closed bottom: ")
