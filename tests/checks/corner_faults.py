"""Faults that show in few cases only: special values, conflicts, coplanar faces, large clouds."""

from __future__ import annotations

import dataclasses
import math

import fault_parts as part
import numpy as np
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation

from pytest_cpas import metrics as m
from pytest_cpas.checks.metrics.conflicts import WRONG
from pytest_cpas.types import Symmetry


def each(change):
    """Change each column of errors: ``change(name, column, limit)``."""
    return lambda f: (
        lambda errors, limits, *rest: f(
            {n: change(n, c, limits[n]) if n in limits else c for n, c in errors.items()},
            limits,
            *rest,
        )
    )


def limited(change):
    """Change each limit: ``change(name, limit)``."""
    return lambda f: (
        lambda errors, limits, *rest: f(errors, {n: change(n, v) for n, v in limits.items()}, *rest)
    )


def kept(keep):
    """Judge only the samples that ``keep(column)`` keeps in all columns that are limited."""

    def make(f):
        def faulty(errors, limits, *rest):
            mask = np.logical_and.reduce([keep(errors[n]) for n in limits if n in errors])
            chosen = {n: c[mask] for n, c in errors.items()}
            if rest:
                rest = ([c for c, k in zip(rest[0], mask, strict=True) if k], *rest[1:])
            return f(chosen, limits, *rest)

        return faulty

    return make


def finite(column):
    return np.array([v is None or math.isfinite(v) for v in column], dtype=bool)


def known(column):
    return np.array([v is not None for v in column], dtype=bool)


def filled(value_of):
    """None becomes a number: ``value_of(name)``."""
    return each(
        lambda name, column, limit: np.array(
            [value_of(name) if v is None else v for v in column], dtype=float
        )
    )


def better(name):
    return 1.0 if name in ("iou", "fscore") else 0.0


def or_else(value):
    """What is n/a becomes a number."""
    return lambda f: lambda *x: value if f(*x) is None else f(*x)


