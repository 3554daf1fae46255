"""Golden tables from the texts of their files, of which every number is checked.

What the facts and the detections say must be what a run can give; all the rest follows from them:
it is written anew and compared.
"""

from __future__ import annotations

import io
import itertools
import math
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from operator import itemgetter
from typing import Any

from pytest_cpas.evaluation import Answer
from pytest_cpas.facts import Fact, fact
from pytest_cpas.golden.noise import FactNoise, Noise
from pytest_cpas.golden.tables import GoldenError, NewerError, RunTable, table_samples
from pytest_cpas.golden.texts import (
    DETECTION,
    DETECTIONS,
    FACTS,
    FAILURE,
    FORMAT,
    KEYS,
    RUN,
    protocol_file,
    table_texts,
)
from pytest_cpas.protocols import Protocol, ProtocolError, RankedDetection, Ranking, ranking_columns
from pytest_cpas.reading.files import lines_of
from pytest_cpas.reading.structured import parse_toml
from pytest_cpas.reading.tables import csv_lines, real
from pytest_cpas.types import DataError, SampleRef, shown
from pytest_cpas.types._arrays import MAX

__all__ = ["checked_fact", "file_names", "parse_table"]

#: Lines of a table with commas: the number and the fields of each.
Rows = Iterator[tuple[int, list[str]]]

#: Share of a limit by which rounding may exceed it.
_SLACK = 1e-9

#: Protocols that a table may be judged under.
_MOST_PROTOCOLS = 100


def parse_table(method: str, dataset: str, texts: Mapping[str, str]) -> RunTable:
    """A table from the texts of its files, by name.

    Raises :class:`GoldenError` if they are not, or do not belong together.
    """
    content = run_content(texts[RUN])
    protocols = tuple(_protocol(name, texts) for name in protocol_names(content))
    with telling():
        facts = csv_rows(FACTS, texts[FACTS])
        detections = csv_rows(DETECTIONS, texts[DETECTIONS]) if is_ranked(content) else None
        table = table_of(method, dataset, content, protocols, facts, detections)
        again = table_texts(table)
    check_same(again, texts)
    return table


def run_content(text: str) -> dict[str, Any]:
    """What ``run.toml`` holds, of a format that is read; raises :class:`GoldenError`."""
    content = toml(RUN, text)
    told = content.get("format")
    if type(told) is int and told > FORMAT:
        raise NewerError(
            f"{RUN}: format {shown(told)} is of a newer version of pytest-cpas than this, which"
            f" reads {FORMAT}; update it"
        )
    if told != FORMAT:
        raise GoldenError(f"{RUN}: format is {shown(told)}, this version reads {FORMAT}")
    return content


@contextmanager
def telling() -> Iterator[None]:
    """What is wrong with a text is a :class:`GoldenError`."""
    try:
        yield
    except ValueError as error:  # DataError is one
        raise GoldenError(str(error)) from error


def table_of(
    method: str,
    dataset: str,
    content: Mapping[str, Any],
    protocols: Sequence[Protocol],
    facts: Rows,
    detections: Rows | None,
) -> RunTable:
    """A table from what is told of its run and the lines of facts and detections.

    Raises :class:`GoldenError`, ValueError for a line that is not what a run gives.
    """
    seeds = content.get("seeds")
    if type(seeds) is not int or not 1 <= seeds < 2**31:
        raise GoldenError(f"{RUN}: seeds is {shown(seeds)}, expected at least 1")
    sections = {name: content.get(name, 0) for name in ("identity", "definitions", "provenance")}
    for section in sections.values():
        if not isinstance(section, dict) or not all(isinstance(v, str) for v in section.values()):
            raise GoldenError(f"{RUN}: {', '.join(sections)} must be tables of strings")
    categories = content.get("categories", {})
    if not isinstance(categories, dict) or not all(
        isinstance(v, dict) for v in categories.values()
    ):
        raise GoldenError(f"{RUN}: categories must be tables")
    answers = _read_facts(facts, seeds)
    ranking = None
    if detections is not None:
        ranking = _read_ranking(detections, categories, protocols)
        _check_ranking(ranking, Counter(category for category, _ in answers.values()))
    return RunTable(
        method=method,
        dataset=dataset,
        identity=sections["identity"],
        definitions=sections["definitions"],
        provenance=sections["provenance"],
        protocols=tuple(protocols),
        samples=table_samples(protocols, answers),
        listed=Counter(category for category, _ in answers.values()),
        seeds=seeds,
        ranking=ranking,
        own_provenance=_own_provenance(categories),
        noise=_noise(content.get("noise", {})),
    )


