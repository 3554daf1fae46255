"""The exact IoU of two boxes in integer arithmetic, and random pairs of every kind.

Independent of the package: the boxes are twelve half-spaces, the volume comes from Lasserre's
recursion over the faces' dimensions (J. B. Lasserre, "An analytical expression and an algorithm
for the volume of a convex polyhedron in R^n", 1983), and nothing is rounded. Rotations come from
integer quaternions, lengths are whole multiples of a power of two.

Run as a script it compares ``oriented_iou`` with the exact value on many pairs of each kind::

    python tests/metrics/exact_boxes.py --pairs 100000
"""

from __future__ import annotations

import argparse
import math
import time
from fractions import Fraction

import numpy as np

from pytest_cpas.metrics import _box_clipping
from pytest_cpas.metrics.boxes import oriented_iou

Row = tuple[tuple[int, ...], int]
Box = tuple[tuple[int, int, int, int], tuple[Fraction, ...], tuple[Fraction, ...]]


def exact_iou(a: Box, b: Box) -> Fraction:
    """IoU of boxes given as (integer quaternion x y z w, centre, extents)."""
    rows_a, rows_b = _half_spaces(a), _half_spaces(b)
    # the volume must not depend on the origin; putting it at A's centre keeps the numbers short
    shared = _volume(rows_a + rows_b)
    volume_a, volume_b = math.prod(a[2]), math.prod(b[2])
    return shared / (volume_a + volume_b - shared)


def rotation_numerator(quaternion: tuple[int, int, int, int]) -> tuple[list[list[int]], int]:
    """Integer matrix M and its denominator d; M / d is the rotation, exactly."""
    x, y, z, w = quaternion
    matrix = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), w * w - x * x + y * y - z * z, 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), w * w - x * x - y * y + z * z],
    ]
    return matrix, x * x + y * y + z * z + w * w


