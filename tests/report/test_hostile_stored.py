"""Reports of strangers: what contradicts itself, or is no value of its place, is refused soon."""

import json
import time
from copy import deepcopy

import pytest
from made_documents import a_run_document
from report_schema import VALIDATOR
from tables import CPAS, GOLDEN, a_parity, a_row, a_run, rows

from pytest_cpas.reading.schemas import check_schema
from pytest_cpas.report.document import document
from pytest_cpas.report.stored import StoredReportError, read_report
from pytest_cpas.types import DataError


def made() -> dict:
    """A report of ten samples, of which one has no answer, beside a golden table."""
    judged = [a_row("s/00", "can", failure="it failed"), *rows(s_03=9.0)[1:]]
    return document([a_run_document(a_run(), judged, GOLDEN, parity=a_parity())], 0, CPAS)


GOOD = made()


def read(tmp_path, content):
    path = tmp_path / "report.json"
    path.write_text(json.dumps(content).replace("Infinity", "1e999"))
    return read_report(path)


def test_sound_one_is_read(tmp_path):
    assert read(tmp_path, GOOD) == json.loads(json.dumps(GOOD))


def run(change):
    return lambda content: change(content["runs"][0])


def sample(**fields):
    return run(lambda r: r["samples"][3].update(fields))


def measured(**fields):
    return run(lambda r: r["precision"][0]["measured"].update(fields))


EDITS = {
    "correct above total": (measured(correct=500), "500 of 5 are correct"),
    "total above judged": (measured(total=6), "more samples than were judged"),
    "correct of no samples": (measured(correct=0), "is not the sum|samples are correct"),
    "golden above total": (
        run(lambda r: r["guards"][0]["golden"].update(correct=6)), "6 of 5 are correct"),
    "all is no sum": (
        run(lambda r: r["precision"][-1]["golden"].update(correct=1)), "is not the sum"),
    "judged": (run(lambda r: r.update(judged=11)), "judged is 11, and its categories have 10"),
    "listed": (run(lambda r: r.update(listed=11)), "listed is 11, and its categories have 10"),
    "judged of a category": (
        run(lambda r: r["categories"]["mug"].update(judged=6)), "judged is 10, and its categor"),
    "more judged than listed": (
        run(lambda r: (r["categories"]["mug"].update(listed=4), r.update(listed=9))), "5 of 4"),
    "unanswered": (run(lambda r: r.update(unanswered=2)), "unanswered is 2, and 1 of its samples"),
    "outcome": (run(lambda r: r.update(outcome="passed")), "outcome is passed, and what it found"),
    "outcome of all": (lambda c: c.update(outcome="passed"), "outcome is passed, and its runs"),
    "run twice": (lambda c: c["runs"].append(c["runs"][0]), "run 'm on d' is there twice"),
    "column twice": (lambda c: c["thresholds"].append(c["thresholds"][0]), "not those|twice"),
    "cell twice": (
        run(lambda r: r["precision"].append(r["precision"][0])), "expected one for each"),
    "cell missing": (run(lambda r: r["guards"].pop()), "expected one for each"),
    "score twice": (run(lambda r: r["scores"].append(r["scores"][0])), "4 cells, expected one"),
    "score of a share": (
        run(lambda r: r["scores"][0].update(measured=2.0, share=True)), "beyond its range"),
    "score below 0": (run(lambda r: r["scores"][0].update(measured=-2.0)), "beyond its range"),
    "score of more": (run(lambda r: r["scores"][0].update(samples=99)), "is of 99 samples"),
    "sample twice": (run(lambda r: r["samples"].append(r["samples"][0])), "'s/00' is there twice"),
    "sample of no category": (sample(category="dog"), "category 'dog' is none"),
    "sample of all": (sample(category="all"), "'all'"),
    "sample without a name": (sample(sample=""), "both need a name"),
    "escape in a name": (sample(sample="a\x1b[2J"), "printable"),
    "row and error": (sample(error="it raised"), "an outcome or an error"),
    "neither": (sample(outcome=None), "an outcome or an error|judged are"),
    "right by outcome alone": (sample(outcome="1" * 11), "samples are correct"),
    "unknown fact": (run(lambda r: r["samples"][3]["facts"].update(bogus=1.0)), "bogus"),
    "unknown definition": (run(lambda r: r["definitions"].update(bogus="x:y:1")), "bogus"),
    "fact below 0": (
        run(lambda r: r["samples"][3]["facts"].update(nad=-1.0)), "nad' is -1.0, which no run"),
    "fact of a failure": (
        run(lambda r: r["samples"][0]["facts"].update(nad=0.1)), "nad' is 0.1, which no run"),
    "fact shown otherwise": (sample(position_m=0.1), "position_m is 0.1, and its fact is"),
    "category all": (run(lambda r: r["categories"].update(all={"judged": 0, "listed": 0})), "all"),
    "category completeness": (
        run(lambda r: r["categories"].update(completeness={"judged": 0, "listed": 0})), "complet"),
    "curve": (
        run(lambda r: r["curves"]["position_m"][0].update(correct=9999)), "9999.*judged samples"),
    "flip in no column": (run(lambda r: r["flips"][0]["lost"].append("x")), "no columns"),
    "parity that parts nowhere": (
        run(lambda r: r["parity"].update(parting=None)), "PARTS AT, and no value that parts"),
    "parity that parts and does not": (
        run(lambda r: r["parity"].update(word="EXACT", outcome="passed")), "EXACT, and a value"),
    "more part than are compared": (
        run(lambda r: r["parity"]["parting"].update(samples=2)), "2 of 1 samples part"),
    "parity passes": (
        run(lambda r: r["parity"].update(outcome="passed")), "passed, and PARTS AT is failed"),
    "method with a path": (run(lambda r: r.update(method="../../x")), "becomes a folder"),
}  # fmt: skip


