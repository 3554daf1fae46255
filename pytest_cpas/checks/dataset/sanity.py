"""The checks of a data set.

A check returns its problems, worst first, or None where the data set has nothing that it could
judge. A fault is named once: where a camera, a pose or a mesh is wrong, what follows from it
(depth, mask, extents) is not judged.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from pytest_cpas.checks.dataset.facts import ImageFacts, MeshFacts, SampleFacts, Survey
from pytest_cpas.checks.dataset.orientations import REACH, up_axis_spread
from pytest_cpas.datasets._edges import told_edges
from pytest_cpas.golden.published import count_problems, published_sample_counts

__all__ = ["CHECKS", "Check", "Problem"]

#: Largest median difference of measured and rendered depth, metres: the distance at which the
#: paper's F-score calls two surfaces different.
MAX_RESIDUAL = 0.01

#: How badly a pose may fit what it is fitted to, metres: half of that, where it is a few points; of
#: many measured ones, of which half may be off, all of it.
MAX_FIT = MAX_RESIDUAL / 2

#: Smallest IoU of mask and silhouette. Fingers on an object that are less than 1 cm thick count
#: against it; the embedded hand-held data set goes down to 0.80.
MIN_IOU = 0.7

#: Smallest share of the mask's rectangle in that of the projected box, where there is no mesh.
MIN_OVERLAP = 0.7

#: Farthest that an object may be, metres: it is what can be handled, seen by a depth camera.
MAX_DISTANCE = 10.0

#: Diagonals of objects that can be handled, metres. A mesh normalised to its diagonal has 1.
MIN_DIAGONAL, MAX_DIAGONAL = 0.02, 0.75

#: Tolerance of a mesh's centre and of extents, metres.
MAX_BOX_ERROR = 0.001

#: From that share of its pixels on, an inside that is seen is a hole and not a ragged edge.
MIN_HOLE = 0.03

#: Least coverage of free orientations (see :func:`up_axis_spread`), and the least number of samples
#: that says anything about it.
MIN_COVERAGE, MIN_ORIENTATIONS = 1 / 3, 20


@dataclass(frozen=True)
class Problem:
    """What is wrong, and with which sample, model or category (where it is one of them).

    ``value``: what was measured, if anything was, in the unit of
    :data:`pytest_cpas.checks.known.MEASURING`.
    """

    message: str
    sample: str = ""
    model: str = ""
    category: str = ""
    value: float | None = None

    def __str__(self) -> str:
        what = ", ".join(filter(None, (self.category, self.model)))
        if self.sample:
            return f"{self.sample} ({what}): {self.message}"
        return f"{self.model or self.category}: {self.message}" if what else self.message


Check = Callable[[Survey], list[Problem] | None]


def check_readable(survey: Survey) -> list[Problem] | None:
    """Every sample can be listed and read."""
    where = {ref.id: ref for ref in survey.refs}
    return [Problem(message) for message in survey.damaged] + [
        Problem(message, sample, where[sample].model, where[sample].category)
        for sample, message in survey.unreadable.items()
    ]


def check_counts(survey: Survey) -> list[Problem] | None:
    """Each category has as many samples as were published; a partial copy has no more."""
    problems = count_problems(survey.name, survey.listed, partial=bool(survey.missing))
    if not problems and survey.listed != published_sample_counts(survey.name):
        return None
    return [Problem(message, category=name) for name, message in problems.items()]


def check_intrinsics(survey: Survey) -> list[Problem] | None:
    """Intrinsics are those of images of that size."""
    users = defaultdict(list)
    for facts, image in _with_image(survey):
        users[image.camera].append(facts.sample)
    if not users:
        return None
    return [
        Problem(f"{message}; {len(samples)} samples have this camera, first {samples[0]}")
        for camera, samples in users.items()
        if (message := _camera_fault(camera))
    ]


def _camera_fault(camera: tuple[int, int, float, float, float, float]) -> str:
    width, height, fx, fy, cx, cy = camera
    off = max(abs(cx - (width - 1) / 2) / width, abs(cy - (height - 1) / 2) / height)
    if off > 0.15:
        return (
            f"principal point ({cx:g}, {cy:g}) in images of {width} x {height}, expected near"
            " their centre; are these the intrinsics of another resolution?"
        )
    if abs(fx / fy - 1) > 0.05:
        return f"fx {fx:g} and fy {fy:g} differ by more than 5 %, expected square pixels"
    view = math.degrees(2 * math.atan(width / fx / 2))
    if not 20 < view < 120:
        return (
            f"fx {fx:g} in images {width} pixels wide is a field of view of {view:.0f} deg,"
            " expected 20 to 120; are these the intrinsics of another resolution?"
        )
    return ""


def check_poses(survey: Survey) -> list[Problem] | None:
    """Objects are before the camera, not too far, and their centres in the image.

    That a rotation is proper is checked when a sample is read.
    """
    if not survey.samples:
        return None
    return [
        _problem(facts, message)
        for facts in survey.samples.values()
        if (message := _pose_fault(facts))
    ]


def _pose_fault(facts: SampleFacts) -> str:
    if facts.distance <= 0:
        return (
            f"its centre is at z = {facts.distance:.3f} m, behind the camera; expected z > 0 (x"
            " right, y down, z forward). Is the pose camera to object, or in OpenGL axes?"
        )
    if facts.distance > MAX_DISTANCE:
        return (
            f"its centre is at z = {facts.distance:.1f} m, expected at most {MAX_DISTANCE:.0f} m;"
            " is the translation in millimetres?"
        )
    image = facts.image
    if image is not None and image.centre is not None and not _camera_fault(image.camera):
        width, height, *_ = image.camera
        u, v = image.centre
        # the centre of an object that is cut by the image's edge may lie a little outside
        if not (-0.25 * width < u < 1.25 * width and -0.25 * height < v < 1.25 * height):
            return f"its centre projects to ({u:.0f}, {v:.0f}), outside of {width} x {height}"
    return ""


def check_fits(survey: Survey) -> list[Problem] | None:
    """A fitted pose fits: what it is fitted to is where the posed model has it."""
    judged = [
        (facts.fit_error, _fit_limit(survey, facts.sample), facts)
        for facts in survey.samples.values()
        if facts.fit_error is not None
    ]
    if not judged:
        return None
    return [
        _problem(
            facts,
            f"what its pose is fitted to is {1000 * error:.1f} mm from where the posed model has"
            f" it, expected at most {1000 * limit:g} mm",
            error,
        )
        for error, limit, facts in sorted(judged, key=lambda entry: -entry[0])
        if error > limit
    ]


def _fit_limit(survey: Survey, sample: str) -> float:
    fitted = [each for each in survey.derived if each.part == "pose" and each.covers(sample)]
    return MAX_RESIDUAL if any("depth" in each.made_of for each in fitted) else MAX_FIT


def check_meshes_metric(survey: Survey) -> list[Problem] | None:
    """Meshes have the size of something that can be handled, in metres."""
    return _of_meshes(survey, _size_fault)


def _size_fault(mesh: MeshFacts) -> str:
    diagonal = math.hypot(*mesh.extents)
    if MIN_DIAGONAL <= diagonal <= MAX_DIAGONAL:
        return ""
    cause = ""
    if abs(diagonal - 1) < 0.01 or abs(max(mesh.extents) - 1) < 0.01:
        cause = "; it seems to be normalised"
    elif MIN_DIAGONAL <= diagonal / 1000 <= MAX_DIAGONAL:
        cause = "; it seems to be in millimetres"
    return (
        f"its box has a diagonal of {diagonal:.4g}, expected {MIN_DIAGONAL} to {MAX_DIAGONAL}"
        f" metres{cause}"
    )


def check_meshes_centred(survey: Survey) -> list[Problem] | None:
    """The origin is in the centre of a mesh's box."""

    def fault(mesh: MeshFacts) -> str:
        distance = math.hypot(*mesh.centre)
        if distance <= MAX_BOX_ERROR or _size_fault(mesh):
            return ""
        return (
            f"the centre of its box is {1000 * distance:.1f} mm from the origin, expected at most"
            f" {1000 * MAX_BOX_ERROR:g} mm: box and position would mean different points"
        )

    return _of_meshes(survey, fault, lambda mesh: math.hypot(*mesh.centre))