def plant_counts(fault):
    both = ("precision", "mean_precision")
    for metric in both:
        fault(metric, "infinite errors left out", kept(finite))
        fault(
            metric,
            "infinite errors become 0",
            each(lambda n, c, t: np.array([v if v is None or math.isfinite(v) else 0 for v in c])),
        )
        fault(
            metric,
            "failed IoUs by their absolute value",
            each(
                lambda n, c, t: (
                    np.array([v if v is None else min(abs(v), 1) for v in c]) if better(n) else c
                )
            ),
        )
        fault(metric, "None is perfect", filled(better))
        fault(metric, "None is wrong", filled(lambda name: math.inf - 2 * math.inf * better(name)
              if not better(name) else -math.inf))  # fmt: skip
        fault(metric, "nothing to judge is 1", or_else(1.0))
    fault("precision", "nothing to judge is 0", or_else(0.0))
    e = "precision"
    fault(
        e,
        "a limit of 0 is none",
        lambda f: (
            lambda errors, t: (
                f(errors, {n: v for n, v in t.items() if v} or t) if any(t.values()) else 1.0
            )
        ),
    )
    for name, size in (("1e-9", 1e-9), ("1e-6", 1e-6), ("one in a thousand", 1e-3)):
        fault(e, f"a tolerance of {name}", limited(
            lambda n, v, size=size: v * (1 - size if better(n) else 1 + size)
        ))  # fmt: skip
    fault(e, "errors rounded to 6 digits", each(lambda n, c, t: np.round(c.astype(float), 6)))
    fault(e, "errors in single precision", each(lambda n, c, t: np.float64(np.float32(c))))
    fault(e, "what is close to a limit meets it", each(
        lambda n, c, t: np.where(np.isclose(c.astype(float), t), t, c.astype(float))
    ))  # fmt: skip
    fault(e, "a limit on what is not given is dropped",
          lambda f: lambda errors, t: f(errors, {n: v for n, v in t.items() if n in errors} or t)
          )  # fmt: skip
    fault(e, "counted in 8 bits", lambda f: lambda errors, t: None if f(errors, t) is None else (
        round(f(errors, t) * len(next(iter(errors.values())))) % 256
        / len(next(iter(errors.values())))
    ))  # fmt: skip
    fault(e, "the first 50000 samples", lambda f: lambda errors, t: f(
        {n: c[:50_000] for n, c in errors.items()}, t))  # fmt: skip
    fault(e, "a single sample is n/a", lambda f: lambda errors, t: (
        None if len(next(iter(errors.values()))) == 1 else f(errors, t)))  # fmt: skip

    k = "mean_precision"

    def renamed(rename):
        return lambda f: (
            lambda errors, t, own, names: f(
                errors, t, [rename(c) for c in own], [rename(c) for c in names]
            )
        )

    fault(k, "names without case", renamed(str.lower))
    fault(k, "names cut to three letters", renamed(lambda name: name[:3]))
    fault(k, "names by their first letter", renamed(lambda name: name[0]))

    def containing(f):
        def faulty(errors, t, own, names):
            if not all(len(c) for c in errors.values()):
                return f(errors, t, own, names)
            parts = []
            for name in names:
                mask = np.array([name in c for c in own])
                part_of = f({n: c[mask] for n, c in errors.items()}, t, [name] * mask.sum(), [name])
                parts += [] if part_of is None else [part_of]
            return float(np.mean(parts)) if parts else None

        return faulty

    fault(k, "names that contain the name", containing)

    def of_shares(combine):
        def make(f):
            def faulty(errors, t, own, names):
                shares = [(f(errors, t, own, [n]), list(own).count(n)) for n in names]
                shares = [(s, n) for s, n in shares if s is not None]
                return combine(*map(np.array, zip(*shares, strict=True))) if shares else None

            return faulty

        return make

    fault(k, "median over categories", of_shares(lambda s, n: float(np.median(s))))
    fault(k, "weighted by the root of the size", of_shares(
        lambda s, n: float(np.average(s, weights=np.sqrt(n)))))  # fmt: skip
    fault(k, "categories of one sample left out", of_shares(
        lambda s, n: float(s[n > 1].mean()) if (n > 1).any() else None))  # fmt: skip
    fault(k, "categories without any right one left out", of_shares(
        lambda s, n: float(s[s > 0].mean()) if (s > 0).any() else 0.0))  # fmt: skip


def plant_areas(fault):
    u, v = "iou_auc", "pose_vus"
    fault(u, "failed samples left out", lambda f: lambda x, lower: f(x[np.isfinite(x)], lower))
    fault(v, "failed samples left out", lambda f: lambda r, t, a, b: f(
        r[np.isfinite(r) & np.isfinite(t)], t[np.isfinite(r) & np.isfinite(t)], a, b))  # fmt: skip
    fault(u, "no samples as 0", or_else(0.0))
    fault(v, "no samples as 0", or_else(0.0))
    fault(u, "the lower threshold is one of three", lambda f: lambda x, lower: f(
        x, min((0.25, 0.5, 0.75), key=lambda t: abs(t - lower))))  # fmt: skip
    fault(v, "ranges of 5 or 10 degrees", lambda f: lambda r, t, a, b: f(
        r, t, 10.0 if a > 7 else 5.0, b))  # fmt: skip
    fault(v, "ranges of 2 or 5 cm", lambda f: lambda r, t, a, b: f(
        r, t, a, 0.05 if b > 0.03 else 0.02))  # fmt: skip

    def rule(edges, strict=False):
        def share(margin, bins=100):
            nodes = edges(bins)
            met = nodes[None] < margin[:, None] if strict else nodes[None] <= margin[:, None]
            return met.mean(axis=1)

        return share

    rules = {
        "lower ends of the bins": rule(lambda n: np.arange(n) / n),
        "upper ends of the bins": rule(lambda n: (np.arange(n) + 1) / n),
        "a bin too few": rule(lambda n: (np.arange(n - 1) + 0.5) / (n - 1)),
        "both ends of the range": rule(lambda n: np.linspace(0, 1, n)),
    }
    for name, share in rules.items():
        fault(u, name, lambda f, share=share: lambda x, lower: 0 * f(x, lower) + share(
            (x - lower) / (1 - lower)).mean(), bins=100)  # fmt: skip
        fault(v, name, lambda f, share=share: lambda r, t, a, b: 0 * f(r, t, a, b) + (
            share(1 - r / a) * share(1 - t / b)).mean(), bins=100)  # fmt: skip


