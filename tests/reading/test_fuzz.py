"""Every reader against seeded mutations of sound files: 500 here, 20000 with ``nox -s fuzz``."""

import ast
import json
import time
from pathlib import Path

import fuzzing
import pytest

from pytest_cpas.types import DataError

READING = Path(fuzzing.__file__).parents[2] / "pytest_cpas" / "reading"

#: Public functions that read nothing of others: text that leaves is escaped by them.
NO_READERS = ("text.",)

#: Seeds that get as far as the last check of their reader, and not beyond.
HALF_SOUND = {("numbers", 1), ("numbers", 2), ("report", 1), ("report", 2)}

CASES = -(-500 // len(fuzzing.READERS))


def public_functions() -> set[str]:
    """As ``module.function``, of every module of the room."""
    return {
        f"{path.stem}.{node.name}"
        for path in READING.glob("*.py")
        for node in ast.parse(path.read_bytes()).body
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
    }


def test_every_public_function_is_fuzzed():
    covered = {name for reader in fuzzing.READERS.values() for name in reader.covers}
    readers = {name for name in public_functions() if not name.startswith(NO_READERS)}
    assert readers - covered == set(), "name it in `covers` of a reader of fuzzing.py"
    assert covered - readers == set(), "fuzzing.py covers what is not there"


@pytest.mark.parametrize("name", fuzzing.READERS)
def test_sound_files_are_read(name, tmp_path):
    reader = fuzzing.READERS[name]
    for number, seed in enumerate(reader.seeds()):
        path = tmp_path / f"{number}{reader.suffix}"
        path.write_bytes(seed)
        if (name, number) in HALF_SOUND:
            with pytest.raises(fuzzing.own_errors()):
                reader.run(path)
        else:
            reader.run(path)


@pytest.mark.parametrize("name", fuzzing.READERS)
def test_nothing_but_the_readers_own_error_comes_out(name):
    assert fuzzing.fuzz(name, 0, CASES) == []


def busy(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


FAULTS = {
    "raises": (lambda path: [][0], "IndexError"),
    "slow": (lambda path: busy(1.2), "1.2"),
    "large": (lambda path: bytearray(b"x") * (2**30 + 2**28), "MiB more memory"),
    "unnamed": (lambda path: fuzzing.READERS["numbers"].run(path), "does not name the file"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_fault_is_found(fault, tmp_path, monkeypatch):
    run, words = FAULTS[fault]
    monkeypatch.setitem(fuzzing.READERS, "planted", fuzzing.Reader(run, list))
    path = tmp_path / "case"
    path.write_bytes(json.dumps("no numbers").encode())
    assert words in fuzzing.complaint("planted", path, (DataError,))


def test_a_case_can_be_made_again(monkeypatch):
    now = time.localtime()  # which archives are stamped with
    monkeypatch.setattr(time, "localtime", lambda *_: now)
    for name in fuzzing.READERS:
        if name != "tensors":  # torch writes a serial number of its own
            assert fuzzing.case(name, 7) == fuzzing.case(name, 7)
