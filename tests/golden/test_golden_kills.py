"""An update of a golden table is killed at every step: the old table or the new one is there."""

import os
import shutil
import signal
import stat
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from older_tables import record_older
from tables import GOLDEN, REFS, Fixed, RunTable, a_run, rows, table

from pytest_cpas.golden import find_golden, record
from pytest_cpas.golden.texts import table_texts
from pytest_cpas.protocols import shipped_protocol

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")

#: What is told to audit hooks before it changes a file or a folder.
_CHANGES = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.truncate")


class _Steps:
    """Dies at the ``last``-th step that changes the disk, of those below ``folder``."""

    def __init__(self, folder: Path, last: int) -> None:
        self.folder, self.left = str(folder), last
        self.sync = os.fsync

    def install(self) -> None:
        sys.addaudithook(self.audit)
        os.fsync = self.fsync

    def step(self) -> bool:
        self.left -= 1
        return self.left < 0

    def audit(self, event: str, args: tuple) -> None:
        changes = event in _CHANGES and (event != "open" or (args[2] or 0) & os.O_ACCMODE)
        if changes and str(args[0]).startswith(self.folder) and self.step():
            os.kill(os.getpid(), signal.SIGKILL)

    def fsync(self, descriptor: int) -> None:
        """Half of a file is on the disk, or all of it, when the writer dies."""
        if self.step():
            if stat.S_ISREG(os.fstat(descriptor).st_mode):
                os.truncate(descriptor, os.fstat(descriptor).st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        self.sync(descriptor)
        if self.step():
            os.kill(os.getpid(), signal.SIGKILL)


def killed(golden: Path, new: RunTable, step: int) -> bool:
    """Record in a process that is killed at a step; whether it was."""
    child = os.fork()
    if child == 0:
        _Steps(golden, step).install()
        record(golden, new)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, -signal.SIGKILL)
    return code != 0


def files(golden: Path) -> set[str]:
    return {p.name for p in golden.rglob("*") if p.is_file()} - {".gitattributes"}


def contents(golden: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in golden.rglob("*") if path.is_file()}


def files_of(table: RunTable | None) -> set[str]:
    """Those that hold a table, and no other."""
    if table is None:
        return set()
    return OLDER if table.outdated else FILES[len(table.protocols)]


MUGS = RunTable.of(a_run(), [row for row in rows(s_03=9) if row.category == "mug"])
ELSEWHERE = replace(GOLDEN, provenance={"python": "4"})

#: Judged under another protocol as well: a file more.
MORE = RunTable.of(
    Fixed(
        "m",
        "d",
        REFS,
        identity={"data": "x"},
        protocols=[shipped_protocol(name) for name in ("cpas", "omni6dpose")],
    ),
    rows(),
)

#: The files that a table has, by its protocols; and those of version 1.
FILES = {
    len(table.protocols): {"run.toml", "facts.csv", *(f"{p.name}.toml" for p in table.protocols)}
    for table in (GOLDEN, MORE)
}
OLDER = {"table.toml", "samples.csv"}


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (None, GOLDEN, GOLDEN),
        (GOLDEN, table(s_03=9), table(s_03=9)),
        (GOLDEN, MUGS, table(s_03=9)),
        (GOLDEN, GOLDEN, GOLDEN),
        (GOLDEN, ELSEWHERE, ELSEWHERE),
        (GOLDEN, MORE, MORE),
        ("version 1", GOLDEN, GOLDEN),
        ("version 1", MORE, MORE),
    ],
    ids=[
        *("first", "other", "part", "same", "same samples", "more protocols"),
        *("of version 1", "of version 1, more protocols"),
    ],
)
def test_killed_at_every_step(tmp_path, old, new, expected):
    def prepare(golden: Path) -> None:
        if old == "version 1":
            record_older(golden, table(s_03=9))
        elif old:
            record(golden, old)

    before = kill_at_every_step(tmp_path, prepare, new, expected)
    assert before in (None, old) or before.outdated


def kill_at_every_step(tmp_path, prepare, new, expected, others=None) -> RunTable | None:
    """Record ``new`` in the place of what ``prepare`` leaves, and return that; ``others``: tables
    that are never touched, with whose files those of ``expected`` are in the end."""
    # the cache has the locks, and is made before anything is counted
    record(tmp_path / "other", replace(GOLDEN, dataset=new.dataset))
    prepared = tmp_path / "prepared"
    prepared.mkdir()
    prepare(prepared)
    step, seen = 0, []
    while True:
        golden = shutil.copytree(prepared, tmp_path / str(step))
        before = find_golden(golden, "m", new.dataset)
        died = killed(golden, new, step)
        left = contents(golden)
        survivor = find_golden(golden, "m", new.dataset)
        assert survivor in (before, expected), f"neither, after step {step}"
        for other in others or ():
            assert find_golden(golden, "m", other.dataset) == other
        assert contents(golden) == left, "whoever reads changes nothing"
        seen.append(survivor)
        record(golden, new)
        assert find_golden(golden, "m", new.dataset) == expected
        assert files(golden) == set().union(*map(files_of, (expected, *(others or ()))))
        assert len([*golden.glob("recorded/*/*")]) == 1
        if not died:
            break
        step += 1
    assert step >= 6
    if before != expected:
        assert seen[0] == before
        assert seen[-1] == expected
        # one step commits: it never goes back
        assert seen == sorted(seen, key=lambda survivor: survivor == expected)
    return before


def at(point: str, table: RunTable) -> RunTable:
    return replace(table, dataset=f"d+{point}")


def of_its_own_folder(golden: Path, table: RunTable) -> None:
    """As earlier versions kept a point of a robustness profile."""
    folder = golden / "recorded" / table.method / table.dataset
    folder.mkdir(parents=True)
    for name, text in table_texts(table).items():
        (folder / name).write_text(text)


BESIDE = ("unperturbed", "mask-dilation-1")


@pytest.mark.parametrize(
    ("earlier", "old", "new", "expected", "others"),
    [
        (record, None, GOLDEN, GOLDEN, BESIDE),
        (record, GOLDEN, MORE, MORE, BESIDE),
        (of_its_own_folder, GOLDEN, table(s_03=9), table(s_03=9), BESIDE),
        (of_its_own_folder, MORE, MORE, MORE, ()),
        (record_older, table(s_03=9), GOLDEN, GOLDEN, ()),
    ],
    ids=[
        *("first", "more protocols"),
        *("of its own folder", "of its own folder, the first that moves", "of version 1"),
    ],
)
def test_update_of_a_point_killed_at_every_step(tmp_path, earlier, old, new, expected, others):
    """All files of all points are one transaction, and so is the end of a folder of its own."""
    kept = [at(point, GOLDEN) for point in others]

    def prepare(golden: Path) -> None:
        for other in kept:
            record(golden, other)
        if old:
            earlier(golden, at("light-2", old))

    kill_at_every_step(tmp_path, prepare, at("light-2", new), at("light-2", expected), kept)
