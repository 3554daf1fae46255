"""``pytest-cpas``: what is not a test run of its own."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pytest

from pytest_cpas.reading.text import say
from pytest_cpas.session import guard


def command_line() -> argparse.ArgumentParser:
    """The subcommands and their options."""
    parser = argparse.ArgumentParser(prog="pytest-cpas", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    merge = commands.add_parser(
        "merge",
        help="judge the results files of shards as one run",
        description="Judge the results files that --cpas-shard I/N --cpas-results DIR wrote as one"
        " run, with the table, verdict and exit code of an undivided run. Further options are"
        " pytest's, such as --cpas-require-golden, --cpas-allow-gaps, --snapshot-update or"
        " --junitxml=FILE.",
    )
    merge.add_argument("files", nargs="+", metavar="FILE", help="a file of --cpas-results")
    report = commands.add_parser(
        "report",
        help="write the report of stored results, and compare two runs",
        description="Judge the files of --cpas-results, of a run or of all its shards, as merge"
        " does, and write the files of --cpas-report; with --cpas-dataset NAME also pictures."
        " Further options are pytest's. Of a single report.json the report is written anew,"
        " without pictures; with --protocol its samples are judged anew by the facts that it has"
        " of them, and no golden table stands beside.",
    )
    report.add_argument(
        "files", nargs="+", metavar="FILE", help="a file of --cpas-results, or one report.json"
    )
    report.add_argument("--to", required=True, metavar="DIR", help="where to write the report")
    report.add_argument(
        "--against",
        nargs="+",
        default=[],
        metavar="FILE",
        help="compare with the runs in these files, results files or report.json",
    )
    report.add_argument(
        "--protocol",
        action="append",
        default=[],
        metavar="NAME",
        help="judge under a protocol, as --cpas-protocol; nothing is run again (repeatable)",
    )
    export = commands.add_parser(
        "export-bop",
        help="write stored results as the file that BOP's evaluation reads",
        description="Write the estimates of a results file that --cpas-dataset bop:DIR"
        " --cpas-results RESULTS made as BOP's scene_id,im_id,obj_id,score,R,t,time.",
    )
    export.add_argument("results", type=Path, metavar="FILE", help="a file of --cpas-results")
    export.add_argument("--bop", type=Path, required=True, metavar="DIR", help="the data set")
    export.add_argument("--to", type=Path, required=True, metavar="CSV", help="what to write")
    convert = commands.add_parser(
        "convert",
        help="write stored predictions in another form",
        description="Read a file or folder of predictions in any form that --cpas-predictions"
        " reads, and write it in the form that the name says: .jsonl (all that there is), .npz"
        " (NOCS's arrays), .csv (BOP's table), else a folder of NOCS's pickles. What the form"
        " cannot say is named, a line each. Nothing is overwritten.",
    )
    convert.add_argument("source", type=Path, metavar="IN", help="what to read")
    convert.add_argument("target", type=Path, metavar="OUT", help="what to write")
    convert.add_argument("--force", action="store_true", help="write over OUT if it is there")
    convert.add_argument(
        "--dataset",
        metavar="NAME",
        help="the data set that IN is about, where its form does not say its classes and axes",
    )
    convert.add_argument(
        "--data", type=Path, metavar="DIR", help="folder that holds the data sets (or CPAS_DATA)"
    )
    linking = commands.add_parser(
        "link",
        help="link the folders of a data set to where they are published",
        description="Find the folders of real275, real_train or camera25 below DIR, whatever they"
        " are called and wherever they are, by what is in them, and make links to them in the"
        " layout in which the data set is published. Nothing is copied, moved or overwritten.",
    )
    linking.add_argument("folder", type=Path, metavar="DIR", help="where to look")
    linking.add_argument("--as", required=True, dest="name", metavar="NAME", help="the data set")
    linking.add_argument("--to", type=Path, metavar="DIR", help="where to (default: ./NAME)")
    golden = commands.add_parser(
        "golden",
        help="what an update of golden tables changed",
        description="Compare the golden tables of the working tree with those of a revision of"
        " git: the samples that flipped, and the facts that moved. The exit code is 0 if there is"
        " no difference, 1 if there is one, 2 for what cannot be compared.",
    )
    golden.add_argument("action", choices=["diff"])
    golden.add_argument("revision", nargs="?", default="HEAD", metavar="REV", help="default: HEAD")
    golden.add_argument(
        "--golden", type=Path, default=Path("golden"), metavar="DIR", help="default: golden"
    )
    noise = commands.add_parser(
        "noise",
        help="measure how far other platforms move what a golden table records",
        description="Run pytest with the options that are given, such as --cpas-method and"
        " --cpas-dataset, under other kernels of OpenBLAS, without newer instructions of the"
        " processor, and both, and keep in the golden table how far facts moved. With"
        " --results nothing is run: they are files of other machines, one for each. A flip that"
        " such moves explain"
        " is BORDERLINE on another platform, and more than they explain are REGRESSED.",
    )
    noise.add_argument(
        "--results", nargs="+", default=[], metavar="FILE", help="a file of --cpas-results"
    )
    noise.add_argument(
        "--golden", type=Path, default=Path("golden"), metavar="DIR", help="default: golden"
    )
    fetching = commands.add_parser(
        "fetch",
        help="fetch a data set, or the weights of a method",
        description="Fetch a data set or the weights of a method from where they are published,"
        " after showing size and licence; an interrupted download is gone on with. What a program"
        " cannot fetch is explained step by step. The exit code is 0 if everything is there then.",
    )
    fetching.add_argument("name", metavar="NAME", help="such as real275, redwood75, sgpa")
    fetching.add_argument("--to", required=True, type=Path, metavar="DIR", help="where to")
    fetching.add_argument("--yes", action="store_true", help="agree to size and licence")
    adapter = commands.add_parser(
        "new-adapter",
        help="write a method that runs at once, to be filled in",
        description="Write the skeleton of a method: its module, its test and the file of what is"
        " known of it. docs/porting.md goes on from there.",
    )
    adapter.add_argument("name", metavar="NAME", help="of the method, such as my-method")
    adapter.add_argument(
        "--to", type=Path, default=Path(), metavar="DIR", help="where (default: here)"
    )
    adapter.add_argument(
        "--for-interpreter",
        metavar="VERSION",
        help="of a method that runs in an interpreter of its own, such as 3.6: it needs numpy and"
        " nothing of pytest-cpas, and cpas-methods.toml says how it is reached",
    )
    checking = commands.add_parser(
        "worker-check",
        help="try a method in another interpreter on one made-up sample",
        description="Start the interpreter of a method that pyproject.toml or cpas-methods.toml"
        " names, or of exec:COMMAND#module:Class, load the method there, send it one made-up sample"
        " and say, step by step, what is known and what is wrong. The exit code is 0 if it"
        " answers.",
    )
    checking.add_argument("name", metavar="NAME", help="as for --cpas-method")
    checking.add_argument("--weights", type=Path, metavar="DIR", help="as --cpas-weights")
    checking.add_argument("--device", default="cpu", help="as --cpas-device (default: cpu)")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a subcommand and return its exit code."""
    parser = command_line()
    options, rest = parser.parse_known_args(arguments)
    if options.command == "report" and any(file.endswith(".json") for file in options.files):
        if rest or len(options.files) > 1:
            unknown = " ".join([*options.files[1:], *rest])
            parser.error(f"a report.json stands alone; not understood: {unknown}")
        return _report(options)
    if options.command in ("merge", "report"):
        for_pytest = [f"--cpas-merge={file}" for file in options.files]
        if options.command == "report":
            for_pytest += [f"--cpas-report={options.to}"]
            for_pytest += [f"--cpas-against={file}" for file in options.against]
            for_pytest += [f"--cpas-protocol={name}" for name in options.protocol]
        guard.is_command = guard.is_command or arguments is None
        return int(pytest.main([*for_pytest, *rest]))
    if options.command == "noise" and not (rest and options.results):
        return _noise(options, rest)
    if rest:
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if options.command == "fetch":
        return _fetch(options.name, options.to, options.yes)
    if options.command == "new-adapter":
        return _new_adapter(options)
    if options.command == "worker-check":
        return _worker_check(options)
    if options.command == "convert":
        return _convert(options)
    if options.command == "link":
        return _link(options)
    if options.command == "golden":
        return _golden_diff(options.golden, options.revision)
    return _export_bop(options)


