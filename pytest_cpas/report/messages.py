"""The sentences of a report: all renderers of a document have them from here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pytest_cpas.checks.contract import CONTRACT
from pytest_cpas.documents import (
    ChangeDocument,
    ContractDocument,
    ContractStatus,
    FlipDocument,
    IntervalDocument,
    ItemOutcome,
    MemoryDocument,
    PairDocument,
    ParityDocument,
    RunDocument,
    RunName,
    SpeedDocument,
    StageDocument,
    VerdictDocument,
)
from pytest_cpas.report.document import SEVERITY
from pytest_cpas.types import shortened, some_of
from pytest_cpas.types.samples import ALL

_OUTCOMES: Mapping[ItemOutcome, str] = {
    "failed": "FAILED",
    "skipped": "NOT DECIDED",
    "passed": "PASSED",
}

#: How the results of contract checks that did not pass are announced.
_STATUSES: Mapping[ContractStatus, str] = {
    "violated": "violated",
    "known": "known",
    "information": "not demanded (information)",
    "gone": "known, but no longer violated",
}


def outcome_message(outcome: ItemOutcome) -> str:
    """An outcome of a run or a session."""
    return _OUTCOMES[outcome]


def run_title(run: RunName) -> str:
    """What a run is called."""
    return f"{run['method']} on {run['dataset']}"


def method_title(name: str, paper: bool) -> str:
    """What a method is called beside others; ``paper``: its figures are those printed there."""
    return f"{name} (paper)" if paper else name


def judged_message(run: RunDocument) -> str:
    """How many samples a verdict is about."""
    answers = f", {run['unanswered']} without an answer" if run["unanswered"] else ""
    kinds = [f"{count} {shortened(why, 80)}" for why, count in run.get("failures", {}).items()]
    why = f": {some_of(kinds)}" if kinds else ""
    return f"{run['judged']} of {run['listed']} samples judged{answers}{why}"


def verdict_message(verdict: VerdictDocument) -> str:
    """A verdict on a category, with its details."""
    subject = "" if verdict["category"] == ALL else f" {verdict['category']}"
    return f"{verdict['word']}{subject}: {verdict['details']}"


def contract_message(results: Sequence[ContractDocument]) -> str:
    """How many checks of the contract passed, and which did not; empty if none was made."""
    judged = [result for result in results if result["status"] != "n/a"]
    if not judged:
        return ""
    passed = sum(result["status"] in ("passed", "gone") for result in judged)
    parts = [f"contract: {passed} of {len(judged)} checks passed"]
    for status, announced in _STATUSES.items():
        names = [result["check"] for result in judged if result["status"] == status]
        if names:
            parts.append(f"{len(names)} {announced}: {', '.join(names)}")
    if lacking := CONTRACT.keys() - {result["check"] for result in results}:
        parts.append(f"{len(lacking)} were not made, or raised: {some_of(sorted(lacking))}")
    return "; ".join(parts)


def flip_message(flip: FlipDocument, every: int) -> str:
    """In which of ``every`` column a sample is judged otherwise than by the golden table."""
    kinds = (("lost", flip["lost"]), ("gained", flip["gained"]), ("n/a changed", flip["changed"]))
    return ". ".join(
        f"{kind} at {'every threshold' if len(labels) == every else '; '.join(labels)}"
        for kind, labels in kinds
        if labels
    )


def worst_flips_first(flips: Sequence[FlipDocument]) -> list[FlipDocument]:
    """Flips that lost most thresholds first."""
    return sorted(flips, key=lambda flip: len(flip["gained"]) - len(flip["lost"]))


def pair_title(pair: PairDocument) -> str:
    """What is compared with what."""
    other = "" if pair["other"] == pair["method"] else f" {pair['other']}"
    return f"{pair['method']} on {pair['dataset']} against{other or ' the other run'}"


def pair_lines(pair: PairDocument) -> list[str]:
    """On which samples two runs are compared, and what else differs between them."""
    count = pair["common"]
    lines = [f"{count} samples judged in both" if count else "no sample was judged in both"]
    if pair["only_here"]:
        lines[0] += f"; {pair['only_here']} in this run only"
    if pair["only_there"]:
        lines[0] += f"; {pair['only_there']} in the other run only"
    return [*lines, *pair["differences"]]


def change_messages(change: ChangeDocument) -> tuple[str, str]:
    """What changed in a cell of two runs: the precisions, and the flips with their probability."""
    before, after = change["before"], change["after"]
    if before is None or after is None:
        return "n/a", ""
    old, new = (100 * count["correct"] / count["total"] for count in (before, after))
    precision = f"{old:.1f} → {new:.1f} % ({new - old:+.1f})"
    if change["p"] is None:
        return precision, "no flip"
    return precision, f"{change['lost']} lost, {change['gained']} gained, p = {change['p']:.2g}"


def verdicts_message(run: RunDocument) -> str:
    """The verdicts of a run, each word with its categories; what failed stands first."""
    categories: dict[str, list[str]] = {}
    for verdict in sorted(run["verdicts"], key=lambda v: SEVERITY.index(v["outcome"])):
        categories.setdefault(verdict["word"], []).append(verdict["category"])
    return "; ".join(f"{word} ({', '.join(names)})" for word, names in categories.items())


def parity_lines(parity: ParityDocument) -> list[str]:
    """The verdict on two codes, line by line."""
    subject = "" if parity["subject"] == ALL else f" {parity['subject']}"
    return f"{parity['word']}{subject}: {parity['details']}".splitlines()


def parity_message(parity: ParityDocument) -> str:
    """The word, and where."""
    subject = "" if parity["subject"] == ALL else f" {parity['subject']}"
    return f"parity with {parity['reference']}: {parity['word']}{subject}"


def speed_lines(speed: SpeedDocument) -> list[str]:
    """What --cpas-benchmark measured; the verdict stands first."""
    verdict, reference, machine = speed["verdict"], speed["reference"], speed["machine"]
    lines = [
        f"{verdict['word']}: {verdict['details']}",
        f"{_seconds(speed['seconds'])} per sample, median of {speed['rounds']} rounds with"
        f" {speed['samples']} samples (mean {duration_message(speed['mean_seconds'])});"
        f" {_factor(speed['ratio'])} times the {reference['kind']} {reference['name']}",
    ]
    if speed["stages"]:
        lines.append("; ".join(map(_stage, speed["stages"])))
    if "transfer_seconds" in speed:
        way = duration_message(speed["transfer_seconds"])
        lines.append(f"beside it, {way} for the way to its interpreter and back")
    cores = "core" if machine["cores"] == 1 else "cores"
    device = "" if machine["device"] == "cpu" else f", {machine['device']}"
    lines.append(
        f"on {machine['cpu']}, {machine['cores']} {cores}{device}; {_memory(speed['memory'])}"
    )
    if paper := speed["published"]:
        lines.append(
            f"the paper: {duration_message(paper['mean_seconds'])} (mean) per sample of"
            f" {paper['dataset']}, on {paper['machine']}"
        )
    return lines


def duration_message(seconds: float) -> str:
    """A time in the unit that suits it."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} us"


