"""Golden tables of two revisions of a project: what an update of them changed, in words."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path

from pytest_cpas.golden.comparison import compare
from pytest_cpas.golden.files import is_recorded, is_table_file, read_tables
from pytest_cpas.golden.older import OLDER_SAMPLES, OLDER_TABLE, parse_older
from pytest_cpas.golden.points import ROBUSTNESS, kept_files, kept_tables, parse_kept
from pytest_cpas.golden.tables import GoldenError, RunTable
from pytest_cpas.golden.texts import RUN
from pytest_cpas.golden.waiting import LARGEST
from pytest_cpas.golden.words import Word
from pytest_cpas.reading.files import decoded
from pytest_cpas.reading.text import terminal_line
from pytest_cpas.types import DataError

__all__ = ["golden_diff"]

#: What a verdict on a run says last, or in a line of its own.
_ADVICE = re.compile(r"(; |\n *)if (this is|these results are) right, record[^\n]*")

#: Of the path of a file of a table: recorded, the method, the data set, the file.
_PARTS = 4


def golden_diff(golden: Path, revision: str) -> Iterator[str]:
    """Lines on every table below ``golden`` that is another one than in ``revision`` of git.

    The flips are those of the verdict, the table of the revision being the golden one. Raises
    :class:`GoldenError` for what is no table, no revision, or no folder under version control.
    """
    if not golden.is_dir():
        raise GoldenError(f"{golden}: no such folder; name that of the golden tables with --golden")
    _git(golden, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}")
    listed = _git(golden, "ls-tree", "-r", "-z", "--name-only", revision, "--", "recorded")
    then = {
        path.parent
        for path in map(Path, os.fsdecode(listed).split("\0"))
        if len(path.parts) == _PARTS and is_table_file(path.name)
    }
    now = {
        path.relative_to(golden)
        for path in golden.glob("recorded/*/*")
        if path.is_dir() and is_recorded(path)
    }
    old: dict[str, RunTable] = {}
    new: dict[str, RunTable] = {}
    for folder in sorted(then, key=_points_first):
        if _title(folder) not in old:
            try:
                old |= _titled(_tables_at(golden, folder, revision))
            except (GoldenError, DataError) as error:
                raise GoldenError(f"{revision}:{folder.as_posix()}: {error}") from error
    for folder in sorted(now, key=_points_first):
        if _title(folder) not in new:
            new |= _titled(read_tables(golden / folder))
    for title in sorted({*old, *new}):
        told = terminal_line(title)
        if title not in new:
            yield f"{told}: there is none any more"
        elif title not in old:
            yield f"{told}: there was none in {revision}"
        else:
            yield from _changed(told, old[title], new[title])


def _points_first(folder: Path) -> tuple[bool, Path]:
    """The order of folders: where a point of a profile has one of its own as well, what is kept
    with the other points counts."""
    return not folder.name.endswith(ROBUSTNESS), folder


def _title(folder: Path) -> str:
    return "/".join(folder.parts[-2:])


def _titled(tables: Mapping[str, RunTable]) -> dict[str, RunTable]:
    return {f"{table.method}/{table.dataset}": table for table in tables.values()}


def _changed(title: str, old: RunTable, new: RunTable) -> Iterator[str]:
    verdicts = [v for v in compare(old, new) if v.word not in (Word.MATCHES, Word.OUTDATED)]
    for verdict in verdicts:
        # both are recorded: there is nothing to type
        yield _ADVICE.sub("", f"{title}: {verdict}")


def _tables_at(golden: Path, folder: Path, revision: str) -> dict[str, RunTable]:
    """The tables that a folder held in a revision, by the names of their data sets."""

    def text(name: str) -> str:
        place = f"{revision}:./{folder.as_posix()}/{name}"
        if (size := int(_git(golden, "cat-file", "-s", place))) > LARGEST:
            raise GoldenError(f"{name}: {size} bytes, at most {LARGEST} are read")
        return decoded(Path(name), _git(golden, "cat-file", "blob", place)).replace("\r\n", "\n")

    method, name = folder.parts[-2:]
    inside = f"{folder.as_posix()}/"
    there = os.fsdecode(_git(golden, "ls-tree", "-z", "--name-only", revision, "--", inside))
    if f"{inside}{RUN}" not in there.split("\0"):
        return kept_tables(parse_older(method, name, text(OLDER_TABLE), text(OLDER_SAMPLES)))
    run = text(RUN)
    files = {file: text(file) for file in kept_files(run)}
    return kept_tables(parse_kept(method, name, {RUN: run, **files}))


def _git(golden: Path, *arguments: str) -> bytes:
    try:
        run = subprocess.run(  # noqa: S603 - the revision is checked before it is used
            ["git", *arguments],  # noqa: S607 - whichever git the user has
            cwd=golden,
            capture_output=True,
            check=False,
        )
    except OSError as error:
        raise GoldenError(f"{golden}: git cannot be run there ({error})") from error
    if run.returncode:
        told = " ".join(run.stderr.decode("utf-8", "replace").split())
        asked = " ".join(arguments[:1])
        raise GoldenError(
            f"{golden}: git {asked} failed ({told or 'no such revision'}); expected a folder of"
            " golden tables under version control, and a revision such as HEAD~1"
        )
    return run.stdout
