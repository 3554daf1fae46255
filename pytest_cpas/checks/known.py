"""Failures that are known and stay, as data beside what is checked: ``NAME.known.toml``.

::

    [[contract]]                        # a check of the method NAME
    check = "extents_of_shape"
    reason = "Size and shape are separate heads; nothing makes the shape fill its box."

    [[dataset]]                         # a check of the data set NAME
    check = "depth"
    model = "can_arizona_tea_norm"      # optional, as are sample and category: patterns (* and ?)
    message = "*no closed bottom*"      # optional: a pattern of what the check says
    worst = 0.018                       # optional: what it was seen with, in the check's unit
    run = "without shape"               # optional: how methods are judged on it, or "left out"
    reason = "The depth measured on this can is 14 mm nearer than its mesh."

    [[metric]]                          # a property of the adapter NAME, by --snapshot-update
    check = "box_iou.touching"
    outcome = "raised"
    reason = "raised QhullError"        # what was seen
    case = '{"first": [1, 1, 1]}'       # the counterexample, which is tried again
    snippet = "subject('box_iou', ...)" # its calls

A known failure is reported and does not fail the run. It must happen: one that a complete run does
not come across fails it. Tables of other names are for people, unless they have a ``check``.
"""

from __future__ import annotations

import difflib
import math
import os
import warnings
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

from pytest_cpas._files import write_file
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.reading.structured import read_toml
from pytest_cpas.types import DataError, DeclarationError, raised_as, shortened, shown

__all__ = [
    "LEFT_OUT",
    "LESS_IS_WORSE",
    "MEASURING",
    "WITHOUT_SHAPE",
    "KnownFailure",
    "gone",
    "known_failures",
    "read_known",
    "record_known",
]

#: Entries of a kind.
_MOST_ENTRIES = 10_000

Kind = Literal["contract", "dataset", "metric"]

#: What an entry has beside check and reason.
_PATTERNS = ("sample", "model", "category")
_OF_DATASETS = (*_PATTERNS, "message", "run")

#: What becomes in a run of the samples that an entry covers; nothing unless it says so.
LEFT_OUT, WITHOUT_SHAPE = "left out", "without shape"

#: The checks of data sets that measure something, and its unit.
MEASURING = {
    "fits": "metres",
    "mesh-centred": "metres",
    "mesh-closed": "open edges",
    "extents": "metres",
    "depth": "metres",
    "masks": "IoU or share",
    "orientations": "coverage",
}
#: Those of them by which less is worse.
LESS_IS_WORSE = frozenset({"masks", "orientations"})
_RECORDED = ("outcome", "case", "snippet")

#: What is known of a method and of an implementation of metrics had files of its own before.
_OLD_FILES: dict[Kind, str] = {
    "contract": "{}.expectations.toml",
    "metric": "{}.violations.toml",
}
#: Tables as they were called, and keys of their entries.
_OLD_TABLES: dict[Kind, str] = {"dataset": "fault", "metric": "violation"}
_OLD_KEYS = {"property": "check", "message": "reason"}

_KINDS: tuple[Kind, ...] = ("dataset", "contract", "metric")

#: What an entry has that says what fails.
_CHECKED = {"check", "property"}


@dataclass(frozen=True, kw_only=True)
class KnownFailure:
    """That ``check`` fails, and why that stays: the ``reason``.

    Of a data set's check: problems that match the patterns ``sample``, ``model``, ``category``, and
    ``message`` of what the check says, and are no worse than ``worst``, in the unit of
    :data:`MEASURING`; ``run``: how a run judges such samples. Of a metric's property: with which
    ``outcome`` for which ``case`` (JSON); ``snippet`` shows the calls, ``reason`` is what was seen.
    """

    check: str
    reason: str
    sample: str = "*"
    model: str = "*"
    category: str = "*"
    message: str = "*"
    worst: float | None = None
    run: str = ""
    outcome: Outcome = Outcome.VIOLATED
    case: str = ""
    snippet: str = ""

    def matches(self, *, sample: str, model: str, category: str) -> bool:
        """Whether the patterns of samples match."""
        there = (sample, model, category)
        return all(
            fnmatchcase(found, getattr(self, key))
            for key, found in zip(_PATTERNS, there, strict=True)
        )

    def says(self, message: str) -> bool:
        """Whether ``message`` is what the check was seen to say."""
        return fnmatchcase(message, self.message)

    def is_no_worse(self, value: float | None) -> bool:
        """Whether what the check measured is no worse than ``worst``."""
        if self.worst is None or value is None:
            return self.worst is None
        return value >= self.worst if self.check in LESS_IS_WORSE else value <= self.worst

    def __str__(self) -> str:
        keys = (*_PATTERNS, "message")
        patterns = [f"{key} {value}" for key in keys if (value := getattr(self, key)) != "*"]
        limit = [] if self.worst is None else [f"worst {self.worst:g}"]
        return " ".join([self.check, *patterns, *limit])


