"""The texts of a golden table's files.

``run.toml``: what the table is of, and a digest of the facts of each category. ``facts.csv``: one
line per sample and seed, sorted by category. ``PROTOCOL.toml``: what the columns of a protocol are,
and one cell per line. No text says anything that two changes of different categories would both
have to change, and none of theirs stand side by side, so that they can be merged line by line.

Cells follow from facts: on reading all but the facts is written anew and compared.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pytest_cpas._files import toml_string
from pytest_cpas.evaluation import Answer
from pytest_cpas.golden.tables import GoldenError, RunTable, table_samples
from pytest_cpas.protocols import Protocol, ProtocolError
from pytest_cpas.types.samples import ALL

__all__ = [
    "FACTS",
    "FORMAT",
    "RUN",
    "parse_table",
    "protocol_file",
    "protocol_names",
    "table_texts",
]

FORMAT = 3

#: The files of a table, besides one for each protocol.
RUN, FACTS = "run.toml", "facts.csv"

_TITLE = "# Recorded by pytest-cpas; --snapshot-update records it anew."

#: The columns of ``facts.csv`` before the facts; the last one is why there is no answer.
_KEYS, _FAILURE = ("category", "sample", "seed"), "failure"


def protocol_file(name: str) -> str:
    """The name of the file that has the cells of a protocol."""
    return f"{name}.toml"


def table_texts(table: RunTable) -> dict[str, str]:
    """The text of each file, by its name."""
    groups = _fact_lines(table)
    head = ",".join((*_KEYS, *table.definitions, _FAILURE))
    digests = {category: _digest(text) for category, text in groups.items()}
    return {
        FACTS: "".join([f"{head}\n", *groups.values()]),
        **{
            protocol_file(protocol.name): _protocol_toml(table, protocol)
            for protocol in table.protocols
        },
        RUN: _run_toml(table, digests),
    }


def _fact_lines(table: RunTable) -> dict[str, str]:
    """The lines of each category, after an empty one: git takes changes of lines that touch each
    other for a conflict."""
    groups: dict[str, io.StringIO] = {}
    for name, sample in sorted(table.samples.items(), key=lambda item: (item[1].category, item[0])):
        if sample.category not in groups:
            groups[sample.category] = io.StringIO("\n")
            groups[sample.category].seek(0, io.SEEK_END)
        writer = csv.writer(groups[sample.category], lineterminator="\n")
        for seed, answer in enumerate(sample.answers):
            values = [answer.facts.get(fact) for fact in table.definitions]
            told = ["" if value is None else repr(float(value)) for value in values]
            writer.writerow([sample.category, name, seed, *told, answer.failure or ""])
    return {category: text.getvalue() for category, text in groups.items()}


def _run_toml(table: RunTable, digests: Mapping[str, str]) -> str:
    """``digests``: of the lines of each category, in their order."""
    names = ", ".join(toml_string(protocol.name) for protocol in table.protocols)
    lines = [f"seeds = {table.seeds}", f"protocols = [{names}]"]
    for title in ("identity", "definitions", "provenance"):
        values: Mapping[str, str] = getattr(table, title)
        order = values if title == "definitions" else sorted(values)
        lines += ["", f"[{title}]", *_toml_lines({key: values[key] for key in order})]
    conditions = "\n".join([*lines, *map(_protocol_head, table.protocols)])
    head = [_TITLE, f"format = {FORMAT}", f"conditions = {toml_string(_digest(conditions))}"]
    counts = Counter(sample.category for sample in table.samples.values())
    for category, digest in digests.items():
        section = f"categories.{toml_string(category)}"
        lines += ["", f"[{section}]", f"samples = {counts[category]}"]
        own = _toml_lines(dict(sorted(table.own_provenance.get(category, {}).items())))
        lines += [f"digest = {toml_string(_digest(''.join([digest, *own])))}"]
        if own:
            lines += ["", f"[{section}.provenance]", *own]
    return "\n".join([*head, *lines]) + "\n"


def _toml_lines(values: Mapping[str, str]) -> list[str]:
    return [f"{toml_key(key)} = {toml_string(value)}" for key, value in values.items()]


def toml_key(key: str) -> str:
    """A key, in quotes unless it is a plain word."""
    plain = key.replace("_", "").replace("-", "")
    return key if plain.isascii() and plain.isalnum() else toml_string(key)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def _protocol_toml(table: RunTable, protocol: Protocol) -> str:
    lines = [_protocol_head(protocol)]
    for category, cells in _cells(table, protocol).items():
        lines += ["", f"[cells.{toml_string(category)}]"]
        lines += [f"{key} = {toml_string(cell)}" for key, cell in cells.items()]
    return "\n".join(lines) + "\n"


def _protocol_head(protocol: Protocol) -> str:
    """What a protocol is, without a table's cells."""
    lines = [
        _TITLE,
        f"name = {toml_string(protocol.name)}",
        f"version = {protocol.version}",
        f"title = {toml_string(protocol.title)}",
        f"source = {toml_string(protocol.source)}",
    ]
    for column in protocol.columns:
        lines += ["", "[[columns]]"]
        lines += [f"{key} = {_toml_value(value)}" for key, value in column.declared().items()]
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
    if type(seeds) is not int or seeds < 1:
        raise GoldenError(f"{RUN}: seeds is {seeds!r}, expected at least 1")
    sections = {name: content.get(name, 0) for name in ("identity", "definitions", "provenance")}
    for section in sections.values():
        if not isinstance(section, dict) or not all(isinstance(v, str) for v in section.values()):
            raise GoldenError(f"{RUN}: {', '.join(sections)} must be tables of strings")
    protocols = tuple(_protocol(name, texts) for name in protocol_names(texts[RUN]))
    lines = io.StringIO(texts[FACTS], newline="")
    answers, digests = _read_facts(lines, list(sections["definitions"]), seeds)
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
        own_provenance=_own_provenance(content.get("categories")),
    )
    if _run_toml(table, digests) != texts[RUN]:
        raise GoldenError(f"{FACTS} is not the file that {RUN} was made with, or that was edited")
    for protocol in protocols:
        if _protocol_toml(table, protocol) != texts[protocol_file(protocol.name)]:
            raise GoldenError(f"{protocol_file(protocol.name)} is not what follows from {FACTS}")
    return table


