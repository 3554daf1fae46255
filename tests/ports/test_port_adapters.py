import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import cases
import numpy as np
import pytest
import torch

import method_adapters
from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.evaluation import check_answers, measure
from pytest_cpas.timing.contestant import Contestant
from pytest_cpas.types import CATEGORIES, Observation
from pytest_cpas.types.frames import to_standard


@pytest.fixture(scope="module", params=cases.METHODS)
def method(request):
    return cases.loaded(request.param)


def same(a, b):
    assert a.reason == b.reason
    for x, y in zip(a.hypotheses, b.hypotheses, strict=True):
        for part in ("rotation", "translation", "extents", "points"):
            np.testing.assert_array_equal(getattr(x, part), getattr(y, part))


@pytest.mark.parametrize("name", cases.METHODS)
def test_recorded_inputs(name):
    cases.check_inputs(name)


def test_recorded_raw_outputs(method):
    cases.check_raw_outputs(method)


def test_loaded_from_files(tmp_path):
    """As published: with DataParallel's prefix and what only training uses."""
    folder = cases.write_assets(tmp_path / "weights", ["sgpa"])
    path = folder / "sgpa" / "real.pth"
    weights = {f"module.{key}": value for key, value in torch.load(path).items()}
    torch.save({**weights, "module.category_local.cls_layer.2.conv.bias": torch.ones(1)}, path)
    method = cases.METHODS["sgpa"]()
    method.load(folder, "cpu")
    shutil.rmtree(folder)
    cases.check_raw_outputs(method)


def test_answer_keeps_the_contract_and_repeats_with_its_seed(method):
    seen = cases.observations()[0]
    predictions = method.predict([seen], 3)
    check_answers(predictions, method.info)
    if method.info.name in cases.MEASURED:
        assert predictions[0].hypotheses
    for hypothesis in predictions[0].hypotheses:
        standard = to_standard(hypothesis, method.info)
        if method.info.name not in cases.MEASURED:
            np.testing.assert_allclose(standard.extents, 2 * np.abs(standard.points).max(axis=0))
    # in a batch with bad observations, which get their reasons
    few = cases.observation("mug", (300, 200), 3)
    strange = cases.observation("teapot", (300, 200), 45)
    flat = Observation(
        category="can", rgb=seen.rgb, depth=0 * seen.depth, mask=seen.mask, camera=seen.camera
    )
    answers = method.predict([few, strange, seen, flat], 3)
    same(answers[2], predictions[0])
    assert "pixels of the mask have a depth, expected at least 32" in answers[0].reason
    assert f"category 'teapot': {method.info.name} knows bottle," in answers[1].reason
    assert answers[3].reason.startswith("0 pixels of the mask")
    assert method.predict([few], 3)[0].reason == answers[0].reason
    assert method.predict([], 3) == []


def test_stages_are_named(method):
    told = Contestant(method, cases.observations()[:1], 3, "cpu").examine()
    assert list(told["stages"]) == ["pre-processing", "network", "post-processing"]
    assert sum(told["stages"].values()) > 0.5 * told["total"]


def test_seed_decides_which_points_are_used(method):
    seen = cases.observations()[0]
    chosen = [method.prepare(seen, np.random.default_rng(seed)).points for seed in (3, 3, 4)]
    assert np.array_equal(chosen[0], chosen[1])
    assert not np.array_equal(chosen[0], chosen[2])


def test_declaration(method):
    assert method.info.categories == CATEGORIES
    assert method.info.object_frame == "nocs"
    for asset in method.info.assets:
        assert asset.url.startswith("https://")
        assert asset.licence


def test_real_frame(method, test_data):
    data = Real275(test_data / "real275")
    rows = []
    for ref in data.samples:
        sample = data.load(ref)
        prediction = check_answers(method.predict([sample.observation], 0), method.info)
        rows += measure(["fscore_1cm"], [sample.truth], [prediction], method.info)
    assert len(rows) == 5
    assert all(row.failure is None or "no pose fits" in row.failure for row in rows)
    assert any(row.failure is None and row.facts["fscore_1cm"] is not None for row in rows)


def test_torch_is_imported_only_to_load():
    code = (
        "import sys, pytest_cpas.plugin;"
        "from method_adapters import asmnet, cass, crnet, dpdn, rbppose, sdfest, sgpa, spd;"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


@pytest.mark.parametrize(
    "path", sorted(Path(method_adapters.__file__).parent.glob("*.toml")), ids=lambda path: path.name
)
def test_every_known_quirk_has_its_reason_and_its_test(path):
    quirks = tomllib.loads(path.read_text())["quirk"]
    assert len({quirk["name"] for quirk in quirks}) == len(quirks) >= 7
    for quirk in quirks:
        assert quirk.keys() - {"categories"} == {"name", "kind", "reason", "shown_by"}
        assert quirk["kind"] in ("published", "port")
        assert set(quirk.get("categories", ())) <= set(CATEGORIES)
        module, test = quirk["shown_by"].split("::")
        assert f"def {test}(" in Path(__file__).with_name(module).read_text()