def plant_rankings(fault):
    i = "average_precision"

    def among(keep):
        def make(f):
            def faulty(s, c, n):
                f(s, c, n)
                mask = keep(s)
                return f(s[mask], c[mask], n) if mask.any() else 0.0

            return faulty

        return make

    fault(i, "best 100 only", among(lambda s: s >= np.sort(s)[-min(100, len(s))]))
    fault(i, "best 1000 only", among(lambda s: s >= np.sort(s)[-min(1000, len(s))]))
    fault(i, "positive scores only", among(lambda s: s > 0))
    fault(i, "scores above 1e-6 only", among(lambda s: s > 1e-6))
    fault(i, "scores up to 1 only", among(lambda s: s <= 1))
    fault(i, "the worst is left out", among(
        lambda s: (s > s.min()) | (len(s) == 1)))  # fmt: skip
    fault(i, "of equal scores one", among(
        lambda s: np.isin(np.arange(len(s)), np.unique(s, return_index=True)[1])))  # fmt: skip
    fault(i, "absolute scores", lambda f: lambda s, c, n: f(np.abs(s), c, n))
    fault(i, "scores in single precision", lambda f: lambda s, c, n: f(
        np.float64(np.float32(s)), c, n))  # fmt: skip
    fault(i, "scores as sigmoids", lambda f: lambda s, c, n: f(1 / (1 + np.exp(-s)), c, n))

    def points_101(s, c, n):
        order = np.argsort(-s, kind="stable")
        hits = np.cumsum(c[order])
        precision, recall = hits / np.arange(1, len(hits) + 1), hits / n
        best = [max(precision[recall >= t - 1e-12], default=0.0) for t in np.linspace(0, 1, 101)]
        return float(np.mean(best))

    fault(i, "101 points", lambda f: lambda s, c, n: 0 * f(s, c, n) + points_101(s, c, n))

    def until_miss(s, c, n):
        order = np.argsort(-s, kind="stable")
        return float(np.cumprod(c[order]).sum() / n)

    fault(i, "nothing after the first miss", lambda f: lambda s, c, n: 0 * f(s, c, n) + until_miss(
        s, c, n))  # fmt: skip
    fault(i, "an empty ranking is NaN", lambda f: lambda s, c, n: f(s, c, n) if len(s) else math.nan
          )  # fmt: skip

    def running_best(s, c, n):
        order = np.argsort(-s, kind="stable")
        hits = np.cumsum(c[order])
        precision = np.maximum.accumulate(hits / np.arange(1, len(hits) + 1))
        return float((precision * c[order]).sum() / n)

    fault(i, "best precision so far", lambda f: lambda s, c, n: 0 * f(s, c, n) + running_best(
        s, c, n))  # fmt: skip