def _seconds(interval: IntervalDocument) -> str:
    low, high = duration_message(interval["lower"]), duration_message(interval["upper"])
    return f"{duration_message(interval['median'])} ({low} to {high})"


def _factor(interval: IntervalDocument) -> str:
    return f"{interval['median']:.3g} ({interval['lower']:.3g} to {interval['upper']:.3g})"


def _stage(stage: StageDocument) -> str:
    return f"{stage['name']} {duration_message(stage['seconds'])} ({100 * stage['share']:.0f} %)"


def _memory(memory: MemoryDocument) -> str:
    if memory["host_bytes"] is None:
        peak = "peak memory unknown"
    else:
        since = "" if memory["host_source"] == "predictions" else " since the process began"
        peak = f"peak memory {memory['host_bytes'] / 2**20:.0f} MiB{since}"
    if memory["device_bytes"] is not None:
        peak += f", {memory['device_bytes'] / 2**20:.0f} MiB on the device"
    return peak


def troubles(run: RunDocument) -> list[tuple[str, list[str]]]:
    """What is wrong with a run, what was missing and what was noticed, under titles."""
    speed = run["speed"]
    sections = [
        ("Problems of the data set", run["problems"]),
        ("Missing", run["missing"]),
        ("Noticed", run.get("notes", [])),
        (
            "Contract of the method",
            [
                f"{result['check']} ({result['status']}): {result['message']}"
                for result in run["contract"]
                if result["status"] in ("violated", "gone")
            ],
        ),
        ("What explains it", [line for entry in run["findings"] for line in entry["lines"]]),
        (
            "Speed",
            speed_lines(speed)[:1] if speed and speed["verdict"]["outcome"] == "failed" else [],
        ),
        ("Verdicts", [verdict_message(v) for v in run["verdicts"] if v["outcome"] != "passed"]),
        (
            "Samples that could not be judged",
            [f"{s['sample']}: {s['error']}" for s in run["samples"] if s["error"] is not None],
        ),
    ]
    return [(title, lines) for title, lines in sections if lines]
