"""The catalogue of planted faults: each is one metric of ours, made wrong in one way.

Run as a script it prints the matrix fault x property, and fails on a fault that nothing catches
and on a property that catches nothing::

    python tests/checks/faults.py --seeds 5 --processes 2
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import corner_faults
import fault_parts as part
import numpy as np
import other_faults
from scipy.spatial.transform import Rotation

from pytest_cpas import metrics as m
from pytest_cpas.checks.metrics import KNOWN, PROPERTIES, Sample, Subject, check, conduct
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.metric_subjects.cpas import METRICS
from pytest_cpas.types import ContractError, Symmetry


@dataclass(frozen=True)
class Fault:
    """``make`` takes our function and gives the faulty one; ``definition``: what it declares."""

    metric: str
    name: str
    make: Callable[[Callable[..., Any]], Callable[..., Any]]
    definition: Mapping[str, Any]

    def subject(self) -> Subject:
        from pytest_cpas.checks.metrics.adapter import Offer

        right = METRICS[self.metric]
        wrong = Offer(self.make(right.function), {**right.definition, **self.definition})
        return Subject("faulty", {**METRICS, self.metric: wrong})


FAULTS: list[Fault] = []


def fault(
    metric: str, name: str, make: Callable[[Callable[..., Any]], Any], **definition: Any
) -> None:
    FAULTS.append(Fault(metric, name, make, definition))


def scaled(factor: float) -> Callable[..., Any]:
    return lambda f: lambda *args: f(*args) * factor


# -- rotation ----------------------------------------------------------------------------------

R = "rotation_error"
fault(R, "degrees for radians", scaled(180 / math.pi))
fault(R, "radians converted twice", scaled(math.pi / 180))
fault(R, "half the angle", scaled(0.5))
fault(R, "transposed rotation", lambda f: lambda a, b: f(a.T, b))
fault(
    R,
    "angle of the product, not of the difference",
    lambda f: lambda a, b: part.angle_by_trace(a, b, transpose=False),
)
fault(R, "arccos of the trace", lambda f: lambda a, b: f(a, b) * 0 + part.angle_by_trace(a, b))
fault(R, "missing clip", lambda f: lambda a, b: f(a, b) * 0 + part.angle_by_trace(a, b, clip=False))
fault(R, "float32", lambda f: lambda a, b: f(a, b) * 0 + part.angle_by_trace(a, b, np.float32))
fault(R, "cosine instead of the angle", lambda f: lambda a, b: 1 - math.cos(f(a, b)))
fault(R, "sine instead of the angle", lambda f: lambda a, b: math.sin(f(a, b)))
fault(R, "arcsin: right below 90 degrees", lambda f: lambda a, b: min(f(a, b), math.pi - f(a, b)))
fault(R, "squared", lambda f: lambda a, b: f(a, b) ** 2)
fault(R, "Frobenius distance", lambda f: lambda a, b: float(f(a, b) * 0 + np.linalg.norm(a - b)))
fault(R, "norm of Euler angles", lambda f: lambda a, b: f(a, b) * 0 + part.as_euler(a, b))
fault(
    R,
    "quaternions, angle not doubled",
    lambda f: lambda a, b: f(a, b) * 0 + part.of_quaternions(a, b, doubled=False),
)
fault(
    R,
    "quaternions, sign forgotten",
    lambda f: lambda a, b: f(a, b) * 0 + part.of_quaternions(a, b, absolute=False),
)
fault(R, "of the estimate alone", lambda f: lambda a, b: f(a, np.eye(3)) + 0 * f(b, b))
fault(
    R,
    "of the z axes only",
    lambda f: lambda a, b: float(f(a, b) * 0 + m.rotation_error(a, b, Symmetry.about((0, 0, 1)))),
)
fault(R, "signed angle", lambda f: lambda a, b: math.copysign(f(a, b), (a @ b.T)[1, 0]))
fault(R, "depends on which is first", lambda f: lambda a, b: f(a, b) * (1 + 0.1 * (a[0, 1] > 0)))


def repaired(flip_only: bool) -> Callable[..., Any]:
    def make(f: Callable[..., Any]) -> Callable[..., Any]:
        def faulty(a: Any, b: Any) -> Any:
            if np.isfinite(a).all() and a.shape == (3, 3):
                if flip_only:
                    a = a * np.sign(np.linalg.det(a)) if np.linalg.det(a) else a
                elif np.linalg.det(a) > 0:
                    u, _, vt = np.linalg.svd(a)
                    a = u @ vt
            return f(a, b)

        return faulty

    return make


fault(R, "scores reflections", repaired(flip_only=True))
fault(R, "divides the scale out", repaired(flip_only=False))

S = "symmetric_rotation_error"
fault(S, "symmetry ignored", lambda f: part.no_symmetry)
fault(S, "wrong axis", lambda f: lambda a, b, s: f(a, b, part.half_turn_only(s)))
fault(S, "sampled symmetry", lambda f: part.sampled_error)
fault(
    S, "half of the turn sampled", lambda f: lambda a, b, s: part.sampled_error(a, b, s, 360, np.pi)
)
fault(S, "max over the group", lambda f: lambda a, b, s: part.sampled_error(a, b, s, 36, pick=max))
fault(
    S,
    "missing clip: NaN upside down",
    lambda f: lambda a, b, s: part.axis_angle(a, b, s, clip=False),
)
fault(S, "axis in the camera frame", lambda f: lambda a, b, s: f(a.T, b.T, s))
fault(
    S,
    "upside down always allowed",
    lambda f: (
        lambda a, b, s: f(a, b, s) if s.axis is None else min(f(a, b, s), math.pi - f(a, b, s))
    ),
)
fault(
    S,
    "upside down never allowed",
    lambda f: lambda a, b, s: f(a, b, s) if s.axis is None else f(a, b, Symmetry.about(s.axis)),
)
fault(
    S,
    "last element of the group forgotten",
    lambda f: (
        lambda a, b, s: f(a, b, s if s.axis is not None or s.sphere else Symmetry(s.rotations[:-1]))
    ),
)
fault(
    S,
    "mean over the group",
    lambda f: (
        lambda a, b, s: (
            f(a, b, s)
            if s.axis is not None or s.sphere
            else float(np.mean([m.rotation_error(a, b @ r) for r in s.rotations]))
        )
    ),
)
fault(
    S,
    "sphere scored like any other",
    lambda f: lambda a, b, s: f(a, b, Symmetry.none() if s.sphere else s),
)
fault(S, "degrees for radians", scaled(180 / math.pi))

T = "translation_error"
fault(T, "squared", lambda f: lambda a, b: f(a, b) ** 2)
fault(T, "sum of the axes", lambda f: lambda a, b: 0 * f(a, b) + np.abs(a - b).sum())
fault(T, "centimetres", scaled(100))
fault(T, "depth ignored", lambda f: lambda a, b: 0 * f(a, b) + np.linalg.norm((a - b)[:2]))
fault(
    T,
    "float32",
    lambda f: lambda a, b: 0 * f(a, b) + float(np.linalg.norm(np.float32(a) - np.float32(b))),
)
fault(
    T,
    "difference of the distances",
    lambda f: lambda a, b: 0 * f(a, b) + abs(np.linalg.norm(a) - np.linalg.norm(b)),
)

# -- boxes -------------------------------------------------------------------------------------

B = "box_iou"
fault(
    B,
    "half extents for extents",
    lambda f: lambda *x: f(x[0], x[1], x[2] / 2, x[3], x[4], x[5] / 2),
)
fault(B, "half extents of one box", lambda f: lambda *x: f(*x[:5], x[5] / 2))
fault(B, "transposed rotation", lambda f: lambda *x: f(x[0].T, x[1], x[2], x[3].T, *x[4:]))
fault(B, "one rotation transposed", lambda f: lambda *x: f(x[0].T, *x[1:]))
fault(
    B, "rotation ignored", lambda f: lambda *x: 0 * f(*x) + f(np.eye(3), *x[1:3], np.eye(3), *x[4:])
)
fault(B, "axis-aligned boxes around them", lambda f: m.axis_aligned_box_iou)
fault(B, "legacy NOCS", lambda f: m.nocs_legacy_iou)
fault(B, "intersection over the sum of volumes", lambda f: lambda *x: f(*x) / (1 + f(*x)))
fault(
    B,
    "intersection over the smaller box",
    lambda f: (
        lambda *x: f(*x) / (1 + f(*x)) * (x[2].prod() + x[5].prod()) / min(x[2].prod(), x[5].prod())
    ),
)
fault(
    B,
    "intersection over the first box",
    lambda f: lambda *x: f(*x) / (1 + f(*x)) * (x[2].prod() + x[5].prod()) / x[2].prod(),
)
fault(B, "distance of the centres ignored", lambda f: lambda *x: f(*x[:4], x[1], x[5]))
fault(B, "sampled volume", lambda f: lambda *x: 0 * f(*x) + part.sampled_volume(*x))
fault(B, "global random numbers",
      lambda f: lambda *x: f(*x) * (1 + 1e-12 * np.random.rand()))  # noqa: NPY002 # fmt: skip
fault(
    B,
    "half-space crash on touching boxes",
    lambda f: lambda *x: 0 * f(*x) + part.box_by_half_spaces(*x, epsilon=-1e-12),
)
fault(
    B,
    "thin overlaps count as none",
    lambda f: lambda *x: 0 * f(*x) + part.box_by_half_spaces(*x, epsilon=1e-3),
)
fault(
    B,
    "float32",
    lambda f: (
        lambda *x: f(
            *(np.float32(a) for a in x[:1]), np.float32(x[1]), *x[2:4], np.float32(x[4]), x[5]
        )
    ),
)
fault(B, "squared", lambda f: lambda *x: f(*x) ** 2)
fault(B, "percent", scaled(100))
fault(
    B,
    "touching counts as a little",
    lambda f: lambda *x: max(f(*x), 1e-3 * (np.linalg.norm(x[1] - x[4]) < 0.5)),
)
fault(
    B,
    "absolute extents",
    lambda f: (
        lambda *x: f(
            *x[:2], np.abs(x[2]) + 1e-9 * (x[2] == 0), *x[3:5], np.abs(x[5]) + 1e-9 * (x[5] == 0)
        )
    ),
)


def mirrored_back(f: Callable[..., Any]) -> Callable[..., Any]:
    def faulty(*x: Any) -> Any:
        a = x[0].copy()
        if np.isfinite(a).all() and a.shape == (3, 3) and np.linalg.det(a) < 0:
            a[:, 0] *= -1
        return f(a, *x[1:])

    return faulty


fault(B, "scores reflections", mirrored_back)

Y = "symmetric_box_iou"
fault(Y, "symmetry ignored", lambda f: lambda *x: float(m.oriented_iou(*x[:6])))
fault(Y, "sampled symmetry (20)", lambda f: part.sampled_iou)
fault(Y, "half of the turn sampled", lambda f: lambda *x: part.sampled_iou(*x, 180, np.pi))
fault(Y, "min over the group", lambda f: lambda *x: part.sampled_iou(*x, 36, pick=np.min))
fault(Y, "mean over the group", lambda f: lambda *x: part.sampled_iou(*x, 36, pick=np.mean))
fault(Y, "wrong axis", lambda f: lambda *x: f(*x[:6], part.half_turn_only(x[6])))
fault(Y, "estimate has the symmetry", lambda f: lambda *x: f(*x[3:6], *x[:3], x[6]))
fault(
    Y,
    "last element of the group forgotten",
    lambda f: (
        lambda *x: f(*x[:6], x[6] if x[6].axis is not None else Symmetry(x[6].rotations[:-1]))
    ),
)
fault(
    Y,
    "crash for continuous axes",
    lambda f: lambda *x: Rotation.from_rotvec(1.0) if x[6].axis is not None else f(*x),
)

# -- surfaces ----------------------------------------------------------------------------------

A, C, N, D = "average_distance", "chamfer", "nad", "diameter"
ok = part.valid_clouds
fault(A, "the other direction", lambda f: lambda a, b: f(b, a))
fault(A, "squared", lambda f: ok(lambda a, b: (part.nearest(a, b) ** 2).mean()))
fault(A, "sum over points", lambda f: ok(lambda a, b: part.nearest(a, b).sum()))
fault(A, "largest distance", lambda f: ok(lambda a, b: part.nearest(a, b).max()))
fault(A, "float32", lambda f: ok(lambda a, b: part.expanded(a, b, np.float32).mean()))
fault(A, "cancellation of expanded squares", lambda f: ok(lambda a, b: part.expanded(a, b).mean()))
fault(
    A,
    "by index instead of nearest",
    lambda f: ok(
        lambda a, b: np.linalg.norm(
            a[: min(len(a), len(b))] - b[: min(len(a), len(b))], axis=1
        ).mean()
    ),
)
fault(A, "divided by the other number of points", lambda f: lambda a, b: f(a, b) * len(a) / len(b))
fault(
    A,
    "without the nearest itself",
    lambda f: ok(lambda a, b: part.cKDTree(np.vstack([b, b + 9])).query(a, 2)[0][:, 1].mean()),
)
fault(C, "one direction only", lambda f: ok(lambda a, b: part.nearest(a, b).mean()))
fault(C, "sum of both directions", scaled(2))
fault(
    C,
    "squared distances",
    lambda f: ok(
        lambda a, b: ((part.nearest(a, b) ** 2).mean() + (part.nearest(b, a) ** 2).mean()) / 2
    ),
)
fault(
    C,
    "root of the mean square",
    lambda f: ok(
        lambda a, b: (
            (
                math.sqrt((part.nearest(a, b) ** 2).mean())
                + math.sqrt((part.nearest(b, a) ** 2).mean())
            )
            / 2
        )
    ),
)
fault(
    C,
    "mean over all points together",
    lambda f: ok(lambda a, b: np.concatenate([part.nearest(a, b), part.nearest(b, a)]).mean()),
)
fault(
    C,
    "larger of both directions",
    lambda f: ok(lambda a, b: max(part.nearest(a, b).mean(), part.nearest(b, a).mean())),
)
fault(
    C,
    "L1 distance",
    lambda f: ok(
        lambda a, b: (
            (part.cKDTree(b).query(a, p=1)[0].mean() + part.cKDTree(a).query(b, p=1)[0].mean()) / 2
        )
    ),
)
fault(
    C,
    "Hausdorff",
    lambda f: ok(lambda a, b: (part.nearest(a, b).max() + part.nearest(b, a).max()) / 2),
)
fault(C, "floor of 1 mm", lambda f: lambda a, b: max(f(a, b), 1e-3))
fault(
    N,
    "normalised by the truth only",
    lambda f: ok(
        lambda a, b: max(part.nearest(a, b).mean(), part.nearest(b, a).mean()) / m.diameter(a)
    ),
)
fault(
    N,
    "min for max",
    lambda f: ok(
        lambda a, b: min(
            part.nearest(a, b).mean() / m.diameter(a), part.nearest(b, a).mean() / m.diameter(b)
        )
    ),
)
fault(
    N,
    "diameters mixed up",
    lambda f: ok(
        lambda a, b: max(
            part.nearest(a, b).mean() / m.diameter(b), part.nearest(b, a).mean() / m.diameter(a)
        )
    ),
)
fault(
    N,
    "box diagonal for diameter",
    lambda f: ok(
        lambda a, b: max(
            part.nearest(a, b).mean() / part.bounding(a),
            part.nearest(b, a).mean() / part.bounding(b),
        )
    ),
)
fault(
    N,
    "not normalised",
    lambda f: ok(lambda a, b: max(part.nearest(a, b).mean(), part.nearest(b, a).mean())),
)
fault(N, "percent", scaled(100))
fault(D, "diagonal of the box", lambda f: ok(part.bounding))
fault(D, "twice the radius", lambda f: ok(part.from_centre))
fault(D, "of a part of the points", lambda f: ok(part.by_hull_of_sample))
fault(D, "radius", scaled(0.5))
fault(D, "along the axes", lambda f: ok(lambda p: np.ptp(p, axis=0).max()))
fault(D, "float32", lambda f: lambda p: float(np.float32(f(p))))

P, Q, F = "surface_precision", "surface_recall", "fscore"
fault(P, "recall for precision", lambda f: lambda a, b, t: METRICS[Q].function(a, b, t))
fault(Q, "precision for recall", lambda f: lambda a, b, t: METRICS[P].function(a, b, t))
for _name in (P, Q, F):
    fault(_name, "inclusive threshold", lambda f: lambda a, b, t: f(a, b, math.nextafter(t, 1)))
    fault(_name, "inverted threshold", lambda f: lambda a, b, t: 1 - f(a, b, t))
    fault(_name, "threshold on squared distances", lambda f: lambda a, b, t: f(a, b, math.sqrt(t)))
    fault(_name, "percent", scaled(100))
    fault(_name, "threshold fixed at 1 cm", lambda f: lambda a, b, t: f(a, b, 0.01))
fault(
    P,
    "divided by the other number of points",
    lambda f: lambda a, b, t: f(a, b, t) * len(b) / len(a),
)
fault(
    Q,
    "divided by the other number of points",
    lambda f: lambda a, b, t: f(a, b, t) * len(a) / len(b),
)
fault(
    F,
    "arithmetic mean",
    lambda f: lambda a, b, t: (METRICS[P].function(a, b, t) + METRICS[Q].function(a, b, t)) / 2,
)
fault(F, "0 / 0 where nothing is near", lambda f: lambda a, b, t: f(a, b, t) or math.nan)
fault(
    F,
    "smaller of both",
    lambda f: lambda a, b, t: min(METRICS[P].function(a, b, t), METRICS[Q].function(a, b, t)),
)
fault(
    F,
    "over all points together",
    lambda f: ok(
        lambda a, b, t: (np.concatenate([part.nearest(a, b), part.nearest(b, a)]) < t).mean()
    ),
)
fault(F, "without the factor 2", scaled(0.5))
fault(
    F,
    "both divided by the same number of points",
    lambda f: ok(
        lambda a, b, t: part.harmonic(
            (part.nearest(a, b) < t).sum() / len(a), min(1, (part.nearest(b, a) < t).sum() / len(a))
        )
    ),
)

# -- counts ------------------------------------------------------------------------------------

E = "precision"


def negated(name: str) -> Callable[..., Any]:
    def make(f: Callable[..., Any]) -> Callable[..., Any]:
        def faulty(errors: Any, limits: Any, *rest: Any) -> Any:
            if name in limits and name in errors:
                errors = {**errors, name: np.abs(2 * limits[name] - errors[name])}
            return f(errors, limits, *rest)

        return faulty

    return make


def nudged(sign: float) -> Callable[..., Any]:
    """Strict limits instead of inclusive ones."""

    def make(f: Callable[..., Any]) -> Callable[..., Any]:
        def faulty(errors: Any, limits: Any, *rest: Any) -> Any:
            moved = {
                k: math.nextafter(v, math.inf if k in ("iou", "fscore") else -math.inf)
                for k, v in limits.items()
            }
            return f(errors, moved, *rest)

        return faulty

    return make


def without(name: str) -> Callable[..., Any]:
    def make(f: Callable[..., Any]) -> Callable[..., Any]:
        def faulty(errors: Any, limits: Any, *rest: Any) -> Any:
            kept = {k: v for k, v in limits.items() if k != name} or limits
            return f(errors, kept, *rest)

        return faulty

    return make


def any_limit(f: Callable[..., Any]) -> Callable[..., Any]:
    return lambda errors, limits: max(f(errors, {k: v}) for k, v in limits.items())


def product(f: Callable[..., Any]) -> Callable[..., Any]:
    return lambda errors, limits: math.prod(f(errors, {k: v}) for k, v in limits.items())


for _name in ("nad", "iou", "rotation_deg"):
    fault(E, f"inverted {_name}", negated(_name))
fault(E, "position ignored beside others", without("position_m"))
fault(E, "strict limits", nudged(1))
fault(E, "any limit instead of all", any_limit)
fault(E, "product of the precisions", product)
fault(E, "percent", scaled(100))
fault(
    E,
    "one sample too many in the divisor",
    lambda f: (
        lambda e, t: f(e, t) * len(next(iter(e.values()))) / (1 + len(next(iter(e.values()))))
    ),
)
fault(
    E,
    "centimetres for metres",
    lambda f: (
        lambda e, t: f(
            {**e, **({"position_m": e["position_m"] * 100} if "position_m" in e else {})}, t
        )
    ),
)
fault(
    E,
    "radians for degrees",
    lambda f: (
        lambda e, t: f(
            {
                **e,
                **({"rotation_deg": np.deg2rad(e["rotation_deg"])} if "rotation_deg" in e else {}),
            },
            t,
        )
    ),
)

M = "mean_precision"
fault(
    M,
    "absent category as 0",
    lambda f: lambda e, t, c, n: (f(e, t, c, n) or 0.0) * len(set(n) & set(c)) / len(n),
)
fault(
    M,
    "mean over samples",
    lambda f: (
        lambda e, t, c, n: (
            None
            if not set(n) & set(c)
            else METRICS[E].function({k: v[np.isin(c, n)] for k, v in e.items()}, t)
        )
    ),
)
fault(
    M,
    "all categories, not those asked for",
    lambda f: lambda e, t, c, n: f(e, t, c, sorted(set(c))),
)
fault(M, "last category only", lambda f: lambda e, t, c, n: f(e, t, c, n[-1:]))
fault(M, "n/a as 0", lambda f: lambda e, t, c, n: f(e, t, c, n) or 0.0)

U, V = "iou_auc", "pose_vus"
fault(U, "not divided by the range", lambda f: lambda x, lower: f(x, lower) * (1 - lower))
fault(
    U,
    "not clipped",
    lambda f: lambda x, lower: 0 * f(x, lower) + ((x - lower) / (1 - lower)).mean(),
)
fault(U, "mean IoU", lambda f: lambda x, lower: 0 * f(x, lower) + x.mean())
fault(U, "ten bins", lambda f: lambda x, lower: m.iou_auc(x, lower, bins=10))
fault(
    V,
    "product of the areas",
    lambda f: lambda r, t, a, b: f(r, 0 * t, a, b) * f(0 * r, t, a, b) + 0 * f(r, t, a, b),
)
fault(V, "position ignored", lambda f: lambda r, t, a, b: 0 * f(r, t, a, b) + f(r, 0 * t, a, b))
fault(V, "centimetres for metres", lambda f: lambda r, t, a, b: f(r, 100 * t, a, b))
fault(V, "ranges mixed up", lambda f: lambda r, t, a, b: f(r, t, 15 - a, b))
fault(
    V,
    "smaller of both margins",
    lambda f: (
        lambda r, t, a, b: (
            0 * f(r, t, a, b)
            + np.minimum(np.clip(1 - r / a, 0, 1), np.clip(1 - t / b, 0, 1)).mean()
        )
    ),
)

G = "pose_correct"


def judged(change: Callable[..., Any]) -> Callable[..., Any]:
    """Change (estimate, truth, limits, axis) before they are judged."""
    return lambda f: lambda e, t, limits, axis: f(*change(e, t, limits, axis))


fault(G, "symmetry ignored", judged(lambda e, t, limits, axis: (e, t, limits, None)))
fault(
    G,
    "wrong axis",
    judged(lambda e, t, limits, axis: (e, t, limits, None if axis is None else (axis + 1) % 3)),
)
fault(
    G,
    "NaN passes as correct: unclipped arccos, then 'wrong if larger'",
    lambda f: (
        lambda e, t, limits, axis: (
            f(e, t, limits, axis)
            if axis is None or set(limits) != {"rotation_deg"}
            else not np.arccos(e.rotation[:, axis] @ t.rotation[:, axis])
            > np.deg2rad(limits["rotation_deg"])
        )
    ),
)
fault(
    G,
    "inverted NAD",
    lambda f: (
        lambda e, t, limits, axis: (
            f(e, t, {k: v for k, v in limits.items() if k != "nad"} or {"position_m": 9.0}, axis)
            and ("nad" not in limits or not f(e, t, {"nad": limits["nad"]}, axis))
        )
    ),
)
fault(
    G,
    "inverted IoU",
    lambda f: lambda e, t, limits, axis: f(e, t, limits, axis) != (set(limits) == {"iou"}),
)
fault(
    G,
    "crash on touching boxes",
    lambda f: (
        lambda e, t, limits, axis: (
            1 / 0
            if "iou" in limits
            and axis is None
            and m.oriented_iou(
                e.rotation, e.translation, e.extents, t.rotation, t.translation, t.extents
            )
            == 0
            else f(e, t, limits, axis)
        )
    ),
)
fault(
    G,
    "upside down is allowed",
    lambda f: (
        lambda e, t, limits, axis: (
            f(e, t, limits, axis)
            or (
                axis is not None
                and f(
                    Sample(
                        e.rotation @ np.diag(np.where(np.arange(3) == (axis + 1) % 3, 1.0, -1.0)),
                        e.translation,
                        e.extents,
                        e.points,
                    ),
                    t,
                    limits,
                    axis,
                )
            )
        )
    ),
)
fault(
    G,
    "degrees for radians",
    judged(
        lambda e, t, limits, axis: (
            e,
            t,
            {
                **limits,
                **(
                    {"rotation_deg": math.degrees(limits["rotation_deg"])}
                    if "rotation_deg" in limits
                    else {}
                ),
            },
            axis,
        )
    ),
)
fault(
    G,
    "centimetres for metres",
    judged(
        lambda e, t, limits, axis: (
            e,
            t,
            {
                **limits,
                **({"position_m": limits["position_m"] * 100} if "position_m" in limits else {}),
            },
            axis,
        )
    ),
)
fault(
    G,
    "first limit only",
    judged(lambda e, t, limits, axis: (e, t, dict([next(iter(limits.items()))]), axis)),
)

# -- average precision -------------------------------------------------------------------------

I, J = "average_precision", "detection_ap"  # noqa: E741 - one letter each
fault(
    I,
    "unstable sort under ties",
    lambda f: lambda s, c, n: 0 * f(s, c, n) + part.ranked_area(s, c, n),
)
fault(
    I,
    "file order under ties",
    lambda f: lambda s, c, n: 0 * f(s, c, n) + part.ranked_area(s, c, n, "stable"),
)
fault(
    I,
    "not interpolated",
    lambda f: lambda s, c, n: 0 * f(s, c, n) + part.ranked_area(s, c, n, "stable", False),
)
fault(
    I,
    "off by one in the ranks",
    lambda f: lambda s, c, n: 0 * f(s, c, n) + part.ranked_area(s, c, n, "stable", first=2),
)
fault(
    I,
    "trapezoids",
    lambda f: lambda s, c, n: 0 * f(s, c, n) + part.ranked_area(s, c, n, "stable", ends=True),
)
fault(I, "11 points", lambda f: lambda s, c, n: 0 * f(s, c, n) + part.points_11(s, c, n))
fault(I, "ascending scores", lambda f: lambda s, c, n: f(-s, c, n))
fault(I, "scores ignored", lambda f: lambda s, c, n: f(-np.arange(len(s)) + 0 * s, c, n))
fault(I, "missed truths forgotten", lambda f: lambda s, c, n: f(s, c, max(1, int(c.sum()))))
fault(I, "divided by the predictions", lambda f: lambda s, c, n: f(s, c, n) * n / len(s))
fault(I, "scores rounded", lambda f: lambda s, c, n: f(np.round(s, 1), c, n))
fault(I, "scores as a scale", lambda f: lambda s, c, n: f(s, c & (s > 0.3), n))
fault(I, "percent", scaled(100))
fault(J, "percent", lambda f: lambda *x: None if f(*x) is None else 100 * f(*x))
fault(
    J,
    "images mixed up",
    lambda f: lambda pi, pc, s, ti, tc, iou, t, k: f(0 * pi, pc, s, 0 * ti, tc, iou, t, k),
)
fault(
    J,
    "categories mixed up",
    lambda f: (
        lambda pi, pc, s, ti, tc, iou, t, k: f(
            pi, 0 * pc, s, ti, 0 * tc, iou, t, k if k in tc else 7
        )
    ),
)
fault(J, "ascending scores", lambda f: lambda pi, pc, s, *rest: f(pi, pc, -s, *rest))
fault(J, "inclusive threshold", lambda f: lambda *x: f(*x[:6], math.nextafter(x[6], -1), x[7]))
fault(J, "absent category as 0", lambda f: lambda *x: f(*x) or 0.0)
fault(J, "fixed threshold", lambda f: lambda *x: f(*x[:6], 0.5, x[7]))
fault(
    J,
    "IoU transposed where square",
    lambda f: lambda *x: f(*x[:5], x[5].T if x[5].shape == x[5].T.shape else x[5], *x[6:]),
)


def truths_reused(f: Callable[..., Any]) -> Callable[..., Any]:
    def faulty(pi: Any, pc: Any, s: Any, ti: Any, tc: Any, iou: Any, t: float, k: int) -> Any:
        f(pi, pc, s, ti, tc, iou, t, k)
        mine, truths = pc == k, int((tc == k).sum())
        if not truths:
            return None
        fits = (iou > t) & (pi[:, None] == ti[None]) & (tc == k)[None]
        return (
            METRICS[I].function(
                s[mine], fits[mine].any(axis=1), max(truths, int(fits[mine].any(axis=1).sum()))
            )
            * 1.0
        )

    return faulty


def first_fit(f: Callable[..., Any]) -> Callable[..., Any]:
    """The first ground truth above the threshold instead of the best."""
    return lambda pi, pc, s, ti, tc, iou, t, k: f(
        pi, pc, s, ti, tc, np.where(iou > t, 0.99 - 0.001 * np.arange(iou.shape[1]), 0.0), t, k
    )


fault(J, "a ground truth matches again and again", truths_reused)
fault(J, "first fit instead of the best", first_fit)
fault(
    J,
    "highest IoU first, not highest score",
    lambda f: (
        lambda pi, pc, s, ti, tc, iou, t, k: f(
            pi, pc, s * 1e-6 + iou.max(axis=1), ti, tc, iou, t, k
        )
    ),
)


corner_faults.plant(fault)
other_faults.plant(fault)

# -- every metric ------------------------------------------------------------------------------


def plain(value: Any) -> Any:
    """Arguments without NaN."""
    if isinstance(value, np.ndarray) and value.dtype == np.float64:
        return np.nan_to_num(value)
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, Sample):
        return Sample(*map(plain, vars(value).values()))
    return value


def scores_nan(f: Callable[..., Any]) -> Callable[..., Any]:
    def faulty(*args: Any) -> Any:
        try:
            return f(*args)
        except ContractError as error:
            if "NaN" in str(error):
                return 0
            raise

    return faulty


def swallows(f: Callable[..., Any]) -> Callable[..., Any]:
    """Whatever goes wrong scores 0, except NaN."""

    def faulty(*args: Any) -> Any:
        try:
            return f(*args)
        except Exception as error:
            if "NaN" in str(error):
                raise
            return 0

    return faulty


def changes_arguments(f: Callable[..., Any]) -> Callable[..., Any]:
    def faulty(*args: Any) -> Any:
        value = f(*args)
        first = args[0]
        if isinstance(first, dict):
            first.popitem()
        elif isinstance(first, Sample):
            first.points[0] += 1
        elif isinstance(first, list):
            first.pop()
        else:
            first += 1
        return value

    return faulty


def prints(f: Callable[..., Any]) -> Callable[..., Any]:
    def faulty(*args: Any) -> Any:
        print("computing", file=sys.stderr)
        return f(*args)

    return faulty


def draws(f: Callable[..., Any]) -> Callable[..., Any]:
    def faulty(*args: Any) -> Any:
        random.random()
        return f(*args)

    return faulty


def noisy(f: Callable[..., Any]) -> Callable[..., Any]:
    rng = np.random.default_rng(0)

    def faulty(*args: Any) -> Any:
        value = f(*args)
        if value is None:
            return None
        if isinstance(value, (list, tuple)):
            return [v + 1e-9 * rng.random() for v in value]
        if isinstance(value, (bool, np.bool_)):
            return bool(value) != (rng.random() < 0.5)
        return value + 1e-9 * rng.random()

    return faulty


for _index, _metric in enumerate(KNOWN):
    if conduct.refuses_nan(_metric):
        fault(_metric, "NaN scores 0", scores_nan)
    if conduct.has_wrong_shapes(_metric):
        fault(_metric, "swallowed exceptions score 0", swallows)
    _marks = (changes_arguments, prints, draws)
    _words = ("changes its arguments", "prints", "draws from the global random state")
    # a number that is passed cannot be changed
    _kind = 1 if _metric == "count_interval" else _index % 3
    fault(_metric, _words[_kind], _marks[_kind])
    fault(_metric, "noise", noisy)
fault(R, "returns an array", lambda f: lambda a, b: np.array([f(a, b)]))
fault(C, "returns a string", lambda f: lambda a, b: f"{f(a, b):.6f}")
fault(G, "returns a probability", lambda f: lambda *x: 0.5 + 0 * f(*x))


def properties_of(metric: str) -> list[str]:
    return [name for name, prop in PROPERTIES.items() if metric in prop.needs]


def catches(index: int, seed: int, first: tuple[str, ...] = ()) -> dict[str, Outcome]:
    """What the properties of the faulty metric end with; without shrinking.

    ``first``: properties to begin with, and to end with as soon as one catches the fault.
    """
    planted = FAULTS[index]
    subject = planted.subject()
    outcomes = {}
    for name in dict.fromkeys([*first, *properties_of(planted.metric)]):
        outcomes[name] = check(subject, PROPERTIES[name], seed=seed, shrink=False).outcome
        if first and outcomes[name] is not Outcome.PASSED:
            break
    return outcomes


def caught_by(outcomes: dict[str, Outcome]) -> list[str]:
    return [name for name, outcome in outcomes.items() if outcome is not Outcome.PASSED]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1, help="seeds 0 to N - 1")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    start = time.perf_counter()
    everything = range(len(FAULTS))
    missed, broken = [], []
    catchers: list[tuple[str, ...]] = [()] * len(FAULTS)
    with ProcessPoolExecutor(options.processes) as pool:
        for seed in range(options.seeds):
            # the first seed makes the matrix, the others ask only whether each fault is caught
            results = pool.map(catches, everything, [seed] * len(FAULTS), catchers, chunksize=4)
            for index, (planted, outcomes) in enumerate(zip(FAULTS, results, strict=True)):
                caught = caught_by(outcomes)
                label = f"{planted.metric}: {planted.name}"
                if seed == 0:
                    catchers[index] = tuple(caught)
                    print(f"{label}\n    {', '.join(n.split('.', 1)[1] for n in caught) or '-'}")
                if not caught:
                    missed.append(f"{label} (seed {seed})")
                broken += [
                    f"{label}: {n}" for n, o in outcomes.items() if o is Outcome.HARNESS_ERROR
                ]
    idle = set(PROPERTIES).difference(*catchers)
    seconds = time.perf_counter() - start
    print(
        f"\n{len(FAULTS)} faults, {len(PROPERTIES)} properties, {options.seeds} seeds:"
        f" {seconds:.0f} s"
    )
    for words, names in (
        ("faults that nothing catches", missed),
        ("properties that catch nothing", sorted(idle)),
        ("harness errors", broken),
    ):
        print(f"{words}: {len(names)}")
        for name in names:
            print(f"    {name}")
    return bool(missed or idle or broken)


if __name__ == "__main__":
    sys.exit(main())
