"""Every text of a document, replaced by what strangers write, in every rendering of it."""

import copy

import numpy as np
import pytest
from hostile import (
    ALL,
    KINDS,
    harmless_csv,
    harmless_html,
    harmless_in_a_terminal,
    harmless_markdown,
)
from made_documents import a_run_document
from tables import GOLDEN, REFS, Fixed, a_parity, a_row, a_speed, rows

from pytest_cpas.checks.contract import ContractResult
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.golden import Word
from pytest_cpas.report.against import against
from pytest_cpas.report.document import document
from pytest_cpas.report.export import precision_csv, precision_tex
from pytest_cpas.report.markdown import markdown
from pytest_cpas.report.page import page
from pytest_cpas.report.terminal import Terminal, print_run
from pytest_cpas.report.value_pictures import value_pictures
from pytest_cpas.types import Verdict

#: Keys whose text may be anybody's; those of lists are their own.
FREE = {
    *("method", "dataset", "category", "sample", "other", "name", "check", "message", "details"),
    *("failure", "error", "before", "after", "lines", "missing", "problems", "differences"),
    *("unpaired", "cpu", "device", "system", "python", "versions", "threads", "categories"),
    *("identity", "provenance", "machine", "lacking", "scene", "notes"),
    *("subject", "reference", "value", "stage", "explained_by", "known"),
}

#: Mappings whose keys are names: their texts are all of one kind.
KEYED = ("identity", "provenance", "versions", "definitions")

#: Keys whose text is one of ours, which the schema or another part of the document fixes.
CLOSED = {
    *("outcome", "golden", "threshold", "thresholds", "word", "status", "published_as", "kind"),
    *("clock", "host_source", "published", "lost", "gained", "changed"),
    *("score", "guards", "better", "definitions", "columns"),
}


def a_document() -> dict:
    """One that has every part."""
    judged = [a_row(REFS[0].id, REFS[0].category, failure="no answer"), *rows(s_03=7.0)[1:9]]
    run = Fixed("spd", "real275", REFS, identity={"data": "x"}, missing=["a part"], damaged=["b"])
    made = {
        "errors": {REFS[9].id: "unreadable"},
        "verdicts": [
            Verdict(Word.REGRESSED, "can", "one\n  two"),
            Verdict(Word.MATCHES, "mug", ""),
        ],
        "contract": [
            ContractResult("order", Outcome.VIOLATED, True, "not so"),
            ContractResult("colour", Outcome.VIOLATED, False, "nor so"),
        ],
        "speed": a_speed(0.2),
        "parity": a_parity(),
    }
    content = document([a_run_document(run, judged, GOLDEN, **made)], 1, run.protocols)
    content["runs"][0]["findings"] = [{"category": "can", "name": "frame", "lines": ["do so"]}]
    content["runs"][0]["contract"][0]["status"] = "gone"
    other = document([a_run_document(run, rows(), GOLDEN)], 0, run.protocols)["runs"]
    content["against"] = against(content["runs"], other)
    content["against"]["pairs"][0]["differences"] = ["something"]
    content["against"]["unpaired"] = ["another run"]
    return content


def hostile(content: dict, text: str) -> tuple[dict, set[str]]:
    """The document with ``text`` before everything of others, and the keys of what was replaced.

    The same text is replaced by the same, so that what belongs together still does.
    """
    seen = set()

    def renamed(value, key):
        if isinstance(value, dict):
            return {
                # what stands for all categories, and parts of ours, stay
                (
                    text + k if key in ("categories", "failures", "versions", "threads") else k
                ): renamed(v, key if key in KEYED else k)
                for k, v in value.items()
            }
        if isinstance(value, list):
            return [renamed(each, key) for each in value]
        if not isinstance(value, str) or value == "all":
            return value
        assert key in FREE | CLOSED, f"{key}: say whether its text is ours, {value!r}"
        if key in CLOSED:
            return value
        seen.add(key)
        return text + value

    runs = [renamed(run, "runs") for run in content["runs"]]
    made = {**copy.deepcopy(content), "runs": runs, "against": renamed(content["against"], "")}
    for run in runs:
        run["published_as"] = None
    return {**made, "published": {}}, seen


class Reporter:
    """What stands for pytest's terminal reporter."""

    class config:
        get_verbosity = staticmethod(lambda: 1)

    def __init__(self):
        self.text = ""

    def section(self, title, **_):
        self.text += f"=== {title}\n"

    def write_line(self, line, **_):
        assert "\n" not in line
        self.text += line + "\n"


@pytest.mark.parametrize("text", [*KINDS.values(), ALL])
def test_document_of_hostile_text(text):
    plain, _ = hostile(a_document(), "x")
    content, seen = hostile(a_document(), text)
    assert seen >= {"method", "sample", "failure", "error", "missing", "details", "lines", "cpu"}
    assert seen >= {"notes", "subject", "reference", "value", "stage", "explained_by"}
    assert text in next(iter(content["runs"][0]["failures"]))
    harmless_markdown(markdown(content))
    harmless_csv(precision_csv(content))
    drawn = value_pictures(np.eye(9), np.ones((9, 9)))
    pages = [
        page(each, {}, {(run["method"], run["dataset"]): drawn})
        for each in (content, plain)
        for run in each["runs"]
    ]
    harmless_html(*pages)
    assert pages[0].count("data:image/webp") == 3
    tex = precision_tex(content)
    assert "\\input" not in tex.partition("\n")[2]
    assert tex.count("\n") == precision_tex(plain).count("\n")
    reporter = Reporter()
    for run in content["runs"]:
        print_run(Terminal(reporter), run, text)
    harmless_in_a_terminal(reporter.text)
    assert reporter.text.count("\n") > 20
