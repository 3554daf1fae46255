"""What all renderers of a document say in the same words."""

from __future__ import annotations

from collections.abc import Sequence

from pytest_cpas.evaluation import THRESHOLDS
from pytest_cpas.report.document import SEVERITY, Document


def outcome_words(outcome: str) -> str:
    """An outcome of a run or a session."""
    return {"failed": "FAILED", "skipped": "NOT CHECKED", "passed": "PASSED"}[outcome]


def judged_words(run: Document) -> str:
    """How many samples a verdict is about."""
    answers = f", {run['unanswered']} without an answer" if run["unanswered"] else ""
    return f"{run['judged']} of {run['listed']} samples judged{answers}"


def verdict_words(verdict: Document) -> str:
    """A verdict on a category, with its details."""
    subject = "" if verdict["category"] == "all" else f" {verdict['category']}"
    return f"{verdict['word']}{subject}: {verdict['details']}"


def contract_words(results: Sequence[Document]) -> str:
    """How many checks of the contract passed, and which did not; empty if none was made."""
    judged = [result for result in results if result["status"] != "n/a"]
    if not judged:
        return ""
    passed = sum(result["status"] in ("passed", "gone") for result in judged)
    parts = [f"contract: {passed} of {len(judged)} checks passed"]
    for status, words in (
        ("violated", "violated"),
        ("known", "known"),
        ("information", "not demanded (information)"),
        ("gone", "known, but no longer violated"),
    ):
        names = [result["check"] for result in judged if result["status"] == status]
        if names:
            parts.append(f"{len(names)} {words}: {', '.join(names)}")
    return "; ".join(parts)


def flip_words(flip: Document) -> str:
    """At which thresholds a sample is judged otherwise than by the golden table."""
    kinds = (("lost", flip["lost"]), ("gained", flip["gained"]), ("n/a changed", flip["changed"]))
    every = len(THRESHOLDS)
    return ". ".join(
        f"{kind} at {'every threshold' if len(labels) == every else '; '.join(labels)}"
        for kind, labels in kinds
        if labels
    )


def golden_words(run: Document) -> str:
    """The verdicts of a run, each word with its categories; what failed stands first."""
    words: dict[str, list[str]] = {}
    for verdict in sorted(run["verdicts"], key=lambda v: SEVERITY.index(v["outcome"])):
        words.setdefault(verdict["word"], []).append(verdict["category"])
    return "; ".join(f"{word} ({', '.join(names)})" for word, names in words.items())


def troubles(run: Document) -> list[tuple[str, list[str]]]:
    """What is wrong with a run, and what was missing, under titles."""
    told = [
        ("Problems of the data set", run["problems"]),
        ("Missing", run["missing"]),
        (
            "Contract of the method",
            [
                f"{result['check']} ({result['status']}): {result['message']}"
                for result in run["contract"]
                if result["status"] in ("violated", "gone")
            ],
        ),
        ("What explains it", [line for entry in run["findings"] for line in entry["lines"]]),
        ("Verdicts", [verdict_words(v) for v in run["verdicts"] if v["outcome"] != "passed"]),
        (
            "Samples that could not be judged",
            [f"{s['sample']}: {s['error']}" for s in run["samples"] if s["error"] is not None],
        ),
    ]
    return [(title, lines) for title, lines in told if lines]