def _own_provenance(categories: object) -> dict[str, dict[str, str]]:
    """That of categories which were recorded by a run of their own."""
    told = {}
    for category, section in categories.items() if isinstance(categories, dict) else ():
        own = section.get("provenance", {}) if isinstance(section, dict) else 0
        if not isinstance(own, dict) or not all(isinstance(value, str) for value in own.values()):
            raise GoldenError(f"{RUN}: [categories.{category}] is not what is recorded")
        if own:
            told[category] = own
    return told


def protocol_names(run_toml: str) -> list[str]:
    """The protocols that a table was judged under; raises :class:`GoldenError`."""
    names = _toml(RUN, run_toml).get("protocols")
    if not isinstance(names, list) or not all(
        isinstance(name, str) and re.fullmatch("[a-z][a-z0-9-]*", name) for name in names
    ):
        raise GoldenError(f"{RUN}: protocols is {names!r}, expected names")
    return names


def _toml(name: str, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise GoldenError(f"{name}: {error}") from error


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


def _read_facts(
    lines: Iterable[str], names: Sequence[str], seeds: int
) -> tuple[dict[str, tuple[str, tuple[Answer, ...]]], dict[str, str]]:
    """The answers of each sample, and the digest of the lines of each category."""
    answers: dict[str, tuple[str, list[Answer]]] = {}
    digests: dict[str, Any] = {}
    seen: list[str] = []

    def read() -> Iterable[str]:
        for line in lines:
            seen.append(line)
            yield line

    reader = csv.reader(read())
    if next(reader, []) != [*_KEYS, *names, _FAILURE]:
        raise GoldenError(f"{FACTS}: expected the columns {', '.join((*_KEYS, *names, _FAILURE))}")
    seen.clear()
    try:
        for line in filter(None, reader):
            category, name, seed, *values, failure = line
            digest = digests.setdefault(category, hashlib.sha256())
            digest.update("".join(seen).encode("utf-8", "surrogatepass"))
            seen.clear()
            facts = {fact: _number(value) for fact, value in zip(names, values, strict=True)}
            own, given = answers.setdefault(sys.intern(name), (sys.intern(category), []))
            if own != category or seed != str(len(given)):
                raise ValueError(f"sample {name}: seed {seed} of {category} is out of order")
            given.append(Answer(facts=facts, failure=failure or None))
    except (ValueError, csv.Error) as error:
        raise GoldenError(f"{FACTS}: {error}") from error
    for name, (_, given) in answers.items():
        if len(given) != seeds:
            raise GoldenError(f"{FACTS}: sample {name} has {len(given)} seeds, expected {seeds}")
    return (
        {name: (category, tuple(given)) for name, (category, given) in answers.items()},
        {category: digest.hexdigest() for category, digest in digests.items()},
    )


def _number(text: str) -> float | None:
    if not text:
        return None
    if math.isnan(value := float(text)):
        raise ValueError(f"{text} is no number")
    return value
