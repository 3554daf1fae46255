"""What Python 2.7 to 3.13 with numpy 1.13 to 2.4 write is read, whatever the protocol.

The files were written by the versions that ``pickles/writers.txt`` names, with
``tools/make_pickle_fixtures.py``. Python 3.14 could not be had; it writes protocols 0 to 5 as 3.13
does.
"""

import math
from pathlib import Path

import numpy as np
import pytest
from make_pickle_fixtures import cases

from pytest_cpas.reading.pickles import load_numpy_pickle

FOLDER = Path(__file__).parent / "pickles"
WRITERS = [line.split(maxsplit=1) for line in (FOLDER / "writers.txt").read_text().splitlines()]


def as_python_2(value):
    """Its bytes are the text of Python 3, in Latin 1."""
    if type(value) is bytes:
        return value.decode("latin1")
    return [as_python_2(part) for part in value] if type(value) is list else value


def same(read, written):
    """The same type, shape, dtype and content, down to the sign of zero."""
    if isinstance(written, np.ndarray):
        assert type(read) is np.ndarray
        assert (read.shape, read.dtype) == (written.shape, written.dtype)
        if written.dtype == object:
            same(read.ravel().tolist(), written.ravel().tolist())
        else:
            assert read.tobytes() == written.tobytes()
        return
    assert type(read) is type(written)
    if isinstance(written, (list, tuple)):
        assert len(read) == len(written)
        for one, other in zip(read, written, strict=True):
            same(one, other)
    elif isinstance(written, dict):
        assert read.keys() == written.keys()
        same([read[key] for key in written], list(written.values()))
    elif isinstance(written, float):
        if not (math.isnan(read) and math.isnan(written)):
            assert (read, math.copysign(1, read)) == (written, math.copysign(1, written))
    else:
        assert read == written


@pytest.mark.parametrize("file", sorted({name for name, _ in WRITERS}))
def test_what_a_version_writes_is_read(file):
    writers = [writer for name, writer in WRITERS if name == file]
    read = load_numpy_pickle(FOLDER / file)
    written = cases()
    assert read.keys() == written.keys()
    for name, value in written.items():
        if "Python 2" in writers[0] and name == "bytes":
            value = as_python_2(value)
        try:
            same(read[name], value)
        except AssertionError as error:
            raise AssertionError(f"{name}, {writers[0]}: {error}") from error


def test_every_file_has_a_writer_and_all_kinds_are_there():
    assert {path.name for path in FOLDER.glob("*.pkl")} == {name for name, _ in WRITERS}
    writers = " ".join(writer for _, writer in WRITERS)
    assert all(f"protocol {number} " in writers for number in range(6))
    assert all(f"Python {version}." in writers for version in ("2.7", "3.6", "3.13"))
    assert all(f"numpy {version}." in writers for version in ("1.13", "1.16", "2.0", "2.4"))
