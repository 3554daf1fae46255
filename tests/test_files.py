"""Our own files are written as a whole or not at all."""

from __future__ import annotations

import errno
import os
import signal
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pytest_cpas._files import write_file


def test_what_is_written(tmp_path):
    file = tmp_path / "new" / "folder" / "file.txt"
    write_file(file, "a\r\nb\n\udcff é")
    assert file.read_bytes() == b"a\r\nb\n\\udcff \xc3\xa9"
    write_file(file, b"\x00\xff")
    assert file.read_bytes() == b"\x00\xff"
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.skipif(sys.platform == "win32", reason="modes of POSIX")
def test_others_may_read_it_as_they_may_read_other_new_files(tmp_path):
    write_file(tmp_path / "ours", "")
    (tmp_path / "another").touch()
    modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("ours", "another")}
    assert len(modes) == 1


@pytest.mark.parametrize("step", ["open", "fsync", "replace"])
@pytest.mark.parametrize("there", [True, False])
def test_an_error_leaves_what_was_there(tmp_path, monkeypatch, step, there):
    file = tmp_path / "file.txt"
    if there:
        file.write_text("old")

    def refused(*args, **kwargs):
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(os if step == "fsync" else Path, step, refused)
    with pytest.raises(OSError, match="no space left"):
        write_file(file, "new")
    monkeypatch.undo()
    assert [path.read_text() for path in tmp_path.iterdir()] == (["old"] if there else [])


@pytest.mark.skipif(sys.platform != "linux", reason="/dev/full")
def test_a_full_disk_is_noticed_before_the_old_file_is_replaced(tmp_path, monkeypatch):
    file = tmp_path / "file.txt"
    file.write_text("old")
    original = Path.open
    monkeypatch.setattr(Path, "open", lambda path, mode: original(Path("/dev/full"), "wb"))
    with pytest.raises(OSError, match="No space left"):
        write_file(file, "new")
    monkeypatch.undo()
    assert file.read_text() == "old"


def test_threads_do_not_disturb_each_other(tmp_path):
    file = tmp_path / "file.txt"
    contents = [str(index) * 100_000 for index in range(8)]
    with ThreadPoolExecutor(8) as threads:
        for _ in range(5):
            list(threads.map(lambda content: write_file(file, content), contents))
            assert file.read_text() in contents
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
def test_whoever_is_killed_leaves_the_old_file_or_the_new_one(tmp_path):
    file = tmp_path / "file.txt"
    code = (
        "import itertools, pathlib, sys\n"
        "from pytest_cpas._files import write_file\n"
        "for index in itertools.cycle(range(10)):\n"
        "    write_file(pathlib.Path(sys.argv[1]), str(index) * 1_000_000)\n"
        "    print(index, flush=True)\n"
    )
    for _ in range(3):
        with subprocess.Popen(
            [sys.executable, "-c", code, file], stdout=subprocess.PIPE, text=True
        ) as process:
            for _ in range(3):
                process.stdout.readline()
            process.send_signal(signal.SIGKILL)
        content = file.read_text()
        assert (len(content), len(set(content))) == (1_000_000, 1)
