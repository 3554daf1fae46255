"""Results files that contradict themselves, under right checksums."""

import base64
import json
from copy import deepcopy

import pytest
from tables import FACTS

from pytest_cpas.checks.contract import CONTRACT as CHECKS
from pytest_cpas.evaluation import ResultsError, results
from pytest_cpas.evaluation.merging import MergedRun
from pytest_cpas.evaluation.result_lines import LONGEST_TEXT
from pytest_cpas.evaluation.results import FORMAT, checksum_of, read_results
from pytest_cpas.facts import fact
from pytest_cpas.session.contract_stage import StoredStage
from pytest_cpas.types.errors import LONGEST_MESSAGE

HEADER = {
    "method": "m", "dataset": "d", "shard": "1/1", "selected": 3, "listed": {"mug": 2, "can": 1},
    "missing": [], "derived": "", "damaged": [], "identity": {"data": "x"},
    "definitions": {name: fact(name).definition for name in FACTS}, "provenance": {},
    "files": {}, "seeds": 2, "under_contract": False, "nonce": "00",
}  # fmt: skip
ANSWER = {"facts": FACTS, "failure": None, "estimate": None}


def a_line(name: str, category: str) -> dict:
    row = {"answers": [deepcopy(ANSWER), deepcopy(ANSWER)], "shape": None}
    return {"row": row, "ref": [name, category, "s", ""]}


def values() -> list[dict]:
    header = {"header": deepcopy(HEADER), "format": FORMAT}
    error = {"error": "it raised", "ref": ["s/2", "can", "s", ""]}
    return [header, a_line("s/0", "mug"), a_line("s/1", "mug"), error]


def read(tmp_path, lines):
    made, last = b"", b""
    for line in lines:
        text = line if isinstance(line, bytes) else json.dumps(line).encode()
        last = checksum_of(last, text)
        made += last + b" " + text + b"\n"
    path = tmp_path / "m-d.jsonl"
    path.write_bytes(made)
    return read_results(path)


def test_sound_one_is_read(tmp_path):
    assert len(read(tmp_path, values()).rows) == 2


def header(**fields):
    return lambda lines: lines[0]["header"].update(fields)


def answers(change):
    return lambda lines: change(lines[2]["row"]["answers"])


EDITS = {
    "listed less": (header(listed={"mug": 1, "can": 2}), "mug has 2, and its header lists 1"),
    "listed other": (header(listed={"dog": 9}), "can has 1, and its header lists 0"),
    "listed none": (header(listed={}), "its header lists 0"),
    "listed all": (header(listed={"all": 3, "mug": 2, "can": 1}), "line 1: .*'all'"),
    "listed completeness": (header(listed={"completeness": 9}), "line 1: .*'completeness'"),
    "listed no name": (header(listed={"": 9}), "line 1: .*both need a name"),
    "listed escape": (header(listed={"a\x1b": 9}), "line 1: .*printable"),
    "listed 10**400": (header(listed={"mug": 10**400}), "line 1: .*more than 256 digits"),
    "selected less": (header(selected=2), "it has 3, and its header selects 2"),
    "selected more": (header(selected=4), "selects 4 of the 3 that it lists"),
    "seeds more": (header(seeds=3), "line 2: .*2 answers, expected one for each of 3 seeds"),
    "seeds less": (header(seeds=1), "line 2: .*2 answers, expected one for each of 1 seeds"),
    "seeds of one row": (answers(list.pop), "line 3: .*1 answers"),
    "definitions none": (header(definitions={}), "line 2: .*does not define"),
    "facts of one row": (answers(lambda a: a[0]["facts"].pop("nad")), "line 3: .*'nad'"),
    "facts of one answer": (answers(lambda a: a[1]["facts"].pop("iou")), "line 3: .*'iou'"),
    "shape of too many points": (
        lambda lines: lines[1]["row"].update(shape=base64.b64encode(bytes(24 + 3 * 401)).decode()),
        "line 2: .*a shape of 401 points, at most 400 are kept",
    ),
    "message without end": (
        lambda lines: lines[3].update(error="x" * (LONGEST_TEXT + 1)),
        f"line 4: .*text of {LONGEST_TEXT + 1} characters, expected at most {LONGEST_TEXT}",
    ),
    "digits of other scripts": (header(shard="\u0661/\u0661"), "line 1: .*expected i/n"),
    "as far as floats go": (
        answers(lambda a: a[0]["facts"].update(position_m=1e308)),
        r"line 3: .*1e\+308, expected a number from 0 to 1e\+31",
    ),
    **{
        f"line of another kind, {line}": (
            lambda lines, line=line: lines.append(line),
            "line 5: .*the line is .*, expected ref and row; or error and ref; or contract; or",
        )
        for line in (
            [],
            5,
            None,
            "row",
            {},
            {"ref": ["s/2", "can", "s", ""]},
            {"contract": 1, "x": 1},
        )
    },
    "no header first": (lambda lines: lines.pop(0), "line 1: .*expected format and header"),
    "twice": (lambda lines: lines.append(lines[1]), "line 5: .*has a row already"),
}