def _report(options: argparse.Namespace) -> int:
    from pytest_cpas.evaluation import ResultsError
    from pytest_cpas.report.against import against
    from pytest_cpas.report.files import write_report
    from pytest_cpas.report.rejudged import rejudged
    from pytest_cpas.report.stored import StoredReportError, read_report, read_runs
    from pytest_cpas.session.protocol_names import resolve_protocols
    from pytest_cpas.types import ContractError

    to, here = Path(options.to), Path.cwd()
    # where pytest would find the project
    root = next(
        (path for path in (here, *here.parents) if (path / "pyproject.toml").is_file()), here
    )
    try:
        protocols = resolve_protocols(options.protocol, here, root) if options.protocol else None
        document = read_report(Path(options.files[0]))
        if protocols is not None:
            document = rejudged(document, protocols)
            for line in dict.fromkeys(line for run in document["runs"] for line in run["lacking"]):
                say(f"n/a: {line}")
        if options.against:
            others = read_runs(list(map(Path, options.against)), protocols)
            document["against"] = against(document["runs"], others)
        write_report(document, to, {})
    except (StoredReportError, ResultsError, ContractError, OSError) as error:
        say(f"pytest-cpas report: {error}", file=sys.stderr)
        return 1
    say(f"wrote {to / 'report.html'}, .md and .json")
    return 0


