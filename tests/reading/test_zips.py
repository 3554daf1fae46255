"""Zip archives are opened only if they list no more than their reader needs."""

import io
import struct
import time
import zipfile

import pytest

from pytest_cpas.reading.zips import open_zip
from pytest_cpas.types import DataError


def listing(count: int, zip64: bool) -> bytes:
    """An archive that lists ``count`` members, all of them the same."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("a", b"")
    whole = made.getvalue()
    start = whole.index(b"PK\1\2")
    entries = b"".join(
        whole[start : start + 28] + b"\7\0" + whole[start + 30 : start + 46] + b"%07d" % n
        for n in range(count)
    )
    content, size = whole[:start] + entries, len(entries)
    if not zip64:
        return content + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, count, count, size, start, 0)
    return (
        content
        + struct.pack("<4sQ2H2I4Q", b"PK\6\6", 44, 45, 45, 0, 0, count, count, size, start)
        + struct.pack("<4sIQI", b"PK\6\7", 0, start + size, 1)
        + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 2**16 - 1, 2**16 - 1, 2**32 - 1, 2**32 - 1, 0)
    )


@pytest.mark.parametrize("zip64", [False, True])
def test_no_more_members_are_listed_than_are_read(zip64):
    with open_zip("mine.zip", io.BytesIO(listing(1000, zip64)), 1000) as archive:
        assert len(archive.namelist()) == 1000
    with pytest.raises(DataError, match=r"mine\.zip: 1001 members, at most 1000 are read"):
        open_zip("mine.zip", io.BytesIO(listing(1001, zip64)), 1000)


def test_a_long_list_is_not_parsed():
    content = listing(200_000, True)
    start = time.process_time()
    with pytest.raises(DataError, match=r"mine\.zip: a list of members of 10600000 bytes"):
        open_zip("mine.zip", io.BytesIO(content), 1000)
    assert time.process_time() - start < 0.1