def check_meshes_closed(survey: Survey) -> list[Problem] | None:
    """Meshes are closed surfaces that face outwards.

    The paper (section on data sets) found that the original meshes of REAL275 have no bottoms:
    points sampled on them, and so the F-score, then miss a part of the object.
    """

    def fault(mesh: MeshFacts) -> str:
        if mesh.open_edges == 0:
            if mesh.volume > 0:
                return ""
            return "its triangles are wound inside out (the volume is negative)"
        holes = [
            f"it has no closed {side}: {share:.0%} of what is seen from there is its inside"
            for side, share in sorted(mesh.inside.items(), key=lambda item: -item[1])
            if share >= MIN_HOLE
        ]
        single = mesh.open_edges - mesh.crowded_edges
        return "; ".join([*holes, told_edges(single, mesh.crowded_edges)])

    return _of_meshes(survey, fault, lambda mesh: mesh.open_edges)


def check_extents(survey: Survey) -> list[Problem] | None:
    """A sample's extents are those of its mesh's box, unless they are made of it."""
    judged = [
        (facts.extents_error, facts)
        for facts in survey.samples.values()
        if facts.extents_error is not None
        and not _size_fault(survey.meshes[facts.mesh])
        and not survey.compares_itself(facts.sample, "extents")
    ]
    if not judged:
        return None
    return [
        _problem(
            facts,
            f"extents differ from the mesh's box by {1000 * error:.1f} mm, expected at most"
            f" {1000 * MAX_BOX_ERROR:g} mm; are axes exchanged, or are they half extents?",
            error,
        )
        for error, facts in sorted(judged, key=lambda pair: -pair[0])
        if error > MAX_BOX_ERROR
    ]


