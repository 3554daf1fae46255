"""Tar archives: what any of them says is read rightly or refused, in bounded time and memory."""

import bz2
import gzip
import io
import lzma
import struct
import tarfile
import time
import zlib

import pytest

from pytest_cpas.reading.archives import ArchiveError, unpack
from pytest_cpas.reading.compressed import SMALL

END = bytes(1024)
FORMATS = {"v7": tarfile.USTAR_FORMAT, "gnu": tarfile.GNU_FORMAT, "pax": tarfile.PAX_FORMAT}
PACKED = {"plain": bytes, "gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress}
LONG = "x" * 120 + "/" + "é" * 90 + "/" + "y" * 80


def header(name=b"a", size=b"0", kind=b"0", **fields):
    """A header with its checksum; ``fields`` are bytes at an offset, as ``at_386``."""
    block = bytearray(512)
    block[: len(name)] = name
    block[124 : 124 + len(size)] = size
    block[156:157] = kind
    block[257:265] = b"ustar\00000"
    for key, value in fields.items():
        at = int(key.removeprefix("at_"))
        block[at : at + len(value)] = value
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)


def body(content):
    return content + bytes(-len(content) % 512)


def records(content, kind=b"x"):
    return header(b"x", b"%o" % len(content), kind) + body(content)


def record(key, value):
    content = key + b"=" + value + b"\n"
    length = next(n for n in range(1, 9999) if len(b"%d " % n) + len(content) == n)
    return b"%d " % length + content


def xz_of_much_memory():
    """A sound file whose header asks for four gigabytes."""
    data = bytearray(lzma.compress(b"x" * 1000, filters=[{"id": lzma.FILTER_LZMA2, "preset": 0}]))
    data[data.index(b"\x21\x01", 12) + 2] = 40
    size = (data[12] + 1) * 4
    data[12 + size - 4 : 12 + size] = struct.pack("<I", zlib.crc32(bytes(data[12 : 12 + size - 4])))
    return bytes(data)


BIG = b"\x80" + (2**60).to_bytes(11, "big")
NEGATIVE = b"\xff" + (2**88 - 512).to_bytes(11, "big")
NAMED = body(b"abc\0")
ATTACKS = {
    "records for a regular expression": (records(b"1" * 2**19) + header(), "expected a length"),
    "records of no length": (records(b"0 a=b\n") + header(), "expected a length"),
    "records of any length": (records(b"9" * 30 + b" a=b\n") + header(), "expected a length"),
    "records beyond their end": (records(b"99 a=b\n") + header(), "expected a length"),
    "records of no value": (records(b"5 ab\n") + header(), "expected a length"),
    "records of many": (records(b"6 a=b\n" * 170_000) * 8 + header(), "headers; a bomb"),
    "long records": (header(size=b"7777777777", kind=b"x"), "a header of 1073741823 bytes"),
    "records for all": (records(record(b"path", b"b"), b"g") + header(), "one path for all"),
    "size below 0": (header(size=NEGATIVE), "expected a size"),
    "size below 0 in records": (records(record(b"size", b"-9")) + header(), "'-9' bytes"),
    "size of any digits": (records(record(b"size", b"9" * 400)) + header(), "expected a size"),
    "size of other digits": (records(record(b"size", "٣".encode())) + header(), "expected a size"),
    "size in words": (header(size=b"many"), "expected a size"),
    "size beyond": (header(size=BIG), "it would unpack to more than"),
    "old sparse": (header(kind=b"S", at_482=b"\1") + bytes(512) * 9, "or sparse"),
    "new sparse": (records(record(b"GNU.sparse.major", b"1")) + header(), "a sparse file"),
    "links": (header(kind=b"1"), "is a link"),
    "symbolic links": (header(kind=b"2"), "is a link"),
    "devices": (header(kind=b"3"), "a device"),
    "pipes": (header(kind=b"6"), "a device"),
    "chain of names": ((header(size=b"4", kind=b"L") + NAMED) * 3000, "more than 8 headers before"),
    "chain of links": ((header(size=b"4", kind=b"K") + NAMED) * 3000, "more than 8 headers before"),
    "chain of records": (records(record(b"a", b"b")) * 3000, "more than 8 headers before one"),
    "chain for all": (records(record(b"a", b"b"), b"g") * 3000, "more than 8 headers before one"),
    "folders": (b"".join(header(b"%d/" % n, kind=b"5") for n in range(500)) * 2, "no files"),
    "other checksum": (header()[:-1] + b"x", "another checksum"),
    "outside": (header(b"../a"), "leads out of the folder"),
    "outside by records": (records(record(b"path", b"/a")) + header(), "leads out of the folder"),
    "NUL in a name": (records(record(b"path", b"a\0b")) + header(), "leads out of the folder"),
    "deep": (header(b"a/" * 40 + b"b"), "lies in 40 folders, at most 31"),
    "long name": (records(record(b"path", b"a" * 300)) + header(), "has 300 characters"),
    "no end": (header(size=b"1000") + bytes(100), "it ends within 'a'"),
}


