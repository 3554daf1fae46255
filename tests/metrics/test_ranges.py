"""Every public name of the metrics against numbers that are none, or far too large: it gives its
documented value or a ContractError, never NaN, an infinity or a warning of NumPy."""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from pytest_cpas import metrics
from pytest_cpas.metrics import (
    AveragePrecision,
    Count,
    Detections,
    Errors,
    Interval,
    JointThreshold,
    ModelPoints,
    Surface,
    SurfaceErrors,
    add,
    add_s,
    axis_aligned_box_iou,
    best_and_worst,
    count,
    count_by_category,
    curve,
    definition,
    diameter,
    iou_auc,
    iou_plus,
    mean_interval,
    mean_over_categories,
    median_interval,
    mspd,
    mssd,
    nocs_legacy_iou,
    oriented_iou,
    pose_vus,
    require_same_definition,
    rotation_error,
    sample_surface,
    scene_mean_intervals,
    scene_median_interval,
    surface_errors,
    symmetric_iou,
    symmetry_rotations,
    translation_error,
)
from pytest_cpas.types import Camera, ContractError, Mesh, Pose, Symmetry

EYE, ORIGIN, UNIT = np.eye(3), np.zeros(3), np.ones(3)
POINTS = np.random.default_rng(0).random((100, 3))
CORNER = Mesh(np.eye(3), np.array([[0, 1, 2]]))
POSE = Pose(EYE, ORIGIN)
ASIDE = Pose(EYE, [0.0, 0.1, 1.0])
CAMERA = Camera(640, 480, 600.0, 600.0, 320.0, 240.0)
ERRORS = Errors({"rotation_deg": [1.0, 2.0], "iou": [0.5, 0.7]})
NARROW = JointThreshold(rotation_deg=1.5)
BOXES: dict[str, Any] = {
    "rotation_a": EYE,
    "translation_a": ORIGIN,
    "extents_a": UNIT,
    "rotation_b": EYE,
    "translation_b": ORIGIN,
    "extents_b": UNIT,
}
FOUND: dict[str, Any] = {
    "pred_image": [0, 1],
    "pred_category": [1, 1],
    "pred_score": [0.5, 0.4],
    "true_image": [0, 1],
    "true_category": [1, 1],
    "categories": [1],
}


def detections() -> Detections:
    return Detections(**FOUND)


def surfaces(thresholds: Any) -> list[Any]:
    found = surface_errors(Surface(POINTS), POINTS + 0.01)
    return [found.recall(thresholds), found.precision(thresholds), found.fscore(thresholds)]


def distances(to_estimate: Any, to_truth: Any) -> list[Any]:
    surface = Surface(POINTS)
    found = SurfaceErrors(to_estimate, to_truth, surface, surface)
    return [found.chamfer, found.nad, found.fscore(0.1)]


#: Of an interval.
VALUES: dict[str, Any] = {"values": [0.1, 0.4, 0.2, 0.9, 0.3, 0.7, 0.5] * 2, "confidence": 0.9}
SCENES = [0, 1, 2, 3, 4, 5, 6] * 2


def ends(interval: Interval | None) -> list[float]:
    return [] if interval is None else [interval.low, interval.high]


def finite_ends(interval: Interval | None) -> list[float]:
    """Infinite values take part in medians."""
    return [end for end in ends(interval) if not math.isinf(end)]