@pytest.mark.parametrize("edit", EDITS)
def test_contradiction_is_refused(edit, tmp_path):
    change, told = EDITS[edit]
    lines = values()
    change(lines)
    with pytest.raises(ResultsError, match=told) as raised:
        read(tmp_path, lines)
    assert "m-d.jsonl" in str(raised.value)


def test_a_line_that_was_cut_off_late_is_refused(tmp_path, monkeypatch):
    """Of a file of zeros, of which a disk keeps nothing, no copy is made either."""
    path = read(tmp_path, values()).path
    with path.open("ab") as file:
        file.write(b"0" * 100)
    assert len(read_results(path).rows) == 2
    monkeypatch.setattr(results, "LARGEST_JSON", 99)
    with pytest.raises(
        ResultsError, match=r"m-d\.jsonl: its last line was cut off after 100 bytes"
    ):
        read_results(path)


CONTRACT = {
    "check": "answers", "outcome": "passed", "demanded": True, "message": "", "known": False,
    "recorded": False,
}  # fmt: skip


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("check", "no\x1bne", r"the contract has no check 'no\\x1bne'; its checks are answers, "),
        ("outcome", "victory", r"check answers ended with 'victory', expected one of passed, "),
        ("outcome", "PASSED", "expected one of"),
        ("message", "x" * 10**5, None),
    ],
)
def test_contract_that_no_check_finds_is_refused(field, value, told, tmp_path):
    """And a message without end is cut short, as it is where it is made."""
    lines = [*values(), {"contract": {**CONTRACT, field: value}}]
    run = MergedRun([read(tmp_path, lines)])
    if told is None:
        assert len(StoredStage(run).result(CHECKS["answers"]).message) == LONGEST_MESSAGE
        return
    with pytest.raises(ResultsError, match=told) as raised:
        StoredStage(run)
    assert "m-d.jsonl" in str(raised.value)


def test_what_is_missing_without_end_is_cut_short(tmp_path):
    lines = values()
    lines[0]["header"]["missing"] = ["x" * 3000] * 2000
    missing = MergedRun([read(tmp_path, lines)]).missing
    assert len(missing) == 1001
    assert missing[-1] == "and 1000 more"
    assert {len(line) for line in missing[:-1]} == {LONGEST_MESSAGE}


def keys_of(value, path=()):
    """The path of every object of a JSON value that has keys."""
    if isinstance(value, dict):
        if value:
            yield path
        for key, part in value.items():
            yield from keys_of(part, (*path, key))
    elif isinstance(value, list):
        for index, part in enumerate(value):
            yield from keys_of(part, (*path, index))


def with_key_twice(line, path) -> bytes:
    """The text of a line in which the first key of an object is there twice."""
    line = deepcopy(line)
    place = line
    for key in path:
        place = place[key]
    first = next(iter(place))
    place["@@@"] = place[first]
    return json.dumps(line).replace('"@@@"', json.dumps(first)).encode()


PLACES = [(number, path) for number, line in enumerate(values()) for path in keys_of(line)]


@pytest.mark.parametrize(("number", "path"), PLACES, ids=str)
def test_key_that_is_there_twice_is_refused(number, path, tmp_path):
    lines = values()
    lines[number] = with_key_twice(lines[number], path)
    with pytest.raises(ResultsError, match=rf"line {number + 1}: .* is there twice"):
        read(tmp_path, lines)