def plant_detections(fault):
    j = "detection_ap"

    def by(rule):
        def make(f):
            def faulty(pi, pc, s, ti, tc, iou, t, k):
                value = f(pi, pc, s, ti, tc, iou, t, k)
                if value is None:
                    return None
                scaled = np.where(iou > t, 0.5 + (iou - t) / 2 + 1e-9, 0.2)
                right = {}
                for image in np.unique(pi[pc == k]):
                    rows = np.flatnonzero((pi == image) & (pc == k))
                    rows = rows[np.argsort(-s[rows], kind="stable")]
                    columns = np.flatnonzero((ti == image) & (tc == k))
                    few = tuple(map(tuple, scaled[np.ix_(rows, columns)].tolist()))
                    if len(columns) == 0 or len(rows) > 6:
                        return value
                    right |= zip(rows.tolist(), rule(few), strict=True)
                ranked = [d for d in sorted(right, key=lambda d: -s[d]) if right[d] is not None]
                hits = np.array([right[d] for d in ranked], dtype=bool)
                places = -np.arange(len(ranked), dtype=float)
                return part.ranked_area(places, hits, int((tc == k).sum())) if len(hits) else 0.0

            return faulty

        return make

    for name, rule in WRONG.items():
        fault(j, name, by(rule))

    def among(keep):
        """Only the detections that ``keep`` keeps."""

        def make(f):
            def faulty(pi, pc, s, ti, tc, iou, t, k):
                f(pi, pc, s, ti, tc, iou, t, k)
                mask = keep(pi, pc, s, ti, tc)
                return f(pi[mask], pc[mask], s[mask], ti, tc, iou[mask], t, k)

            return faulty

        return make

    fault(j, "best 100 only", among(
        lambda pi, pc, s, ti, tc: s >= np.sort(s)[-min(100, len(s))] if len(s) else s > 0
    ))  # fmt: skip
    fault(j, "scores of 0.05 and more", among(lambda pi, pc, s, ti, tc: s >= 0.05))
    fault(j, "detections in images without ground truth left out", among(
        lambda pi, pc, s, ti, tc: np.isin(pi, ti)))  # fmt: skip
    fault(j, "absolute scores", lambda f: lambda pi, pc, s, *rest: f(pi, pc, np.abs(s), *rest))
    fault(j, "scores in half precision", lambda f: lambda pi, pc, s, *rest: f(
        pi, pc, np.float64(np.float16(np.clip(s, -6e4, 6e4))), *rest))  # fmt: skip
    fault(j, "images in 16 bits", lambda f: lambda pi, pc, s, ti, tc, *rest: f(
        pi % 65536, pc, s, ti % 65536, tc, *rest))  # fmt: skip
    fault(j, "categories in 8 bits", lambda f: lambda pi, pc, s, ti, tc, iou, t, k: f(
        pi, pc % 256, s, ti, tc % 256, iou, t, k))  # fmt: skip
    fault(j, "ground truth in images without detections left out",
          lambda f: lambda pi, pc, s, ti, tc, iou, t, k: f(
              pi, pc, s, ti[np.isin(ti, pi) | (tc != k)], tc[np.isin(ti, pi) | (tc != k)],
              iou[:, np.isin(ti, pi) | (tc != k)], t, k,
          ))  # fmt: skip
    fault(j, "without detections n/a", lambda f: lambda pi, *rest: f(pi, *rest) if len(pi) else None
          )  # fmt: skip

    def classless(f):
        def faulty(pi, pc, s, ti, tc, iou, t, k):
            if f(pi, pc, s, ti, tc, iou, t, k) is None:
                return None
            # detections of other categories match as well, and take ground truths away
            found = m.Detections(pi, 0 * pc, s, ti, 0 * tc, [0])
            matches = found.iou_matches(iou[found.pairs[:, 0], found.pairs[:, 1]], t)
            mine = pc == k
            return part.ranked_area(s[mine], matches.matched[mine], int((tc == k).sum())) if (
                mine.any()) else 0.0  # fmt: skip

        return faulty

    fault(j, "other categories take ground truths", classless)


