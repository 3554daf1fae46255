"""Known faults of a data set, in runs: what is left out, what has no shape, and what is said."""

import inspect
from pathlib import Path

import pytest
from tiny import Tiny

from pytest_cpas.checks.dataset import CHECKS
from pytest_cpas.checks.known import known_failures
from pytest_cpas.session.known_faults import without_faults
from pytest_cpas.types import DataError, Dataset

FAULTS = """
[[dataset]]
check = "readable"
sample = "scene_1/*"
run = "left out"
reason = "The disk was full."

[[dataset]]
check = "mesh-closed"
category = "mug"
run = "without shape"
reason = "Scanned upright."

[[dataset]]
check = "orientations"
reason = "Of no concern to a run."
"""


@pytest.fixture
def faults(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(FAULTS)
    return path


def test_what_a_fault_says_becomes_of_its_samples(faults):
    plain = Tiny(None)
    data = without_faults(plain, [faults])
    assert [ref.id for ref in data.samples] == [
        ref.id for ref in plain.samples if ref.scene != "scene_1"
    ]
    for ref in data.samples:
        for truth in (data.load(ref).truth, data.truth(ref)):
            assert (truth.surface is None) == (ref.category == "mug")
    assert list(data.missing) == [
        "known fault (mesh-closed category mug): 4 samples judged without shape. Scanned upright.",
        "known fault (readable sample scene_1/*): 4 samples left out. The disk was full.",
    ]


def test_it_is_another_data_set_only_if_something_is_another(faults):
    plain = Tiny(None)
    digests = {plain.digest, without_faults(plain, [faults]).digest}
    for was, now in (("scene_1/*", "scene_2/*"), ('"left out"', '"without shape"')):
        faults.write_text(FAULTS.replace(was, now))
        digests.add(without_faults(plain, [faults]).digest)
    assert len(digests) == 4
    for nothing in (
        FAULTS.replace("run =", "# run ="),
        FAULTS.replace("scene_1", "x").replace("mug", "x"),
    ):
        faults.write_text(nothing)
        assert without_faults(plain, [faults]) is plain


class Torn(Tiny):
    """Of scene_1 no truth can be read."""

    def truth(self, ref):
        if ref.scene == "scene_1":
            raise DataError("torn apart")
        return super().truth(ref)


@pytest.mark.parametrize(
    ("kind", "message", "left_out"),
    [(Torn, "*torn*", True), (Torn, "*lost*", False), (Tiny, "*torn*", False), (Tiny, "*", True)],
)
def test_what_is_mended_is_not_left_out_for_what_it_was(faults, kind, message, left_out):
    entry = f'check = "readable"\nmessage = "{message}"'
    faults.write_text(FAULTS.replace('check = "readable"', entry))
    scenes = {ref.scene for ref in without_faults(kind(None), [faults]).samples}
    assert ("scene_1" not in scenes) == left_out


@pytest.mark.parametrize("name", ["camera25", "real_train"])
def test_of_the_shipped_faults_of_meshes_none_covers_one_that_is_inside_out(name):
    folder = Path(inspect.getfile(Dataset)).parents[1] / "datasets"
    known = known_failures(folder, name, "dataset", CHECKS)
    (fault,) = (fault for fault in known if fault.check == "mesh-closed")
    assert fault.says(
        "it has no closed bottom: 28% of what is seen is its inside; 63 edges are open"
    )
    assert not fault.says("its triangles are wound inside out (the volume is negative)")
    for bottle in (fault for fault in known if fault.check == "readable"):
        assert bottle.says(
            "model.obj: not a readable mesh: line 1 begins with 'newmtl', which is no"
        )
        assert not bottle.says("0000_depth.png: not a readable image")


@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
def test_a_run_leaves_out_what_is_known(recorded, faults, how):
    result = recorded("Perfect", f"--cpas-known-faults={faults}", "--cpas-require-golden", *how)
    assert result.ret == 1
    result.stdout.fnmatch_lines(["missing: known fault (readable sample scene_1/[*]): 4 samples*"])
    result.stdout.fnmatch_lines(["8 of 8 samples judged"])
    assert "MATCHES" not in result.stdout.str()
    assert "STALE" in result.stdout.str(), "the table is of other samples"


def test_faults_that_cannot_be_read_end_the_run(recorded, faults):
    faults.write_text(FAULTS.replace("left out", "leave"))
    result = recorded("Perfect", f"--cpas-known-faults={faults}")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(
        ["*entry 1: run is 'leave', expected 'left out' or 'without shape'*"]
    )


def test_no_sample_that_can_be_read_is_no_error_of_the_contract(cpas, pytester):
    pytester.makepyfile(
        bad="""
        import tiny
        class Bad(tiny.Tiny):
            name = "bad"
            def load(self, ref):
                raise tiny.ContractError("torn")
        """
    )
    result = cpas("Perfect", "--cpas-dataset=bad:Bad", dataset="Tiny")
    assert result.ret == 1
    assert "Error:" not in result.stdout.str().replace("ContractError:", "")
    result.stdout.fnmatch_lines(["*sample scene_0/0000 (bowl): the data is bad: torn*"])


def test_where_nothing_can_be_listed_there_is_no_item_of_nothing(cpas, pytester):
    pytester.makepyfile(
        empty="""
        import tiny
        class Empty(tiny.Tiny):
            name = "empty"
            def __init__(self, data_dir):
                super().__init__(data_dir)
                self.samples, self.damaged = [], ["scene_0: which pose is whose cannot be told"]
        """
    )
    result = cpas("Perfect", "--cpas-dataset=empty:Empty", "-rA")
    assert result.ret == 1
    assert "NOTSET" not in result.stdout.str()
    assert "empty parameter set" not in result.stdout.str()
    result.stdout.fnmatch_lines(["*scene_0: which pose is whose cannot be told*"])
