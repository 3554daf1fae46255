"""Reading of :mod:`pytest_cpas.submissions.jsonl`: every line when a file is read, but that shapes
are only checked then, and read again when they are asked for."""

from __future__ import annotations

import math
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pytest_cpas.reading.files import opened
from pytest_cpas.reading.paths import matching
from pytest_cpas.reading.structured import LARGEST_JSON, json_value
from pytest_cpas.submissions.frames import Answers, Image, Submission
from pytest_cpas.submissions.jsonl import FORMAT, VERSION, Header
from pytest_cpas.submissions.jsonl_parts import (
    LARGEST,
    SHAPES,
    Place,
    Shapes,
    check_keys,
    numbers,
    shape_of,
    table,
)
from pytest_cpas.types import Array, ContractError, DataError, SampleRef, shown
from pytest_cpas.types._arrays import LARGEST_PIXEL
from pytest_cpas.types.names import checked_name, checked_text

__all__ = ["read"]

#: Hypotheses of a file, of a line, and detections in an image.
MOST_HYPOTHESES = 1_000_000
MOST_OF_LINE = 1000
MOST_IN_IMAGE = 300

_PARTS = ("extents", "shape", "score")

_DETECTION = {"category", "box", "hypotheses", "failure", "score"}

_LINE = _DETECTION | {"sample", "image", "detections"}

_HYPOTHESIS = {"rotation", "translation", "extents", "score", "points", "mesh"}


@dataclass
class _Rows:
    """The answers about an image, as they come."""

    class_ids: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    extents: list[Array] = field(default_factory=list)
    boxes: list[Array | None] = field(default_factory=list)
    samples: list[str] = field(default_factory=list)
    ranks: list[int] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    places: list[Place | None] = field(default_factory=list)
    reasons: list[str | None] = field(default_factory=list)
    detected: int = 0
    surer: int = 0

    def image(self, name: str, header: Header) -> Image:
        named = bool(self.samples)
        lacking = sum(box is None for box in self.boxes)
        # a sample that is named needs none
        if lacking and not (named and lacking < len(self.boxes)):
            boxes = None
        else:
            boxes = np.array([np.full(4, np.nan) if box is None else box for box in self.boxes])
        return Image(
            name=name,
            answers=Answers(
                class_ids=np.array(self.class_ids, dtype=np.int64),
                poses=np.array(self.poses),
                extents=np.array(self.extents) if "extents" in header.gives else None,
                boxes=boxes,
                samples=self.samples if named else None,
                ranks=np.array(self.ranks, dtype=np.int64) if named else None,
                scores=np.array(self.scores) if "score" in header.gives else None,
                shapes=Shapes(self.places) if "shape" in header.gives else None,
                reasons=self.reasons,
            ),
        )


def read(path: Path) -> Submission:
    """A file, or a folder of the files of one run's shards.

    Raises :class:`DataError` naming the line that is damaged.
    """
    files = matching(path, "*.jsonl") if os.path.isdir(path) else [path]
    first: Header | None = None
    images: dict[str, _Rows] = defaultdict(_Rows)
    seen: dict[str, str] = {}
    counts = Counter[str]()
    for file in files:
        lines = _lines(file)
        header = _header(*next(lines, (f"{file}, line 1", b"", 0)))
        counts["samples"] += header.samples or 0
        first = first or header
        for name in ("method", "dataset", "object_frame", "gives", "classes"):
            if getattr(header, name) != getattr(first, name):
                raise DataError(
                    f"{file}: {name} differs from that of {files[0]}, so they are not of one run;"
                    " name one of them"
                )
        for where, content, offset in lines:
            place = Place(file, offset, len(content))
            _take(json_value(where, content), where, place, first, images, seen, counts)
    if first is None:
        raise DataError(f"{path}: no .jsonl files in this folder")
    notes = []
    if counts["lines"] < counts["samples"]:
        notes.append(
            f"the file has answers about {counts['lines']} of the {counts['samples']} samples of"
            " its run, which was not finished, or had errors"
        )
    if surer := sum(rows.surer for rows in images.values()):
        notes.append(
            f"the first hypothesis of a line is its answer, and {surer} lines have a surer one"
            " further on, which does not count"
        )
    return Submission(
        path=path,
        form="JSON lines",
        images=[rows.image(name, first) for name, rows in images.items()],
        classes=first.classes,
        object_frame=first.object_frame,
        gives=first.gives,
        notes=notes,
        method=first.method,
        dataset=first.dataset,
        provenance=first.provenance,
    )


