import bz2
import gzip
import lzma
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from pickled import pickled, text

from pytest_cpas.reading.pickle_loop import unpickle
from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.types import DataError


class Runs:
    """A pickle that runs a command when plain pickle loads it."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self):
        return os.system, (f"touch {self.target}",)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_and_builtins_are_read(tmp_path, protocol):
    content = {
        "gt_RTs": np.arange(32.0).reshape(2, 4, 4),
        "gt_class_ids": np.array([1, 6], dtype=np.int32),
        "image_id": np.int64(7),
        "scores": np.array([0.5], dtype=">f4"),
        "path": "scene_1/0000",
        "nested": [1, 2.5, None, True, ("a", {"b": 1})],
    }
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    loaded = load_numpy_pickle(path)
    assert loaded.keys() == content.keys()
    np.testing.assert_array_equal(loaded["gt_RTs"], content["gt_RTs"])
    assert loaded["gt_class_ids"].dtype == np.int32
    assert loaded["scores"] == content["scores"]
    assert (loaded["image_id"], loaded["nested"]) == (7, content["nested"])


def test_an_array_that_is_there_twice_is_one_and_read_only(tmp_path):
    array = np.arange(3)
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps({"a": array, "b": array}))
    loaded = load_numpy_pickle(path)
    assert loaded["a"] is loaded["b"]
    assert not loaded["a"].flags.writeable


@pytest.mark.parametrize("where", ["alone", "nested", "in an object array", "under numpy's name"])
def test_code_is_never_run(tmp_path, where):
    target = tmp_path / "touched"
    bomb = Runs(target)
    content = {
        "alone": bomb,
        "nested": {"gt_RTs": [np.zeros(3), (bomb,)]},
        "in an object array": {"gt_RTs": np.array([bomb, None], dtype=object)},
        "under numpy's name": {"gt_RTs": np.testing.assert_allclose},
    }[where]
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps(content, protocol=4))
    message = r"x\.pkl: at byte \d+, the pickle names [\w.]+, and only plain values"
    with pytest.raises(DataError, match=message):
        load_numpy_pickle(path)
    assert not target.exists()
    if where != "under numpy's name":
        pickle.loads(path.read_bytes())
        assert target.exists(), "the bomb of this test is a dud"


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_every_truncation_is_an_error(protocol):
    whole = pickle.dumps({"gt_RTs": np.eye(4)[None], "a": {1: [2.5, "x"]}}, protocol=protocol)
    for length in range(len(whole)):
        with pytest.raises(DataError, match=r"^not a readable pickle: at byte \d+, .*damaged"):
            unpickle(whole[:length])


@pytest.mark.parametrize(("value", "kind"), [([1, 2], "list"), (np.zeros(2), "ndarray")])
def test_anything_but_a_dict_is_refused(tmp_path, value, kind):
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps(value, protocol=4))
    with pytest.raises(DataError, match=f"holds a {kind}, expected a dict"):
        load_numpy_pickle(path)


def test_what_follows_a_pickle_is_seen(tmp_path):
    path = tmp_path / "x.pkl"
    path.write_bytes(pickled(text("a")) * 2)
    with pytest.raises(DataError, match="at byte 22, it ends, and 23 bytes follow; expected one"):
        load_numpy_pickle(path)


@pytest.mark.parametrize(
    "value",
    [
        np.zeros(2, dtype=[("a", "f4")]),
        np.zeros(2, dtype="M8[s]"),
        np.zeros(2, dtype=np.longdouble),
        np.zeros(2, dtype="V3"),
        np.ma.array([1, 2]),
        np.zeros((2, 2)).view(np.matrix),
        np.dtype("f4"),
        10**40,
        "\ud800",
    ],
    ids=repr,
)
def test_other_values_are_refused_with_a_reason(tmp_path, value):
    path = tmp_path / "x.pkl"
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        path.write_bytes(pickle.dumps({"a": value}, protocol=protocol))
        with pytest.raises(DataError, match=r"x\.pkl: .*at byte \d+, "):
            load_numpy_pickle(path)


def test_real_pickles_are_read(test_data):
    files = [
        test_data / "real275/gts/real_test/results_real_test_scene_1_0000.pkl",
        test_data / "predictions/dualposenet_real275/results_test_scene_1_0000.pkl",
    ]
    for path in files:
        assert load_numpy_pickle(path)["gt_RTs"].shape == (5, 4, 4)
    # numpy 1.16.0 wrote it: its arrays name numpy.core._multiarray_umath._reconstruct
    found = load_numpy_pickle(test_data / "detections/results_test_scene_5_0001.pkl")
    assert found["masks"].shape == (480, 640, 4)
    assert found["masks"].dtype == bool
    assert found["class_ids"].tolist() == [4, 2, 3, 3]


def test_all_real_pickles_are_as_plain_pickle_reads_them(test_data):
    for path in sorted((test_data / "predictions/dualposenet_real275").glob("*.pkl")):
        plain, read = pickle.loads(path.read_bytes()), load_numpy_pickle(path)
        assert list(read) == list(plain)
        for key, value in plain.items():
            assert type(read[key]) is type(value)
            np.testing.assert_array_equal(read[key], value, strict=True)


@pytest.mark.parametrize(
    ("packed", "kind"),
    [
        (gzip.compress, "gzip"),
        (bz2.compress, "bzip2"),
        (lzma.compress, "xz"),
        (lambda content: b"PK\3\4" + content, "a zip archive, as torch.save"),
        (lambda content: b"\x28\xb5\x2f\xfd" + content, "zstandard"),
    ],
)
def test_what_is_packed_is_told_to_be_unpacked(tmp_path, packed, kind):
    path = tmp_path / "a.pkl"
    path.write_bytes(packed(pickle.dumps({"a": 1})))
    with pytest.raises(DataError, match=rf"a\.pkl: {kind}.*, and no pickle; unpack it"):
        load_numpy_pickle(path)