def check_same(again: Mapping[str, str], texts: Mapping[str, str]) -> None:
    """:class:`GoldenError` unless the texts are as they are written."""
    for name in again:
        if again[name] != texts.get(name):
            told = (
                f"{name} is not as it is written"
                if name in (FACTS, DETECTIONS)
                else f"{name} is not what follows from the other files: one of them was edited"
            )
            raise GoldenError(told)


def _own_provenance(categories: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, str]]:
    """That of categories which were recorded by a run of their own."""
    told = {}
    for category, section in categories.items():
        own = section.get("provenance", {})
        if not isinstance(own, dict) or not all(isinstance(value, str) for value in own.values()):
            raise GoldenError(f"{RUN}: [categories.{category}] is not what is recorded")
        if own:
            told[category] = own
    return told


def _noise(section: Any) -> Noise:
    """What was measured on other platforms."""
    try:
        if not section:
            return Noise()
        platforms, facts = section["platforms"], section.get("facts", {})
        if not all(isinstance(each, str) for each in platforms):
            raise TypeError
        made = {}
        for name, told in facts.items():
            fact(name)
            compared, sizes = told["compared"], tuple(map(float, told["sizes"]))
            falls = all(a >= b > 0 for a, b in itertools.pairwise((math.inf, *sizes)))
            if type(compared) is not int or not 2 ** len(sizes) // 2 <= compared or not falls:
                raise TypeError
            made[name] = FactNoise(compared, sizes)
        return Noise(tuple(platforms), made)
    except (KeyError, TypeError, AttributeError, ValueError):
        raise GoldenError(f"{RUN}: [noise] is not what is recorded") from None


def file_names(contents: Iterable[Mapping[str, Any]]) -> list[str]:
    """The files besides ``run.toml`` that hold tables of which this is told; raises
    :class:`GoldenError`."""
    contents = list(contents)
    ranked = [DETECTIONS] if any(is_ranked(content) for content in contents) else []
    names = dict.fromkeys(name for content in contents for name in protocol_names(content))
    return [FACTS, *ranked, *map(protocol_file, names)]


def protocol_names(content: Mapping[str, Any]) -> list[str]:
    """The protocols that a table is judged under; raises :class:`GoldenError`."""
    names = content.get("protocols")
    if (
        not isinstance(names, list)
        or not all(isinstance(n, str) and re.fullmatch("[a-z][a-z0-9-]{0,39}", n) for n in names)
        or not 0 < len(names) == len(set(names)) <= _MOST_PROTOCOLS
    ):
        raise GoldenError(
            f"{RUN}: protocols is {shown(names)}, expected different names, at most"
            f" {_MOST_PROTOCOLS}"
        )
    return names


def is_ranked(content: Mapping[str, Any]) -> bool:
    """Whether there are detections; raises :class:`GoldenError` if that is not told."""
    ranked = content.get("detections")
    if not isinstance(ranked, bool):
        raise GoldenError(f"{RUN}: detections is {shown(ranked)}, expected true or false")
    return ranked


def toml(name: str, text: str) -> dict[str, Any]:
    """What a text holds; raises :class:`GoldenError`."""
    try:
        return parse_toml(name, text)
    except DataError as error:
        raise GoldenError(str(error)) from error


def _protocol(name: str, texts: Mapping[str, str]) -> Protocol:
    """A protocol of the table."""
    file = protocol_file(name)
    if file not in texts:
        raise GoldenError(f"{file} is missing")
    content = toml(file, texts[file])
    content.pop("cells", None)
    return protocol_of(name, content)


def protocol_of(name: str, content: Mapping[str, Any]) -> Protocol:
    """The protocol of this name from what its file tells; raises :class:`GoldenError`."""
    file = protocol_file(name)
    try:
        protocol = Protocol.parse(content, file)
    except ProtocolError as error:
        raise GoldenError(str(error)) from error
    if protocol.name != name:
        raise GoldenError(f"{file}: name is {protocol.name!r}, expected {name!r}")
    return protocol


def csv_rows(name: str, text: str) -> Rows:
    """The lines of a table with commas, and their numbers; the columns first."""
    return csv_lines(name, lines_of(io.StringIO(text, newline=""), name))


