"""``--cpas-check-dataset`` from the command line."""

import dataclasses
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from harness import RUN
from PIL import Image

import pytest_cpas.session.dataset_session  # noqa: F401 - runs in this process share our modules
from pytest_cpas._open3d import import_open3d
from pytest_cpas.checks.dataset import facts
from pytest_cpas.datasets.synthetic import HANDHELD, generate

import_open3d()  # it cannot be loaded twice, and a run in this process forgets what it loaded

MODULE = """
from pathlib import Path
from pytest_cpas.datasets.nocs import NocsTree
from pytest_cpas.types import Camera

class Held(NocsTree):
    def __init__(self, data_dir):
        super().__init__("held", Path({root!r}), Camera(640, 480, 525.0, 525.0, 319.5, 239.5))
"""


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """Three frames of a bottle, the second of which has its depth off."""
    root = tmp_path_factory.mktemp("held") / "tree"
    generate(dataclasses.replace(HANDHELD, frames=3), root, [1])
    path = root / "real_test/scene_1/0001_depth.png"
    with Image.open(path) as image:
        depth = np.array(image)
    Image.fromarray(np.where(depth > 0, depth + 40, 0).astype(depth.dtype)).save(path)
    return root


@pytest.fixture
def check(pytester, monkeypatch, tree):
    """Check that tree with further arguments."""
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    pytester.makepyfile(held=MODULE.format(root=str(tree)))

    def run(*args: str) -> pytest.RunResult:
        start = pytester.runpytest_subprocess if "-n2" in args else pytester.runpytest_inprocess
        return start(*RUN, "--cpas-check-dataset=held:Held", *args)

    return run


def known(pytester, **entry: str) -> None:
    text = "\n".join(f"{key} = '{value}'" for key, value in entry.items())
    (pytester.path / "held.known.toml").write_text(f"[[dataset]]\n{text}")


@pytest.mark.parametrize("how", [(), ("-n2",), ("--cpas-granularity=scene",)], ids=" ".join)
def test_fault_is_named(check, pytester, how):
    result = check("--junitxml=out.xml", "--cpas-pictures=pictures", *how)
    assert result.ret == 1
    items = 1 if how == ("--cpas-granularity=scene",) else 3
    result.assert_outcomes(passed=items + 8, failed=1, skipped=4)
    result.stdout.fnmatch_lines(
        [
            "scene_1/0001/1 (bottle, bottle_0): the median |measured - rendered| depth is 4*",
            "depth         FAILED  scene_1/0001/1 (bottle, bottle_0): *",
            "masks         passed",
            "scene_1/0001/1    bottle * 4?.? mm  +4?.? mm  0.*",
            "category  samples  |depth| median*",
            "bottle          3 * mm* mm* mm *",
            "held: 3 of 3 samples examined, with 1 meshes; 13 checks: 8 passed, 1 FAILED, 4 n/a",
            "FAILED cpas-dataset::depth[[]held] - *",
        ]
    )
    failures = [
        case.get("name")
        for case in ET.parse(pytester.path / "out.xml").iter("testcase")
        if case.find("failure") is not None
    ]
    assert failures == ["depth[held]"]
    with Image.open(pytester.path / "pictures" / "up_axes.png") as picture:
        assert len(picture.getcolors(1 << 20)) > 10  # something is drawn


@pytest.mark.parametrize("how", [(), ("--runxfail",)], ids=" ".join)
def test_known_fault_is_visible_and_green(check, pytester, how):
    known(pytester, check="depth", sample="scene_1/0001/*", reason="the bench was kicked")
    result = check(*how)
    assert result.ret == 0
    result.assert_outcomes(passed=11, xfailed=1, skipped=4)
    result.stdout.fnmatch_lines(
        ["depth         known   scene_1/0001/1 *. Known: the bench was kicked"]
    )


def test_known_fault_that_is_gone_fails_a_complete_run(check, pytester):
    known(pytester, check="masks", reason="the bench was kicked")
    assert check("--cpas-limit=2", "-k", "0000").ret == 0
    result = check()
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        ["masks         FAILED  known fault does not happen any more, take it out: masks (the*"]
    )


def test_known_faults_of_ones_own(check, pytester):
    (pytester.path / "ours.toml").write_text("[[dataset]]\ncheck = 'depth'\nreason = 'seen it'")
    result = check("--cpas-known-faults=ours.toml")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["depth *known *Known: seen it"])


def test_mesh_is_measured_once(check, monkeypatch):
    measured = []
    original = facts.measure_mesh
    monkeypatch.setattr(
        facts, "measure_mesh", lambda *args: measured.append(args) or original(*args)
    )
    check()
    assert len(measured) == 1


def test_part_of_the_samples(check):
    result = check("--cpas-limit=1")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["held: 1 of 3 samples (1 selected) examined, *"])
    assert check("--collect-only", "-q").ret == 0


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--cpas-check-dataset=real276",), "Did you mean 'real275'?"),
        (("--cpas-check-dataset=real275", "--cpas-data=nowhere"), "nowhere"),
        (("--cpas-known-faults=nowhere.toml",), "nowhere.toml: known failures cannot be read"),
        (("--cpas-category=mug",), "held: no samples to check"),
        (("--cpas-shard=3/2",), "expected i/n with 1 <= i <= n"),
    ],
)
def test_usage_errors(check, args, words):
    result = check(*args)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    assert words in result.stderr.str()
    assert "Traceback" not in result.stderr.str()