def gone(
    known: Iterable[KnownFailure], happened: Collection[KnownFailure], *, complete: bool
) -> list[KnownFailure]:
    """Those that must have happened and did not: of a ``complete`` run, all others."""
    return [failure for failure in known if complete and failure not in happened]


def known_failures(
    folder: Path, name: str, kind: Kind, checks: Collection[str]
) -> list[KnownFailure]:
    """What is known of ``name``, whose module is in ``folder``; nothing if there is no file.

    As :func:`read_known`. The file of an older version is read with a FutureWarning.
    """
    path = folder / f"{name}.known.toml"
    if kind in _OLD_FILES:
        old = folder / _OLD_FILES[kind].format(name)
        if os.path.isfile(old) and os.path.isfile(path):  # of a name that is too long as well
            raise DeclarationError(f"{old}: {path.name} is there as well; move its entries there")
        if os.path.isfile(old):
            warnings.warn(
                f"{old}: what is known is kept in {path.name}; rename the file",
                FutureWarning,
                stacklevel=2,
            )
            path = old
    return read_known(path, kind, checks) if os.path.isfile(path) else []


def read_known(path: Path, kind: Kind, checks: Collection[str]) -> list[KnownFailure]:
    """The entries of a kind in a file, which may name these ``checks``.

    Raises :class:`DeclarationError` for a file that cannot be read and an entry that is wrong.
    """
    try:
        content = read_toml(path)
    except DataError as error:
        raise DeclarationError(f"{path}: known failures cannot be read ({error})") from error
    entries = _tables(path, content, kind)
    if len(entries) > _MOST_ENTRIES:
        raise DeclarationError(
            f"{path}: {len(entries)} entries [[{kind}]], at most {_MOST_ENTRIES} are read; one"
            " with a pattern covers many"
        )
    known: list[KnownFailure] = []
    seen: set[str] = set()
    for number, entry in enumerate(entries, start=1):
        try:
            known.append(_parse(entry, kind, checks))
            if kind != "dataset" and known[-1].check in seen:
                raise ValueError(f"check {known[-1].check!r} is there twice")
            seen.add(known[-1].check)
        except ValueError as error:
            raise DeclarationError(f"{path}: [[{kind}]] entry {number}: {error}") from error
    return known


def _tables(path: Path, content: dict[str, Any], kind: Kind) -> list[Any]:
    tables = [content.get(kind, [])]
    old = _OLD_TABLES.get(kind)
    if old in content:
        tables.append(content[old])
        instead = ", ".join(f"{new} for {key}" for key, new in _OLD_KEYS.items())
        warnings.warn(
            f"{path}: write [[{kind}]] for [[{old}]]"
            + (f", {instead}; or record them anew with --snapshot-update" * (kind == "metric")),
            FutureWarning,
            stacklevel=4,
        )
    _check_others(path, content, kind)
    if not all(isinstance(table, list) for table in tables):
        raise DeclarationError(f"{path}: {kind} is no list of tables; write [[{kind}]] above each")
    return [entry for table in tables for entry in table]


def _check_others(path: Path, content: dict[str, Any], kind: Kind) -> None:
    """Raise :class:`DeclarationError` for a table of another name that was meant to be read."""
    for name, table in content.items():
        if name in _KINDS or name in _OLD_TABLES.values():
            continue
        entries = table if isinstance(table, list) else [table]
        meant = difflib.get_close_matches(name.lower(), _KINDS, n=1, cutoff=0.8)
        if name in ("check", "reason"):
            seen = f"{name} stands above all tables"
        elif meant or any(isinstance(e, dict) and _CHECKED & e.keys() for e in entries):
            seen = f"[[{shortened(name, 100)}]] is no table that is read"
        else:
            continue
        others = " or ".join(f"[[{each}]]" for each in _KINDS if each != kind)
        raise DeclarationError(
            f"{path}: {seen}; write [[{kind}]] above each entry ({others} for those of other kinds)"
        )


