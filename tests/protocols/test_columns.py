"""What is declared of a protocol: read as it is meant, or refused in one clear sentence."""

import copy
import math
import tomllib

import pytest

from pytest_cpas.facts import all_facts, fact
from pytest_cpas.protocols import (
    PAPER,
    CountColumn,
    Protocol,
    ProtocolError,
    ScoreColumn,
    facts_of,
    read_protocol,
    shipped_protocol,
    shipped_protocols,
)
from pytest_cpas.reading.structured import LARGEST_TOML

GOOD = {
    "name": "mine",
    "version": 2,
    "columns": [
        {"id": "tight", "at": {"rotation_deg": 2, "position_m": 0.005}},
        {"id": "box", "guard": True, "at": {"iou": 0.5}},
        {"id": "auc", "label": "AUC", "area": {"iou": [0.25, 1]}, "bins": 10},
        {"id": "middle", "median": "cd_m"},
        {"id": "recall", "levels": {"mspd_px": [5, 10]}},
    ],
}


def with_column(**column: object) -> dict:
    content = copy.deepcopy(GOOD)
    content["columns"].append({"id": "last", **column})
    return content


def test_declaration_is_read():
    protocol = Protocol.parse(GOOD, "here")
    tight, box, auc, middle, recall = protocol.columns
    assert (protocol.name, protocol.version, protocol.title) == ("mine", 2, "mine")
    assert tight == CountColumn(
        protocol="mine",
        id="tight",
        label="2 deg, 0.5 cm",
        limits={"rotation_deg": 2.0, "position_m": 0.005},
    )
    assert (box.key, box.label, box.guard) == ("mine.box", "IoU 0.5", True)
    assert auc == ScoreColumn(
        protocol="mine", id="auc", label="AUC", areas={"iou": (0.25, 1.0)}, bins=10
    )
    assert (middle.label, middle.better, auc.better) == ("median CD (m)", "lower", "higher")
    assert recall.levels == {"mspd_px": (5.0, 10.0)}
    assert (recall.label, recall.better) == ("mean over 2 limits to MSPD 10 px", "higher")
    names = ("position_m", "rotation_deg", "iou", "cd_m", "mspd_px")
    assert facts_of(protocol.columns) == names


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({}, "name is missing, expected a line of text"),
        ({**GOOD, "columns": [{"at": {"iou": 0.5}}]}, "id is missing"),
        ({**GOOD, "name": "Mine"}, "name is 'Mine', expected up to 40 small letters"),
        ({**GOOD, "name": "../mine"}, "name is '../mine'"),
        ({**GOOD, "name": "m" * 41}, "expected up to 40"),
        ({**GOOD, "name": 3}, "name is 3, expected a line of text"),
        ({**GOOD, "title": "two\nlines"}, "title is .*expected a line of text"),
        ({**GOOD, "title": "x" * 300}, "expected a line of text"),
        ({**GOOD, "version": 0}, "version is 0, expected a whole number from 1"),
        ({**GOOD, "version": True}, "version is True"),
        ({**GOOD, "version": 1.5}, "version is 1.5"),
        ({**GOOD, "colour": "red"}, "a protocol has 'colour'; it knows name, version, title"),
        ({**GOOD, "columns": []}, "columns is empty or missing"),
        ({**GOOD, "columns": {"id": "a"}}, "columns is {'id': 'a'}, expected"),
        ({**GOOD, "columns": ["a"]}, "a column is 'a', expected a"),
        (with_column(at={"rotation": 5}), "column last: there is no fact 'rotation'; expected one"),
        (with_column(at={"fscore_0mm": 0.5}), "there is no fact 'fscore_0mm'"),
        (with_column(at={"fscore_99999mm": 0.5}), "there is no fact"),
        (with_column(at={"fscore_999cm": 0.5}), "the distance of an F-score is 1 to 500 mm, such"),
        (with_column(at={"fscore_501mm": 0.5}), "there is no fact 'fscore_501mm': the distance"),
        (
            with_column(at={}),
            "column last: at is {}, expected facts and their limits, such as at =",
        ),
        (
            with_column(at=5),
            "column last: at is 5, expected facts and their limits, such as at = {",
        ),
        (
            with_column(area=[0, 1]),
            r"column last: area is \[0, 1\], expected facts, from and to, such",
        ),
        (
            with_column(levels=3),
            "column last: levels is 3, expected a fact and a list of limits, such",
        ),
        (
            with_column(ap="iou"),
            "column last: ap is 'iou', expected facts and their limits, such as",
        ),
        (
            with_column(levels={"mspd_px": [5], "iou": [0.5]}),
            "column last: levels of mspd_px and iou, expected one fact",
        ),
        (with_column(at={"iou": 1.1}), "column last: iou is 1.1, expected 0 to 1"),
        (with_column(at={"iou": -0.1}), "iou is -0.1, expected 0 to 1"),
        (with_column(at={"rotation_deg": 181}), "rotation_deg is 181 deg, expected 0 to 180 deg"),
        (with_column(at={"position_m": 200}), "position_m is 200 m, expected 0 to 1 m"),
        (with_column(at={"iou": math.nan}), "iou is nan, expected 0 to 1"),
        (with_column(at={"position_m": math.inf}), "position_m is inf m, expected 0 to 1 m"),
        (with_column(at={"iou": True}), "iou is True, expected a number"),
        (with_column(at={"iou": "0.5"}), "iou is '0.5', expected a number"),
        (with_column(at={"iou": [0.5]}), r"iou is \[0.5\], expected a number"),
        (with_column(area={"iou": 0.5}), r"iou is 0.5, expected \[from, to\]"),
        (with_column(area={"iou": [0.5]}), r"iou is \[0.5\], expected \[from, to\]"),
        (with_column(area={"iou": [0.5, 0.5]}), "iou runs from 0.5 to 0.5"),
        (with_column(area={"iou": [1, 0.5]}), "iou runs from 1 to 0.5, not up"),
        (with_column(area={"iou": [0.5, math.nan]}), "iou is nan"),
        (with_column(area={"iou": [False, True]}), "iou is False, expected a number"),
        (with_column(area={"iou": [0, 1]}, bins=True), "bins is True, expected a whole number"),
        (with_column(area={"iou": [0, 1]}, bins=-1), "bins is -1"),
        (with_column(area={"iou": [0, 1]}, bins=10**9), "bins is 1000000000"),
        (with_column(at={"iou": 0.5}, bins=5, label="x"), "bins belongs? to"),
        (with_column(levels={"mspd_px": 5}), "mspd_px is 5, expected a list of limits"),
        (with_column(levels={"mspd_px": []}), r"mspd_px is \[\], expected a list of limits"),
        (with_column(levels={"mspd_px": [0] * 1001}), "expected a list of limits"),
        (with_column(levels={"mspd_px": [5, 5]}), "the limits on mspd_px do not all rise"),
        (with_column(levels={"mspd_px": [5, 200_000]}), "mspd_px is 200000 px, expected 0 to 1000"),
        (with_column(levels={"iou": [0.5, 1.5]}), "iou is 1.5, expected 0 to 1"),
        (with_column(levels={"mspd_px": [1]}, bins=3), "bins belongs to area"),
        (with_column(median="median"), "there is no fact 'median'"),
        (with_column(median=["iou"]), r"\['iou'\], expected a fact such as 'iou'"),
        (with_column(), "column last has no judgement, expected one of at"),
        (with_column(at={"iou": 0.7}, median="iou"), "column last has at and median, expected one"),
        (with_column(at={"iou": 0.7}, guard="yes"), "guard is 'yes', expected true or false"),
        (with_column(at={"iou": 0.7}, color="red"), "a column has 'color'; it knows id, label"),
        (with_column(at={"iou": 0.7}, id="Last"), "id is 'Last', expected up to 60"),
        (with_column(at={"iou": 0.7}, id="a.b"), "id is 'a.b'"),
        (with_column(at={"iou": 0.7}, id="x" * 61), "expected up to 60"),
        (with_column(at={"iou": 0.7}, id=""), "id is ''"),
        (with_column(at={"iou": 0.7}, id="tight"), "two columns have the id 'tight'"),
        (
            with_column(at={"iou": 0.5}),
            "two columns have the label 'IoU 0.5'; give one another label",
        ),
        (with_column(at={"iou": 0.7}, label="AUC"), "two columns have the label 'AUC'"),
        (with_column(at={"iou": 0.7}, label="\x1b[31m"), "label is .*expected a line of text"),
        (with_column(at={"iou": 0.7}, label=""), "label is '', expected a line of text"),
        (with_column(at={"iou": 0.7}, label=" "), "label is ' '"),
    ],
)
def test_bad_declaration_is_one_clear_sentence(content, told):
    with pytest.raises(ProtocolError, match=f"^here: .*{told}") as caught:
        Protocol.parse(content, "here")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("name = ", "Invalid value"),
        ("name = 'a'\nname = 'b'", "Cannot overwrite a value"),
        ("x = " + "[" * 100_000, "levels deep"),
        ("x = " + "{a = " * 5000, "levels deep"),
        ("# " + "x" * LARGEST_TOML, f"{LARGEST_TOML}"),
        ("name = 'a'\ncolumns = " + "[" * 50 + "]" * 50, "a column is"),
    ],
    ids=["torn", "twice", "deep", "deep tables", "huge", "nested"],
)
def test_file_that_is_no_protocol(tmp_path, text, told):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(ProtocolError, match=told) as caught:
        read_protocol(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_file_that_is_none(tmp_path):
    (tmp_path / "latin.toml").write_bytes(b"name = '\xe9'")
    for name in ("absent.toml", "latin.toml", "."):
        with pytest.raises(ProtocolError, match=str(tmp_path)):
            read_protocol(tmp_path / name)


def test_shipped_protocols_are_sound():
    names = shipped_protocols()
    assert names[0] == PAPER == "cpas"
    assert {"cpas", "nocs", "nocs-legacy", "bop", "best-of-n", "omni6dpose"} | {
        *("omni6dpose-printed", "scale-agnostic")
    } <= set(names)
    for name in names:
        protocol = shipped_protocol(name)
        assert protocol.name == name
        assert protocol.source
    with pytest.raises(ProtocolError, match="no protocol 'bob'; those that ship are cpas, "):
        shipped_protocol("bob")


@pytest.mark.parametrize("name", shipped_protocols())
def test_what_is_declared_is_read_again(name):
    """A column's own words make the same column."""
    protocol = shipped_protocol(name)
    assert Protocol.parse(protocol.declared(), "again") == protocol


def test_readme_of_a_protocol_can_be_written_by_hand():
    """As in pyproject.toml, integers and all."""
    text = """
    name = "mine"
    [[columns]]
    id = "a"
    at = { rotation_deg = 5, fscore_5mm = 1 }
    """
    (column,) = Protocol.parse(tomllib.loads(text), "here").columns
    assert column.label == "5 deg, F(5 mm) 1"
    assert [made.name for made in column.facts] == ["rotation_deg", "fscore_5mm"]


def test_labels_that_are_made_tell_every_fact_apart():
    """Also those of facts with limits in their names; a median's has the unit of its number."""
    names = [*(made.name for made in all_facts()), "fscore_5mm"]
    names += [
        f"{which}_{limits}" for which in ("best", "worst") for limits in ("9deg_2cm", "9deg_3cm")
    ]
    columns = [{"id": f"m{i}", "median": name} for i, name in enumerate(names)]
    columns += [{"id": f"a{i}", "at": {name: 1}} for i, name in enumerate(names)]
    protocol = Protocol.parse({"name": "mine", "columns": columns}, "here")
    for column, name in zip(protocol.columns, names, strict=False):
        assert name not in column.label
        assert column.label.endswith(f" ({fact(name).unit})") is bool(fact(name).unit)