@pytest.mark.parametrize("packed", ["plain", "gz"])
@pytest.mark.parametrize("attack", ATTACKS)
def test_what_a_tar_archive_says_is_not_followed(attack, packed, tmp_path):
    content, words = ATTACKS[attack]
    path = tmp_path / "mine.tar"
    path.write_bytes(PACKED[packed](content + (b"" if attack == "no end" else END)))
    start = time.process_time()
    with pytest.raises(ArchiveError, match=rf"mine\.tar: .*{words}") as raised:
        unpack(path, tmp_path / "to")
    assert time.process_time() - start < 1
    assert len(str(raised.value)) < 600
    assert list((tmp_path / "to").iterdir()) == []


def test_small_archives_hold_few_files(tmp_path, monkeypatch):
    monkeypatch.setattr("pytest_cpas.reading.archives._FEW", 100)
    path = tmp_path / "mine.tar"
    path.write_bytes(gzip.compress(b"".join(header(b"%d" % n) for n in range(500)) + END))
    with pytest.raises(ArchiveError, match=r"mine\.tar: .* bytes or 10[0-9] files, from \d+ bytes"):
        unpack(path, tmp_path / "to")


@pytest.mark.parametrize("packed", PACKED)
@pytest.mark.parametrize("form", FORMATS)
def test_what_tar_programs_write_is_read(form, packed, tmp_path):
    made = io.BytesIO()
    names = ["a", "b/c", "b/empty", "d" * 90 + "/" + "e" * 60] + [LONG] * (form != "v7")
    with tarfile.open(fileobj=made, mode="w", format=FORMATS[form]) as archive:
        folder = tarfile.TarInfo("b")
        folder.type = tarfile.DIRTYPE
        archive.addfile(folder)
        for name in names:
            info = tarfile.TarInfo(name)
            info.size, info.mtime = 0 if "empty" in name else 700, 1.5
            archive.addfile(info, io.BytesIO(name.encode() * 700))
    path = tmp_path / "mine.tar"
    path.write_bytes(PACKED[packed](made.getvalue()))
    assert unpack(path, tmp_path / "to") == len(names)
    for name in names:
        size = 0 if "empty" in name else 700
        assert (tmp_path / "to" / name).read_bytes() == (name.encode() * 700)[:size]


def test_large_sizes_are_read(tmp_path):
    path = tmp_path / "mine.tar"
    path.write_bytes(header(size=b"\x80" + (3).to_bytes(11, "big")) + body(b"abc") + END)
    unpack(path, tmp_path / "to")
    assert (tmp_path / "to" / "a").read_bytes() == b"abc"


@pytest.mark.parametrize("packed", ["gz", "bz2", "xz"])
def test_parts_one_after_the_other_are_one_archive(packed, tmp_path):
    content, pack = header(size=b"3") + body(b"abc") + END, PACKED[packed]
    path = tmp_path / "mine.tar"
    path.write_bytes(pack(content[:100]) + pack(b"") + pack(content[100:]) + bytes(512))
    unpack(path, tmp_path / "to")
    assert (tmp_path / "to" / "a").read_bytes() == b"abc"
    path.write_bytes(pack(content[:100]) + pack(b"") * 102 + pack(content[100:]))
    with pytest.raises(ArchiveError, match=r"mine\.tar: more than 100 of its parts hold nothing"):
        unpack(path, tmp_path / "more")


@pytest.mark.parametrize("packed", ["gz", "bz2", "xz"])
def test_small_files_do_not_become_large_ones(packed, tmp_path):
    path = tmp_path / "mine.tar"
    no_records = header(b"x", b"%o" % SMALL, b"x") + bytes(SMALL)
    path.write_bytes(PACKED[packed](no_records * 8 + header() + END))
    with pytest.raises(ArchiveError, match=r"mine\.tar: its first \d+ bytes become more than \d+"):
        unpack(path, tmp_path / "to")


@pytest.mark.parametrize("packed", ["gz", "bz2", "xz"])
def test_torn_files_are_noticed_wherever_they_are_torn(packed, tmp_path):
    content = PACKED[packed](header(size=b"3000") + body(bytes(range(256)) * 6) + END)
    path = tmp_path / "mine.tar"
    for length in range(7, len(content) - 40, 23):
        path.write_bytes(content[:length])
        with pytest.raises(ArchiveError, match=r"mine\.tar: "):
            unpack(path, tmp_path / "to")
    assert list((tmp_path / "to").iterdir()) == []


def test_memory_that_a_file_asks_for_is_not_given(tmp_path):
    path = tmp_path / "mine.tar.xz"
    path.write_bytes(xz_of_much_memory())
    with pytest.raises(ArchiveError, match=r"mine\.tar\.xz: .*Memory usage limit exceeded"):
        unpack(path, tmp_path / "to")