def _parse(entry: Any, kind: Kind, checks: Collection[str]) -> KnownFailure:
    """Raises ValueError."""
    needed = ("check", "reason", *(_RECORDED if kind == "metric" else ()))
    possible = (*needed, *(_OF_DATASETS if kind == "dataset" else ()))
    worst = None
    if kind == "dataset" and isinstance(entry, dict) and "worst" in entry:
        entry = {**entry}
        worst = _worst(entry.pop("worst"), entry.get("check"))
    if not isinstance(entry, dict) or not all(isinstance(text, str) for text in entry.values()):
        raise ValueError(f"{shown(entry)}, expected {', '.join(needed)} as text")
    if kind == "metric":
        entry = {_OLD_KEYS.get(key, key): text for key, text in entry.items()}
    missing = [key for key in needed if not entry.get(key, "").strip()]
    if missing:
        raise ValueError(f"{' and '.join(missing)} missing, expected {', '.join(needed)}")
    if unknown := sorted(entry.keys() - set(possible)):
        raise ValueError(
            f"{shortened(', '.join(unknown), 100)}, expected some of"
            f" {', '.join([*possible, *['worst'] * (kind == 'dataset')])}"
        )
    if entry.get("run", LEFT_OUT) not in (LEFT_OUT, WITHOUT_SHAPE):
        raise ValueError(
            f"run is {shown(entry['run'])}, expected {LEFT_OUT!r} or {WITHOUT_SHAPE!r}"
        )
    if entry["check"] not in checks:
        raise ValueError(
            f"there is no check {shown(entry['check'])}; the checks are {', '.join(checks)}"
        )
    if kind == "metric":
        entry["outcome"] = Outcome(entry["outcome"])
    return KnownFailure(**entry, worst=worst)


def _worst(value: Any, check: Any) -> float:
    """Raises ValueError."""
    if check not in MEASURING:
        raise ValueError(
            f"worst is of what a check measures, and {shown(check)} measures nothing; those that do"
            f" are {', '.join(MEASURING)}"
        )
    if isinstance(value, bool) or not isinstance(value, float | int) or not math.isfinite(value):
        raise ValueError(f"worst is {shown(value)}, expected a number ({MEASURING[check]})")
    return float(value)


def record_known(folder: Path, name: str, recorded: Sequence[KnownFailure]) -> Path:
    """Write what was seen of the implementation of metrics ``name``; returns the file's path.

    The file is removed if nothing is known. Raises :class:`DeclarationError`, with nothing written,
    if it holds what was not recorded.
    """
    path = folder / f"{name}.known.toml"
    if path.is_file():
        with raised_as(DeclarationError):
            others = read_toml(path).keys() - {"metric", "violation"}
        if others:
            raise DeclarationError(
                f"{path}: it holds {', '.join(sorted(others))} as well; move them"
            )
    if recorded:
        parts = ["# Recorded by pytest --cpas-metrics NAME --snapshot-update\n"]
        for failure in recorded:
            lines = [
                f"{key} = {_text(getattr(failure, key))}"
                for key in ("check", "outcome", "reason", "case", "snippet")
            ]
            parts += ["[[metric]]", *lines[:-1], f"{lines[-1]}\n"]
        write_file(path, "\n".join(parts), below=path.parent)
    else:
        path.unlink(missing_ok=True)
    (folder / _OLD_FILES["metric"].format(name)).unlink(missing_ok=True)
    return path


def _text(text: str) -> str:
    """A TOML string: literal where possible."""
    if "\n" in text and "'''" not in text:
        return f"'''\n{text}'''"
    if "'" not in text and text.isprintable():
        return f"'{text}'"
    escaped = "".join(
        char if char.isprintable() and char not in '"\\' else f"\\u{ord(char):04x}" for char in text
    )
    return f'"{escaped}"'
