"""What all renderers of a document say in the same words."""

from __future__ import annotations

from collections.abc import Sequence

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


def golden_words(run: Document) -> str:
    """The verdicts of a run, each word with its categories; what failed stands first."""
    words: dict[str, list[str]] = {}
    for verdict in sorted(run["verdicts"], key=lambda v: SEVERITY.index(v["outcome"])):
        words.setdefault(verdict["word"], []).append(verdict["category"])
    return "; ".join(f"{word} ({', '.join(names)})" for word, names in words.items())