def _read_facts(lines: Rows, seeds: int) -> dict[str, tuple[str, tuple[Answer, ...]]]:
    """The category and the answers of each sample."""
    _, head = next(lines, (0, []))
    first, names, last = head[: len(KEYS)], head[len(KEYS) : -1], head[-1:]
    if (*first, *last) != (*KEYS, FAILURE):
        raise ValueError(f"{FACTS}: expected {', '.join(KEYS)}, facts and {FAILURE}")
    in_catalogue = [fact(name) for name in names]
    answers: dict[str, tuple[str, list[Answer]]] = {}
    for number, line in filter(itemgetter(1), lines):
        if len(line) != len(head):
            raise ValueError(f"{FACTS}, line {number}: {len(line)} fields, expected {len(head)}")
        category, name, seed = line[: len(KEYS)]
        failed = bool(line[-1])
        try:
            facts = {
                made.name: checked_fact(value, made, failed=failed)
                for made, value in zip(in_catalogue, line[len(KEYS) : -1], strict=True)
            }
            if name not in answers:
                SampleRef(id=name, category=category, scene="")  # checks both
        except ValueError as error:
            raise ValueError(f"{FACTS}, line {number}: {error}") from None
        own, given = answers.setdefault(sys.intern(name), (sys.intern(category), []))
        if own != category or seed != str(len(given)):
            raise ValueError(f"{FACTS}, line {number}: sample {name}, seed {seed}: out of order")
        given.append(Answer(facts=facts, failure=line[-1] or None))
    for name, (_, given) in answers.items():
        if len(given) != seeds:
            raise ValueError(f"{FACTS}: sample {name} has {len(given)} seeds, expected {seeds}")
    return {name: (category, tuple(given)) for name, (category, given) in answers.items()}


def checked_fact(text: str, made: Fact, *, failed: bool) -> float | None:
    """The fact that a field holds, None if it is empty; ValueError for what no run gives.

    Of an answer that ``failed`` it meets no limit; of any other it is in its range.
    """
    if not text:
        return None
    number = real(text, -math.inf, math.inf)
    if number == made.failed if failed else 0 <= number <= min(made.most * (1 + _SLACK), MAX):
        return number
    expected = f"{made.failed} where there is a failure" if failed else f"0 to {made.most:g}"
    raise ValueError(f"{made.name} is {shown(text)}, expected {expected}")


def _read_ranking(lines: Rows, stated: Mapping[str, Any], protocols: Sequence[Protocol]) -> Ranking:
    columns = len(ranking_columns(protocols))
    if tuple(next(lines, (0, ()))[1]) != DETECTION:
        raise ValueError(f"{DETECTIONS}: expected the columns {', '.join(DETECTION)}")
    detections: dict[str, RankedDetection] = {}
    for number, line in filter(itemgetter(1), lines):
        if len(line) != len(DETECTION) or not re.fullmatch(f"[01-]{{{columns}}}", line[-1]):
            raise ValueError(f"{DETECTIONS}, line {number}: expected {', '.join(DETECTION)}")
        category, name, score, outcome = line
        try:
            SampleRef(id=name, category=category, scene="")  # checks both
            value = real(score, -MAX, MAX)
        except ValueError as error:
            raise ValueError(f"{DETECTIONS}, line {number}: {error}") from None
        detections[name] = RankedDetection(sys.intern(category), value, sys.intern(outcome))
    counted = {
        category: tuple(numbers)
        for category, told in stated.items()
        if isinstance(numbers := told.get("counted"), list) and numbers
    }
    for category, numbers in counted.items():
        if len(numbers) != columns or not all(type(n) is int and n >= 0 for n in numbers):
            raise ValueError(
                f"{RUN}: counted of {shown(category)} is {shown(numbers)}, expected {columns}"
                " counts"
            )
    return Ranking(detections, counted)


def _check_ranking(ranking: Ranking, samples: Mapping[str, int]) -> None:
    """ValueError unless objects are counted that there are, and no more detections are right."""
    right: dict[str, Counter[int]] = {}
    for detection in ranking.detections.values():
        places = (i for i, letter in enumerate(detection.outcome) if letter == "1")
        right.setdefault(detection.category, Counter()).update(places)
    for category in sorted({*right, *ranking.counted}):
        counted = ranking.counted.get(category, ())
        most = samples.get(category, 0)
        if max(counted, default=0) > most:
            raise ValueError(
                f"{RUN}: counted of {category} is {max(counted)}, but {FACTS} has {most} samples"
            )
        for index, number in right.get(category, Counter()).items():
            if number > (objects := counted[index] if counted else 0):
                raise ValueError(
                    f"{DETECTIONS}: {number} detections of {category} are right in column"
                    f" {index + 1}, but {RUN} counts {objects} objects"
                )
