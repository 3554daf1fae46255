"""What the literature prints as average precision: the file's form, and a line that is ours too."""

import csv
import re
from collections import Counter

import pytest

from pytest_cpas.evaluation import StoredRun
from pytest_cpas.golden import shipped_golden
from pytest_cpas.golden.literature import (
    LEGACY,
    literature,
    literature_columns,
    literature_datasets,
)
from pytest_cpas.protocols import ranking_table, shipped_protocol
from pytest_cpas.types.samples import ALL

FILE = shipped_golden() / "published" / "average_precision.csv"


def lines() -> list[dict[str, str]]:
    with FILE.open(newline="") as file:
        return list(csv.DictReader(file))


def test_columns_are_those_of_the_protocol():
    assert list(lines()[0]) == [
        *("dataset", "method", "paper", "read_in", "also_in"),
        *(column.id for column in shipped_protocol(LEGACY).columns),
        "note",
    ]


def test_every_line_has_a_source_and_numbers_that_are_percent():
    for line in lines():
        where = f"{line['dataset']}, {line['method']}"
        assert re.search(r"20\d\d|preprint", line["paper"]), where
        assert line["read_in"], where
        # who reads a line sees whether a second place agrees
        assert bool(line["also_in"]) != ("not cross-checked" in line["note"]), where
        assert line["also_in"] != line["read_in"], where
        printed = [line[column.id] for column in literature_columns() if line[column.id]]
        assert len(printed) >= 4, where
        for text in printed:
            assert re.fullmatch(r"\d{1,2}\.\d{1,2}", text), where
            assert 0 <= float(text) <= 100, where


def test_wider_limits_are_met_at_least_as_often():
    """A figure in the wrong column, or two that changed places."""
    for line in lines():
        for strict, wide in (
            ("ap_iou_50", "ap_iou_25"),
            ("ap_iou_75", "ap_iou_50"),
            ("ap_5deg_2cm", "ap_5deg_5cm"),
            ("ap_5deg_2cm", "ap_10deg_2cm"),
            ("ap_5deg_5cm", "ap_10deg_5cm"),
            ("ap_10deg_2cm", "ap_10deg_5cm"),
        ):
            if line[strict] and line[wide]:
                assert float(line[strict]) < float(line[wide]), (line["method"], strict, wide)


def test_at_least_fifteen_methods_each_once_per_data_set():
    assert literature_datasets() == ["camera25", "real275"]
    counts = Counter((line["dataset"], line["method"]) for line in lines())
    assert set(counts.values()) == {1}
    assert len(literature("real275")) == 26
    assert len(literature("camera25")) == 17
    assert len({method for _, method in counts}) == 27
    assert literature("redwood75") == []


def test_what_is_not_printed_is_left_out():
    rows = {row.method: row for row in literature("real275")}
    assert rows["cass"].percent == {
        "ap_iou_25": 84.2,
        "ap_iou_50": 77.7,
        "ap_5deg_5cm": 23.5,
        "ap_10deg_5cm": 58.0,
    }


def test_dualposenet_is_printed_as_its_predictions_are_judged(test_data):
    path = test_data / "predictions" / "dualposenet_real275.npz"
    protocol = shipped_protocol(LEGACY)
    run = StoredRun(path, protocols=(protocol,))
    judged = ranking_table(protocol.rankings, run.ranking(()))[ALL]
    (row,) = (row for row in literature("real275") if row.method == "dualposenet")
    assert len(row.percent) == 6
    ours = {key.removeprefix(f"{LEGACY}."): score.value for key, score in judged.items()}
    assert {name: round(100 * ours[name], 1) for name in row.percent} == pytest.approx(row.percent)
