"""Results files that contradict themselves, under right checksums."""

import json
from copy import deepcopy

import pytest
from tables import FACTS

from pytest_cpas.evaluation import ResultsError
from pytest_cpas.evaluation.results import FORMAT, checksum_of, read_results
from pytest_cpas.facts import fact

HEADER = {
    "method": "m", "dataset": "d", "shard": "1/1", "selected": 3, "listed": {"mug": 2, "can": 1},
    "missing": [], "damaged": [], "identity": {"data": "x"},
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
