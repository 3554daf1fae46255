"""The pickled DetectMatch of Omni6DPose's evaluation, whose classes are not there."""

import pickle
import sys
from dataclasses import make_dataclass
from types import ModuleType

import forms
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.evaluation import StoredRun
from pytest_cpas.submissions import cutoop, read_submission
from pytest_cpas.types import DataError

FIELDS = {
    "eval_utils.DetectMatch": (
        *("gt_affine", "gt_size", "gt_sym_labels", "gt_class_labels", "pred_affine", "pred_size"),
        *("image_path", "camera_intrinsics", "detect_scores", "gt_n_objects"),
    ),
    "rotation.SymLabel": ("any", "x", "y", "z"),
    "data_types.CameraIntrinsicsBase": ("fx", "fy", "cx", "cy", "width", "height"),
    "rotation.Unknown": ("x",),
}


@pytest.fixture
def classes(monkeypatch):
    """Kinds of objects under cutoop's names, which only the writer has."""
    made = {}
    for name, fields in FIELDS.items():
        module, kind = name.split(".")
        made[kind] = make_dataclass(kind, fields, namespace={"__module__": f"cutoop.{module}"})
        for parent in ("cutoop", f"cutoop.{module}"):
            monkeypatch.setitem(sys.modules, parent, sys.modules.get(parent) or ModuleType(parent))
        monkeypatch.setattr(sys.modules[f"cutoop.{module}"], kind, made[kind], raising=False)
    return made


@pytest.mark.parametrize("kind", ["objects", "dicts"])
def test_round_trip(kind, classes, tmp_path):
    path = forms.cutoop(
        tmp_path / "detect_match.pkl",
        forms.frames(),
        classes=classes if kind == "objects" else None,
    )
    for name in list(sys.modules):
        if name.startswith("cutoop"):
            del sys.modules[name]
    run, other = StoredRun(path), StoredRun(forms.nocs(tmp_path / "nocs", forms.frames()))
    assert not [name for name in sys.modules if name.startswith("cutoop")], "nothing is imported"
    assert run.notes[0].startswith("100 objects were annotated, and the file has 12: ")
    assert [ref.id for ref in run.samples] == [ref.id for ref in other.samples]
    assert {ref.category for ref in run.samples} == {"class_2", "class_6"}
    for ref, theirs in zip(run.samples, other.samples, strict=True):
        assert run.judge(ref).facts == pytest.approx(other.judge(theirs).facts, abs=1e-9), ref


def test_labels_of_a_data_set_count_from_1(tmp_path):
    truths = forms.frames()
    forms.nocs(tmp_path / "data/gts/real_test", truths, "results_real_test_{}.pkl")
    dataset = Real275(tmp_path / "data")
    path = forms.cutoop(tmp_path / "x.pkl", truths)
    run = StoredRun(path, dataset=dataset)
    other = StoredRun(forms.nocs(tmp_path / "nocs", truths), dataset=dataset)
    for ref in run.samples:
        assert run.judge(ref).facts == pytest.approx(other.judge(ref).facts, abs=1e-9)
    dataset.class_names = dataset.class_names[:3]
    with pytest.raises(
        DataError, match=r"labels run from 2 to 6, and real275 has .* 1 to 3 \(bott"
    ):
        read_submission(path, dataset)


@pytest.mark.parametrize(
    ("axes", "order", "axis"),
    [
        (("none", "none", "none"), 1, None),
        (("none", "half", "none"), 2, None),
        (("half", "half", "none"), 4, None),
        (("half", "half", "half"), 4, None),
        (("none", "quarter", "none"), 4, None),
        (("half", "quarter", "half"), 8, None),
        (("quarter", "quarter", "none"), 24, None),
        (("none", "any", "none"), 1, 1),
        (("half", "any", "half"), 4, 1),
    ],
)
def test_symmetries(axes, order, axis):
    made = cutoop._symmetry(False, axes)
    assert len(made.rotations) == order
    assert np.array_equal(made.axis, None if axis is None else np.eye(3)[axis])
    for place, tag in enumerate(axes):
        angle = {"none": None, "any": 33, "half": 180, "quarter": 90}[tag]
        if angle is not None and place != axis:
            turn = Rotation.from_rotvec(np.radians(angle) * np.eye(3)[place]).as_matrix()
            assert np.abs(made.rotations - turn).max(axis=(1, 2)).min() < 1e-9


@pytest.mark.parametrize(
    ("free", "axes"),
    [(True, ("none",) * 3), (False, ("any", "any", "none")), (False, ("any", "quarter", "none"))],
)
def test_spheres(free, axes):
    assert cutoop._symmetry(free, axes).sphere


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gt_class_labels": None}, "gt_class_labels is missing or not an array of integers"),
        (
            {"pred_affine": np.zeros((12, 3, 4))},
            r"pred_affine has shape \(12, 3, 4\), expected \(12",
        ),
        ({"pred_size": [[1.0], [1.0, 2.0]]}, "pred_size is missing or not an array of numbers"),
        ({"detect_scores": np.full(12, np.nan)}, "detect_scores holds NaN"),
        ({"image_path": ["a"]}, "image_path is no list of 12 texts"),
        ({"image_path": [0] * 12}, "image_path: row 0 is 0, expected the image's path"),
        ({"gt_sym_labels": ["any"] * 12}, "gt_sym_labels: row 0 is 'any', expected any, and x, y"),
        (
            {"gt_class_labels": np.full(12, -1)},
            "gt_class_labels run from -1 to -1, expected 0 to a million",
        ),
    ],
)
def test_damaged_fields(change, words, tmp_path):
    path = forms.cutoop(tmp_path / "x.pkl", forms.frames())
    forms.dump(path, pickle.loads(path.read_bytes()) | change)
    with pytest.raises(DataError, match=rf"x\.pkl: {words}"):
        read_submission(path)


def test_rows_without_images_are_images_of_their_own(tmp_path):
    path = forms.cutoop(tmp_path / "x.pkl", forms.frames())
    forms.dump(path, pickle.loads(path.read_bytes()) | {"image_path": None})
    assert [image.name for image in read_submission(path).images][-1] == "000011"


@pytest.mark.parametrize("kind", ["other class", "state of a dict", "state twice", "arguments"])
def test_other_objects_are_refused(kind, classes, tmp_path):
    path = tmp_path / "x.pkl"
    label = b"\x80\x02ccutoop.rotation\nSymLabel\n"
    content = {
        "other class": pickle.dumps(classes["Unknown"](1)),
        "state of a dict": b"\x80\x02}}b.",
        "state twice": label + b")\x81}b}b.",
        "arguments": label + b"K\x01\x85\x81.",
    }[kind]
    path.write_bytes(content)
    words = "names cutoop.rotation.Unknown|sets the state of a dict|makes an object of a class"
    with pytest.raises(DataError, match=words):
        read_submission(path)
    path.write_bytes(label + b")\x81K\x01b.")
    with pytest.raises(DataError, match="an object is given a state that is no dict"):
        read_submission(path)
