"""Every layout's rendered tree passes the sanity checks: axes, units, masks and extents agree."""

import pytest
import test_bop
import test_folder
import test_other_layouts

from pytest_cpas.checks.dataset import CHECKS
from pytest_cpas.checks.dataset.facts import survey
from pytest_cpas.registry import resolve


def write_folder(root):
    _, lines = test_folder.write_folder(root)
    test_folder.write_table(root, lines)


@pytest.mark.parametrize(
    ("name", "write", "known"),
    [
        ("housecat6d", test_other_layouts.write_housecat6d, set()),
        ("phocal", test_other_layouts.write_phocal, set()),
        ("wild6d", test_other_layouts.write_wild6d, set()),
        ("tod", test_other_layouts.write_tod, set()),
        ("folder", write_folder, set()),
        ("bop", test_bop.write_bop, {"duplicates"}),  # its two scenes show the same
    ],
)
def test_layout(tmp_path, name, write, known):
    write(tmp_path)
    dataset = resolve("dataset", name)(tmp_path)
    measured = survey(dataset)
    assert len(measured.samples) == len(dataset.samples) > 0
    assert {check for check in CHECKS if CHECKS[check](measured)} == known
