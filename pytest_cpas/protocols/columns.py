"""Protocols as data: columns of tables, each with a stable id apart from its label."""

from __future__ import annotations

import functools
import itertools
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from pytest_cpas.facts import Fact, FactError, fact
from pytest_cpas.types import ContractError, shown

__all__ = ["Column", "CountColumn", "Protocol", "ProtocolError", "RankingColumn", "ScoreColumn"]

#: The most that a limit may be, by the unit of its fact; what lies beyond is taken for a mistake.
_LARGEST: Mapping[str, float] = {"deg": 180.0, "m": 1.0, "px": 100_000.0, "": 1000.0}

#: What a column can be judged by, the keys of which it has one: what it holds, and an example.
_KINDS: Mapping[str, tuple[str, str]] = {
    "at": ("facts and their limits", "{ rotation_deg = 5, position_m = 0.05 }"),
    "area": ("facts, from and to", "{ iou = [0.25, 1.0] }"),
    "levels": ("a fact and a list of limits", "{ mspd_px = [5, 10, 15] }"),
    "median": ("the name of a fact", '"rotation_deg"'),
    "ap": ("facts and their limits", "{ iou = 0.5 }"),
}

#: More levels than that are a slip of the pen.
_MOST_LEVELS = 1000

#: More columns than that have no line of a table.
_MOST_COLUMNS = 900


class ProtocolError(ContractError):
    """What is declared of a protocol is not what it must be."""


@dataclass(frozen=True, kw_only=True)
class _Column(ABC):
    """What all kinds of columns have.

    ``protocol``: the name of the one that it belongs to; ``id``: what it is called in files, for
    ever; ``label``: the same for people; ``guard``: whether it is there to be guarded more than to
    be read.
    """

    protocol: str
    id: str
    label: str
    guard: bool = False

    @property
    def key(self) -> str:
        """The id, among the columns of all protocols."""
        return f"{self.protocol}.{self.id}"

    @property
    @abstractmethod
    def meaning(self) -> dict[str, object]:
        """How it judges, whatever it is called: that part of :meth:`declared`."""

    def declared(self) -> dict[str, object]:
        """As the ``[[columns]]`` table of a file has it."""
        guard = {"guard": True} if self.guard else {}
        return {"id": self.id, "label": self.label, **guard, **self.meaning}


@dataclass(frozen=True, kw_only=True)
class CountColumn(_Column):
    """How many samples meet all ``limits``, by fact: precision at a joint threshold."""

    limits: Mapping[str, float]

    @property
    def meaning(self) -> dict[str, object]:
        """The limits."""
        return {"at": dict(self.limits)}

    @property
    def conditions(self) -> list[tuple[Fact, float]]:
        """Each fact, and the limit on it."""
        return [(fact(name), limit) for name, limit in self.limits.items()]

    @property
    def facts(self) -> tuple[Fact, ...]:
        """What it is judged by."""
        return tuple(made for made, _ in self.conditions)


@dataclass(frozen=True, kw_only=True)
class ScoreColumn(_Column):
    """The mean, or the median, of a number per sample.

    With ``areas``: the mean of the share of thresholds that the sample meets, of each fact from one
    to the other, multiplied. Of one fact it is the area under the precision curve (AUC), of two the
    volume under the surface (VUS), over its width. ``bins``: the midpoint sum of so many thresholds
    per fact, 0 for the integral. With ``levels``: the mean of the share of those limits, per fact,
    that the sample is strictly better than; BOP calls it average recall. With
    ``median``: the median of that fact over the samples.
    """

    areas: Mapping[str, tuple[float, float]]
    bins: int = 0
    levels: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    median: str = ""

    @property
    def meaning(self) -> dict[str, object]:
        """The statistic."""
        if self.median:
            return {"median": self.median}
        if self.levels:
            return {"levels": {name: list(limits) for name, limits in self.levels.items()}}
        area = {name: list(ends) for name, ends in self.areas.items()}
        return {"area": area, **({"bins": self.bins} if self.bins else {})}

    @property
    def facts(self) -> tuple[Fact, ...]:
        """What it is judged by."""
        return tuple(map(fact, [*self.areas, *self.levels, *filter(None, [self.median])]))

    @property
    def better(self) -> Literal["lower", "higher"]:
        """Which direction is the better one."""
        return fact(self.median).better if self.median else "higher"


