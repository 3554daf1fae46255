"""Properties of every metric: bad input raises, and a call leaves no traces."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pytest_cpas.checks.metrics.adapter import KNOWN, Box, Sample
from pytest_cpas.checks.metrics.properties import expect, prop
from pytest_cpas.checks.metrics.strategies import posed, seeds
from pytest_cpas.checks.metrics.subject import Subject
from pytest_cpas.types import Symmetry

Generator = np.random.Generator


def _turn(rng: Generator) -> Any:
    return Rotation.from_rotvec(rng.normal(size=3)).as_matrix()


def _box(rng: Generator) -> Box:
    return Box(_turn(rng), rng.normal(size=3) / 20, rng.uniform(0.1, 0.3, 3))


def _sample(rng: Generator) -> Sample:
    return posed(_turn(rng), rng.normal(size=3) / 20, rng.uniform(0.1, 0.3, 3))


def _clouds(rng: Generator) -> tuple[Any, Any]:
    return rng.normal(size=(7, 3)) / 10, rng.normal(size=(9, 3)) / 10


def _ahead(rng: Generator) -> Box:
    """A box in front of the camera."""
    return Box(_turn(rng), [0, 0, 1] + rng.normal(size=3) / 20, rng.uniform(0.1, 0.3, 3))


def _detected(rng: Generator) -> tuple[Any, ...]:
    return (
        np.zeros(4, dtype=int), np.zeros(4, dtype=int), rng.random(4),
        np.zeros(3, dtype=int), np.zeros(3, dtype=int),
        rng.uniform(0, 20, (4, 3)), rng.uniform(0, 0.1, (4, 3)),
    )  # fmt: skip


def _posed_points(rng: Generator) -> tuple[Any, ...]:
    places = [[0, 0, 1] + rng.normal(size=3) / 20 for _ in range(2)]
    return _turn(rng), places[0], _turn(rng), places[1], rng.normal(size=(7, 3)) / 10


def _errors(rng: Generator) -> dict[str, Any]:
    return {"rotation_deg": rng.uniform(0, 20, 6), "position_m": rng.uniform(0, 0.04, 6)}


_LIMITS = {"rotation_deg": 10.0, "position_m": 0.02}

#: Ordinary arguments of each metric.
ARGUMENTS: dict[str, Callable[[Generator], tuple[Any, ...]]] = {
    "rotation_error": lambda rng: (_turn(rng), _turn(rng)),
    "symmetric_rotation_error": lambda rng: (
        _turn(rng), _turn(rng), Symmetry.about((0, 1, 0))
    ),
    "translation_error": lambda rng: (rng.normal(size=3), rng.normal(size=3)),
    "box_iou": lambda rng: (_box(rng), _box(rng)),
    "symmetric_box_iou": lambda rng: (_box(rng), _box(rng), Symmetry.about((0, 1, 0))),
    "average_distance": _clouds,
    "chamfer": _clouds,
    "surface_precision": lambda rng: (*_clouds(rng), 0.05),
    "surface_recall": lambda rng: (*_clouds(rng), 0.05),
    "fscore": lambda rng: (*_clouds(rng), 0.05),
    "nad": _clouds,
    "diameter": lambda rng: (_clouds(rng)[0],),
    "precision": lambda rng: (_errors(rng), dict(_LIMITS)),
    "mean_precision": lambda rng: (
        _errors(rng), dict(_LIMITS), ["mug", "mug", "can", "can", "can", "mug"], ["mug", "can"]
    ),
    "iou_auc": lambda rng: (rng.random(6), 0.25),
    "pose_vus": lambda rng: (rng.uniform(0, 20, 6), rng.uniform(0, 0.04, 6), 10.0, 0.05),
    "pose_correct": lambda rng: (
        _sample(rng), _sample(rng),
        {"rotation_deg": 179.0, "position_m": 1.0, "iou": 0.01, "fscore": 0.01, "nad": 1.0},
        None,
    ),
    "average_precision": lambda rng: (rng.random(6), rng.random(6) < 0.5, 6),
    "detection_ap": lambda rng: (
        np.zeros(4, dtype=int), np.zeros(4, dtype=int), rng.random(4),
        np.zeros(3, dtype=int), np.zeros(3, dtype=int), rng.random((4, 3)), 0.25, 0,
    ),
    "equal_diagonals_iou": lambda rng: (_ahead(rng), _ahead(rng)),
    "relative_translation_error": lambda rng: (_ahead(rng), _ahead(rng)),
    "axis_aligned_iou": lambda rng: (_box(rng), _box(rng), 3),
    "legacy_iou": lambda rng: (_box(rng), _box(rng), 3),
    "iou_plus": _clouds,
    "best_precision": lambda rng: ([[{"iou": 0.1}, {"iou": rng.random()}]], {"iou": 0.5}),
    "worst_precision": lambda rng: ([[{"iou": 0.9}, {"iou": rng.random()}]], {"iou": 0.5}),
    "precision_curve": lambda rng: (rng.random(6), "iou", np.array([0.25, 0.5])),
    "count_interval": lambda rng: (int(rng.integers(9)), 9, 0.95),
    "mean_interval": lambda rng: (rng.random(9), 0.95),
    "median_interval": lambda rng: (rng.random(9), 0.95),
    "mean_detection_ap": lambda rng: (
        np.zeros(4, dtype=int), np.arange(4) % 2, rng.random(4),
        np.zeros(3, dtype=int), np.arange(3) % 2, rng.random((4, 3)), 0.25, [0, 1],
    ),
    "pose_ap": lambda rng: (*_detected(rng), 10.0, 0.05, 0),
    "matched_pose_ap": lambda rng: (*_detected(rng), 10.0, 0.05, 0, rng.random((4, 3))),
    "sample_surface": lambda rng: (
        rng.normal(size=(5, 3)), np.array([[0, 1, 2], [2, 3, 4]]), 20, int(rng.integers(100))
    ),
    "add": _posed_points,
    "add_s": _posed_points,
    "mssd": lambda rng: (*_posed_points(rng), Symmetry.box()),
    "mspd": lambda rng: (
        *_posed_points(rng), Symmetry.box(), np.array([600.0, 590.0, 320.0, 240.0]), 640
    ),
}  # fmt: skip

#: Metrics on points, which can be without any.
_POINTS = (
    "average_distance", "chamfer", "surface_precision", "surface_recall", "fscore", "nad",
    "diameter", "iou_plus",
)  # fmt: skip


#: Without an array of numbers among their arguments.
_NO_ARRAYS = ("best_precision", "worst_precision", "count_interval")

#: Of a list of numbers no length is wrong.
_LISTS = ("iou_auc", "precision_curve", "mean_interval", "median_interval")

#: What NaN is n/a to.
_NAN_IS_NA = ("mean_interval", "median_interval")


def has_wrong_shapes(metric: str) -> bool:
    """Whether there are arrays that are no arguments of a metric by their shape."""
    return metric not in (*_NO_ARRAYS, *_LISTS)


def refuses_nan(metric: str) -> bool:
    """Whether NaN is no argument of a metric."""
    return metric not in (*_NO_ARRAYS, *_NAN_IS_NA)


def _arrays(args: tuple[Any, ...]) -> Iterator[tuple[Callable[[Any], tuple[Any, ...]], Any]]:
    """Each array of real numbers among the arguments, with what puts another one in its place."""
    for i, arg in enumerate(args):

        def put(new: Any, i: int = i) -> tuple[Any, ...]:
            return (*args[:i], new, *args[i + 1 :])

        if isinstance(arg, np.ndarray) and arg.dtype == np.float64:
            yield put, arg
        elif isinstance(arg, (Box, Sample)):
            for name, part in vars(arg).items():

                def put_part(new: Any, arg: Any = arg, name: str = name, put: Any = put) -> Any:
                    return put(type(arg)(**{**vars(arg), name: new}))

                yield put_part, part
        elif isinstance(arg, dict):
            for name, part in arg.items():

                def put_entry(new: Any, arg: Any = arg, name: str = name, put: Any = put) -> Any:
                    return put({**arg, name: new})

                if isinstance(part, np.ndarray):
                    yield put_entry, part


def _of_each_metric(metric: str) -> None:
    make = ARGUMENTS[metric]

    def leaves_no_traces(subject: Subject, seed: int) -> None:
        """A call changes no argument, prints nothing, and leaves global random numbers alone."""
        subject.conduct(metric, *make(np.random.default_rng(seed)))

    def repeatable(subject: Subject, seed: int) -> None:
        """The same arguments give the same result, twice and in a row."""
        args = make(np.random.default_rng(seed))
        one, other = subject(metric, *args), subject(metric, *args)
        expect(one == other, f"{one!r} the first time, {other!r} the second")

    def nan_rejected(subject: Subject, seed: int, where: int) -> None:
        """NaN in an argument raises."""
        rng = np.random.default_rng(seed)
        slots = list(_arrays(make(rng)))
        put, array = slots[where % len(slots)]
        broken = array.copy()
        broken.flat[int(rng.integers(broken.size))] = np.nan
        subject.refuses(metric, *put(broken))

    def wrong_shape_rejected(subject: Subject, seed: int, where: int) -> None:
        """An argument of another shape raises."""
        slots = list(_arrays(make(np.random.default_rng(seed))))
        put, array = slots[where % len(slots)]
        subject.refuses(metric, *put(array[..., :-1]))

    def empty_rejected(subject: Subject, seed: int, where: int) -> None:
        """A surface without points raises."""
        slots = list(_arrays(make(np.random.default_rng(seed))))
        put, _ = slots[where % len(slots)]
        subject.refuses(metric, *put(np.zeros((0, 3))))

    def matrices(subject: Subject) -> bool:
        definition = subject.offers[metric].definition
        plain = definition.get("rotation", "matrix") == "matrix"
        return plain and definition.get("box") != ("corners",)

    prop(
        metric,
        reason="a metric that changes its input corrupts the next one; global random numbers make"
        " it depend on what ran before",
        given={"seed": seeds},
        weight=0.2,
    )(leaves_no_traces)
    prop(
        metric,
        reason="a number that changes from call to call cannot be compared",
        given={"seed": seeds},
        weight=0.2,
    )(repeatable)
    broken = {"seed": seeds, "where": st.integers(0, 7)}
    if refuses_nan(metric):
        prop(
            metric,
            reason="NaN compares false with every threshold, so that it passes as correct or wrong",
            given=broken,
            weight=0.6,
            applies=matrices,
        )(nan_rejected)
    if has_wrong_shapes(metric):
        prop(
            metric,
            reason="broadcast or cut off, wrong shapes give numbers that look right",
            given=broken,
            weight=0.6,
            applies=matrices,
        )(wrong_shape_rejected)
    if metric in _POINTS:
        prop(
            metric,
            reason="a missing reconstruction must not score: a mean of nothing is NaN, or 0",
            given=broken,
            weight=0.2,
        )(empty_rejected)


for _metric in KNOWN:
    _of_each_metric(_metric)