def plant_boxes(fault):
    b, y = "box_iou", "symmetric_box_iou"

    def none_if(test):
        return lambda f: lambda *x: 0 * f(*x) if test(*x) else f(*x)

    def far(*x):
        return np.linalg.norm(x[1] - x[4]) > max(x[2].max(), x[5].max())

    fault(b, "nothing beyond the longest side", none_if(far))
    fault(b, "nothing beyond half of both diagonals along an axis", none_if(
        lambda *x: np.abs(x[1] - x[4]).max() > (x[2].max() + x[5].max()) / 2
    ))  # fmt: skip

    def outside(r, t, e, r_b, t_b, e_b):
        inside = np.abs((part.corners(r, t, e) - t_b) @ r_b) <= e_b / 2 + 1e-12
        return not inside.all(axis=1).any()

    fault(b, "nothing without a corner of the first in the second", none_if(outside))
    fault(b, "nothing without a corner of either in the other", none_if(
        lambda *x: outside(*x) and outside(*x[3:], *x[:3])
    ))  # fmt: skip

    def coplanar(*x):
        parallel = np.abs(np.abs(x[0].T @ x[3]) - np.eye(3)).max() < 1e-9
        offset = np.abs(x[0].T @ (x[4] - x[1]))
        sides = np.abs(np.abs(x[2] - x[5]) / 2 - offset)
        return parallel and 0 < (sides < 1e-9).sum() < 3

    fault(b, "faces in one plane are lost", lambda f: lambda *x: f(*x) * (
        0.97 if coplanar(*x) else 1))  # fmt: skip
    fault(b, "volumes below a millilitre are none", lambda f: lambda *x: f(*x) * (
        f(*x) / (1 + f(*x)) * (x[2].prod() + x[5].prod()) > 1e-6))  # fmt: skip
    fault(b, "centres in half precision", lambda f: lambda *x: 0 * f(*x) + f(
        x[0], np.float64(np.float16(x[1])), x[2], x[3], np.float64(np.float16(x[4])), x[5]
    ))  # fmt: skip
    fault(b, "centres in single precision", lambda f: lambda *x: 0 * f(*x) + f(
        x[0], np.float64(np.float32(x[1])), x[2], x[3], np.float64(np.float32(x[4])), x[5]
    ))  # fmt: skip

    def forgives_second(f):
        def faulty(*x):
            if np.isfinite(x[3]).all() and x[3].shape == (3, 3) and np.linalg.det(x[3]) < 0:
                return f(*x[:3], -x[3], *x[4:])
            return f(*x)

        return faulty

    fault(b, "scores a mirrored truth", forgives_second)

    def along_first(*x):
        reach = np.abs(x[0].T @ x[3]) @ x[5] / 2
        centre = x[0].T @ (x[4] - x[1])
        low, high = np.maximum(-x[2] / 2, centre - reach), np.minimum(x[2] / 2, centre + reach)
        shared = np.maximum(high - low, 0).prod()
        return shared / (x[2].prod() + (2 * reach).prod() - shared)

    fault(b, "second box around along the first", lambda f: lambda *x: 0 * f(*x) + along_first(*x))

    def iou_at(x, spin):
        turn = Rotation.from_rotvec(np.outer(np.atleast_1d(spin), x[6].axis)).as_matrix()
        return m.oriented_iou(*x[:3], x[3] @ turn, *x[4:6])

    def climbed(starts, refined=True):
        def make(f):
            def faulty(*x):
                if x[6].axis is None or x[6].sphere or len(x[6].rotations) > 1:
                    return f(*x)
                grid = np.arange(starts) * 2 * np.pi / starts
                values = iou_at(x, grid)
                spin, value, step = grid[values.argmax()], values.max(), np.pi / starts / 2
                while refined and step > 1e-7:
                    moved = iou_at(x, [spin - step, spin + step])
                    if moved.max() > value:
                        spin, value = spin + step * (2 * moved.argmax() - 1), moved.max()
                    else:
                        step /= 2
                return float(value)

            return faulty

        return make

    for starts in (1, 4, 12, 36):
        fault(y, f"climbed from the best of {starts}", climbed(starts))
    fault(y, "360 spins", climbed(360, refined=False))

    def other_group(change):
        return lambda f: lambda *x: f(*x[:6], change(x[6]))

    def plain(s):
        return s.axis is None and not s.sphere and len(s.rotations) == 1

    fault(y, "sphere as none", other_group(lambda s: Symmetry.none() if s.sphere else s))
    fault(y, "sphere as round about y", other_group(
        lambda s: Symmetry.about((0, 1, 0)) if s.sphere else s))  # fmt: skip
    fault(y, "none as round", other_group(
        lambda s: Symmetry.about((0, 1, 0)) if plain(s) else s))  # fmt: skip
    fault(y, "none as quarter turns", other_group(
        lambda s: Symmetry.n_fold((0, 1, 0), 4) if plain(s) else s))  # fmt: skip
    fault(y, "first three elements", other_group(
        lambda s: Symmetry(s.rotations[:3]) if s.axis is None and not s.sphere else s
    ))  # fmt: skip
    fault(y, "sphere scores 1", lambda f: lambda *x: 1.0 + 0 * f(*x) if x[6].sphere else f(*x))

    r = "symmetric_rotation_error"

    def group(change):
        return lambda f: lambda a, b, s: f(a, b, change(s))

    fault(r, "none as round", group(lambda s: Symmetry.about((0, 1, 0)) if plain(s) else s))
    fault(r, "none as half turns", group(
        lambda s: Symmetry.n_fold((0, 1, 0), 2) if plain(s) else s))  # fmt: skip
    fault(r, "first eight elements", group(
        lambda s: Symmetry(s.rotations[:8]) if s.axis is None and not s.sphere else s
    ))  # fmt: skip
    fault(r, "elements about one axis only", group(
        lambda s: Symmetry(np.stack([e for e in s.rotations if abs(e[1, 1] - 1) < 1e-9]))
        if s.axis is None and not s.sphere and len(s.rotations) > 8 else s
    ))  # fmt: skip
    fault(r, "more than a right angle is a flip", lambda f: lambda a, b, s: (
        f(a, b, s) if s.axis is None or f(a, b, s) < 1.75 else math.pi - f(a, b, s)))  # fmt: skip
    fault(r, "with a flip the sine of the angle", lambda f: lambda a, b, s: (
        f(a, b, s) if s.axis is None or len(s.rotations) == 1 else math.sin(f(a, b, s))
    ))  # fmt: skip

    def forgives(f):
        def faulty(a, b, *rest):
            if np.isfinite(b).all() and b.shape == (3, 3) and np.linalg.det(b) < 0:
                b = -b
            return f(a, b, *rest)

        return faulty

    fault(r, "scores a mirrored truth", forgives)
    fault("rotation_error", "scores a mirrored truth", forgives)

    def rescales(f):
        def faulty(a, b):
            if np.isfinite(b).all() and b.shape == (3, 3) and np.linalg.det(b) > 0:
                u, _, vt = np.linalg.svd(b)
                b = u @ vt
            return f(a, b)

        return faulty

    fault("rotation_error", "rescales the truth", rescales)


