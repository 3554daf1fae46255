"""Known faults of a data set, in runs: what is left out, what has no shape, and what is said."""

import pytest
from tiny import Tiny

from pytest_cpas.session.known_faults import without_faults

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