@pytest.mark.parametrize("edit", EDITS)
def test_contradiction_is_refused(edit, tmp_path):
    change, told = EDITS[edit]
    content = deepcopy(GOOD)
    change(content)
    with pytest.raises(StoredReportError, match=told) as raised:
        read(tmp_path, content)
    assert "report.json" in str(raised.value)


HUGE = {
    "samples that are none": lambda r: r.update(samples=[1] * 300_000),
    "samples that are empty": lambda r: r.update(samples=[{"a": 1}] * 100_000),
    "categories": lambda r: r.update(
        categories={f"c{i}": {"judged": 0, "listed": 0} for i in range(20_000)}, judged=1),
    "columns": lambda r: r["precision"].extend(
        {**r["precision"][0], "threshold": f"t{i}"} for i in range(10_000)),
    "samples twice": lambda r: r.update(samples=r["samples"] * 1_000),
}  # fmt: skip


@pytest.mark.parametrize("part", HUGE)
def test_what_is_wrong_in_much_is_found_soon(part, tmp_path):
    content = deepcopy(GOOD)
    HUGE[part](content["runs"][0])
    start = time.process_time()
    with pytest.raises(StoredReportError):
        read(tmp_path, content)
    assert time.process_time() - start < 3


def test_more_runs_than_anybody_has_are_refused(tmp_path):
    content = deepcopy(GOOD)
    one = {**content["runs"][0], "samples": [], "precision": [], "guards": [], "flips": []}
    content["runs"] = [{**one, "method": f"m{i}"} for i in range(1001)]
    with pytest.raises(StoredReportError, match="1001 runs, at most 1000 are read"):
        read(tmp_path, content)


#: Where JSON Schema has no say.
BEYOND = (10**400, float("inf"), -float("inf"), float("nan"))

VALUES = (*(None, True, 0, -1, 0.5, 2, 10**15), *BEYOND, *("", "x", [], {}, [None], {"a": 1}))


def places(value, path=()):
    """Every place of a JSON value."""
    if path:
        yield path
    if isinstance(value, dict):
        for key, part in value.items():
            yield from places(part, (*path, key))
    elif isinstance(value, list):
        for index, part in enumerate(value):
            yield from places(part, (*path, index))


SCHEMA = VALIDATOR.schema


def thinned(value):
    """A value with the first item of each list alone, unless it is a list of numbers."""
    if isinstance(value, dict):
        return {key: thinned(part) for key, part in value.items()}
    if isinstance(value, list) and value and isinstance(value[0], dict | str):
        return [thinned(part) for part in value[:1]]
    return value


def test_the_schema_is_followed_as_its_own_validator_does():
    seen = [0, 0]
    few = {**thinned(GOOD), "published": {}}
    for path in places(few):
        content = deepcopy(few)
        place = content
        for key in path[:-1]:
            place = place[key]
        for value in VALUES:
            place[path[-1]] = value
            try:
                check_schema(SCHEMA, content, "it")
                sound = True
            except DataError:
                sound = False
            seen[sound] += 1
            if any(value is each for each in BEYOND):
                assert not sound, (path, value)
            else:
                assert sound == VALIDATOR.is_valid(content), (path, value)
    assert min(seen) > 100
