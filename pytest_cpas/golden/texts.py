"""The texts of a golden table's files.

``run.toml``: what the table is of, and a digest of the facts of each category. ``facts.csv``: one
line per sample and seed, sorted by category. ``detections.csv``: one line per detection, where a
protocol ranks them: how sure it is, and in which columns it is right. ``PROTOCOL.toml``: what the
columns of a protocol are, and one cell per line. No text says anything that two changes of
different categories would both have to change, and none of theirs stand side by side, so that they
can be merged line by line.

All but the facts and the detections follows from those: on reading it is written anew and compared.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from typing import Any

from pytest_cpas._files import toml_string
from pytest_cpas.evaluation import Answer
from pytest_cpas.facts import Fact, fact
from pytest_cpas.golden.tables import GoldenError, RunTable, table_samples
from pytest_cpas.protocols import Protocol, ProtocolError, RankedDetection, Ranking, ranking_columns
from pytest_cpas.reading.files import lines_of
from pytest_cpas.reading.structured import parse_toml
from pytest_cpas.reading.tables import csv_lines, real
from pytest_cpas.types import DataError
from pytest_cpas.types.names import checked_text
from pytest_cpas.types.samples import ALL

__all__ = ["FORMAT", "RUN", "file_names", "parse_table", "table_texts"]

FORMAT = 3

#: The files of a table, besides one for each protocol.
RUN, FACTS, DETECTIONS = "run.toml", "facts.csv", "detections.csv"

_TITLE = "# Recorded by pytest-cpas; --snapshot-update records it anew."

#: The columns of ``facts.csv`` before the facts; the last one is why there is no answer.
_KEYS, _FAILURE = ("category", "sample", "seed"), "failure"

#: The columns of ``detections.csv``.
_DETECTION = ("category", "detection", "score", "outcome")


def protocol_file(name: str) -> str:
    """The name of the file that has the cells of a protocol."""
    return f"{name}.toml"


def table_texts(table: RunTable) -> dict[str, str]:
    """The text of each file, by its name."""
    facts, detections = _fact_lines(table), _detection_lines(table)
    texts = {FACTS: _joined((*_KEYS, *table.facts, _FAILURE), facts)}
    if table.ranking is not None:
        texts[DETECTIONS] = _joined(_DETECTION, detections)
    for protocol in table.protocols:
        texts[protocol_file(protocol.name)] = _protocol_toml(table, protocol)
    return {**texts, RUN: _run_toml(table, facts, detections)}


def _joined(head: Sequence[str], groups: Mapping[str, str]) -> str:
    return "".join([f"{','.join(head)}\n", *groups.values()])


def _fact_lines(table: RunTable) -> dict[str, str]:
    """The lines of each category."""
    ordered = sorted(table.samples.items(), key=lambda item: (item[1].category, item[0]))
    return _by_category(
        (
            sample.category,
            name,
            seed,
            *(_field(answer.facts.get(fact)) for fact in table.facts),
            answer.failure or "",
        )
        for name, sample in ordered
        for seed, answer in enumerate(sample.answers)
    )


def _detection_lines(table: RunTable) -> dict[str, str]:
    """The lines of each category."""
    if table.ranking is None:
        return {}
    lines = (
        (detection.category, name, _field(detection.score), detection.outcome)
        for name, detection in table.ranking.detections.items()
    )
    return _by_category(sorted(lines))


def _by_category(lines: Iterable[Sequence[object]]) -> dict[str, str]:
    """The lines of each category, after an empty one: git takes changes of lines that touch each
    other for a conflict."""
    groups: dict[str, io.StringIO] = {}
    for line in lines:
        category = str(line[0])
        if category not in groups:
            groups[category] = io.StringIO()
            groups[category].write("\n")
        csv.writer(groups[category], lineterminator="\n").writerow(line)
    return {category: text.getvalue() for category, text in groups.items()}


def _field(value: float | None) -> str:
    return "" if value is None else repr(float(value))


def _run_toml(table: RunTable, facts: Mapping[str, str], detections: Mapping[str, str]) -> str:
    """``facts`` and ``detections``: the lines of each category."""
    names = ", ".join(toml_string(protocol.name) for protocol in table.protocols)
    lines = [f"seeds = {table.seeds}", f"protocols = [{names}]"]
    lines += [f"detections = {str(table.ranking is not None).lower()}"]
    for title in ("identity", "definitions", "provenance"):
        values: Mapping[str, str] = getattr(table, title)
        order = values if title == "definitions" else sorted(values)
        lines += ["", f"[{title}]", *_toml_lines({key: values[key] for key in order})]
    conditions = "\n".join([*lines, *map(_protocol_head, table.protocols)])
    head = [_TITLE, f"format = {FORMAT}", f"conditions = {toml_string(_digest(conditions))}"]
    counted = table.ranking.counted if table.ranking else {}
    samples = Counter(sample.category for sample in table.samples.values())
    for category in sorted({*facts, *detections, *counted}):
        section = f"categories.{toml_string(category)}"
        own = _toml_lines(dict(sorted(table.own_provenance.get(category, {}).items())))
        told: dict[str, object] = {"samples": samples[category]}
        if table.ranking:
            told["counted"] = list(counted.get(category, ()))
        content = [facts.get(category, ""), detections.get(category, ""), str(told), *own]
        told["digest"] = _digest("".join(content))
        lines += ["", f"[{section}]", *_toml_lines(told)]
        if own:
            lines += ["", f"[{section}.provenance]", *own]
    return "\n".join([*head, *lines]) + "\n"


def _toml_lines(values: Mapping[str, object]) -> list[str]:
    return [f"{toml_key(key)} = {_toml_value(value)}" for key, value in values.items()]


def toml_key(key: str) -> str:
    """A key, in quotes unless it is a plain word."""
    plain = key.replace("_", "").replace("-", "")
    return key if plain.isascii() and plain.isalnum() else toml_string(key)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def _protocol_toml(table: RunTable, protocol: Protocol) -> str:
    lines = [_protocol_head(protocol)]
    for category, cells in _cells(table, protocol).items():
        lines += ["", f"[cells.{toml_string(category)}]", *_toml_lines(cells)]
    return "\n".join(lines) + "\n"


def _protocol_head(protocol: Protocol) -> str:
    """What a protocol is, without a table's cells."""
    head = {key: value for key, value in protocol.declared().items() if key != "columns"}
    lines = [_TITLE, *_toml_lines(head)]
    for column in protocol.columns:
        lines += ["", "[[columns]]", *_toml_lines(column.declared())]
    return "\n".join(lines)


