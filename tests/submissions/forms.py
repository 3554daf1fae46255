"""The same answers in every form that is read, as the code writes it that the forms are from."""

import pickle
from collections import Counter, OrderedDict

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

NAMES = ("scene_1/0000", "scene_1/0001", "scene_1/0002", "scene_1/0010", "scene_2/0100")


def frames(names=NAMES, most_classes=6):
    """Per image the dict of NOCS's form: two or three objects, found a little aside."""
    made = {}
    for number, name in enumerate(names):
        dice = np.random.default_rng(number)
        count = 2 + number % 2
        ids = np.array([2, 6, 6][:count]) if most_classes == 6 else np.array([9, 10, 4][:count])
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, :3, :3] = Rotation.random(count, random_state=number).as_matrix()
        poses[:, :3, 3] = dice.uniform((-0.3, -0.3, 0.7), (0.3, 0.3, 1.3), (count, 3))
        off = np.tile(np.eye(4), (count, 1, 1))
        off[:, :3, :3] = Rotation.from_rotvec(dice.normal(size=(count, 3)) / 20).as_matrix()
        off[:, :3, 3] = dice.normal(size=(count, 3)) / 100
        sizes = dice.uniform(0.05, 0.2, (count, 3))
        boxes = np.array([[0, 0, 10, 10], [0, 20, 10, 30], [50, 50, 90, 90]])[:count]
        made[name] = {
            **side("gt", ids, boxes, poses, sizes),
            **side("pred", ids, boxes, poses @ off, sizes * dice.uniform(0.9, 1.1, (count, 3))),
            "pred_scores": dice.uniform(size=count),
        }
    return made


def side(name, ids, boxes, poses, sizes):
    """Objects of an image in NOCS's keys, from poses without a scale and sizes in metres."""
    scale = np.linalg.norm(sizes, axis=1)
    scaled = poses.copy()
    scaled[:, :3, :3] *= scale[:, None, None]
    return {
        f"{name}_class_ids": ids,
        f"{name}_bboxes": boxes,
        f"{name}_RTs": scaled,
        f"{name}_scales": sizes / scale[:, None],
    }


def metric(values, name):
    """Poses (n, 4, 4) without a scale, and sizes (n, 3) in metres."""
    poses = values[f"{name}_RTs"].copy()
    scale = np.cbrt(np.linalg.det(poses[:, :3, :3]))
    poses[:, :3, :3] /= scale[:, None, None]
    return poses, values[f"{name}_scales"] * scale[:, None]


def dump(path, value, protocol=4):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(value, protocol))
    return path


def nocs(folder, made, form="results_test_{}.pkl"):
    """A pickle of each image."""
    for name, values in made.items():
        dump(folder / form.format(name.replace("/", "_")), values)
    return folder


def scenes(folder, made):
    """A folder of each scene, as AG-Pose writes HouseCat6D; it knows of no handles there."""
    for name, values in made.items():
        dump(folder / f"{name}.pkl", values | {"gt_handle_visibility": None})
    return folder


def listed(path, made, names=True):
    """One list of frames, as HS-Pose writes it: poses without a scale, sizes in metres."""
    rows = []
    for name, values in made.items():
        poses, sizes = metric(values, "pred")
        row = values | {"pred_RTs": poses, "pred_scales": sizes}
        if not len(poses):
            row["pred_scales"] = np.zeros((0, 4, 4))  # as it is written there
        rows.append(row | ({"image_path": f"data/real/test/{name}"} if names else {}))
    return dump(path, rows)


def bop(path, runs):
    """BOP's table of the poses that a run found, by object; millimetres from the model's origin."""
    lines = ["scene_id,im_id,obj_id,score,R,t,time"]
    for (scene, image, number), score, pose in runs:
        r = " ".join(map(str, pose[:3, :3].ravel().tolist()))
        t = " ".join(map(str, (1000 * pose[:3, 3]).tolist()))
        lines.append(f"{scene},{image},{number},{score},{r},{t},0.25")
    path.write_text("\n".join(lines))
    return path


def png(path, size):
    Image.fromarray(np.full(size, 9, np.uint8)).save(path)


PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""


def matrices(folder, poses):
    """A text of each pose, as FoundationPose writes it; ``poses`` by the name of the file."""
    for name, pose in poses.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(folder / name, pose)
    return folder


def cutoop(path, made, scores=True, classes=None):
    """A pickled DetectMatch, as GenPose++ writes it. ``classes``: kinds of its objects by name, or
    None where it holds dicts."""
    make = classes or dict.fromkeys(("DetectMatch", "SymLabel", "CameraIntrinsicsBase"), dict)
    rows = [
        (name, values, row)
        for name, values in made.items()
        for row in range(len(values["gt_class_ids"]))
    ]
    tags = {2: "any", 6: "none"}
    camera = make["CameraIntrinsicsBase"](fx=1.0, fy=1.0, cx=0.0, cy=0.0, width=2, height=2)
    symmetries = np.empty(len(rows), object)
    for place, (_, values, row) in enumerate(rows):
        about_y = tags[int(values["gt_class_ids"][row])]
        symmetries[place] = make["SymLabel"](any=False, x="none", y=about_y, z="none")
    sides = {}
    for side in ("gt", "pred"):
        pairs = [metric(values, side) for values in made.values()]
        sides[f"{side}_affine"] = np.concatenate([poses for poses, _ in pairs])
        sides[f"{side}_size"] = np.concatenate([sizes for _, sizes in pairs])
    match = make["DetectMatch"](
        **sides,
        gt_sym_labels=symmetries,
        gt_class_labels=np.concatenate([values["gt_class_ids"] for values in made.values()]),
        image_path=[f"data/ROPE/{name}_color.png" for name, _, _ in rows],
        camera_intrinsics=[camera] * len(rows),
        detect_scores=np.concatenate([v["pred_scores"] for v in made.values()]) if scores else None,
        gt_n_objects=Counter({2: 100}),
    )
    return dump(path, match)


def catre(path, made):
    """The dict of each step and image, as CATRE writes it; no truth, sizes in metres."""
    steps = OrderedDict()
    for step in range(3):
        steps[f"iter{step}"] = {}
        for name, values in made.items():
            found = {k: v for k, v in values.items() if k.startswith("pred")}
            found["pred_RTs"], found["pred_scales"] = metric(values, "pred")
            found["pred_RTs"][:, 0, 3] += 0.1 * (2 - step)  # the last is the best
            steps[f"iter{step}"][name] = found
    return dump(path, steps, protocol=2)


def pace(folder, made):
    """PACE's pair of files: no boxes of detections, and those of the truth are x, y, w, h."""
    found, truths = {}, {}
    for name, values in made.items():
        path = "test/{}/rgb/{}.png".format(*name.split("/"))
        found[path] = {k: v for k, v in values.items() if k[:4] == "pred" and k[-6:] != "bboxes"}
        truths[path] = {k: v for k, v in values.items() if k.startswith("gt")}
        truths[path]["gt_RTs"], truths[path]["gt_scales"] = metric(values, "gt")
        y1, x1, y2, x2 = truths[path]["gt_bboxes"].T
        truths[path]["gt_bboxes"] = np.stack([x1, y1, x2 - x1, y2 - y1], axis=1)
        truths[path] |= {"gt_segs": [[1.5, 2]], "image_path": path}
    truths["test/9/rgb/9.png"] = {f"gt_{k}": [] for k in ("class_ids", "RTs", "scales", "bboxes")}
    dump(folder / "catpose_gts_test.pkl", truths)
    return dump(folder / "mine_pred.pkl", found)