def _lines(file: Path) -> Iterator[tuple[str, bytes, int]]:
    """Each line that is not empty: where it is in words, what it is, and its first byte."""
    offset = number = 0
    with opened(file, LARGEST) as content:
        while line := content.readline(LARGEST_JSON + 2):
            number += 1
            where = f"{file}, line {number}"
            if len(line) > LARGEST_JSON:
                raise DataError(
                    f"{where}: more than {LARGEST_JSON} bytes, at most as many are read"
                )
            if line.strip():
                yield where, line, offset
            offset += len(line)


def _header(where: str, content: bytes, _: int) -> Header:
    if re.match(rb"[0-9a-f]{16} \{", content):
        raise DataError(
            f"{where}: this is a results file of --cpas-results, which has what was measured of"
            " answers, and no answers; pytest-cpas merge FILE judges it"
        )
    told = table(json_value(where, content), where) if content else {}
    if told.get("format") != FORMAT:
        raise DataError(
            f"{where}: expected the header of a file of --cpas-save-predictions, with"
            f' "format": "{FORMAT}"'
        )
    if told.get("version") != VERSION:
        raise DataError(
            f"{where}: version {shown(told.get('version'))}, this version reads {VERSION}"
        )
    known = {"format", "version", *Header.__dataclass_fields__}
    check_keys(told, known, {"object_frame", "gives", "classes"}, where)
    frame, gives, classes = told["object_frame"], told["gives"], told["classes"]
    if frame not in ("shapenet", "nocs"):
        raise DataError(f"{where}: object_frame is {shown(frame)}, expected shapenet or nocs")
    if not isinstance(gives, list) or any(part not in _PARTS for part in gives):
        raise DataError(f"{where}: gives is {shown(gives)}, expected some of {', '.join(_PARTS)}")
    if not isinstance(classes, list) or not classes or len(classes) > MOST_OF_LINE:
        raise DataError(f"{where}: classes is {shown(classes)}, expected a list of categories")
    samples, provenance = told.get("samples"), told.get("provenance", {})
    if samples is not None and (type(samples) is not int or not 0 <= samples < 2**31):
        raise DataError(f"{where}: samples is {shown(samples)}, expected a count")
    if not isinstance(provenance, dict) or not all(
        isinstance(text, str) for text in provenance.values()
    ):
        raise DataError(f"{where}: provenance is {shown(provenance)}, expected texts by name")
    try:
        for name in classes:
            SampleRef(id="any", category=checked_text("category", name), scene="")
        if len(set(classes)) < len(classes):
            raise DataError(f"classes has a category twice: {shown(classes)}")
        names = {
            key: checked_name(kind, told[key])
            for key, kind in (("method", "method"), ("dataset", "data set"))
            if key in told
        }
    except ContractError as error:
        raise DataError(f"{where}: {error}") from None
    return Header(
        object_frame=frame,
        gives=frozenset(gives),
        classes=tuple(classes),
        samples=samples,
        provenance=provenance,
        **names,
    )


def _take(
    value: Any,
    where: str,
    place: Place,
    header: Header,
    images: dict[str, _Rows],
    seen: dict[str, str],
    counts: Counter[str],
) -> None:
    """Take in a line; :class:`DataError` that begins with ``where``."""
    told = table(value, where)
    check_keys(told, _LINE, {"image"}, where)
    texts = _texts(told, ("sample", "image"), where)
    rows, sample = images[texts["image"]], texts.get("sample")
    if sample is not None:
        if sample in seen:
            raise DataError(f"{where}: sample {sample} is in {seen[sample]} already; keep one")
        seen[sample] = where
    if len(seen) not in (0, counts["lines"] + 1):
        raise DataError(f"{where}: some lines name a sample and others do not; name all or none")
    counts["lines"] += 1
    others = told.get("detections", [])
    if not isinstance(others, list) or (others and sample is None):
        raise DataError(
            f"{where}: detections is {shown(others)}, expected a list of those beside a sample"
        )
    _take_answer(told, sample, where, place, header, rows)
    for number, other in enumerate(others):
        what = f"{where}, detection {number + 1}"
        check_keys(table(other, what), _DETECTION, {"category"}, what)
        _take_answer(other, "", what, place._replace(detection=number), header, rows)
    if rows.detected > MOST_IN_IMAGE:
        raise DataError(f"{where}: image {texts['image']} has more than {MOST_IN_IMAGE} detections")
    counts["hypotheses"] += len(told.get("hypotheses") or ()) + len(others)
    if max(counts["hypotheses"], counts["lines"]) > MOST_HYPOTHESES:
        raise DataError(
            f"{where}: more than {MOST_HYPOTHESES} hypotheses; split the file by images"
        )


