"""The golden tables of a robustness profile: all points of the curves in the files of one folder.

``METHOD/DATASET+robustness/`` has the files that the table of one run has. ``facts.csv`` and
``detections.csv`` have one column more, the perturbation and its severity, empty for what is not
perturbed. ``run.toml`` and ``PROTOCOL.toml`` have a section for each point; what a section does not
state is what stands above all of them. That stays what it is while it is true of any point, and
until then, recording a point anew changes nothing that is told of the others; only a fact that none
of them had is a column more, empty in their lines.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from pytest_cpas._files import toml_string
from pytest_cpas.evaluation import RobustnessPoint
from pytest_cpas.facts import in_order
from pytest_cpas.golden.parsing import (
    Rows,
    check_same,
    csv_rows,
    file_names,
    is_ranked,
    parse_table,
    protocol_names,
    protocol_of,
    run_content,
    table_of,
    telling,
    toml,
)
from pytest_cpas.golden.tables import GoldenError, RunTable
from pytest_cpas.golden.texts import (
    DETECTION,
    DETECTIONS,
    FACTS,
    FAILURE,
    FORMAT,
    KEYS,
    RUN,
    TITLE,
    category_lines,
    cell_lines,
    conditions,
    detection_lines,
    fact_lines,
    joined,
    protocol_file,
    protocol_head,
    section,
    table_texts,
    toml_lines,
)
from pytest_cpas.protocols import Protocol
from pytest_cpas.types import shown

__all__ = [
    "ROBUSTNESS",
    "Kept",
    "Points",
    "joined_kept",
    "kept_files",
    "kept_tables",
    "kept_texts",
    "parse_kept",
]

#: What the name of a folder has behind that of the data set.
ROBUSTNESS = "+robustness"

#: The first column of ``facts.csv`` and ``detections.csv``.
_KEY = "perturbation"

#: What is told above all points of those of which it is true.
_SHARED = ("seeds", "protocols", "detections", "facts", "definitions", "provenance")

#: What the point is called at which nothing is perturbed, but in tables with commas.
_UNPERTURBED = "unperturbed"

#: A point; of versions that know other perturbations as well.
_POINT = rf"{_UNPERTURBED}|[a-z][a-z-]*-[0-9]+"


@dataclass(frozen=True)
class Points:
    """The tables of a profile by point (``unperturbed``, ``light-2``), as files of one folder.

    ``shared``: what stands above all points of ``run.toml``; ``protocols``: above those of each
    protocol's file.
    """

    tables: Mapping[str, RunTable]
    shared: Mapping[str, object]
    protocols: Mapping[str, Protocol]

    def joined(self, point: str, table: RunTable) -> Points:
        """These with another table of a point."""
        tables = {**self.tables, point: table}
        told = [_told(each) for each in tables.values()]
        new = _told(table)
        shared = {
            key: self.shared[key]
            if any(_is_same(self.shared.get(key), each[key]) for each in told)
            else new[key]
            for key in _SHARED
        }
        protocols: dict[str, Protocol] = {}
        for name in _protocol_names(tables):
            used = [p for each in (table, *tables.values()) for p in each.protocols]
            used = [p for p in used if p.name == name]
            there = self.protocols.get(name)
            stays = there is not None and any(_is_same_protocol(there, p) for p in used)
            protocols[name] = there if there is not None and stays else used[0]
        return Points(tables, shared, protocols)

    def texts(self) -> dict[str, str]:
        """The text of each file, by its name."""
        ordered = sorted(self.tables.items(), key=lambda item: _field_of(item[0]))
        names = in_order({name for table in self.tables.values() for name in table.facts})
        facts: dict[str, str] = {}
        detections: dict[str, str] = {}
        run = [TITLE, f"format = {FORMAT}", *_toml(self.shared)]
        for point, table in ordered:
            field, key = _field_of(point), f"points.{toml_string(point)}"
            facts[point] = "".join(fact_lines(table, names, field).values())
            detections[point] = "".join(detection_lines(table, field).values())
            told: dict[str, object] = {"conditions": conditions(table)}
            told["identity"] = section(table, "identity")
            told |= {k: v for k, v in _told(table).items() if not _is_same(v, self.shared[k])}
            run += ["", f"[{key}]", *_toml(told, f"{key}.")]
            run += category_lines(table, fact_lines(table), detection_lines(table), f"{key}.")
        texts = {
            RUN: "\n".join(run) + "\n",
            FACTS: joined((_KEY, *KEYS, *names, FAILURE), facts),
        }
        if any(table.ranking is not None for table in self.tables.values()):
            texts[DETECTIONS] = joined((_KEY, *DETECTION), detections)
        for name, protocol in self.protocols.items():
            lines = [protocol_head(protocol)]
            for point, table in ordered:
                key = f"points.{toml_string(point)}."
                for own in (p for p in table.protocols if p.name == name):
                    if not _is_same_protocol(own, protocol):
                        lines += ["", protocol_head(own, key)]
                    lines += cell_lines(table, own, key)
            texts[protocol_file(name)] = "\n".join(lines) + "\n"
        return texts

    @classmethod
    def parse(cls, method: str, base: str, texts: Mapping[str, str]) -> Points:
        """From the texts of the files; :class:`GoldenError` if they do not belong together.

        ``base``: the data set of which the points are parts.
        """
        contents = point_contents(content := run_content(texts[RUN]))
        names = dict.fromkeys(name for each in contents.values() for name in protocol_names(each))
        files = {name: toml(protocol_file(name), texts[protocol_file(name)]) for name in names}
        heads = {name: protocol_of(name, _without(files[name], "points")) for name in names}
        tables = {}
        with telling():
            facts = _Lines.of(FACTS, texts[FACTS])
            ranked = any(is_ranked(each) for each in contents.values())
            detections = _Lines.of(DETECTIONS, texts[DETECTIONS]) if ranked else None
            for point, told in contents.items():
                protocols = [
                    _own_protocol(files[name], point) or heads[name]
                    for name in protocol_names(told)
                ]
                tables[point] = table_of(
                    method,
                    f"{base}+{point}",
                    told,
                    protocols,
                    facts.of_point(point, (*KEYS, *_facts_of(told), FAILURE)),
                    detections.of_point(point, DETECTION)
                    if detections and is_ranked(told)
                    else None,
                )
            points = cls(tables, {key: content[key] for key in _SHARED}, heads)
            again = points.texts()
        check_same(again, texts)
        return points


#: What the files of one folder hold.
Kept: TypeAlias = RunTable | Points


def kept_files(run_toml: str) -> list[str]:
    """The files besides ``run.toml`` of a folder, as that names them; raises
    :class:`GoldenError`."""
    content = toml(RUN, run_toml)
    return file_names(point_contents(content).values() if "points" in content else [content])


def parse_kept(method: str, folder: str, texts: Mapping[str, str]) -> Kept:
    """What the files of a folder of this name hold; :class:`GoldenError` if they do not belong
    together."""
    if folder.endswith(ROBUSTNESS) and "points" in toml(RUN, texts[RUN]):
        return Points.parse(method, folder.removesuffix(ROBUSTNESS), texts)
    return parse_table(method, folder, texts)


def kept_texts(kept: Kept) -> dict[str, str]:
    """The text of each file, by its name."""
    return kept.texts() if isinstance(kept, Points) else table_texts(kept)


def kept_tables(kept: Kept | None) -> dict[str, RunTable]:
    """The tables by the names of their data sets."""
    if kept is None:
        return {}
    tables = kept.tables.values() if isinstance(kept, Points) else [kept]
    return {table.dataset: table for table in tables}


def joined_kept(kept: Kept | None, table: RunTable, point: RobustnessPoint | None) -> Kept:
    """What a folder holds once a table has its place there; :class:`GoldenError` if another kind of
    table has it."""
    if point is None and not isinstance(kept, Points):
        return table
    if point is not None and not isinstance(kept, RunTable):
        return (kept or Points({}, {}, {})).joined(point.suffix, table)
    raise GoldenError(
        f"{table.dataset} cannot be kept in a folder that has other tables: names of data sets that"
        f" end with {ROBUSTNESS} are those of the points of robustness profiles"
    )


@dataclass(frozen=True)
class _Lines:
    """The lines of a table with commas: its columns, and number and fields of each by point."""

    name: str
    columns: list[str]
    lines: Mapping[str, list[tuple[int, list[str]]]]

    @classmethod
    def of(cls, name: str, text: str) -> _Lines:
        """ValueError unless the first column is the perturbation, and for a line that is too
        short or too long."""
        rows = csv_rows(name, text)
        _, columns = next(rows, (0, []))
        if columns[:1] != [_KEY]:
            raise ValueError(f"{name}: the first column is {shown(columns[:1])}, expected {_KEY}")
        lines: dict[str, list[tuple[int, list[str]]]] = {}
        for number, fields in rows:
            if fields and len(fields) != len(columns):
                raise ValueError(
                    f"{name}, line {number}: {len(fields)} fields, expected {len(columns)}"
                )
            if fields:
                lines.setdefault(fields[0] or _UNPERTURBED, []).append((number, fields))
        return cls(name, columns, lines)

    def of_point(self, point: str, columns: Sequence[str]) -> Rows:
        """Some columns of the lines of a point; ValueError for one that is not there."""
        if lacking := [column for column in columns if column not in self.columns]:
            raise ValueError(f"{self.name}: the column {', '.join(lacking)} is missing")
        places = [self.columns.index(column) for column in columns]
        yield 1, [*columns]
        for number, fields in self.lines.get(point, ()):
            yield number, [fields[place] for place in places]


def point_contents(content: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """What ``run.toml`` tells of each point; raises :class:`GoldenError`."""
    points = content.get("points")
    if (
        not isinstance(points, dict)
        or not points
        or not all(re.fullmatch(_POINT, point) for point in points)
        or not all(isinstance(section, dict) for section in points.values())
    ):
        raise GoldenError(f"{RUN}: points is {shown(points)}, expected a table for each point")
    if lacking := [key for key in _SHARED if key not in content]:
        raise GoldenError(f"{RUN}: {', '.join(lacking)} is missing")
    for key in ("definitions", "provenance"):
        if not isinstance(content[key], dict):
            raise GoldenError(f"{RUN}: {key} is {shown(content[key])}, expected a table")
    shared = {key: content[key] for key in _SHARED}
    return {point: shared | section for point, section in points.items()}


def _facts_of(content: Mapping[str, Any]) -> list[str]:
    facts = content["facts"]
    if not isinstance(facts, list) or not all(isinstance(name, str) for name in facts):
        raise GoldenError(f"{RUN}: facts is {shown(facts)}, expected names")
    return facts


def _own_protocol(content: Mapping[str, Any], point: str) -> Protocol | None:
    """The protocol in the section of a point, None if it is that above all sections."""
    points = content.get("points")
    section = points.get(point) if isinstance(points, dict) else None
    told = _without(section, "cells") if isinstance(section, dict) else {}
    return protocol_of(content["name"], told) if told else None


def _told(table: RunTable) -> dict[str, object]:
    """What can stand above all points, of one of them."""
    return {
        "seeds": table.seeds,
        "protocols": [protocol.name for protocol in table.protocols],
        "detections": table.ranking is not None,
        "facts": list(table.facts),
        "definitions": section(table, "definitions"),
        "provenance": section(table, "provenance"),
    }


def _toml(told: Mapping[str, object], within: str = "") -> Iterator[str]:
    """Lines of single values, then sections."""
    yield from toml_lines({k: v for k, v in told.items() if not isinstance(v, dict)})
    for key, values in told.items():
        if isinstance(values, dict):
            yield from ("", f"[{within}{key}]", *toml_lines(values))


def _protocol_names(tables: Mapping[str, RunTable]) -> list[str]:
    return list(dict.fromkeys(p.name for table in tables.values() for p in table.protocols))


def _is_same(one: object, other: object) -> bool:
    """Whether they are written alike: the order of keys counts."""
    return repr(one) == repr(other)


def _is_same_protocol(one: Protocol, other: Protocol) -> bool:
    return protocol_head(one) == protocol_head(other)


def _field_of(point: str) -> str:
    """A point as a field of a table with commas."""
    return "" if point == _UNPERTURBED else point


def _without(content: Mapping[str, Any], key: str) -> dict[str, Any]:
    return {k: v for k, v in content.items() if k != key}
