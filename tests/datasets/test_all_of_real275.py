"""The truth about all 2754 published frames of REAL275, and seven of them with an object hidden."""

import itertools
import pickle
from collections import Counter

import numpy as np
import pytest
from PIL import Image

from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.golden.published import count_problems, published_sample_counts
from pytest_cpas.types import CATEGORIES

#: Frames whose meta file lists an object of which the mask has no pixel.
SEVEN = [f"scene_1_{number:04d}" for number in range(198, 205)]
HIDDEN = 3

INTRINSICS = np.array([[591.0125, 0, 322.525], [0, 590.16775, 244.11084], [0, 0, 1]])


@pytest.fixture(scope="module")
def published(test_data):
    with np.load(test_data / "predictions/dualposenet_real275.npz") as file:
        return {key: file[key] for key in file.files}


@pytest.fixture(scope="module")
def tree(published, tmp_path_factory):
    """No images but those of the seven frames: the objects' 2-D boxes as masks, far ones first."""
    root = tmp_path_factory.mktemp("real275")
    (root / "gts/real_test").mkdir(parents=True)
    (root / "real_test/scene_1").mkdir(parents=True)
    (root / "obj_models/real_test").mkdir(parents=True)
    starts = published["gt_offset"]
    for index, frame in enumerate(published["frame"].tolist()):
        rows = slice(starts[index], starts[index + 1])
        truth = {
            key: published[f"gt_{key}"][rows] for key in ("class_ids", "RTs", "scales", "bboxes")
        }
        path = root / f"gts/real_test/results_real_test_{frame}.pkl"
        path.write_bytes(pickle.dumps({f"gt_{key}": value for key, value in truth.items()}))
        if frame in SEVEN:
            _write_frame(root, frame, truth)
    return root


def _write_frame(root, frame, truth):
    count = len(truth["class_ids"])
    ids = [number for number in range(1, count + 2) if number != HIDDEN]
    mask = np.full((480, 640), 255, np.uint8)
    for place in np.argsort(-truth["RTs"][:, 2, 3]):
        top, left, bottom, right = truth["bboxes"][place]
        mask[top:bottom, left:right] = ids[place]
    stem = root / "real_test" / frame.replace("scene_1_", "scene_1/")
    Image.fromarray(mask).save(f"{stem}_mask.png")
    Image.fromarray(np.zeros((480, 640, 3), np.uint8)).save(f"{stem}_color.png")
    Image.fromarray(np.full((480, 640), 900, np.uint16)).save(f"{stem}_depth.png")
    lines = [f"{HIDDEN} 1 hidden"]
    (root / "obj_models/real_test/hidden.txt").write_text("0.1 0.1 0.1")
    for place, (number, class_id) in enumerate(zip(ids, truth["class_ids"], strict=True)):
        lines.append(f"{number} {class_id} {frame}_{place}")
        scale = np.cbrt(np.linalg.det(truth["RTs"][place, :3, :3]))
        sides = " ".join(map(str, scale * truth["scales"][place]))
        (root / f"obj_models/real_test/{frame}_{place}.txt").write_text(sides)
    (stem.parent / f"{stem.name}_meta.txt").write_text("\n".join(lines))


def test_all_frames_have_the_published_objects(tree):
    data = Real275(tree)
    assert data.damaged == []
    listed = Counter(ref.category for ref in data.samples)
    assert sum(listed.values()) == 16118
    assert dict(listed) == published_sample_counts("real275")
    assert not count_problems("real275", listed, partial=False)


def test_a_hidden_object_takes_nobodys_pose(tree, published):
    data, starts = Real275(tree), published["gt_offset"]
    seen = 0
    for frame in SEVEN:
        (index,) = np.flatnonzero(published["frame"] == frame)
        rows = slice(starts[index], starts[index + 1])
        name = frame.replace("scene_1_", "scene_1/")
        refs = [ref for ref in data.samples if ref.id.startswith(f"{name}/")]
        assert [CATEGORIES.index(ref.category) + 1 for ref in refs] == published["gt_class_ids"][
            rows
        ].tolist()
        assert HIDDEN not in [int(ref.id.rpartition("/")[2]) for ref in refs]
        for ref, pose in zip(refs, published["gt_RTs"][rows], strict=True):
            sample = data.load(ref)  # which refuses a frame with a pose that cannot be its object's
            assert np.array_equal(sample.truth.pose.translation, pose[:3, 3])
            seen += 1
    assert seen > 20


def test_every_published_pose_holds_the_pixels_of_its_object_and_few_others_do(published):
    """With half the margin all of the 2-D box of the mask, so that no published frame is refused;
    and nowhere do two objects hold each other's."""
    rows = slice(None, None, 7)
    boxes, poses = published["gt_bboxes"], published["gt_RTs"]
    scales = np.cbrt(np.linalg.det(poses[:, :3, :3]))
    extents = scales[:, None] * published["gt_scales"]
    of_frame = np.repeat(np.arange(2754), np.diff(published["gt_offset"]))
    models = {round(scale, 4) for scale in scales.tolist()}
    assert len(models) == 18  # each model has one scale, in all frames
    wrong = 0
    for index in np.arange(len(poses))[rows]:
        assert share(poses[index], extents[index], boxes[index], margin=0.1) == 1
        for other in np.flatnonzero(of_frame == of_frame[index]):
            there = share(poses[other], extents[index], boxes[index], margin=0.2)
            back = share(poses[index], extents[other], boxes[other], margin=0.2)
            wrong += other != index and min(there, back) >= 0.9
    assert wrong == 0


def share(pose, extents, box, margin):
    """Of the area of a 2-D box the share that is in that of a posed box, by other means."""
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    scale = np.cbrt(np.linalg.det(pose[:3, :3]))
    u, v, depth = INTRINSICS @ (pose[:3, :3] / scale @ (signs * extents).T + pose[:3, 3:])
    u, v = u / depth, v / depth
    top, left, bottom, right = box
    return overlap(u, left, right, margin) * overlap(v, top, bottom, margin)


def overlap(places, low, high, margin):
    more = margin * np.ptp(places)
    common = min(places.max() + more, high) - max(places.min() - more, low)
    return max(common, 0) / (high - low)
