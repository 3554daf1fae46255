import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.types import ContractError


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
    if b"_codecs" in path.read_bytes() or protocol < 2:
        # protocols below 3 name _codecs.encode for bytes, which is no global of numpy's
        with pytest.raises(ContractError, match=r"names (_codecs|copyreg)\."):
            load_numpy_pickle(path)
        return
    loaded = load_numpy_pickle(path)
    assert loaded.keys() == content.keys()
    np.testing.assert_array_equal(loaded["gt_RTs"], content["gt_RTs"])
    assert loaded["gt_class_ids"].dtype == np.int32
    assert loaded["scores"] == content["scores"]
    assert (loaded["image_id"], loaded["nested"]) == (7, content["nested"])


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
    with pytest.raises(ContractError, match=r"x\.pkl: the pickle names \S+, and only plain values"):
        load_numpy_pickle(path)
    assert not target.exists()
    if where != "under numpy's name":
        pickle.loads(path.read_bytes())
        assert target.exists(), "the bomb of this test is a dud"


def test_persistent_ids_and_extensions_are_refused(tmp_path):
    path = tmp_path / "x.pkl"
    for content in (b"Pabc\n.", b"\x82\x01.", b"cnumpy\ncore.multiarray._reconstruct\n."):
        path.write_bytes(content)
        with pytest.raises(ContractError, match=r"x\.pkl"):
            load_numpy_pickle(path)


def test_every_truncation_is_an_error(tmp_path):
    whole = pickle.dumps({"gt_RTs": np.eye(4)[None]}, protocol=3)
    path = tmp_path / "x.pkl"
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(ContractError, match=r"x\.pkl"):
            load_numpy_pickle(path)


def test_anything_but_a_dict_is_refused(tmp_path):
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps([1, 2], protocol=4))
    with pytest.raises(ContractError, match="holds a list, expected a dict"):
        load_numpy_pickle(path)


def test_real_pickles_are_read(test_data):
    files = [
        test_data / "real275/gts/real_test/results_real_test_scene_1_0000.pkl",
        test_data / "predictions/dualposenet_real275/results_test_scene_1_0000.pkl",
    ]
    for path in files:
        assert load_numpy_pickle(path)["gt_RTs"].shape == (5, 4, 4)
