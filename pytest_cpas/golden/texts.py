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
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from pytest_cpas._files import toml_string
from pytest_cpas.facts import in_order
from pytest_cpas.golden.noise import Noise
from pytest_cpas.golden.tables import RunTable
from pytest_cpas.protocols import Protocol
from pytest_cpas.types.samples import ALL

__all__ = ["DETECTIONS", "FACTS", "FORMAT", "RUN", "protocol_file", "table_texts"]

FORMAT = 3

#: The files of a table, besides one for each protocol.
RUN, FACTS, DETECTIONS = "run.toml", "facts.csv", "detections.csv"

TITLE = "# Recorded by pytest-cpas; --snapshot-update records it anew."

#: The columns of ``facts.csv`` before the facts; the last one is why there is no answer.
KEYS, FAILURE = ("category", "sample", "seed"), "failure"

#: The columns of ``detections.csv``.
DETECTION = ("category", "detection", "score", "outcome")


def protocol_file(name: str) -> str:
    """The name of the file that has the cells of a protocol."""
    return f"{name}.toml"


def table_texts(table: RunTable) -> dict[str, str]:
    """The text of each file, by its name."""
    facts, detections = fact_lines(table), detection_lines(table)
    texts = {FACTS: joined((*KEYS, *table.facts, FAILURE), facts)}
    if table.ranking is not None:
        texts[DETECTIONS] = joined(DETECTION, detections)
    for protocol in table.protocols:
        lines = [protocol_head(protocol), *cell_lines(table, protocol)]
        texts[protocol_file(protocol.name)] = "\n".join(lines) + "\n"
    head = [TITLE, f"format = {FORMAT}", f"conditions = {toml_string(conditions(table))}"]
    told = [*head, *_condition_lines(table), *category_lines(table, facts, detections)]
    return {**texts, RUN: "\n".join(told) + "\n"}


def joined(head: Sequence[str], groups: Mapping[str, str]) -> str:
    """A table with commas: its columns, and the lines of groups."""
    return "".join([f"{','.join(head)}\n", *groups.values()])


def fact_lines(table: RunTable, facts: Sequence[str] | None = None, *first: str) -> dict[str, str]:
    """The lines of each category, with the table's own facts if ``facts`` is None; ``first``: what
    each line begins with."""
    ordered = sorted(table.samples.items(), key=lambda item: (item[1].category, item[0]))
    names = table.facts if facts is None else facts
    return _by_category(
        first,
        (
            (
                sample.category,
                name,
                seed,
                *(_field(answer.facts.get(fact)) for fact in names),
                answer.failure or "",
            )
            for name, sample in ordered
            for seed, answer in enumerate(sample.answers)
        ),
    )


def detection_lines(table: RunTable, *first: str) -> dict[str, str]:
    """The lines of each category; ``first``: what each begins with."""
    if table.ranking is None:
        return {}
    lines = (
        (detection.category, name, _field(detection.score), detection.outcome)
        for name, detection in table.ranking.detections.items()
    )
    return _by_category(first, sorted(lines))


def _by_category(first: Sequence[str], lines: Iterable[Sequence[object]]) -> dict[str, str]:
    """The lines of each category, after an empty one: git takes changes of lines that touch each
    other for a conflict."""
    groups: dict[str, io.StringIO] = {}
    for line in lines:
        category = str(line[0])
        if category not in groups:
            groups[category] = io.StringIO()
            groups[category].write("\n")
        csv.writer(groups[category], lineterminator="\n").writerow([*first, *line])
    return {category: text.getvalue() for category, text in groups.items()}


def _field(value: float | None) -> str:
    return "" if value is None else repr(float(value))


def _condition_lines(table: RunTable) -> list[str]:
    """What the table was recorded under."""
    names = ", ".join(toml_string(protocol.name) for protocol in table.protocols)
    lines = [f"seeds = {table.seeds}", f"protocols = [{names}]"]
    lines += [f"detections = {str(table.ranking is not None).lower()}"]
    for title in ("identity", "definitions", "provenance"):
        lines += ["", f"[{title}]", *toml_lines(section(table, title))]
    return [*lines, *_noise_lines(table.noise)]


def section(table: RunTable, title: str) -> dict[str, str]:
    """The ``identity``, ``definitions`` or ``provenance`` of a table, in the order of its file."""
    values: Mapping[str, str] = getattr(table, title)
    order = values if title == "definitions" else sorted(values)
    return {key: values[key] for key in order}


def conditions(table: RunTable) -> str:
    """A digest of what the table was recorded under."""
    return _digest("\n".join([*_condition_lines(table), *map(protocol_head, table.protocols)]))


def category_lines(
    table: RunTable, facts: Mapping[str, str], detections: Mapping[str, str], within: str = ""
) -> list[str]:
    """What ``run.toml`` tells of each category, of which ``facts`` and ``detections`` are the
    lines; ``within``: what the keys of sections begin with."""
    counted = table.ranking.counted if table.ranking else {}
    samples = Counter(sample.category for sample in table.samples.values())
    lines = []
    for category in sorted({*facts, *detections, *counted}):
        key = f"{within}categories.{toml_string(category)}"
        own = toml_lines(dict(sorted(table.own_provenance.get(category, {}).items())))
        told: dict[str, object] = {"samples": samples[category]}
        if table.ranking:
            told["counted"] = list(counted.get(category, ()))
        content = [facts.get(category, ""), detections.get(category, ""), str(told), *own]
        told["digest"] = _digest("".join(content))
        lines += ["", f"[{key}]", *toml_lines(told)]
        if own:
            lines += ["", f"[{key}.provenance]", *own]
    return lines


def _noise_lines(noise: Noise) -> list[str]:
    if not noise.platforms:
        return []
    lines = ["", "[noise]", *toml_lines({"platforms": list(noise.platforms)})]
    for name in in_order(noise.facts):
        told = {"compared": noise.facts[name].compared, "sizes": list(noise.facts[name].sizes)}
        lines += ["", f"[noise.facts.{toml_key(name)}]", *toml_lines(told)]
    return lines


def toml_lines(values: Mapping[str, object]) -> list[str]:
    """A line for each key."""
    return [f"{toml_key(key)} = {toml_value(value)}" for key, value in values.items()]


def toml_key(key: str) -> str:
    """A key, in quotes unless it is a plain word."""
    plain = key.replace("_", "").replace("-", "")
    return key if plain.isascii() and plain.isalnum() else toml_string(key)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def protocol_head(protocol: Protocol, within: str = "") -> str:
    """What a protocol is, without a table's cells; in a section, unless ``within`` is empty, which
    the keys of sections begin with."""
    head = {key: value for key, value in protocol.declared().items() if key != "columns"}
    lines = [f"[{within.removesuffix('.')}]" if within else TITLE, *toml_lines(head)]
    for column in protocol.columns:
        lines += ["", f"[[{within}columns]]", *toml_lines(column.declared())]
    return "\n".join(lines)


def cell_lines(table: RunTable, protocol: Protocol, within: str = "") -> list[str]:
    """The cells of a protocol; ``within``: what the keys of sections begin with."""
    lines = []
    for category, cells in _cells(table, protocol).items():
        lines += ["", f"[{within}cells.{toml_string(category)}]", *toml_lines(cells)]
    return lines


def toml_value(value: object) -> str:
    """A value in one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {toml_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
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