def plant_surfaces(fault):
    ok = part.valid_clouds

    def thinned(few):
        """Of a large cloud a part of the points."""
        return lambda f: (
            lambda a, *rest: f(few(a), *(few(x) if isinstance(x, np.ndarray) else x for x in rest))
        )

    def approximate(a, b):
        return cKDTree(b, leafsize=1).query(a, eps=1.0)[0]

    for metric in ("average_distance", "chamfer", "nad"):
        fault(metric, "every second point of many", thinned(
            lambda p: p[::2] if len(p) > 200 else p))  # fmt: skip
        fault(metric, "the first 2000 points", thinned(lambda p: p[:2000]))
        fault(metric, "a thousand points at random", thinned(
            lambda p: p if len(p) < 1000 else p[np.random.default_rng(0).choice(len(p), 1000)]
        ))  # fmt: skip
    fault("average_distance", "approximate neighbours", lambda f: ok(
        lambda a, b: approximate(a, b).mean()))  # fmt: skip
    fault("chamfer", "approximate neighbours", lambda f: ok(
        lambda a, b: (approximate(a, b).mean() + approximate(b, a).mean()) / 2))  # fmt: skip
    for metric in ("average_distance", "chamfer"):
        fault(metric, "by index where there are as many", lambda f: lambda a, b: (
            float(np.linalg.norm(a - b, axis=1).mean()) + 0 * f(a, b)
            if a.shape == b.shape and len(a) > 200 else f(a, b)
        ))  # fmt: skip
    for metric in ("surface_precision", "surface_recall", "fscore"):
        fault(metric, "the first 1000 points", thinned(lambda p: p[:1000]))
        fault(metric, "thresholds of a millimetre at least", lambda f: lambda a, b, t: f(
            a, b, max(t, 1e-3)))  # fmt: skip
        fault(metric, "points within a tenth more", lambda f: lambda a, b, t: f(a, b, 1.1 * t))
    p = "fscore"

    def combined(rule):
        return lambda f: ok(lambda a, b, t: 0 * f(a, b, t) + rule(
            (part.nearest(b, a) < t).mean(), (part.nearest(a, b) < t).mean()
        ))  # fmt: skip

    fault(p, "geometric mean", combined(lambda x, r: math.sqrt(x * r)))
    fault(p, "product", combined(lambda x, r: x * r))
    fault(p, "larger of both", combined(max))
    fault(p, "Jaccard index", combined(lambda x, r: x * r / (x + r - x * r) if x * r else 0.0))
    fault(p, "F2", combined(lambda x, r: 5 * x * r / (4 * x + r) if x * r else 0.0))
    fault(p, "recall alone for as many points", lambda f: ok(
        lambda a, b, t: float((part.nearest(a, b) < t).mean()) + 0 * f(a, b, t)
        if len(a) == len(b) else f(a, b, t)
    ))  # fmt: skip
    d = "diameter"
    fault(d, "hulls of flat clouds fail", lambda f: ok(lambda c: 0 * ConvexHull(c).volume + f(c)))
    fault(d, "two hops from the first point", lambda f: ok(lambda c: max(
        np.linalg.norm(c - c[np.linalg.norm(c - c[0], axis=1).argmax()], axis=1)) + 0 * f(c)
    ))  # fmt: skip
    fault(d, "first 5000 points", lambda f: lambda c: f(c[:5000]))
    fault(d, "a thousand points at random", lambda f: lambda c: f(
        c if len(c) < 1000 else c[np.random.default_rng(0).choice(len(c), 1000)]))  # fmt: skip
    fault(d, "one point is n/a", lambda f: lambda c: math.nan if f(c) == 0 else f(c))
    fault(d, "extremes along the axes", lambda f: ok(lambda c: f(
        np.concatenate([c[c.argmin(axis=0)], c[c.argmax(axis=0)]]))))  # fmt: skip


