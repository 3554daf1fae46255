"""``pytest-cpas``: what is not a test run of its own."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

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
    known, others = parser.parse_known_args(arguments)
    return int(pytest.main([*(f"--cpas-merge={file}" for file in known.files), *others]))


if __name__ == "__main__":
    sys.exit(main())