#: A call with sound arguments for every function, and every class, that takes numbers; each of the
#: arguments is replaced in turn.
CALLS: dict[str, list[tuple[Callable[..., Any], dict[str, Any]]]] = {
    "AveragePrecision": [(lambda value: AveragePrecision({1: value}).mean, {"value": 0.5})],
    "Count": [
        (lambda correct, total: Count(correct, total).interval(), {"correct": 1, "total": 2}),
        (Count(1, 2).interval, {"confidence": 0.9}),
    ],
    "Definition": [
        (definition("ap", "nocs-iou").id, {"iou": 0.5, "limit": 0.25}),
    ],
    "Detections": [
        (lambda **found: Detections(**found).iou_ap([1, 1], 0.5).mean, FOUND),
        (lambda **given: detections().iou_ap(**given).mean, {"iou": [0.3, 0.9], "threshold": 0.5}),
        (
            lambda **given: detections().pose_ap(**given).mean,
            {
                "rotation_deg": [1.0, 2.0],
                "position_m": [0.1, 0.2],
                "max_rotation_deg": 5,
                "max_position_m": 0.15,
                "match_iou": [0.5, 0.4],
            },
        ),
    ],
    "Errors": [
        (
            lambda x, name=name: count(Errors({name: x}), JointThreshold(**{name: 0.5})),
            {"x": [0.1, 0.6]},
        )
        for name in ("rotation_deg", "position_m", "iou", "fscore", "nad")
    ],
    "JointThreshold": [
        (lambda x, name=name: JointThreshold(**{name: x}).label, {"x": 0.5})
        for name in ("rotation_deg", "position_m", "iou", "fscore", "nad")
    ],
    "Surface": [(lambda points: Surface(points).diameter, {"points": POINTS})],
    "SurfaceErrors": [
        (surfaces, {"thresholds": [0.1, 0.2]}),
        (distances, {"to_estimate": [0.1, 0.2], "to_truth": [0.3]}),
    ],
    "axis_aligned_box_iou": [(axis_aligned_box_iou, BOXES | {"spins": 3})],
    "best_and_worst": [
        (lambda x: best_and_worst([[{"rotation_deg": x}]], NARROW), {"x": 1.0}),
    ],
    "count": [(lambda among: count(ERRORS, NARROW, among), {"among": np.array([True, False])})],
    "count_by_category": [
        (lambda names: count_by_category(ERRORS, names, NARROW, ["a"]), {"names": ["a", "b"]}),
    ],
    "curve": [(lambda x: curve(ERRORS, "rotation_deg", x), {"x": [0.5, 1.5]})],
    "definition": [(definition, {"name": "iou", "variant": "oriented"})],
    "diameter": [(diameter, {"points": POINTS})],
    "iou_auc": [(iou_auc, {"iou": [0.2, 0.9], "lower": 0.25, "bins": 10})],
    "iou_plus": [
        (
            lambda a, b: iou_plus(a, POSE, b, POSE),
            {"a": POINTS, "b": POINTS},
        )
    ],
    "mean_interval": [(lambda **given: ends(mean_interval(**given)), VALUES)],
    "mean_over_categories": [(lambda x: mean_over_categories({"a": x}), {"x": Count(1, 2)})],
    "median_interval": [(lambda **given: finite_ends(median_interval(**given)), VALUES)],
    "nocs_legacy_iou": [(nocs_legacy_iou, BOXES | {"spins": 3})],
    "oriented_iou": [(oriented_iou, BOXES)],
    "pose_vus": [
        (
            pose_vus,
            {
                "rotation_deg": [1.0, 2.0],
                "position_m": [0.1, 0.2],
                "max_rotation_deg": 5,
                "max_position_m": 0.15,
                "bins": 10,
            },
        )
    ],
    "require_same_definition": [
        (require_same_definition, {"ours": "iou:oriented:1", "theirs": "iou:oriented:1"})
    ],
    "rotation_error": [(rotation_error, {"estimate": EYE, "truth": EYE})],
    "sample_surface": [
        (lambda **given: sample_surface(CORNER, **given), {"count": 5, "seed": 0}),
        (
            lambda vertices: sample_surface(Mesh(vertices, CORNER.triangles), 5, 0),
            {"vertices": CORNER.vertices},
        ),
    ],
    "scene_mean_intervals": [
        (
            lambda **given: [ends(each) for each in scene_mean_intervals(**given)],
            VALUES | {"values": np.transpose([VALUES["values"]] * 2), "scenes": SCENES},
        )
    ],
    "scene_median_interval": [
        (
            lambda **given: finite_ends(scene_median_interval(**given)),
            VALUES | {"scenes": SCENES},
        )
    ],
    "surface_errors": [
        (
            lambda **given: [surface_errors(Surface(POINTS), **given).chamfer],
            {"estimate": POINTS},
        )
    ],
    "symmetric_iou": [
        (lambda s=s, **given: symmetric_iou(**given, symmetry=s), BOXES)
        for s in (Symmetry.none(), Symmetry.about([0, 1, 0]), Symmetry.full())
    ],
    "ModelPoints": [(lambda points: ModelPoints.of(points).diameter, {"points": POINTS})],
    "add": [(lambda points: add(POSE, ASIDE, ModelPoints.of(points)), {"points": POINTS})],
    "add_s": [(lambda points: add_s(POSE, ASIDE, ModelPoints.of(points)), {"points": POINTS})],
    "mssd": [
        (
            lambda points: mssd(POSE, ASIDE, ModelPoints.of(points), Symmetry.none()),
            {"points": POINTS},
        )
    ],
    "mspd": [
        (
            lambda points: mspd(POSE, ASIDE, ModelPoints.of(points), Symmetry.none(), CAMERA),
            {"points": POINTS},
        )
    ],
    "symmetry_rotations": [
        (lambda axis: symmetry_rotations(Symmetry.about(axis)), {"axis": [0, 1, 0]})
    ],
    "translation_error": [(translation_error, {"estimate": ORIGIN, "truth": UNIT})],
}

#: Constants, which take nothing, and what is only given.
CONSTANTS = {"DEFINITIONS", "FAILED", "Interval", "METRICS", "PAPER_THRESHOLDS", "POSE_MATCH_IOU"}

SCALES = (
    math.nan, math.inf, -math.inf, -1.0, 0.0, 5e-324, 1e-310, 1e-200, 1e-110, 1e-60, 1e-31, 1e-16,
    1e16, 1e31, 1e60, 1e103, 1e200, 1.7e308,
)  # fmt: skip


