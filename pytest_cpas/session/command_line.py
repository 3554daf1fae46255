"""The ``--cpas-*`` options, as pytest is told of them when it starts: nothing heavy is imported."""

from __future__ import annotations

import argparse
import os

import pytest

__all__ = ["add_options"]


def add_options(parser: pytest.Parser) -> None:
    """The options alone."""
    group = parser.getgroup("cpas", "categorical pose and shape")
    group.addoption(
        "--cpas-method",
        action="append",
        default=[],
        metavar="NAME",
        help="method to run: a registered name, package.module:Class, or one in another"
        " interpreter, which pyproject.toml or cpas-methods.toml names, or"
        " exec:COMMAND#module:Class (repeatable)",
    )
    group.addoption(
        "--cpas-dataset",
        action="append",
        default=[],
        metavar="NAME",
        help="data set to run on: a registered name or package.module:Class (repeatable)",
    )
    group.addoption(
        "--cpas-predictions",
        action="append",
        default=[],
        metavar="PATH",
        help="judge stored predictions: a pickle, an .npz, a .csv of BOP, a .jsonl of"
        " --cpas-save-predictions, or a folder of files (repeatable)",
    )
    group.addoption(
        "--cpas-save-predictions",
        metavar="PATH",
        help="write all answers of the run, with shapes, to a .jsonl that --cpas-predictions reads;"
        " of several runs one file each, into a folder",
    )
    group.addoption(
        "--cpas-data",
        metavar="DIR",
        default=os.environ.get("CPAS_DATA"),
        help="folder that holds the data sets (default: environment variable CPAS_DATA)",
    )
    group.addoption(
        "--cpas-detections",
        metavar="DIR",
        help="let methods see objects through the masks of a detector's files in DIR instead of"
        " those of the ground truth; what it did not find counts as not correct",
    )
    group.addoption(
        "--cpas-categories",
        metavar="FILE",
        help="take the known objects of the data sets as instances of categories, by a map in FILE"
        " or one that ships (ycbv, hope), so that categorical methods run on them",
    )
    group.addoption(
        "--cpas-weights",
        metavar="DIR",
        default=os.environ.get("CPAS_WEIGHTS"),
        help="folder that holds the methods' weights (default: environment variable CPAS_WEIGHTS)",
    )
    group.addoption(
        "--cpas-device", metavar="DEVICE", default="cpu", help="device of the method (default: cpu)"
    )
    group.addoption(
        "--cpas-seed",
        metavar="N",
        type=int,
        default=0,
        help="seed of the method, and of the examples of --cpas-metrics (default: 0)",
    )
    group.addoption(
        "--cpas-jitter",
        metavar="K",
        type=int,
        default=1,
        help="judge every sample under K seeds, so that --snapshot-update records their spread,"
        " which later runs are then allowed (default: 1)",
    )
    group.addoption(
        "--cpas-batch",
        metavar="N",
        type=int,
        help="ask the methods for N samples at once (default: as many as each declares). With"
        " --cpas-timeout, which is about one sample, a method in this interpreter is asked for one",
    )
    group.addoption(
        "--cpas-category",
        action="append",
        default=[],
        metavar="NAME",
        help="judge only the samples of this category (repeatable)",
    )
    group.addoption(
        "--cpas-limit",
        metavar="N",
        type=int,
        help="judge only N samples of each data set, evenly spaced",
    )
    group.addoption(
        "--cpas-profile",
        choices=("robustness",),
        help="robustness: judge a part of each data set as it is and perturbed (noise and gaps in"
        " depth, wrong masks, occlusion, darkness), for curves of precision against severity",
    )
    group.addoption(
        "--cpas-shard",
        metavar="I/N",
        default="1/1",
        help="judge the I-th of N parts of the samples; merge the --cpas-results of all parts with"
        " pytest-cpas merge",
    )
    group.addoption(
        "--cpas-timeout",
        metavar="SECONDS",
        help="end the run when a prediction takes longer per sample, and say where the method was;"
        " the same command goes on from there. With xdist, and of a method in another interpreter,"
        " that process alone is ended (default: ini cpas_timeout, else any time)",
    )
    group.addoption(
        "--cpas-results",
        metavar="DIR",
        help="keep the rows in DIR as they come; the same command goes on where it was killed",
    )
    group.addoption(
        "--cpas-results-reuse",
        choices=("same", "any"),
        default="same",
        help="which rows in --cpas-results are not computed again, and which are judged together"
        " by --cpas-merge: those of the same program, told by digests of the method's sources and"
        " of the files around them and by the versions of what it imports, or those of any"
        " (default: same)",
    )
    group.addoption(
        "--cpas-merge",
        action="append",
        default=[],
        metavar="FILE",
        help="judge the results files of shards as one run (repeatable)",
    )
    group.addoption(
        "--cpas-allow-gaps",
        action="store_true",
        help="with --cpas-merge: accept that shards or samples are missing",
    )
    group.addoption(
        "--cpas-granularity",
        choices=("sample", "scene", "dataset"),
        default="sample",
        help="how many samples one test item judges (default: sample)",
    )
    group.addoption(
        "--cpas-golden",
        metavar="DIR",
        help="folder of golden tables (default: ini cpas_golden, else golden/ in the root"
        " directory); those that ship with the plugin are read after it",
    )
    group.addoption(
        "--cpas-require-golden",
        action="store_true",
        help="fail when a golden table is missing or was compared with a part of its samples only;"
        " with =strict also when a verdict is PROBABLY WORSE",
    )
    # a name of its own, not a value: a path that follows the plain option is none of it
    group.addoption(
        "--cpas-require-golden=strict",
        dest="cpas_require_golden",
        action="store_const",
        const="strict",
        help=argparse.SUPPRESS,
    )
    group.addoption(
        "--cpas-protocol",
        action="append",
        default=[],
        metavar="NAME",
        help="judge under a protocol: one of --cpas-list, one of your own in pyproject.toml, or a"
        " .toml file (repeatable; default: ini cpas_protocol, else cpas)",
    )
    group.addoption(
        "--cpas-alarm",
        metavar="P",
        help="probability that a run without a change is called REGRESSED or IMPROVED, against a"
        " golden table of several seeds that disagree (default: ini cpas_alarm, else 1/1000)",
    )
    group.addoption(
        "--cpas-metrics",
        action="append",
        default=[],
        metavar="NAME",
        help="check an implementation of metrics: a registered name or package.module (repeatable)",
    )
    group.addoption(
        "--cpas-examples",
        metavar="N",
        type=int,
        help="examples per property of --cpas-metrics (default: 40)",
    )
    group.addoption(
        "--cpas-no-shrink",
        action="store_true",
        help="keep the first counterexample of --cpas-metrics as it is: quicker, and larger",
    )
    group.addoption(
        "--cpas-metrics-report",
        action="append",
        default=[],
        metavar="PATH",
        help="write the matrix of --cpas-metrics to a .json or .md file (repeatable)",
    )
    group.addoption(
        "--cpas-check-dataset",
        action="append",
        default=[],
        metavar="NAME",
        help="check a data set: a registered name or package.module:Class (repeatable)",
    )
    group.addoption(
        "--cpas-known-faults",
        action="append",
        default=[],
        metavar="FILE",
        help="known faults of the data sets that are checked or run, beside those that ship"
        " (repeatable)",
    )
    group.addoption(
        "--cpas-pictures",
        metavar="DIR",
        help="with --cpas-check-dataset: draw where the objects' up axes point into DIR",
    )
    group.addoption(
        "--cpas-report",
        metavar="DIR",
        help="write a report into DIR: report.html, report.md, report.json, precision.csv,"
        " scores.csv, precision.tex",
    )
    group.addoption(
        "--cpas-against",
        action="append",
        default=[],
        metavar="FILE",
        help="with --cpas-report: compare with the runs in a report.json or in a file of"
        " --cpas-results (repeatable)",
    )
    group.addoption(
        "--cpas-benchmark",
        action="store_true",
        help="time every method on every data set, with pytest-benchmark, after its samples;"
        " -k test_speed times alone",
    )
    group.addoption(
        "--cpas-benchmark-against",
        metavar="NAME",
        help="with --cpas-benchmark: time in turns with another method (a registered name or"
        " package.module:Class), or with the method itself in another revision (git:REVISION);"
        " without it, with a fixed calibration kernel, relative to which the time can be recorded",
    )
    group.addoption(
        "--cpas-benchmark-fail",
        metavar="SHARE",
        help="with --cpas-benchmark: fail when a method takes longer by more than SHARE, such as"
        " 20%% or 0.2, than what it is timed against, or than recorded by --snapshot-update",
    )
    group.addoption(
        "--cpas-trace",
        metavar="DIR",
        help="record what happens inside the method for each sample, into DIR: what it sees, the"
        " values that it names by tap and draw, the answer; -k test_parity does that alone",
    )
    group.addoption(
        "--cpas-trace-max",
        metavar="MIB",
        help="with --cpas-trace: keep about so many MiB of each sample; of larger values every"
        " so-manyth number, and a digest (default: 64)",
    )
    group.addoption(
        "--cpas-trace-spread",
        action="store_true",
        help="with --cpas-trace: measure the float noise of each value (other threads, a batch,"
        " touched inputs, float64), which --cpas-parity then allows",
    )
    group.addoption(
        "--cpas-parity",
        metavar="REFERENCE",
        help="compare with a folder of --cpas-trace, with another method (as --cpas-method names"
        " one), or with the method itself in another revision (git:REVISION), value by value, and"
        " say where the two part",
    )
    group.addoption(
        "--cpas-parity-map",
        metavar="FILE",
        help="with --cpas-parity: a .toml file that says how the reference's values are called"
        " here, and which draws are taken over from it",
    )
    group.addoption(
        "--cpas-parity-propose",
        metavar="FILE",
        help="with --cpas-parity: write such a map into FILE, from values that hold the same"
        " numbers under other names, or turned",
    )
    group.addoption(
        "--cpas-list",
        action="store_true",
        help="print what is registered, which weights of the methods are there, and the protocols"
        " with their columns, and exit",
    )
    parser.addini("cpas_golden", "folder of golden tables, relative to the root directory")
    parser.addini("cpas_alarm", "the same as --cpas-alarm")
    parser.addini("cpas_protocol", "the same as --cpas-protocol, one a line", type="linelist")
    parser.addini("cpas_timeout", "the same as --cpas-timeout")