def plant_verdicts(fault):
    g = "pose_correct"

    def judged(change):
        return lambda f: lambda e, t, limits, axis: f(*change(e, t, limits, axis))

    def moved(norm):
        """Position judged by another norm of the difference."""

        def change(e, t, limits, axis):
            distance = norm(e.translation - t.translation, t)
            if "position_m" not in limits:
                return e, t, limits, axis
            true = np.linalg.norm(e.translation - t.translation) or 1.0
            scale = distance / true
            return e, t, {**limits, "position_m": limits["position_m"] / (scale or 1e-9)}, axis

        return judged(change)

    fault(g, "largest coordinate of the shift", moved(lambda d, t: np.abs(d).max()))
    fault(g, "sum of the coordinates of the shift", moved(lambda d, t: np.abs(d).sum()))
    fault(g, "shift without depth", moved(lambda d, t: np.linalg.norm(d[:2])))
    fault(g, "shift in depth alone", moved(lambda d, t: abs(d[2])))
    fault(g, "difference of the distances to the camera", moved(
        lambda d, t: abs(np.linalg.norm(t.translation + d) - np.linalg.norm(t.translation))
    ))  # fmt: skip

    def in_own_frame(e, t, limits, axis):
        own = [dataclasses.replace(x, points=(x.points - x.translation) @ x.rotation)
               for x in (e, t)]  # fmt: skip
        return *own, limits, axis

    fault(g, "shapes in their own frames", judged(in_own_frame))
    fault(g, "shapes about one centre", judged(lambda e, t, limits, axis: (
        dataclasses.replace(e, points=e.points - e.translation + t.translation), t, limits, axis
    )))  # fmt: skip
    fault(g, "shapes posed twice", judged(lambda e, t, limits, axis: (
        *(dataclasses.replace(x, points=x.points @ x.rotation.T + x.translation) for x in (e, t)),
        limits, axis,
    )))  # fmt: skip
    for name, factor in (("2 cm", 2.0), ("5 mm", 0.5), ("11 mm", 1.1)):
        fault(g, f"F-score at {name}", lambda f, factor=factor: lambda e, t, limits, axis: (
            f(e, t, {n: v for n, v in limits.items() if n != "fscore"} or {"position_m": 99.0},
              axis)
            and ("fscore" not in limits
                 or m.surface_errors(m.Surface(t.points), e.points).fscore(0.01 * factor)
                 >= limits["fscore"])
        ))  # fmt: skip

    def instead(name, better_is_larger, value):
        """Another value for one of the errors."""

        def make(f):
            def faulty(e, t, limits, axis):
                rest = {n: v for n, v in limits.items() if n != name} or {"position_m": 99.0}
                if not f(e, t, rest, axis):
                    return False
                if name not in limits or (axis is not None and name == "iou"):
                    return f(e, t, limits, axis)
                got = value(e, t)
                return bool(got >= limits[name] if better_is_larger else got <= limits[name])

            return faulty

        return make

    def surfaces(e, t):
        return m.surface_errors(m.Surface(t.points), e.points)

    def boxes(e, t):
        return e.rotation, e.translation, e.extents, t.rotation, t.translation, t.extents

    fault(g, "recall for the F-score", instead(
        "fscore", True, lambda e, t: surfaces(e, t).recall(0.01)))  # fmt: skip
    fault(g, "NAD of one direction", instead(
        "nad", False, lambda e, t: surfaces(e, t).ad_truth_to_estimate / m.diameter(t.points)
    ))  # fmt: skip
    fault(g, "NAD not normalised", instead(
        "nad", False, lambda e, t: surfaces(e, t).chamfer))  # fmt: skip
    fault(g, "IoU of boxes along the camera", instead(
        "iou", True, lambda e, t: m.axis_aligned_box_iou(*boxes(e, t))))  # fmt: skip
    fault(g, "IoU without rotation", instead(
        "iou", True, lambda e, t: m.oriented_iou(t.rotation, *boxes(e, t)[1:])))  # fmt: skip
    fault(g, "IoU with the true extents", instead(
        "iou", True, lambda e, t: m.oriented_iou(*boxes(e, t)[:2], t.extents, *boxes(e, t)[3:])
    ))  # fmt: skip
    fault(g, "angle of the largest axis alone", instead(
        "rotation_deg", False, lambda e, t: np.degrees(max(
            np.arccos(np.clip((e.rotation * t.rotation).sum(axis=0), -1, 1))
        ))))  # fmt: skip
    fault(g, "round: more than a right angle is a flip", lambda f: lambda e, t, limits, axis: (
        f(e, t, limits, axis) or (
            axis is not None and "rotation_deg" in limits
            and e.rotation[:, axis] @ t.rotation[:, axis] < -0.2
            and f(e, t, {n: v for n, v in limits.items() if n != "rotation_deg"}
                  or {"position_m": 99.0}, axis)
            and 180 - np.degrees(np.arccos(np.clip(
                e.rotation[:, axis] @ t.rotation[:, axis], -1, 1))) <= limits["rotation_deg"]
        )
    ))  # fmt: skip


def plant(fault):
    """Add them to the catalogue."""
    plant_counts(fault)
    plant_areas(fault)
    plant_rankings(fault)
    plant_detections(fault)
    plant_boxes(fault)
    plant_surfaces(fault)
    plant_verdicts(fault)