def _take_answer(
    told: Mapping[str, Any],
    sample: str | None,
    where: str,
    place: Place,
    header: Header,
    rows: _Rows,
) -> None:
    """Take in the answer about a sample; ``sample`` is None, or empty of a detection beside one,
    for one that names none."""
    category = _texts(told, ("category",), where).get("category")
    if category is not None and category not in header.classes:
        raise DataError(f"{where}: category {shown(category)} is none of the header's classes")
    box = None
    if told.get("box") is not None:
        box = numbers(told["box"], (4,), f"{where}: box")
        if not (np.abs(box) <= LARGEST_PIXEL).all():
            raise DataError(f"{where}: box is {shown(told['box'])}, expected y1, x1, y2, x2")
    reason, hypotheses = told.get("failure"), told.get("hypotheses")
    _check_answer(reason, hypotheses, where)
    if not sample:
        rows.detected += 1
        if len(hypotheses or ()) > 1:
            raise DataError(f"{where}: names no sample; such a line has one hypothesis")
    for rank, each in enumerate(hypotheses or [None]):
        rows.class_ids.append(0 if category is None else header.classes.index(category) + 1)
        rows.boxes.append(box)
        if sample is not None:
            rows.samples.append(sample)
        rows.ranks.append(rank)
        rows.reasons.append(reason)
        what = where if len(hypotheses or ()) < 2 else f"{where}, hypothesis {rank + 1}"
        _take_hypothesis(rows, each, what, header)
        if each is None and told.get("score") is not None:
            rows.scores[-1] = _score(told, header, where)
        shaped = each is not None and "shape" in header.gives
        rows.places.append(place._replace(hypothesis=rank) if shaped else None)
    first, *further = rows.scores[-len(hypotheses or [None]) :]
    rows.surer += any(score > first for score in further)


def _texts(told: Mapping[str, Any], names: Sequence[str], where: str) -> dict[str, str]:
    try:
        return {name: checked_text(name, told[name]) for name in names if name in told}
    except ContractError as error:
        raise DataError(f"{where}: {error}") from None


def _check_answer(reason: Any, hypotheses: Any, where: str) -> None:
    if (reason is None) is (hypotheses is None):
        raise DataError(f"{where}: expected either hypotheses or failure")
    if reason is not None and (not isinstance(reason, str) or not reason):
        raise DataError(f"{where}: failure is {shown(reason)}, expected the reason as text")
    if reason is None and (
        not isinstance(hypotheses, list) or not 1 <= len(hypotheses) <= MOST_OF_LINE
    ):
        raise DataError(
            f"{where}: hypotheses is {shown(hypotheses)}, expected a list of 1 to {MOST_OF_LINE}"
        )


def _take_hypothesis(rows: _Rows, value: Any, where: str, header: Header) -> None:
    """Take in a hypothesis, None for a failure. What is no number at all is an error here; a pose
    that is not finite is a failed one, as in other forms."""
    pose, extents, score = np.zeros((4, 4)), np.full(3, np.nan), math.nan
    if value is not None:
        told = table(value, where)
        check_keys(told, _HYPOTHESIS, {"rotation", "translation"}, where)
        has = {"extents", "score"} & told.keys() | ({"shape"} if told.keys() & SHAPES else set())
        if has != header.gives:
            raise DataError(
                f"{where}: it has {', '.join(sorted(has)) or 'a pose alone'}, but the header's"
                f" gives is {sorted(header.gives)}"
            )
        pose[:3, :3] = numbers(told["rotation"], (3, 3), f"{where}: rotation")
        pose[:3, 3] = numbers(told["translation"], (3,), f"{where}: translation")
        pose[3, 3] = 1
        if "extents" in has:
            extents = numbers(told["extents"], (3,), f"{where}: extents")
        if "score" in has and told["score"] is not None:
            score = _score(told, header, where)
        if "shape" in has:
            shape_of(told, where)
    rows.poses.append(pose)
    rows.extents.append(extents)
    rows.scores.append(score)


def _score(told: Mapping[str, Any], header: Header, where: str) -> float:
    score = float(numbers([told["score"]], (1,), f"{where}: score")[0])
    if not math.isfinite(score) or "score" not in header.gives:
        raise DataError(
            f"{where}: score is {score}, expected a finite number, and none unless the header's"
            " gives has it"
        )
    return score