def as_floats(box: Box) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same box for the package: rotation (rounded once), translation, extents."""
    matrix, denominator = rotation_numerator(box[0])
    return (
        np.array([[m / denominator for m in row] for row in matrix]),
        np.array([float(t) for t in box[1]]),
        np.array([float(e) for e in box[2]]),
    )


def _half_spaces(box: Box) -> list[Row]:
    """Rows (normal, bound): normal . x <= bound, in integers."""
    matrix, denominator = rotation_numerator(box[0])
    rows: list[Row] = []
    for axis in range(3):
        normal = [matrix[i][axis] for i in range(3)]
        along = sum(n * t for n, t in zip(normal, box[1], strict=True))
        for sign in (1, -1):
            bound = sign * along + box[2][axis] * denominator / 2
            scale = bound.denominator
            row = [sign * n * scale for n in normal]
            shrink = math.gcd(*row, bound.numerator)
            rows.append((tuple(r // shrink for r in row), bound.numerator // shrink))
    return rows


def _volume(rows: list[Row]) -> Fraction:
    """Volume of {x : normal . x <= bound for all rows}."""
    total = Fraction(0)
    for i, (normal, bound) in enumerate(rows):
        if bound == 0:
            continue
        pivot = max(range(3), key=lambda k: abs(normal[k]))
        u, v = (pivot + 1) % 3, (pivot + 2) % 3
        lead = abs(normal[pivot])
        n_u, n_v, n_bound = normal[u], normal[v], bound
        if normal[pivot] < 0:
            n_u, n_v, n_bound = -n_u, -n_v, -n_bound
        # x[pivot] = (bound - n_u x[u] - n_v x[v]) / lead on this face
        face = []
        for j, (other, limit) in enumerate(rows):
            if j == i:
                continue
            high = other[pivot]
            row = (other[u] * lead - high * n_u, other[v] * lead - high * n_v)
            rest = limit * lead - high * n_bound
            if any(row):
                face.append((*row, rest))
            elif rest < 0 or (rest == 0 and j < i and high * normal[pivot] > 0):
                break  # outside a parallel face, or the same face was counted before
        else:
            area = _area(face)
            if area:
                total += Fraction(bound, lead) * area
    return total / 3


def _area(rows: list[tuple[int, int, int]]) -> Fraction:
    """Area of {(x, y) : a x + b y <= c for all rows (a, b, c)}."""
    total = Fraction(0)
    for i, (a, b, c) in enumerate(rows):
        if c == 0:
            continue
        swap = abs(a) < abs(b)
        p, q, r = (b, a, c) if swap else (a, b, c)
        if p < 0:
            p, q, r = -p, -q, -r
        # on this edge the first coordinate is (r - q y) / p; y runs from low to high
        high_n = high_d = low_n = low_d = 0
        for j, (a_j, b_j, c_j) in enumerate(rows):
            if j == i:
                continue
            if swap:
                a_j, b_j = b_j, a_j
            slope = b_j * p - a_j * q
            rest = c_j * p - a_j * r
            if slope > 0:
                if high_d == 0 or rest * high_d < high_n * slope:
                    high_n, high_d = rest, slope
            elif slope < 0:
                if low_d == 0 or rest * low_d < low_n * slope:
                    low_n, low_d = -rest, -slope
            elif rest < 0 or (rest == 0 and j < i and a_j * (b if swap else a) > 0):
                break  # outside a parallel edge, or the same edge was counted before
            if high_d and low_d and high_n * low_d <= low_n * high_d:
                break
        else:
            total += Fraction(c, p) * (Fraction(high_n, high_d) - Fraction(low_n, low_d))
    return total / 2


def _dyadic(rng: np.random.Generator, low: float, high: float) -> Fraction:
    """A length in metres, log-uniform, with 20 significant bits."""
    value = math.exp(rng.uniform(math.log(low), math.log(high)))
    mantissa, exponent = math.frexp(value)
    return Fraction(round(mantissa * 2**20), 2**20) * Fraction(2) ** exponent


def _quaternion(rng: np.random.Generator) -> tuple[int, int, int, int]:
    x, y, z, w = (int(v) for v in np.round(rng.normal(size=4) * 30))
    return (x, y, z, w) if any((x, y, z, w)) else (0, 0, 0, 1)


def _turned(rng: np.random.Generator, q: tuple[int, ...], low: int, high: int) -> tuple[int, ...]:
    """``q`` followed by a rotation of about 10**low to 10**high radians."""
    axis = [int(v) for v in rng.integers(-9, 10, size=3)]
    if not any(axis):
        axis = [1, 0, 0]
    w = round(math.sqrt(sum(v * v for v in axis)) * 2 / 10 ** rng.uniform(low, high))
    x1, y1, z1, w1 = q
    x2, y2, z2 = axis
    return (
        w1 * x2 + x1 * w + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w,
        w1 * w - x1 * x2 - y1 * y2 - z1 * z2,
    )


def _along(q: tuple[int, ...], local: list[Fraction]) -> tuple[Fraction, ...]:
    matrix, denominator = rotation_numerator(q)
    return tuple(
        sum(m * v for m, v in zip(row, local, strict=True)) / denominator for row in matrix
    )


#: Quaternions of some of the 24 rotations that map the axes to the axes: their matrices are
#: exact in floating point, so that touching and coplanar faces stay so.
_AXIS_ROTATIONS = [
    (0, 0, 0, 1), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (1, 0, 0, 1), (0, 1, 0, 1),
    (0, 0, 1, 1), (1, 1, 1, 1), (1, 1, 0, 0), (-1, 1, 1, 1),
]  # fmt: skip

KINDS = (
    "random", "identical", "nearly identical", "touching", "nested", "disjoint", "flat",
    "very different sizes", "far from the origin", "millimetre to room", "near", "coplanar",
)  # fmt: skip


def random_pair(kind: str, rng: np.random.Generator) -> tuple[Box, Box]:
    """A pair of boxes of one of ``KINDS``."""
    q_a, q_b = _quaternion(rng), _quaternion(rng)
    extents_a = tuple(_dyadic(rng, 0.05, 0.4) for _ in range(3))
    extents_b = tuple(_dyadic(rng, 0.05, 0.4) for _ in range(3))
    size = float(max(extents_a) + max(extents_b))
    origin = (Fraction(0),) * 3

    def somewhere(spread: float) -> tuple[Fraction, ...]:
        return tuple(_dyadic(rng, spread / 50, spread) * int(rng.choice((-1, 1))) for _ in range(3))

    if kind == "random":
        return (q_a, origin, extents_a), (q_b, somewhere(size / 3), extents_b)
    if kind == "identical":
        centre = somewhere(2)
        return (q_a, centre, extents_a), (q_a, centre, extents_a)
    if kind == "nearly identical":
        moved = somewhere(10 ** rng.uniform(-15, -3)) if rng.random() < 0.5 else origin
        return (q_a, origin, extents_a), (_turned(rng, q_a, -15, -3), moved, extents_a)
    if kind == "touching":
        q_a, q_b = (_AXIS_ROTATIONS[int(rng.integers(len(_AXIS_ROTATIONS)))] for _ in range(2))
        reach = [
            sum(abs(m) * e for m, e in zip(row, box_extents, strict=True)) / (2 * d)
            for box_extents, (matrix, d) in (
                (extents_a, rotation_numerator(q_a)),
                (extents_b, rotation_numerator(q_b)),
            )
            for row in matrix
        ]
        axis = int(rng.integers(3))
        centre = list(somewhere(0.05))
        gap = Fraction(int(rng.integers(-1, 2)), 2 ** int(rng.integers(20, 50)))
        centre[axis] = reach[axis] + reach[3 + axis] + gap
        return (q_a, origin, extents_a), (q_b, tuple(centre), extents_b)
    if kind == "nested":
        inner = tuple(_dyadic(rng, 0.001, 0.02) for _ in range(3))
        return (q_a, origin, extents_a), (q_b, somewhere(0.01), inner)
    if kind == "disjoint":
        return (q_a, origin, extents_a), (q_b, somewhere(0.9), tuple(e / 4 for e in extents_b))
    if kind == "flat":
        flat_a, flat_b = list(extents_a), list(extents_b)
        flat_a[int(rng.integers(3))] = _dyadic(rng, 1e-6, 1e-3)
        if rng.random() < 0.7:
            flat_b[int(rng.integers(3))] = _dyadic(rng, 1e-6, 1e-3)
        if rng.random() < 0.5:
            return (q_a, origin, tuple(flat_a)), (_turned(rng, q_a, -7, -1), origin, tuple(flat_a))
        return (q_a, origin, tuple(flat_a)), (q_b, somewhere(size / 20), tuple(flat_b))
    if kind == "very different sizes":
        scale = Fraction(2) ** int(rng.integers(-12, 13))
        extents_b = tuple(e * scale for e in extents_b)
        return (q_a, origin, extents_a), (
            q_b,
            somewhere(size / 3 * min(1.0, float(scale))),
            extents_b,
        )
    if kind == "far from the origin":
        far = tuple(Fraction(int(v)) for v in rng.integers(-(10**4), 10**4, size=3))
        moved = tuple(f + m for f, m in zip(far, somewhere(0.05), strict=True))
        moved = tuple(Fraction(round(m * 2**36), 2**36) for m in moved)
        return (q_a, far, extents_a), (_turned(rng, q_a, -3, 0), moved, extents_b)
    if kind == "millimetre to room":
        scale = 10 ** rng.uniform(-3, 1)
        a = tuple(_dyadic(rng, scale / 3, scale) for _ in range(3))
        b = tuple(_dyadic(rng, scale / 3, scale) for _ in range(3))
        return (q_a, origin, a), (q_b, somewhere(scale / 3), b)
    if kind == "near":
        b = tuple(e * Fraction(int(rng.integers(900, 1100)), 1024) for e in extents_a)
        return (q_a, origin, extents_a), (_turned(rng, q_a, -2, -0.5), somewhere(0.02), b)
    if kind == "coplanar":
        # one or more shared planes: same rotation, offset by half the difference of the extents
        local = [Fraction(0)] * 3
        for axis in range(3):
            if rng.random() < 0.6:
                local[axis] = (extents_a[axis] - extents_b[axis]) / 2 * int(rng.choice((-1, 1)))
            elif rng.random() < 0.5:
                extents_b = (*extents_b[:axis], extents_a[axis], *extents_b[axis + 1 :])
        return (q_a, origin, extents_a), (q_a, _along(q_a, local), extents_b)
    raise ValueError(kind)


def compare(kind: str, pairs: int, seed: int) -> tuple[float, float, int]:
    """Largest |oriented_iou - exact| over random pairs, exact seconds, pairs that overlap.

    Both of the package's paths are compared: numpy, and the compiled kernel if there is numba.
    """
    rng = np.random.default_rng((seed, KINDS.index(kind)))
    boxes = [random_pair(kind, rng) for _ in range(pairs)]
    start = time.perf_counter()
    exact = np.array([float(exact_iou(a, b)) for a, b in boxes])
    seconds = time.perf_counter() - start
    a = [np.stack(part) for part in zip(*(as_floats(a) for a, _ in boxes), strict=True)]
    b = [np.stack(part) for part in zip(*(as_floats(b) for _, b in boxes), strict=True)]
    before = _box_clipping._clipped_by_numpy
    differences = []
    for clipped in (-(10**12), _box_clipping._WARM):
        _box_clipping._clipped_by_numpy = clipped
        differences.append(float(np.abs(oriented_iou(*a, *b) - exact).max()))
    _box_clipping._clipped_by_numpy = before
    return max(differences), seconds, int((exact > 0).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=1000, help="pairs of each kind")
    parser.add_argument("--kind", choices=KINDS, action="append", help="only this kind")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(f"{'kind':<24}{'pairs':>8}{'overlap':>9}{'largest difference':>20}{'exact s':>9}")
    for kind in options.kind or KINDS:
        difference, seconds, overlapping = compare(kind, options.pairs, options.seed)
        print(
            f"{kind:<24}{options.pairs:>8}{overlapping:>9}{difference:>20.2e}{seconds:>9.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
