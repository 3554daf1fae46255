"""Faults of IoUs along axes, hypotheses, curves, intervals, pose AP, known objects, sampling."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri

from pytest_cpas import metrics as m
from pytest_cpas.metrics.boxes import of_unit_diagonal
from pytest_cpas.types import Pose, Symmetry


def scaled(factor):
    return lambda f: lambda *x: f(*x) * factor


def plant_boxes(fault):
    aligned, legacy, plus = "axis_aligned_iou", "legacy_iou", "iou_plus"
    fault(aligned, "legacy", lambda f: m.nocs_legacy_iou)
    fault(legacy, "repaired", lambda f: m.axis_aligned_box_iou)
    for metric in (aligned, legacy):
        fault(metric, "spins ignored", lambda f: lambda *x: f(*x[:6], 1))
        fault(metric, "always 20 spins", lambda f: lambda *x: f(*x[:6], 20))
        fault(metric, "the truth is spun", lambda f: lambda *x: f(*x[3:6], *x[:3], x[6]))
        fault(metric, "half extents", lambda f: lambda *x: f(*x[:2], x[2] / 2, *x[3:]))
        fault(metric, "one spin too few", lambda f: lambda *x: f(*x[:6], max(1, x[6] - 1)))
    fault(aligned, "of oriented boxes", lambda f: lambda *x: float(m.oriented_iou(*x[:6])))
    fault(plus, "over the sum of volumes", lambda f: lambda a, b: f(a, b) / (1 + f(a, b)))
    fault(plus, "about one centre", lambda f: lambda a, b: f(
        a - a.mean(axis=0), b - b.mean(axis=0)))  # fmt: skip
    fault(plus, "over the first", lambda f: lambda a, b: f(a, b) / (1 + f(a, b)) * (
        1 + np.ptp(b, axis=0).prod() / np.ptp(a, axis=0).prod()))  # fmt: skip
    fault(plus, "disjoint along two axes is positive", lambda f: lambda a, b: max(
        f(a, b), 0.1 * (((a.min(0) > b.max(0)) | (b.min(0) > a.max(0))).sum() == 2)
    ))  # fmt: skip
    fault(plus, "between the second smallest and largest", lambda f: lambda a, b: f(
        *(np.sort(x, axis=0)[1:] if len(x) > 3 else x for x in (a, b))))  # fmt: skip

    equal, relative = "equal_diagonals_iou", "relative_translation_error"

    def changed(change):
        def make(f):
            return lambda *x: float(m.oriented_iou(x[0], *change(*x[1:3]), x[3], *change(*x[4:])))

        return make

    fault(equal, "not scaled", changed(lambda t, e: (t, e)))
    fault(equal, "extents scaled alone", changed(lambda t, e: (t, of_unit_diagonal(t, e)[1])))
    fault(equal, "centres scaled alone", changed(lambda t, e: (of_unit_diagonal(t, e)[0], e)))
    fault(equal, "by the longest side", changed(lambda t, e: (t / e.max(), e / e.max())))
    fault(relative, "over the true diagonal", lambda f: lambda *x: 0 * f(*x) + np.linalg.norm(
        x[1] - x[4]) / np.linalg.norm(x[5]))  # fmt: skip
    fault(relative, "not scaled", lambda f: lambda *x: 0 * f(*x) + np.linalg.norm(x[1] - x[4]))
    fault(relative, "half diagonals", scaled(2))


def plant_counts(fault):
    best, worst = "best_precision", "worst_precision"
    fault(best, "worst", lambda f: lambda h, t: m.best_and_worst(h, m.JointThreshold(**t))[1]
          .precision)  # fmt: skip
    fault(worst, "best", lambda f: lambda h, t: m.best_and_worst(h, m.JointThreshold(**t))[0]
          .precision)  # fmt: skip
    for metric in (best, worst):
        fault(metric, "first hypothesis", lambda f: lambda h, t: f([s[:1] for s in h], t))
        fault(metric, "last hypothesis", lambda f: lambda h, t: f([s[-1:] for s in h], t))
        fault(metric, "samples without hypotheses left out", lambda f: lambda h, t: f(
            [s for s in h if s], t) if any(h) else None)  # fmt: skip
        fault(metric, "counted by hypothesis", lambda f: lambda h, t: f(
            [[row] for s in h for row in s or [dict(m.FAILED)]], t))  # fmt: skip
    fault(best, "each limit by its own hypothesis", lambda f: lambda h, t: f(
        [
            [{n: (max if n in ("iou", "fscore") else min)(r[n] for r in s) for n in t}] if s else []
            for s in h
        ], t,
    ))  # fmt: skip

    curve = "precision_curve"
    fault(curve, "strict", lambda f: lambda e, n, t: f(e, n, np.nextafter(
        t, np.inf if n in ("iou", "fscore") else -np.inf) if np.min(t) > 0 else t))  # fmt: skip
    fault(curve, "sorted thresholds", lambda f: lambda e, n, t: f(e, n, np.sort(t)))
    fault(curve, "each threshold once", lambda f: lambda e, n, t: f(e, n, np.unique(t)))
    fault(curve, "always smaller is better", lambda f: lambda e, n, t: f(e, "nad", t))
    fault(curve, "accumulated", lambda f: lambda e, n, t: np.maximum.accumulate(f(e, n, t)))
    fault(curve, "backwards", lambda f: lambda e, n, t: f(e, n, t)[::-1])

    interval = "count_interval"

    def wilson(k, n, sure):
        z = ndtri((1 + sure) / 2)
        middle = (k + z * z / 2) / (n + z * z)
        reach = z / (n + z * z) * math.sqrt(k * (n - k) / n + z * z / 4)
        return middle - reach, middle + reach

    def normal(k, n, sure):
        reach = ndtri((1 + sure) / 2) * math.sqrt(k * (n - k) / n**3)
        return k / n - reach, k / n + reach

    fault(interval, "Wilson", lambda f: wilson)
    fault(interval, "normal approximation", lambda f: normal)
    fault(interval, "all of the tail on either side", lambda f: lambda k, n, sure: f(
        k, n, 2 * sure - 1 if sure > 0.5 else sure / 2))  # fmt: skip
    fault(interval, "always 95 %", lambda f: lambda k, n, sure: f(k, n, 0.95))
    fault(interval, "ends swapped", lambda f: lambda *x: f(*x)[::-1])
    fault(interval, "of the wrong ones", lambda f: lambda k, n, sure: f(n - k, n, sure))
    fault(interval, "one more sample", lambda f: lambda k, n, sure: f(k, n + 1, sure))

    mean, median = "mean_interval", "median_interval"

    def kept(values):
        return values[~np.isnan(values)]

    def of_mean(factor):
        def make(f):
            def faulty(values, sure):
                if f(values, sure) is None:
                    return None
                low, high = f(values, sure)
                middle, reach = (low + high) / 2, (high - low) / 2 * factor(kept(values), sure)
                return middle - reach, middle + reach

            return faulty

        return make

    fault(mean, "divided by n", of_mean(lambda v, sure: math.sqrt((len(v) - 1) / len(v))))
    fault(mean, "of one value", of_mean(lambda v, sure: math.sqrt(len(v))))
    fault(mean, "1.96 standard errors", lambda f: lambda values, sure: (
        None if f(values, sure) is None else (
            kept(values).mean() - 1.96 * kept(values).std(ddof=1) / math.sqrt(len(kept(values))),
            kept(values).mean() + 1.96 * kept(values).std(ddof=1) / math.sqrt(len(kept(values))),
        )))  # fmt: skip
    for metric in (mean, median):
        fault(metric, "n/a as 0", lambda f: lambda values, sure: f(np.nan_to_num(values), sure))
        fault(metric, "always 95 %", lambda f: lambda values, sure: f(values, 0.95))
    fault(median, "smallest and largest", lambda f: lambda values, sure: (
        None if f(values, sure) is None else (kept(values).min(), kept(values).max())))  # fmt: skip

    def further_in(values, sure):
        if (ends := m.median_interval(values, sure)) is None:
            return None
        rank = int((np.sort(kept(values)) <= ends.low).sum())
        return np.sort(kept(values))[min(rank, len(kept(values)) - 1)], ends.high

    fault(median, "one rank further in", lambda f: further_in)
    fault(median, "of the mean", lambda f: lambda values, sure: (
        None if f(values, sure) is None or np.ptp(kept(values)) == 0
        else (lambda i: (i.low, i.high))(m.mean_interval(values, sure))))  # fmt: skip


def plant_poses(fault):
    for metric in ("pose_ap", "matched_pose_ap"):
        fault(metric, "matched by degrees alone", lambda f: lambda *x: f(
            *x[:6], x[6] * 1e-9, x[7], x[8], *x[9:]) if (x[6] <= x[8]).all() else f(*x)
        )  # fmt: skip
        fault(metric, "centimetres for metres", lambda f: lambda *x: f(*x[:6], 100 * x[6], *x[7:]))
        fault(metric, "radians for degrees", lambda f: lambda *x: f(
            *x[:5], np.radians(x[5]), *x[6:]))  # fmt: skip
        fault(metric, "position without limit", lambda f: lambda *x: f(*x[:8], 1e9, *x[9:]))
        fault(metric, "rotation without limit", lambda f: lambda *x: f(*x[:7], 1e9, *x[8:]))
        fault(metric, "ascending scores", lambda f: lambda pi, pc, s, *x: f(pi, pc, -s, *x))
        fault(metric, "images mixed up", lambda f: lambda pi, pc, s, ti, *x: f(
            0 * pi, pc, s, 0 * ti, *x))  # fmt: skip
    fault("pose_ap", "strict limits", lambda f: lambda *x: f(
        *x[:7], math.nextafter(x[7], 0), math.nextafter(x[8], 0), x[9]))  # fmt: skip
    fault("pose_ap", "absent category as 0", lambda f: lambda *x: f(*x) or 0.0)
    fault("matched_pose_ap", "matches by IoU ignored", lambda f: lambda *x: f(*x[:10]))
    fault("matched_pose_ap", "matched at IoU 0.25", lambda f: lambda *x: f(*x[:10], x[10] / 2.5))
    fault("matched_pose_ap", "matched at any IoU", lambda f: lambda *x: f(
        *x[:10], np.minimum(x[10] + 0.1, 1)))  # fmt: skip
    fault("matched_pose_ap", "unmatched ground truth counts", lambda f: lambda *x: (
        None if f(*x) is None else f(*x) * min(
            1.0, len(np.unique(np.argmax(x[10], axis=1))) / max(1, (x[4] == x[9]).sum()))
        if len(x[0]) else f(*x)
    ))  # fmt: skip

    mean = "mean_detection_ap"
    fault(mean, "absent categories as 0", lambda f: lambda *x: (f(*x) or 0.0) * len(
        set(x[7]) & set(x[4].tolist())) / len(x[7]))  # fmt: skip
    fault(mean, "over all categories", lambda f: lambda *x: f(*x[:7], sorted(set(x[4].tolist()))))
    fault(mean, "first category", lambda f: lambda *x: f(*x[:7], x[7][:1]))
    fault(mean, "categories as one", lambda f: lambda pi, pc, s, ti, tc, iou, t, k: f(
        pi, 0 * pc, s, ti, 0 * tc, iou, t, [0 if set(k) & set(tc.tolist()) else 7]))  # fmt: skip
    fault(mean, "categories without detections left out", lambda f: lambda *x: f(
        *x[:7], [k for k in x[7] if k in x[1]] or x[7]))  # fmt: skip


def plant_objects(fault):
    for metric in ("add", "add_s", "mssd", "mspd"):
        fault(metric, "rotation ignored", lambda f: lambda *x: f(x[2], *x[1:]))
        fault(metric, "transposed rotations", lambda f: lambda *x: f(
            x[0].T, x[1], x[2].T, *x[3:]))  # fmt: skip
        fault(metric, "points about their mean", lambda f: lambda *x: f(
            *x[:4], x[4] - x[4].mean(axis=0), *x[5:]))  # fmt: skip
        fault(metric, "first three points", lambda f: lambda *x: f(*x[:4], x[4][:3], *x[5:]))
    fault("add", "ADD-S", lambda f: lambda *x: 0 * f(*x) + m.add_s(
        Pose(*x[:2]), Pose(*x[2:4]), m.ModelPoints(x[4])))  # fmt: skip
    fault("add_s", "ADD", lambda f: lambda *x: 0 * f(*x) + m.add(
        Pose(*x[:2]), Pose(*x[2:4]), m.ModelPoints(x[4])))  # fmt: skip
    fault("add_s", "the other direction", lambda f: lambda *x: f(*x[2:4], *x[:2], x[4]))
    for metric in ("mssd", "mspd"):
        fault(metric, "symmetry ignored", lambda f: lambda *x: f(*x[:5], Symmetry.none(), *x[6:]))
        fault(metric, "last element forgotten", lambda f: lambda *x: f(
            *x[:5], x[5] if x[5].axis is not None or len(x[5].rotations) == 1
            else Symmetry(x[5].rotations[:-1]), *x[6:]))  # fmt: skip
        fault(metric, "symmetry in the camera frame", lambda f: lambda *x: f(*x[:5], Symmetry(
            np.stack([x[2].T @ r @ x[2] for r in x[5].rotations])) if x[5].axis is None else x[5],
            *x[6:]))  # fmt: skip

    def mean_distance(*x):
        return min(
            np.linalg.norm(x[4] @ x[0].T + x[1] - x[4] @ (x[2] @ r).T - x[3], axis=1).mean()
            for r in x[5].rotations
        )

    fault("mssd", "mean distance", lambda f: lambda *x: (
        f(*x) if x[5].axis is not None else 0 * f(*x) + mean_distance(*x)))  # fmt: skip
    fault("mssd", "twelve spins", lambda f: lambda *x: (
        f(*x) if x[5].axis is None else f(*x[:5], Symmetry.n_fold(x[5].axis, 12))))  # fmt: skip
    fault("mspd", "not of width 640", lambda f: lambda *x: f(*x) * x[7] / 640)
    fault("mspd", "focal lengths swapped", lambda f: lambda *x: f(
        *x[:6], x[6][[1, 0, 2, 3]], x[7]))  # fmt: skip
    fault("mspd", "halved twice", scaled(0.5))


def plant_samples(fault):
    sample = "sample_surface"

    def along(weights_of, fold=True, bend=None):
        """Sampled with other weights, or unevenly in a triangle."""

        def make(f):
            def faulty(vertices, triangles, count, seed):
                f(vertices, triangles, count, seed)
                rng = np.random.default_rng(seed)
                a, b, c = (vertices[triangles[:, i]] for i in range(3))
                areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
                weights = weights_of(areas, a, b, c)
                which = rng.choice(len(a), count, p=weights / weights.sum())
                u, v = rng.random((2, count))
                if fold:
                    over = u + v > 1
                    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
                if bend:
                    u, v = bend(u, v)
                a, b, c = a[which], b[which], c[which]
                return a + u[:, None] * (b - a) + v[:, None] * (c - a)

            return faulty

        return make

    def by_area(areas, a, b, c):
        return areas

    fault(sample, "each triangle alike", along(lambda areas, *_: 1.0 * (areas > 0)))
    fault(sample, "by the root of the area", along(lambda areas, *_: np.sqrt(areas)))
    fault(sample, "by the square of the area", along(lambda areas, *_: areas**2))
    fault(sample, "by circumference", along(lambda areas, a, b, c: (areas > 0) * (
        np.linalg.norm(b - a, axis=1) + np.linalg.norm(c - b, axis=1)
        + np.linalg.norm(a - c, axis=1))))  # fmt: skip
    fault(sample, "parallelograms", along(by_area, fold=False))
    fault(sample, "towards a corner", along(by_area, fold=False, bend=lambda u, v: (
        u, v * (1 - u))))  # fmt: skip
    fault(sample, "normalised weights", along(by_area, fold=False, bend=lambda u, v: (
        u / (1 + u + v), v / (1 + u + v))))  # fmt: skip
    fault(sample, "without the root", along(by_area, fold=False, bend=lambda u, v: (
        (1 - u) * v, u * v)))  # fmt: skip
    fault(sample, "last triangle left out", lambda f: lambda v, t, n, s: f(v, t[:-1], n, s) if (
        len(t) > 1) else f(v, t, n, s))  # fmt: skip
    fault(sample, "vertices", lambda f: lambda v, t, n, s: v[t][:, 0][
        np.random.default_rng(s).integers(len(t), size=n)] + 0 * f(v, t, n, s))  # fmt: skip
    fault(sample, "seed ignored", lambda f: lambda v, t, n, s: f(v, t, n, 0))
    fault(sample, "one point less", lambda f: lambda v, t, n, s: f(v, t, n, s)[1:])
    fault(sample, "rounded to millimetres", lambda f: lambda *x: np.round(f(*x), 3))


def plant(fault):
    """Add them to the catalogue."""
    plant_boxes(fault)
    plant_counts(fault)
    plant_poses(fault)
    plant_objects(fault)
    plant_samples(fault)
