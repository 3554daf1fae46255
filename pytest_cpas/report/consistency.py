"""Whether the parts of a report agree: what is counted twice must be the same number."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Literal

from pytest_cpas.documents import (
    CountDocument,
    Document,
    ParityDocument,
    PrecisionDocument,
    RunDocument,
    SampleDocument,
)
from pytest_cpas.facts import fact
from pytest_cpas.report.document import run_outcome, short, worst
from pytest_cpas.report.messages import run_title
from pytest_cpas.types import DataError, SampleRef, shown
from pytest_cpas.types.names import checked_name
from pytest_cpas.types.samples import ALL

__all__ = ["check_consistency"]

#: Runs of a report.
_MOST_RUNS = 1000

#: Share of a limit by which rounding may exceed it.
_SLACK = 1e-6

#: The facts of a sample that stand beside the others, as people read them.
_SHOWN: tuple[Literal["position_m", "rotation_deg", "iou", "fscore_1cm"], ...] = (
    *("position_m", "rotation_deg"),
    *("iou", "fscore_1cm"),
)


def check_consistency(document: Document) -> None:
    """Raise :class:`ContractError` that says which part contradicts another one, or is none."""
    runs = document["runs"]
    if len(runs) > _MOST_RUNS:
        raise DataError(f"{len(runs)} runs, at most {_MOST_RUNS} are read")
    columns = [*document["thresholds"], *document["guards"]]
    _once("column", columns)
    _once("run", map(run_title, runs))
    for run in runs:
        for problem in _problems(run, columns, len(document["thresholds"])):
            raise DataError(f"{shown(run_title(run))}: {problem}")
    expected = "failed" if document["failed_items"] else worst(run["outcome"] for run in runs)
    if document["outcome"] != expected:
        raise DataError(f"outcome is {document['outcome']}, and its runs make it {expected}")
    for pair in document.get("against", {"pairs": []})["pairs"]:
        for change in (*pair["precision"], *pair["guards"]):
            before, after = change["before"], change["after"]
            counts = [count for count in (before, after) if count]
            if any(count["correct"] > count["total"] for count in counts) or (
                before and after and before["total"] != after["total"]
            ):
                raise DataError(f"against {shown(pair['other'])}: {shown(change)}: no such counts")


def _once(kind: str, names: Iterable[str]) -> None:
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise DataError(f"{kind} {shown(twice[0])} is there twice")


def _problems(run: RunDocument, columns: list[str], thresholds: int) -> Iterator[str]:
    """What contradicts something else, in words."""
    checked_name("method", run["method"])
    checked_name("data set", run["dataset"])
    for category in run["categories"]:
        SampleRef(id="any", category=category, scene="")  # checks what it is called
    for name in run["definitions"]:
        fact(name)
    for key in ("judged", "listed"):
        told = sum(count[key] for count in run["categories"].values())
        if run[key] != told:
            yield f"{key} is {run[key]}, and its categories have {told}"
    for category, count in run["categories"].items():
        if count["judged"] > count["listed"]:
            yield f"{count['judged']} of {count['listed']} {shown(category)} are judged"
    if run["unanswered"] > run["judged"]:
        yield f"{run['unanswered']} of {run['judged']} judged samples are unanswered"
    if sum(run.get("failures", {}).values()) > run["unanswered"]:
        yield f"{run['unanswered']} samples are unanswered, and more have a reason why"
    judged = {ALL: run["judged"], **{k: n["judged"] for k, n in run["categories"].items()}}
    listed = {ALL: run["listed"], **{k: n["listed"] for k, n in run["categories"].items()}}
    for part, labels in (("precision", columns[:thresholds]), ("guards", columns[thresholds:])):
        entries: list[PrecisionDocument] = run[part]  # type: ignore[literal-required]
        yield from _grid(part, [(e["category"], e["threshold"]) for e in entries], labels)
        yield from _counts(part, entries, judged)
    scores = [(entry["category"], entry["score"]) for entry in run["scores"]]
    yield from _grid("scores", scores, list(dict.fromkeys(label for _, label in scores)))
    for score in run["scores"]:
        values = [value for value in (score["measured"], score["golden"]) if value is not None]
        if any(value < 0 or (score["share"] and value > 1 + _SLACK) for value in values):
            yield f"scores: {shown(score['score'])} is {values}, beyond its range"
        if score["samples"] > listed.get(score["category"], 0):
            yield f"scores: {shown(score['score'])} is of {score['samples']} samples"
    for name, points in run["curves"].items():
        for point in points or ():  # type: ignore[attr-defined]
            if not point["correct"] <= point["total"] <= run["judged"]:
                yield f"curves: {name}: {shown(point)} of {run['judged']} judged samples"
    for flip in run["flips"]:
        if unknown := {*flip["lost"], *flip["gained"], *flip["changed"]} - set(columns):
            yield f"flips: {shown(sorted(unknown))}: no columns of this report"
    if "parity" in run:
        yield from _parity(run["parity"])
    errors = [sample for sample in run["samples"] if sample["error"] is not None]
    if run["samples"]:
        yield from _samples(run, columns, thresholds)
    if run["samples"] or not run["judged"]:
        broken, parity = run["problems"] or errors, run.get("parity")
        outcome = run_outcome(broken, run["contract"], run["speed"], run["verdicts"], parity)
        if run["outcome"] != outcome:
            yield f"outcome is {run['outcome']}, and what it found makes it {outcome}"


def _parity(told: ParityDocument) -> Iterator[str]:
    parting = told["parting"]
    outcome = "passed" if told["word"] in ("EXACT", "FLOAT NOISE") else "failed"
    if told["outcome"] != outcome:
        yield f"parity: {told['outcome']}, and {told['word']} is {outcome}"
    if (parting is None) is (told["word"] == "PARTS AT"):
        yield f"parity: {told['word']}, and {'no' if parting is None else 'a'} value that parts"
    if parting and parting["samples"] > told["compared"]:
        yield f"parity: {parting['samples']} of {told['compared']} samples part"


def _grid(part: str, cells: list[tuple[str, str]], labels: list[str]) -> Iterator[str]:
    """Each category has each column, once."""
    if not cells:
        return
    categories = list(dict.fromkeys(category for category, _ in cells))
    if len(cells) != len(categories) * len(labels) or set(cells) != {
        (category, label) for category in categories for label in labels
    }:
        yield f"{part} has {len(cells)} cells, expected one for each category and column"


def _counts(
    part: str, entries: list[PrecisionDocument], judged: Mapping[str, int]
) -> Iterator[str]:
    sums: dict[tuple[str, str], Counter[str]] = {}
    for entry in entries:
        where = f"{part}: {shown(entry['category'])} at {shown(entry['threshold'])}"
        published = entry["published"]
        if published and not published["lowest"] <= published["highest"] <= published["total"]:
            yield f"{where}: {shown(published)} is no count"
        for key in ("measured", "golden"):
            count: CountDocument | None = entry[key]
            if count is None:
                continue
            if count["correct"] > count["total"]:
                yield f"{where}: {count['correct']} of {count['total']} are correct"
            if key == "measured" and count["total"] > judged.get(entry["category"], 0):
                yield f"{where}: more samples than were judged"
            sign = -1 if entry["category"] == ALL else 1
            total = sums.setdefault((entry["threshold"], key), Counter())
            for name in ("correct", "total"):
                total[name] += sign * count[name]
    for (threshold, key), total in sums.items():
        if any(total.values()):
            yield f"{part}: {shown(threshold)}: {key} of all is not the sum of the categories"


def _samples(run: RunDocument, columns: list[str], thresholds: int) -> Iterator[str]:
    """The samples, and what is counted of them."""
    _once("sample", (sample["sample"] for sample in run["samples"]))
    for sample in run["samples"]:
        yield from _sample(sample, run["categories"], run["definitions"])
    judged = [sample for sample in run["samples"] if sample["outcome"] is not None]
    counts = Counter(sample["category"] for sample in judged)
    unanswered = sum(sample["failure"] is not None for sample in judged)
    if unanswered != run["unanswered"]:
        yield f"unanswered is {run['unanswered']}, and {unanswered} of its samples are"
    for category, count in run["categories"].items():
        if counts[category] != count["judged"]:
            yield f"{shown(category)} has {counts[category]} samples, judged are {count['judged']}"
    found: Counter[tuple[str, str, str]] = Counter()
    for sample in run["samples"]:
        for label, letter in zip(columns, sample["outcome"] or "", strict=False):
            for category in (sample["category"], ALL):
                found[category, label, letter] += 1
    for entry in (*run["precision"], *run["guards"]):
        right, wrong = (found[entry["category"], entry["threshold"], letter] for letter in "10")
        told = entry["measured"] or {"correct": 0, "total": 0}
        if (told["correct"], told["total"]) != (right, right + wrong):
            where = f"{shown(entry['category'])} at {shown(entry['threshold'])}"
            yield f"{where}: {shown(told)}, and {right} of {right + wrong} samples are correct"


def _sample(
    sample: SampleDocument, categories: Collection[str], definitions: Collection[str]
) -> Iterator[str]:
    where = f"sample {shown(sample['sample'])}"
    SampleRef(id=sample["sample"], category=sample["category"], scene="")  # checks both
    if sample["category"] not in categories:
        yield f"{where}: category {shown(sample['category'])} is none of the run's"
    if (sample["outcome"] is None) is (sample["error"] is None):
        yield f"{where}: expected an outcome or an error"
    facts = sample["facts"]
    if unknown := sorted(facts.keys() - set(definitions)):
        yield f"{where}: {shown(unknown)} are no facts of the run"
    for name, value in facts.items():
        failed = sample["failure"] is not None
        if value is not None and (failed or not 0 <= value <= fact(name).most * (1 + _SLACK)):
            yield f"{where}: {shown(name)} is {value}, which no run gives"
    for name in _SHOWN:
        value = facts.get(name)
        if sample[name] != (None if value is None else short(value)):
            yield f"{where}: {name} is {sample[name]}, and its fact is {value}"
