"""What no archive may hold: see tests/fetching for the rest."""

import zipfile

import pytest

from pytest_cpas.reading.archives import KEPT, ArchiveError, unpack


@pytest.mark.parametrize("name", [f"{KEPT}/other.zip", f"./{KEPT}/other.zip", f"{KEPT}/a/b"])
def test_downloads_that_are_kept_cannot_be_planted(tmp_path, name):
    with zipfile.ZipFile(tmp_path / "first.zip", "w") as archive:
        archive.writestr("data/good", b"good")
        archive.writestr(name, b"evil")
    with pytest.raises(ArchiveError, match="where downloads are kept"):
        unpack(tmp_path / "first.zip", tmp_path / "there")
    assert not (tmp_path / "there" / KEPT).exists()