@dataclass(frozen=True, kw_only=True)
class RankingColumn(_Column):
    """Average precision of detections: the area under their precision-recall curve.

    ``limits``: an IoU above which, or the two errors of a pose at and below which, a detection is
    right. ``matched``: the IoU by which detections and objects must be matched to take part in the
    AP of poses ("use matches for pose"); "" if all do.
    """

    limits: Mapping[str, float]
    matched: str = ""

    @property
    def meaning(self) -> dict[str, object]:
        """What is right, and what takes part."""
        return {"ap": dict(self.limits), **({"matched": self.matched} if self.matched else {})}

    @property
    def facts(self) -> tuple[Fact, ...]:
        """What it is judged by."""
        return tuple(map(fact, [*self.limits, *filter(None, [self.matched])]))

    @property
    def better(self) -> Literal["higher"]:
        """Which direction is the better one."""
        return "higher"

    @property
    def is_pose(self) -> bool:
        """Whether poses are ranked, and not boxes."""
        return len(self.limits) == 2

    @property
    def pose_limits(self) -> tuple[tuple[str, float], tuple[str, float]]:
        """The fact that is an angle and its limit, and the one that is a distance."""
        angle, distance = sorted(self.limits.items(), key=lambda item: fact(item[0]).unit)
        return angle, distance


Column: TypeAlias = CountColumn | ScoreColumn | RankingColumn


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """A way to judge answers that has a name.

    ``version`` is raised whenever a change of its columns changes a printed number; ``title`` and
    ``source`` say for people what it is, and where it comes from.
    """

    name: str
    version: int
    title: str
    source: str
    columns: Sequence[Column]

    @classmethod
    def parse(cls, content: Mapping[str, object], where: str) -> Protocol:
        """From the content of a TOML file; :class:`ProtocolError` names ``where`` and what."""
        return _Parser(content, where).protocol()

    def declared(self) -> dict[str, object]:
        """As a file has it."""
        return {
            "name": self.name,
            "version": self.version,
            "title": self.title,
            "source": self.source,
            "columns": [column.declared() for column in self.columns],
        }

    @property
    def counts(self) -> list[CountColumn]:
        """The columns that count samples."""
        return [column for column in self.columns if isinstance(column, CountColumn)]

    @property
    def scores(self) -> list[ScoreColumn]:
        """The columns that have a number per sample."""
        return [column for column in self.columns if isinstance(column, ScoreColumn)]

    @property
    def rankings(self) -> list[RankingColumn]:
        """The columns that rank detections."""
        return [column for column in self.columns if isinstance(column, RankingColumn)]


