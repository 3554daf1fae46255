"""``--cpas-save-predictions``: where the answers of each run go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pytest_cpas.evaluation import MergedRun, ResultsFile, Run, SavedAnswers
from pytest_cpas.session.options import RunOptions
from pytest_cpas.submissions import UNWRITTEN

__all__ = ["open_saved"]

_OPTION = "--cpas-save-predictions"

#: What files are called in forms that only ``pytest-cpas convert`` writes, or nothing does.
_FILES = UNWRITTEN | {".npz", ".csv"}


def open_saved(
    options: RunOptions, runs: Sequence[Run], files: Mapping[Run, ResultsFile], worker: str
) -> dict[Run, SavedAnswers]:
    """The file of the answers of each run, to which it hands them over; none unless asked for.

    ``files``: those of the rows that are reused; ``worker``: the name of this process, empty for
    the one that writes the files. Raises :class:`ValueError` for a name that cannot be meant,
    :class:`pytest_cpas.evaluation.ResultsError` if the answers of reused rows are not there.
    """
    path = options.save
    if path is None:
        return {}
    if any(isinstance(run, MergedRun) for run in runs):
        raise ValueError(
            f"{_OPTION}: results files have facts and no whole answers; leave --cpas-merge out"
        )
    is_file = path.suffix == ".jsonl" and not path.is_dir()
    if is_file and len(runs) > 1:
        raise ValueError(
            f"{_OPTION} {path.name}: there are {len(runs)} runs, each with a file of its own; name"
            f" a folder: {_OPTION}={path.stem}"
        )
    if not is_file and (path.suffix in _FILES or path.exists()) and not path.is_dir():
        raise ValueError(f"{_OPTION} {path.name}: expected a .jsonl, or a folder")
    saved = {}
    judged = {read.resolve() for read in options.predictions}
    for run in runs:
        target = path if is_file else path / f"{options.shard.stem_of(run)}.jsonl"
        if judged & {target.resolve(), target.resolve().parent}:
            raise ValueError(f"{_OPTION}: {target} is, or is in, what is judged; name another file")
        saved[run] = SavedAnswers(target, run, worker)
        run.take_answer = saved[run].add
        if not worker and run in files:
            saved[run].check(files[run].rows, files[run].path)
    return saved