def hostile(sound: Any) -> Iterator[tuple[str, Any]]:
    """Instead of an argument: others of its shape, and others of another shape or kind."""
    array = np.asarray(sound)
    if array.dtype.kind in "iuf":
        for scale in SCALES:
            with np.errstate(all="ignore"):
                whole = np.nan_to_num(array * np.float64(scale), nan=0)
            yield f"all times {scale}", whole if array.ndim else float(whole)
            if array.size:
                one = np.array(array, dtype=float)
                one.flat[0] = scale
                yield f"first {scale}", one if array.ndim else float(one)
        with np.errstate(over="ignore"):
            yield "float16", array.astype(np.float16)
        yield "longdouble", array.astype(np.longdouble)
        yield "complex", array + 1j
        yield "texts", array.astype(str)
        yield "objects", array.astype(object)
        yield "huge integers", np.full(array.shape, 10**400, dtype=object).tolist()
        yield "half", array + 0.5
        yield "ragged", [array.tolist(), [array.tolist()]]
    yield "text", "much"
    yield "none", None
    yield "empty", []
    yield "empty rows", np.empty((0, 3))
    yield "number", 3
    yield "dates", np.zeros(array.shape, "datetime64[s]")
    yield "more dimensions", np.zeros((*array.shape, 1, 2))
    yield "object", object()
    yield "true", True


def values(result: Any) -> Iterator[float]:
    """Every number in a result, whatever it is of."""
    if isinstance(result, Count):
        yield from (result.correct, result.total)
    elif isinstance(result, dict):
        yield from itertools.chain.from_iterable(map(values, result.values()))
    elif isinstance(result, list | tuple):
        yield from itertools.chain.from_iterable(map(values, result))
    elif isinstance(result, np.ndarray):
        yield from result.ravel().tolist()
    elif isinstance(result, int | float):
        yield result
    else:
        assert result is None or isinstance(result, str | metrics.Definition), type(result)


def test_every_public_name_is_called():
    assert set(CALLS) | CONSTANTS == set(metrics.__all__)
    assert not set(CALLS) & CONSTANTS


@pytest.mark.parametrize("name", CALLS)
def test_sound_arguments_give_a_number(name):
    for call, arguments in CALLS[name]:
        assert all(math.isfinite(value) for value in values(call(**arguments)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", CALLS)
def test_no_argument_gives_nan_or_infinity_in_silence(name):
    for call, arguments in CALLS[name]:
        for argument, sound in arguments.items():
            for what, value in hostile(sound):
                with np.errstate(all="warn", under="ignore"):
                    try:
                        found = list(values(call(**arguments | {argument: value})))
                    except ContractError:
                        continue
                    except Exception as error:
                        pytest.fail(f"{name}, {argument}: {what}: {type(error).__name__}: {error}")
                assert all(map(math.isfinite, found)), f"{name}, {argument}: {what}: {found}"


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: oriented_iou(EYE, ORIGIN, 1e-110 * UNIT, EYE, ORIGIN, UNIT), "at least 1e-100"),
        (lambda: oriented_iou(EYE, ORIGIN, 1e103 * UNIT, EYE, ORIGIN, UNIT), "at most 1e[+]100"),
        (lambda: translation_error([1e200, 0, 0], ORIGIN), "at most 1e[+]100"),
        (lambda: Errors({"rotation_deg": [-1.0]}), "rotation_deg is -1, expected 0 or more"),
        (lambda: Errors({"iou": [1.5]}), "iou is 1.5, expected 0 or more.*1 at most"),
        (lambda: surfaces(math.nan), "thresholds.*NaN"),
        (lambda: Count(1.5, 2), "correct: 1.5, expected an integer"),  # type: ignore[arg-type]
        (lambda: pose_vus([1.0], [1.0], math.inf, 1), "the largest rotation_deg: inf"),
    ],
)
def test_what_was_silent_is_told(call, words):
    with pytest.raises(ContractError, match=words):
        call()


def test_extremes_that_are_read_rightly():
    for scale in (1e-99, 1e-30, 1e30, 1e99):
        box = (EYE, scale * UNIT, scale * UNIT)
        half = (EYE, scale * UNIT, scale * UNIT * [1, 1, 0.5])
        assert oriented_iou(*box, *half) == pytest.approx(0.5)
        assert symmetric_iou(*box, *half, Symmetry.about([0, 1, 0])) == pytest.approx(0.5)
        assert axis_aligned_box_iou(*box, *half) == pytest.approx(0.5)
    assert axis_aligned_box_iou(EYE, 1e20 * UNIT, UNIT, EYE, 1e20 * UNIT, UNIT) == 1
    for scale in (1e-250, 1e-150, 1e29):
        assert diameter(scale * POINTS) == pytest.approx(scale * diameter(POINTS))


@pytest.mark.parametrize("thin", [1e-5, 1e-9, 1e-14])
def test_search_over_spins_of_thin_boxes_ends(thin):
    turned = Pose(np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]]), ORIGIN)
    for symmetry in (Symmetry.about([0, 1, 0]), Symmetry.full()):
        value = symmetric_iou(
            turned.rotation, 0.1 * UNIT, [thin, 1, 1], EYE, ORIGIN, [1, thin, 1], symmetry
        )
        assert 0 <= value <= 1
