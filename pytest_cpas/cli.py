"""``pytest-cpas``: what is not a test run of its own."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a subcommand and return its exit code."""
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
    merge.add_argument("files", nargs="+", metavar="FILE")
    export = commands.add_parser(
        "export-bop",
        help="write stored results as the file that BOP's evaluation reads",
        description="Write the estimates of a results file that --cpas-dataset bop:DIR"
        " --cpas-results RESULTS made as BOP's scene_id,im_id,obj_id,score,R,t,time.",
    )
    export.add_argument("results", type=Path, metavar="FILE")
    export.add_argument("--bop", type=Path, required=True, metavar="DIR", help="the data set")
    export.add_argument("--to", type=Path, required=True, metavar="CSV", help="what to write")
    known, others = parser.parse_known_args(arguments)
    if known.command == "merge":
        return int(pytest.main([*(f"--cpas-merge={file}" for file in known.files), *others]))
    if others:
        parser.error(f"unrecognized arguments: {' '.join(others)}")
    return _export_bop(known)


def _export_bop(known: argparse.Namespace) -> int:
    from pytest_cpas.bop_export import export_bop
    from pytest_cpas.results import ResultsError
    from pytest_cpas.types import ContractError

    try:
        count = export_bop(known.results, known.bop, known.to)
    except (ResultsError, ContractError, OSError) as error:
        print(f"pytest-cpas export-bop: {error}", file=sys.stderr)
        return 1
    print(f"{known.to}: {count} estimates")
    return 0


if __name__ == "__main__":
    sys.exit(main())