def check_depth(survey: Survey) -> list[Problem] | None:
    """The measured depth is that of the mesh at its pose."""
    judged = [
        (image.residual, image.offset, facts)
        for facts, image in _sound(survey)
        if image.residual is not None and image.offset is not None
    ]
    if not judged:
        return None
    return [
        _problem(
            facts,
            f"the median |measured - rendered| depth is {1000 * residual:.1f} mm (median"
            f" difference {1000 * offset:+.1f} mm), expected at most {1000 * MAX_RESIDUAL:g} mm"
            f"{_other_unit(facts.distance, offset)}",
            residual,
        )
        for residual, offset, facts in sorted(judged, key=lambda entry: -entry[0])
        if residual > MAX_RESIDUAL
    ]


def _other_unit(distance: float, offset: float) -> str:
    """What tells of a depth image whose steps, or a pose whose translation, are in another unit
    than the reader takes."""
    times = 1 + offset / distance
    near = [unit for unit in (0.001, 0.01, 0.1, 10, 100, 1000) if 2 / 3 < times / unit < 3 / 2]
    told = "; what was measured is about {:g} times as far as the object: is a step of the depth"
    told += " image of another length, or the pose's translation in another unit?"
    return told.format(*near) if near else ""


def check_masks(survey: Survey) -> list[Problem] | None:
    """The mask is the visible part of the silhouette; without a mesh, it lies in the box.

    A mask that was rendered is not judged.
    """
    judged = [
        (facts, image)
        for facts, image in _sound(survey)
        if not survey.compares_itself(facts.sample, "mask")
    ]
    if not judged:
        return None
    found = []
    for facts, image in judged:
        if image.iou is not None and image.iou < MIN_IOU:
            message = f"IoU with the rendered silhouette is {image.iou:.2f}, expected {MIN_IOU}"
            found.append((image.iou, _problem(facts, message, image.iou)))
        elif image.iou is None and image.overlap < MIN_OVERLAP:
            message = f"{image.overlap:.0%} of it in the projected box, expected {MIN_OVERLAP:.0%}"
            found.append((image.overlap, _problem(facts, message, image.overlap)))
    return [problem for _, problem in sorted(found, key=lambda pair: pair[0])]