class _Parser:
    """The content of a protocol's file, checked piece by piece."""

    def __init__(self, content: Mapping[str, object], where: str) -> None:
        self.content, self.where = content, where

    def fail(self, told: str) -> ProtocolError:
        return ProtocolError(f"{self.where}: {told}")

    def text(self, section: Mapping[str, object], key: str, default: str | None = None) -> str:
        value = section.get(key, default)
        if value is None:
            raise self.fail(f"{key} is missing, expected a line of text")
        if (
            not isinstance(value, str)
            or not value.isprintable()
            or len(value) > 200
            or (key != "source" and not value.strip())
        ):
            raise self.fail(f"{key} is {shown(value)}, expected a line of text, at most 200 long")
        return value

    def known(self, section: Mapping[str, object], keys: Sequence[str], what: str) -> None:
        for key in section:
            if key not in keys:
                raise self.fail(f"{what} has {shown(key)}; it knows {', '.join(keys)}")

    def protocol(self) -> Protocol:
        self.known(self.content, ("name", "version", "title", "source", "columns"), "a protocol")
        name = self.text(self.content, "name")
        if not re.fullmatch(r"[a-z][a-z0-9-]{0,39}", name):
            raise self.fail(
                f"name is {shown(name)}, expected up to 40 small letters, digits and '-', a letter"
                " first"
            )
        version = self.content.get("version", 1)
        if type(version) is not int or version < 1:
            raise self.fail(f"version is {shown(version)}, expected a whole number from 1")
        sections = self.content.get("columns")
        if not isinstance(sections, list) or not sections:
            seen = shown(sections) if sections else "empty or missing"
            raise self.fail(f"columns is {seen}, expected [[columns]] tables")
        if len(sections) > _MOST_COLUMNS:
            raise self.fail(f"{len(sections)} columns, at most {_MOST_COLUMNS} are read")
        columns = [self.column(name, section) for section in sections]
        for kind in ("id", "label"):
            value, times = Counter(getattr(each, kind) for each in columns).most_common(1)[0]
            if times > 1:
                raise self.fail(f"two columns have the {kind} {value!r}; give one another {kind}")
        return Protocol(
            name=name,
            version=version,
            title=self.text(self.content, "title", name),
            source=self.text(self.content, "source", ""),
            columns=columns,
        )

    def column(self, protocol: str, section: object) -> Column:
        if not isinstance(section, dict):
            raise self.fail(f"a column is {shown(section)}, expected a [[columns]] table")
        self.known(
            section,
            ("id", "label", "guard", *_KINDS, "bins", "matched"),
            "a column",
        )
        name = self.text(section, "id")
        if not re.fullmatch(r"[a-z0-9][a-z0-9_]{0,59}", name):
            raise self.fail(f"id is {shown(name)}, expected up to 60 small letters, digits and '_'")
        guard = section.get("guard", False)
        if not isinstance(guard, bool):
            raise self.fail(f"column {name}: guard is {shown(guard)}, expected true or false")
        kinds = [kind for kind in _KINDS if kind in section]
        if len(kinds) != 1:
            raise self.fail(
                f"column {name} has {' and '.join(kinds) or 'no judgement'}, expected one of "
                + ", ".join(f"{kind} ({told})" for kind, (told, _) in _KINDS.items())
            )
        for key, kind in (("bins", "area"), ("matched", "ap")):
            if key in section and kinds != [kind]:
                raise self.fail(f"column {name}: {key} belongs to {kind}")
        common = functools.partial(dict[str, Any], protocol=protocol, id=name, guard=guard)
        if kinds == ["at"]:
            limits = {
                made.name: self.limit(name, made, value)
                for made, value in self.facts(name, section, "at")
            }
            label = ", ".join(fact(key).limit_label(limit) for key, limit in limits.items())
            return CountColumn(**common(label=self.text(section, "label", label)), limits=limits)
        if kinds == ["ap"]:
            return self.ranking(section, common)
        if kinds == ["median"]:
            made = self.fact(name, section["median"])
            label = self.text(section, "label", f"median {made.title}")
            return ScoreColumn(**common(label=label), areas={}, median=made.name)
        if kinds == ["levels"]:
            levels = {
                made.name: self.levels(name, made, value)
                for made, value in self.facts(name, section, "levels")
            }
            if len(levels) > 1:
                raise self.fail(
                    f"column {name}: levels of {' and '.join(levels)}, expected one fact, of whose"
                    " limits it is the mean; give each a column, or judge them together by area"
                )
            [(key, given)] = levels.items()
            told = f"mean over {len(given)} limits to {fact(key).limit_label(given[-1])}"
            label = self.text(section, "label", told)
            return ScoreColumn(**common(label=label), areas={}, levels=levels)
        areas = {
            made.name: self.ends(name, made, value)
            for made, value in self.facts(name, section, "area")
        }
        bins = section.get("bins", 0)
        if type(bins) is not int or not 0 <= bins <= 10_000:
            raise self.fail(
                f"column {name}: bins is {shown(bins)}, expected a whole number to 10000"
            )
        told = " x ".join(
            f"{fact(key).limit_label(start)} to {fact(key).limit_label(stop)}"
            for key, (start, stop) in areas.items()
        )
        label = self.text(section, "label", f"area from {told}")
        return ScoreColumn(**common(label=label), areas=areas, bins=bins)

    def ranking(
        self, section: Mapping[str, object], common: Callable[..., dict[str, Any]]
    ) -> RankingColumn:
        name = self.text(section, "id")
        made = self.facts(name, section, "ap")
        limits = {each.name: self.limit(name, each, value) for each, value in made}
        units = sorted((each.unit, each.better) for each, _ in made)
        if units not in ([("", "higher")], [("deg", "lower"), ("m", "lower")]):
            raise self.fail(
                f"column {name}: ap of {', '.join(limits)}, expected an IoU, or an angle and a"
                " distance"
            )
        label = "AP " + ", ".join(fact(key).limit_label(limit) for key, limit in limits.items())
        matched = ""
        if "matched" in section:
            by = self.fact(name, section["matched"])
            if len(limits) == 1 or (by.unit, by.better) != ("", "higher"):
                raise self.fail(f"column {name}: matched is an IoU, for the AP of poses")
            matched = by.name
        return RankingColumn(
            **common(label=self.text(section, "label", label)), limits=limits, matched=matched
        )

    def fact(self, column: str, name: object) -> Fact:
        try:
            if not isinstance(name, str) or len(name) > 60:
                raise self.fail(f"column {column}: {shown(name)}, expected a fact such as 'iou'")
            return fact(name)
        except FactError as error:
            raise self.fail(f"column {column}: {error}") from None

    def unlike(self, column: str, section: Mapping[str, object], kind: str) -> ProtocolError:
        """What to say of a judgement that does not hold what it must."""
        told, example = _KINDS[kind]
        return self.fail(
            f"column {column}: {kind} is {shown(section[kind])}, expected {told}, such as"
            f" {kind} = {example}"
        )

    def facts(
        self, column: str, section: Mapping[str, object], kind: str
    ) -> list[tuple[Fact, object]]:
        judged_by = section[kind]
        if not isinstance(judged_by, dict) or not judged_by:
            raise self.unlike(column, section, kind)
        return [(self.fact(column, name), value) for name, value in judged_by.items()]

    def limit(self, column: str, made: Fact, value: object) -> float:
        largest = 1.0 if made.better == "higher" else _LARGEST[made.unit]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fail(f"column {column}: {made.name} is {shown(value)}, expected a number")
        if not 0 <= value <= largest:
            unit = f" {made.unit}" if made.unit else ""
            raise self.fail(
                f"column {column}: {made.name} is {shown(value)}{unit}, expected 0 to"
                f" {largest:g}{unit}"
            )
        return float(value)

    def ends(self, column: str, made: Fact, value: object) -> tuple[float, float]:
        if not isinstance(value, list) or len(value) != 2:
            raise self.fail(f"column {column}: {made.name} is {shown(value)}, expected [from, to]")
        start, stop = (self.limit(column, made, end) for end in value)
        if not start < stop:
            raise self.fail(f"column {column}: {made.name} runs from {start:g} to {stop:g}, not up")
        return start, stop

    def levels(self, column: str, made: Fact, value: object) -> tuple[float, ...]:
        if not isinstance(value, list) or not 1 <= len(value) <= _MOST_LEVELS:
            raise self.fail(
                f"column {column}: {made.name} is {shown(value)}, expected a list of limits, up to"
                f" {_MOST_LEVELS}"
            )
        limits = tuple(self.limit(column, made, each) for each in value)
        if any(later <= before for before, later in itertools.pairwise(limits)):
            raise self.fail(f"column {column}: the limits on {made.name} do not all rise")
        return limits
