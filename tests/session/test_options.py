"""What the command line asks for, as plain values; no run of pytest is needed."""

import argparse
from contextlib import nullcontext
from pathlib import Path

import pytest
from harness import DeclaredOptions

from pytest_cpas.evaluation import MethodRun, Selection
from pytest_cpas.session import options as options_module
from pytest_cpas.session.command_line import add_options
from pytest_cpas.session.options import DatasetOptions, MetricsOptions, RunOptions
from pytest_cpas.session.resolution import read_others, resolve_runs

HERE = Path("/where/pytest/started")


@pytest.fixture
def parse(monkeypatch):
    """What the plugin's options make of arguments."""
    monkeypatch.delenv("CPAS_DATA", raising=False)
    monkeypatch.delenv("CPAS_WEIGHTS", raising=False)
    declared = DeclaredOptions()
    add_options(declared)
    return lambda *arguments: declared.parser.parse_args(arguments)


def test_nothing_is_asked_for_by_default(parse):
    expected = RunOptions(golden=Path("golden"))
    assert RunOptions.of(parse(), HERE, golden=Path("golden")) == expected
    assert MetricsOptions.of(parse(), HERE) == MetricsOptions(metrics=())
    assert not MetricsOptions.of(parse("--cpas-no-shrink"), HERE).shrink
    assert DatasetOptions.of(parse(), HERE) == DatasetOptions(datasets=())


WRITTEN = (
    "--cpas-results=",
    "--cpas-report=",
    "--cpas-save-predictions=",
    "--cpas-golden=",
    "--cpas-pictures=",
    "--cpas-metrics-report=",
)


@pytest.mark.parametrize("where", ["file", "file/below/it", "sealed", "sealed/below/it"])
@pytest.mark.parametrize("option", WRITTEN)
def test_what_cannot_be_written_is_told_before_the_run(parse, tmp_path, monkeypatch, option, where):
    (tmp_path / "file").write_text("")
    (tmp_path / "sealed").mkdir()
    # of root nobody asks
    monkeypatch.setattr(options_module.os, "access", lambda path, _: Path(path).name != "sealed")
    inside = "/report.json" * ("metrics" in option) + "/answers.jsonl" * ("save" in option)
    for place in (where, "there"):
        read = parse(f"{option}{place}{inside}")
        read.update_snapshots = True
        told = "file is a file, expected" if "file" in where else "nobody lets this user write"
        golden = tmp_path / place if "golden" in option else tmp_path
        with (
            pytest.raises(ValueError, match=f"{option[:-1]}: .*{told}")
            if place == where
            else nullcontext()
        ):
            RunOptions.of(read, tmp_path, golden=golden).check_written()
            DatasetOptions.of(read, tmp_path).check_written()
            MetricsOptions.of(read, tmp_path)


def test_paths_are_those_of_the_folder_where_pytest_was_started(parse):
    options = parse("--cpas-results=out", "--cpas-data=/data", "--cpas-merge=a", "--cpas-merge=/b")
    read = RunOptions.of(options, HERE, golden=Path("golden"))
    assert (read.results, read.data, read.weights) == (HERE / "out", Path("/data"), None)
    assert read.merge == (HERE / "a", Path("/b"))


def test_selection_and_shard_are_read_together(parse):
    options = parse("--cpas-category=mug", "--cpas-limit=7", "--cpas-shard=2/3")
    read = RunOptions.of(options, HERE, golden=Path("golden"))
    assert read.selection == Selection(categories=("mug",), limit=7, shard=2, shards=3)
    assert str(read.shard) == "2/3"
    assert DatasetOptions.of(options, HERE).selection == read.selection


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("--cpas-limit=0", "--cpas-limit is 0, expected at least 1"),
        ("--cpas-jitter=-1", "--cpas-jitter is -1, expected at least 1"),
        ("--cpas-shard=3/2", "expected i/n with 1 <= i <= n"),
    ],
)
def test_values_that_cannot_be_meant(parse, argument, words):
    with pytest.raises(ValueError, match=words):
        RunOptions.of(parse(argument), HERE, golden=Path("golden"))


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("--cpas-examples=0", "--cpas-examples is 0, expected at least 1"),
        ("--cpas-metrics-report=m.txt", "expected .json or .md"),
    ],
)
def test_values_that_cannot_be_meant_for_metrics(parse, argument, words):
    with pytest.raises(ValueError, match=words):
        MetricsOptions.of(parse(argument), HERE)


def test_update_is_syrupys_option():
    options = argparse.Namespace(
        cpas_metrics=[],
        cpas_examples=None,
        cpas_no_shrink=False,
        cpas_seed=0,
        cpas_metrics_report=[],
    )
    assert not MetricsOptions.of(options, HERE).update
    options.update_snapshots = True
    assert MetricsOptions.of(options, HERE).update


def test_runs_are_every_method_on_every_data_set():
    options = RunOptions(
        methods=("tiny:Perfect", "tiny:OnlyPose"),
        datasets=("tiny:Tiny",),
        selection=Selection(categories=("mug",)),
        seeds=2,
        golden=Path("golden"),
    )
    runs = resolve_runs(options)
    assert [(run.method, run.dataset) for run in runs] == [
        ("perfect", "tiny"),
        ("only-pose", "tiny"),
    ]
    assert all(isinstance(run, MethodRun) and run.seeds == 2 for run in runs)
    assert [len(run.samples) for run in runs] == [6, 6]
    assert read_others(options, runs) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"methods": ("icp",)}, "--cpas-method needs --cpas-dataset NAME as well; registered: "),
        ({"datasets": ("real275",)}, "--cpas-dataset needs --cpas-method NAME as well"),
        (
            {"methods": ("tiny:Perfect", "tiny:Biased"), "datasets": ("tiny:Tiny",)},
            "the same method and data set twice",
        ),
        (
            {
                "methods": ("tiny:Perfect",),
                "datasets": ("tiny:Tiny",),
                "selection": Selection(categories=("cup",)),
            },
            "perfect on tiny: no samples of cup",
        ),
    ],
)
def test_options_that_make_no_run(options, words):
    with pytest.raises(ValueError, match=words):
        resolve_runs(RunOptions(**options, golden=Path("golden")))