def _golden_diff(golden: Path, revision: str) -> int:
    from pytest_cpas.golden import GoldenError, golden_diff

    try:
        lines = list(golden_diff(golden, revision))
    except GoldenError as error:
        say(f"pytest-cpas golden: {error}", file=sys.stderr)
        return 2
    say(*(lines or [f"{golden}: no table differs from {revision}"]))
    return 1 if lines else 0


def _noise(options: argparse.Namespace, rest: Sequence[str]) -> int:
    from pytest_cpas.golden import GoldenError
    from pytest_cpas.session.platforms import check_golden, learn_noise, measured_runs

    try:
        check_golden(options.golden)
        with tempfile.TemporaryDirectory() as folder:
            runs = {file: [Path(file)] for file in options.results}
            if not runs:
                for words, files in measured_runs(rest, Path(folder)):
                    say(f"ran under {words}")
                    runs[words] = files
            say(*learn_noise(options.golden, runs))
    except GoldenError as error:
        say(f"pytest-cpas noise: {error}", file=sys.stderr)
        return 1
    return 0


def _new_adapter(options: argparse.Namespace) -> int:
    from pytest_cpas.new_adapter import NewAdapterError, new_adapter

    try:
        paths, next_options = new_adapter(options.name, options.to, options.for_interpreter)
    except (NewAdapterError, OSError) as error:
        say(f"pytest-cpas new-adapter: {error}", file=sys.stderr)
        return 1
    say("wrote", *(f"  {path}" for path in paths))
    there = "" if options.to == Path() else f"cd {shlex.quote(str(options.to))} && "
    if options.for_interpreter:
        say(f"next:\n  {there}pytest-cpas worker-check {options.name}")
        there = ""
    else:
        say("next:")
    say(f"  {there}pytest {next_options} --cpas-limit=24")
    return 0


def _worker_check(options: argparse.Namespace) -> int:
    from pytest_cpas.registry import RegistryError
    from pytest_cpas.remote import RaisedThereError, WorkerError, close_all
    from pytest_cpas.session.worker_check import worker_check
    from pytest_cpas.types import ContractError

    weights = options.weights or os.environ.get("CPAS_WEIGHTS")
    try:
        for line in worker_check(
            options.name, Path.cwd(), Path(weights) if weights else None, options.device
        ):
            say(line)
    except (RegistryError, RaisedThereError, WorkerError, ContractError, OSError) as error:
        say(f"pytest-cpas worker-check: {error}", file=sys.stderr)
        return 1
    finally:
        close_all()
    return 0


def _export_bop(options: argparse.Namespace) -> int:
    from pytest_cpas.evaluation import ResultsError
    from pytest_cpas.evaluation.bop_export import export_bop
    from pytest_cpas.types import ContractError

    try:
        count = export_bop(options.results, options.bop, options.to)
    except (ResultsError, ContractError, OSError) as error:
        say(f"pytest-cpas export-bop: {error}", file=sys.stderr)
        return 1
    say(f"{options.to}: {count} estimates")
    return 0


def _convert(options: argparse.Namespace) -> int:
    from pytest_cpas import registry
    from pytest_cpas.submissions import read_submission, write_submission
    from pytest_cpas.types import ContractError

    data = options.data or os.environ.get("CPAS_DATA")
    try:
        dataset = None
        if options.dataset:
            dataset = registry.open_dataset(options.dataset, Path(data) if data else None)
        submission = read_submission(options.source, dataset)
        lost = write_submission(submission, options.target, dataset=dataset, force=options.force)
    except (registry.RegistryError, ContractError, OSError) as error:
        # pytest's options are called otherwise here
        say(f"pytest-cpas convert: {error}".replace("--cpas-", "--"), file=sys.stderr)
        return 1
    count = sum(len(image.answers) for image in submission.images)
    say(
        f"{options.target}: from {count} answers about {len(submission.images)} images",
        *(f"note: {note}" for note in submission.notes),
        *(f"lost: {line}" for line in lost),
    )
    return 0


def _link(options: argparse.Namespace) -> int:
    from pytest_cpas.fetching.layouts import link
    from pytest_cpas.types import ContractError

    to = options.to or Path(options.name)
    try:
        lines = link(options.folder, options.name, to)
    except (ContractError, OSError) as error:
        say(f"pytest-cpas link: {error}", file=sys.stderr)
        return 1
    say(*lines, f"next:\n  pytest --cpas-check-dataset={options.name}:{to}")
    return 0


def _fetch(name: str, to: Path, yes: bool) -> int:
    from pytest_cpas.fetching.command import FetchError, fetch, find_source

    def confirm(question: str) -> bool:
        if yes:
            return True
        if not sys.stdin.isatty():
            say(f"{question} Nobody can answer here; agree with --yes.", file=sys.stderr)
            return False
        return input(f"{question} [y/N] ").strip().lower() in ("y", "yes")

    try:
        return 0 if fetch(find_source(name), to, confirm=confirm, tell=say) else 1
    except FetchError as error:
        say(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        say("interrupted; the same command goes on where it stopped", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
