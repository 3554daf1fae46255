"""Golden tables of two revisions of a project: what an update of them changed, in words."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

from pytest_cpas.golden.comparison import compare
from pytest_cpas.golden.files import is_recorded, read_golden
from pytest_cpas.golden.older import OLDER_SAMPLES, OLDER_TABLE, parse_older
from pytest_cpas.golden.parsing import file_names, parse_table
from pytest_cpas.golden.tables import GoldenError, RunTable
from pytest_cpas.golden.texts import RUN
from pytest_cpas.golden.words import Word

__all__ = ["golden_diff"]


def golden_diff(golden: Path, revision: str) -> Iterator[str]:
    """Lines on every table below ``golden`` that is another one than in ``revision`` of git.

    The flips are those of the verdict, the table of the revision being the golden one. Raises
    :class:`GoldenError` for what is no table, no revision, or no folder under version control.
    """
    _git(golden, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}")
    listed = _git(golden, "ls-tree", "-r", "-z", "--name-only", revision, "--", "recorded")
    then = {Path(name).parent for name in listed.decode().split("\0") if name}
    now = {
        path.relative_to(golden)
        for path in golden.glob("recorded/*/*")
        if path.is_dir() and is_recorded(path)
    }
    for folder in sorted(then | now):
        title = "/".join(folder.parts[-2:])
        if folder not in now:
            yield f"{title}: there is none any more"
        elif folder not in then:
            yield f"{title}: there was none in {revision}"
        else:
            yield from _changed(
                title, _table_at(golden, folder, revision), read_golden(golden / folder)
            )


def _changed(title: str, old: RunTable, new: RunTable) -> Iterator[str]:
    verdicts = [v for v in compare(old, new) if v.word not in (Word.MATCHES, Word.OUTDATED)]
    for verdict in verdicts:
        yield f"{title}: {verdict}"


def _table_at(golden: Path, folder: Path, revision: str) -> RunTable:
    """The table that a folder held in a revision."""

    def text(name: str) -> str:
        content = _git(golden, "show", f"{revision}:./{folder.as_posix()}/{name}")
        return content.decode("utf-8", "replace").replace("\r\n", "\n")

    method, dataset = folder.parts[-2:]
    inside = f"{folder.as_posix()}/"
    there = _git(golden, "ls-tree", "-z", "--name-only", revision, "--", inside).decode()
    if f"{inside}{RUN}" not in there.split("\0"):
        return parse_older(method, dataset, text(OLDER_TABLE), text(OLDER_SAMPLES))
    run = text(RUN)
    files = {name: text(name) for name in file_names(run)}
    return parse_table(method, dataset, {RUN: run, **files})


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
