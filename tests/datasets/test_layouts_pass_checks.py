"""Every layout's rendered tree passes the sanity checks: axes, units, masks and extents agree."""

import pytest
import test_bop
import test_folder
import test_nocs_fitted
import test_other_layouts

from pytest_cpas.checks.dataset import CHECKS
from pytest_cpas.checks.dataset.facts import survey
from pytest_cpas.registry import resolve


def write_folder(root):
    _, lines = test_folder.write_folder(root)
    test_folder.write_table(root, lines)


LAYOUTS = {
    "housecat6d": test_other_layouts.write_housecat6d,
    "phocal": test_other_layouts.write_phocal,
    "wild6d": test_other_layouts.write_wild6d,
    "tod": test_other_layouts.write_tod,
    "folder": write_folder,
    "bop": test_bop.write_bop,
    "camera25": test_nocs_fitted.write_camera25,
    "real_train": test_nocs_fitted.write_real_train,
}


@pytest.mark.parametrize(("name", "write"), LAYOUTS.items())
def test_what_systems_write_beside_files_is_no_data(tmp_path, name, write):
    """As macOS and Windows leave it on a disk that is shared: of every file and folder."""
    write(tmp_path)
    first = resolve("dataset", name)(tmp_path)
    for path in [*tmp_path.rglob("*")]:
        path.with_name(f"._{path.name}").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X")
        if path.is_dir():
            (path / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
            (path / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0")
            (path / "desktop.ini").write_text("[ViewState]")
    second = resolve("dataset", name)(tmp_path)
    assert second.samples == first.samples
    assert (second.missing, second.damaged) == (first.missing, first.damaged)
    assert second.digest == first.digest


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("housecat6d", set()),
        ("phocal", set()),
        ("wild6d", set()),
        ("tod", set()),
        ("folder", set()),
        ("bop", {"duplicates"}),  # its two scenes show the same
    ],
)
def test_layout(tmp_path, name, known):
    write = LAYOUTS[name]
    write(tmp_path)
    dataset = resolve("dataset", name)(tmp_path)
    measured = survey(dataset)
    assert len(measured.samples) == len(dataset.samples) > 0
    assert {check for check in CHECKS if CHECKS[check](measured)} == known
