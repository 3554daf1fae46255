"""Our own form, JSON lines: a header, then a line for each sample, with all that a method gave.

The first line of a ``.jsonl`` is the header:

* ``format``: ``"cpas-predictions"``; ``version``: 1;
* ``object_frame``: ``"shapenet"`` or ``"nocs"``, the axes of rotations, extents and shapes; camera
  axes are OpenCV's;
* ``gives``: which of ``"extents"``, ``"shape"`` and ``"score"`` every hypothesis has;
* ``classes``: all categories, in the order of the class ids of other forms;
* if they are known: ``method`` and ``dataset``, their names; ``samples``, how many the run had, so
  that a file of a part of them says so; ``provenance``, texts by name.

Every other line is about one sample:

* ``sample``: its id in the data set; ``category``; ``image``: that it is in, as the data set names
  it; ``box``: y1, x1, y2, x2 in pixels. Category and box need not be there;
* ``hypotheses``, the best first, whatever their scores: ``rotation`` 3 x 3, or its 9 numbers row by
  row; ``translation``, 3 numbers, metres; ``extents``, 3 side lengths, metres; ``score``, larger is
  surer; the shape in the object frame, metres, as ``points`` or as ``mesh`` with ``vertices`` and
  ``triangles``;
* or ``failure``: why there is no answer; ``score`` if it is a detection all the same;
* if there are any, ``detections``: what was found in its image beside the samples, for a ranking;
  each with ``category``, ``box``, and one hypothesis or ``failure`` as above.

A ``score`` of null takes no part in a ranking.

Where the samples are not known, no line has ``sample``: each is a detection with one hypothesis,
which belongs to an object of its category by its ``box``, or by its position. Points, vertices and
triangles are lists of rows of three, or the base64 of their little-endian numbers row by row under
the name of their kind: ``{"float32": "..."}``, ``float64``, ``int32``. Numbers are written so that
they are read as what they were. A folder of such files, of the shards of one run, is read as one.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.types import Array, Prediction

__all__ = ["FORMAT", "KINDS", "VERSION", "Given", "Header", "answer_line"]

FORMAT, VERSION = "cpas-predictions", 1

#: Numbers in base64, by the name of their kind.
KINDS = {"float32": "<f4", "float64": "<f8", "int32": "<i4"}


@dataclass(frozen=True, kw_only=True)
class Header:
    """The first line: see the module. ``samples``: None where it is not known."""

    object_frame: Literal["shapenet", "nocs"]
    gives: frozenset[Literal["extents", "shape", "score"]]
    classes: Sequence[str]
    method: str = ""
    dataset: str = ""
    samples: int | None = None
    provenance: Mapping[str, str] = field(default_factory=dict)

    def line(self) -> str:
        """As it is written, without the end of the line."""
        told: dict[str, Any] = {"format": FORMAT, "version": VERSION}
        for name in ("method", "dataset", "samples"):
            if getattr(self, name):
                told[name] = getattr(self, name)
        told |= {"object_frame": self.object_frame, "gives": sorted(self.gives)}
        told |= {"classes": list(self.classes), "provenance": dict(self.provenance)}
        return _json(told)


class Given(NamedTuple):
    """An answer about an object: ``category``, empty where it is not known; ``box`` (4,): y1, x1,
    y2, x2 in pixels; ``score``: how sure it is that there is one, of a detection without an answer.
    """

    category: str
    prediction: Prediction
    box: Array | None
    score: float | None = None


def answer_line(
    image: str,
    sample: str | None,
    answer: Given,
    gives: Collection[str],
    others: Sequence[Given] = (),
) -> str:
    """The line of an answer, without its end.

    ``sample``: None where it is not known; ``gives``: that of the header, whose frames those of the
    hypotheses are; ``others``: what else was found in the image, and is told with this sample.
    """
    told: dict[str, Any] = {} if sample is None else {"sample": sample}
    told |= {"image": image, **_told(answer, gives)}
    if others:
        told["detections"] = [_told(other, gives) for other in others]
    return _json(told)


def _told(answer: Given, gives: Collection[str]) -> dict[str, Any]:
    told: dict[str, Any] = {"category": answer.category} if answer.category else {}
    if answer.box is not None:
        told["box"] = answer.box.tolist()
    if not answer.prediction.hypotheses:
        if answer.score is not None:
            told["score"] = answer.score
        return {**told, "failure": answer.prediction.reason}
    hypotheses = []
    for hypothesis in answer.prediction.hypotheses:
        each: dict[str, Any] = {
            "rotation": hypothesis.rotation.tolist(),
            "translation": hypothesis.translation.tolist(),
        }
        if hypothesis.extents is not None:
            each["extents"] = hypothesis.extents.tolist()
        if "score" in gives:
            each["score"] = hypothesis.score
        if hypothesis.mesh is not None:
            each["mesh"] = {
                "vertices": _encoded(hypothesis.mesh.vertices),
                "triangles": _packed("int32", hypothesis.mesh.triangles),
            }
        elif hypothesis.points is not None:
            each["points"] = _encoded(hypothesis.points)
        hypotheses.append(each)
    return {**told, "hypotheses": hypotheses}


def _json(value: Any) -> str:
    # a lone surrogate, which no file in UTF-8 can hold, is an escape here
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def _encoded(values: Array) -> dict[str, str]:
    """Coordinates in single precision if they were given in it, else in double."""
    single = np.array_equal(values.astype(np.float32), values)
    return _packed("float32" if single else "float64", values)


def _packed(kind: str, values: NDArray[Any]) -> dict[str, str]:
    return {kind: base64.b64encode(values.astype(KINDS[kind]).tobytes()).decode("ascii")}