def check_orientations(survey: Survey) -> list[Problem] | None:
    """Orientations are free: the objects' up axes cover the sphere.

    The paper's finding about REAL275, whose objects all stand upright: a method can do well on such
    data without telling one orientation from another.
    """
    if len(survey.samples) < MIN_ORIENTATIONS:
        return None
    spread = up_axis_spread(survey.up_axes)
    if spread.coverage >= MIN_COVERAGE:
        return []
    return [
        Problem(
            f"the up axes of {spread.count} samples come within {REACH:.0f} deg of"
            f" {spread.coverage:.0%} of what uniform orientations reach (expected"
            f" {MIN_COVERAGE:.0%}); their mean resultant length is {spread.resultant:.3f}",
            value=spread.coverage,
        )
    ]


def check_duplicates(survey: Survey) -> list[Problem] | None:
    """No image of an object occurs twice."""
    images = list(_with_image(survey))
    if not images:
        return None
    problems = {}
    for what in ("colour", "depth"):
        first: dict[str, str] = {}
        for facts, image in images:
            earlier = first.setdefault(getattr(image, what), facts.sample)
            if earlier != facts.sample and facts.sample not in problems:
                message = f"its {what} image and mask are those of {earlier}"
                problems[facts.sample] = _problem(facts, message)
    return list(problems.values())


#: All checks, in the order in which they are reported.
CHECKS: dict[str, Check] = {
    "readable": check_readable,
    "counts": check_counts,
    "intrinsics": check_intrinsics,
    "poses": check_poses,
    "fits": check_fits,
    "mesh-metric": check_meshes_metric,
    "mesh-centred": check_meshes_centred,
    "mesh-closed": check_meshes_closed,
    "extents": check_extents,
    "depth": check_depth,
    "masks": check_masks,
    "orientations": check_orientations,
    "duplicates": check_duplicates,
}


def _problem(facts: SampleFacts, message: str, value: float | None = None) -> Problem:
    return Problem(message, facts.sample, facts.model, facts.category, value)


def _of_meshes(
    survey: Survey,
    fault: Callable[[MeshFacts], str],
    value: Callable[[MeshFacts], float | None] = lambda _: None,
) -> list[Problem] | None:
    if not survey.meshes:
        return None
    return [
        Problem(message, "" if mesh.model else mesh.sample, mesh.model, mesh.category, value(mesh))
        for mesh in sorted(survey.meshes.values(), key=lambda mesh: mesh.model or mesh.sample)
        if (message := fault(mesh))
    ]


def _with_image(survey: Survey) -> Iterator[tuple[SampleFacts, ImageFacts]]:
    for facts in survey.samples.values():
        if facts.image is not None:
            yield facts, facts.image


def _sound(survey: Survey) -> Iterator[tuple[SampleFacts, ImageFacts]]:
    """Samples whose camera, pose and mesh are right, so that images can be held against them."""
    for facts, image in _with_image(survey):
        if _camera_fault(image.camera) or _pose_fault(facts):
            continue
        mesh = survey.meshes.get(facts.mesh)
        if mesh and (_size_fault(mesh) or math.hypot(*mesh.centre) > MAX_BOX_ERROR):
            continue
        yield facts, image