def _toml_value(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return toml_string(value) if isinstance(value, str) else repr(value)


def _cells(table: RunTable, protocol: Protocol) -> dict[str, dict[str, str]]:
    """The cells of a protocol in words, by category; "all" follows from the others."""
    cells: dict[str, dict[str, str]] = {}
    for category in sorted(table.table.keys() - {ALL}):
        counts, scores = table.table[category], table.scores[category]
        told = {}
        for column in protocol.columns:
            if (count := counts.get(column.key)) is not None:
                told[column.id] = f"{count.correct}/{count.total}"
            elif (score := scores.get(column.key)) is not None:
                told[column.id] = f"{score.value:.6g} over {score.samples}"
            else:
                told[column.id] = "n/a"
        cells[category] = told
    return cells


# -- reading ------------------------------------------------------------------------------------


def parse_table(method: str, dataset: str, texts: Mapping[str, str]) -> RunTable:
    """A table from the texts of its files, by name.

    Raises :class:`GoldenError` if they are not, or do not belong together.
    """
    content = _toml(RUN, texts[RUN])
    if content.get("format") != FORMAT:
        raise GoldenError(f"format is {content.get('format')!r}, this version reads {FORMAT}")
    seeds = content.get("seeds")
    if type(seeds) is not int or not 1 <= seeds < 2**31:
        raise GoldenError(f"{RUN}: seeds is {seeds!r}, expected at least 1")
    sections = {name: content.get(name, 0) for name in ("identity", "definitions", "provenance")}
    for section in sections.values():
        if not isinstance(section, dict) or not all(isinstance(v, str) for v in section.values()):
            raise GoldenError(f"{RUN}: {', '.join(sections)} must be tables of strings")
    protocols = tuple(_protocol(name, texts) for name in _protocol_names(content))
    categories = content.get("categories", {})
    if not isinstance(categories, dict) or not all(
        isinstance(v, dict) for v in categories.values()
    ):
        raise GoldenError(f"{RUN}: categories must be tables")
    try:
        answers = _read_facts(texts[FACTS], seeds)
        ranking = None
        if _is_ranked(content):
            ranking = _read_ranking(texts[DETECTIONS], categories, protocols)
        table = RunTable(
            method=method,
            dataset=dataset,
            identity=sections["identity"],
            definitions=sections["definitions"],
            provenance=sections["provenance"],
            protocols=protocols,
            samples=table_samples(protocols, answers),
            listed=Counter(category for category, _ in answers.values()),
            seeds=seeds,
            ranking=ranking,
            own_provenance=_own_provenance(categories),
        )
        again = table_texts(table)
    except (DataError, ValueError) as error:
        raise GoldenError(str(error)) from error
    for name in again:
        if again[name] != texts.get(name):
            told = (
                f"{name} is not as it is written"
                if name in (FACTS, DETECTIONS)
                else f"{name} is not what follows from the other files: one of them was edited"
            )
            raise GoldenError(told)
    return table


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


def file_names(run_toml: str) -> list[str]:
    """The other files of a table, as its ``run.toml`` names them; raises :class:`GoldenError`."""
    content = _toml(RUN, run_toml)
    ranked = [DETECTIONS] if _is_ranked(content) else []
    return [FACTS, *ranked, *map(protocol_file, _protocol_names(content))]


def _protocol_names(content: Mapping[str, Any]) -> list[str]:
    names = content.get("protocols")
    if not isinstance(names, list) or not all(
        isinstance(name, str) and re.fullmatch("[a-z][a-z0-9-]*", name) for name in names
    ):
        raise GoldenError(f"{RUN}: protocols is {names!r}, expected names")
    return names


def _is_ranked(content: Mapping[str, Any]) -> bool:
    ranked = content.get("detections")
    if not isinstance(ranked, bool):
        raise GoldenError(f"{RUN}: detections is {ranked!r}, expected true or false")
    return ranked


def _toml(name: str, text: str) -> dict[str, Any]:
    try:
        return parse_toml(name, text)
    except DataError as error:
        raise GoldenError(str(error)) from error


def _protocol(name: str, texts: Mapping[str, str]) -> Protocol:
    """A protocol of the table."""
    file = protocol_file(name)
    if file not in texts:
        raise GoldenError(f"{file} is missing")
    content = _toml(file, texts[file])
    content.pop("cells", None)
    try:
        protocol = Protocol.parse(content, file)
    except ProtocolError as error:
        raise GoldenError(str(error)) from error
    if protocol.name != name:
        raise GoldenError(f"{file}: name is {protocol.name!r}, expected {name!r}")
    return protocol


def _read_facts(text: str, seeds: int) -> dict[str, tuple[str, tuple[Answer, ...]]]:
    """The category and the answers of each sample."""
    lines = csv_lines(FACTS, lines_of(io.StringIO(text, newline=""), FACTS))
    _, head = next(lines, (0, []))
    first, names, last = head[: len(_KEYS)], head[len(_KEYS) : -1], head[-1:]
    if (*first, *last) != (*_KEYS, _FAILURE):
        raise ValueError(f"{FACTS}: expected {', '.join(_KEYS)}, facts and {_FAILURE}")
    in_catalogue = [fact(name) for name in names]
    answers: dict[str, tuple[str, list[Answer]]] = {}
    for number, line in filter(itemgetter(1), lines):
        if len(line) != len(head):
            raise ValueError(f"{FACTS}, line {number}: {len(line)} fields, expected {len(head)}")
        category, name, seed = line[: len(_KEYS)]
        facts = {
            made.name: _number(value, made)
            for made, value in zip(in_catalogue, line[len(_KEYS) : -1], strict=True)
        }
        checked_text("category", category)
        checked_text("sample", name)
        own, given = answers.setdefault(sys.intern(name), (sys.intern(category), []))
        if own != category or seed != str(len(given)):
            raise ValueError(f"{FACTS}, line {number}: sample {name}, seed {seed}: out of order")
        given.append(Answer(facts=facts, failure=line[-1] or None))
    for name, (_, given) in answers.items():
        if len(given) != seeds:
            raise ValueError(f"{FACTS}: sample {name} has {len(given)} seeds, expected {seeds}")
    return {name: (category, tuple(given)) for name, (category, given) in answers.items()}


def _number(text: str, made: Fact) -> float | None:
    if not text:
        return None
    number = real(text, -math.inf, math.inf)
    if number == made.failed:
        return number
    return real(text, 0.0, made.most * (1 + 1e-6))


def _read_ranking(text: str, stated: Mapping[str, Any], protocols: Sequence[Protocol]) -> Ranking:
    columns = len(ranking_columns(protocols))
    lines = csv_lines(DETECTIONS, lines_of(io.StringIO(text, newline=""), DETECTIONS))
    if tuple(next(lines, (0, ()))[1]) != _DETECTION:
        raise ValueError(f"{DETECTIONS}: expected the columns {', '.join(_DETECTION)}")
    detections: dict[str, RankedDetection] = {}
    for number, line in filter(itemgetter(1), lines):
        if len(line) != len(_DETECTION) or not re.fullmatch(f"[01-]{{{columns}}}", line[-1]):
            raise ValueError(f"{DETECTIONS}, line {number}: expected {', '.join(_DETECTION)}")
        category, name, score, outcome = line
        checked_text("category", category)
        checked_text("detection", name)
        value = real(score, -math.inf, math.inf)
        detections[name] = RankedDetection(sys.intern(category), value, sys.intern(outcome))
    counted = {
        category: tuple(numbers)
        for category, told in stated.items()
        if isinstance(numbers := told.get("counted"), list) and numbers
    }
    for category, numbers in counted.items():
        if len(numbers) != columns or not all(type(n) is int and n >= 0 for n in numbers):
            raise ValueError(
                f"{RUN}: counted of {category} is {numbers}, expected {columns} counts"
            )
    return Ranking(detections, counted)
