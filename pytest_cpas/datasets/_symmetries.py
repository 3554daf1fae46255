"""Symmetries in words, and which of them a mesh has."""

from __future__ import annotations

import functools
import itertools
import re
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_cpas._open3d import import_open3d
from pytest_cpas.reading.numbers import whole
from pytest_cpas.types import Array, DataError, Mesh, Symmetry

__all__ = ["EXPECTED", "TOLERANCE", "Found", "find_symmetry", "mismatch", "parse_symmetry"]

#: The words of a symmetry, for messages.
EXPECTED = "none, y, y/4 (or x, z), several of these joined by +, box or sphere"

#: A rotation that brings no point of a surface farther from it than this share of the diagonal of
#: the box is a symmetry.
TOLERANCE = 0.01

#: More turns than anybody would list are a slip of the pen.
_MOST_FOLD = 360

#: Largest group of several terms: that of a prism of so many sides. A cube has 24.
_MOST_ROTATIONS = 720

#: Folds that are looked for, and of which primes they are; what has more is round.
_FOLDS = {12: (2, 3), 11: (11,), 10: (2, 5), 9: (3,), 8: (2,), 7: (7,), 6: (2, 3), 5: (5,)}
_FOLDS |= {4: (2,), 3: (3,), 2: (2,)}

#: Turns that no fold of a part has, degrees: what none of them changes is round.
_ROUND = (13.0, 31.0, 47.0, 73.0, 101.0, 139.0, 163.0)

#: Points of a surface that are turned.
_POINTS = 2000

_TERM = re.compile(r"([xyz])(?:/(\d+))?")


@functools.cache
def parse_symmetry(text: str) -> Symmetry:
    """``none``, ``y`` (any angle about y), ``y/4`` (four-fold about y), ``box`` or ``sphere``;
    x and z as y. ``y + x/2`` is the group of both: a cylinder, which is also turned over.

    Raises :class:`DataError`.
    """
    named = {"none": Symmetry.none, "box": Symmetry.box, "sphere": Symmetry.full}
    if text in named:
        return named[text]()
    axis, turns = None, [np.eye(3)[None]]
    for term in text.split("+"):
        match = _TERM.fullmatch(term.strip())
        fold = whole(match[2]) if match else None
        if not match or (match[2] and not (fold and fold <= _MOST_FOLD)):
            raise DataError(f"symmetry {text!r}, expected {EXPECTED}")
        about = np.eye(3)["xyz".index(match[1])]
        if fold is not None:
            turns.append(Symmetry.n_fold(about, fold).rotations)
        elif axis is None or np.array_equal(axis, about):
            axis = about
        else:
            return Symmetry.full()  # round about two axes
    if len(turns) <= 2:
        rotations = turns[-1]
    else:
        rotations = _generated(np.concatenate(turns), text)
    if axis is None:
        return Symmetry(rotations=rotations)
    ends = rotations @ axis @ axis
    if np.any(np.abs(np.abs(ends) - 1) > 1e-6):
        return Symmetry.full()  # the axis is turned away
    # whatever turns the axis over does, together with the spins, what all that do so do
    over = rotations[np.flatnonzero(ends < 0)[:1]]
    return Symmetry(rotations=np.concatenate([np.eye(3)[None], over]), axis=axis)


def _generated(turns: Array, text: str) -> Array:
    """All rotations (n, 3, 3) that follow from some."""
    found = np.eye(3)[None]
    while True:
        products = np.einsum("aij,bjk->abik", found, turns).reshape(-1, 3, 3)
        _, first = np.unique(np.round(products, 6) + 0.0, axis=0, return_index=True)
        if len(first) == len(found):
            return found
        if len(first) > _MOST_ROTATIONS:
            raise DataError(
                f"symmetry {text!r} has more than {_MOST_ROTATIONS} rotations; expected those of a"
                " part, such as y/4 + x/2"
            )
        found = products[first]


@dataclass(frozen=True)
class Found:
    """The symmetry of a mesh in words, and the share of its diagonal that its surface is off itself
    under it at most; ``next_best``: the like of what is not one but comes nearest, if any does."""

    text: str
    off: float
    next_best: tuple[str, float] | None = None


def find_symmetry(mesh: Mesh) -> Found:
    """The symmetry of a centred mesh about the axes of its frame.

    Looked for are any angle, and folds of 2 to 12, about x, y and z, and what they make together.
    Raises :class:`ImportError` where Open3D is missing.
    """
    surface = _Surface(mesh)
    tried: dict[str, float] = {}

    def holds(term: str) -> bool:
        if term not in tried:
            tried[term] = surface.off(term)
        return tried[term] <= TOLERANCE

    # about y is what people mean where a shape allows several
    terms = []
    for axis in "yxz":
        if holds(axis):
            terms.append(axis)
            continue
        primes = [prime for prime in (2, 3, 5, 7, 11) if holds(f"{axis}/{prime}")]
        of_them = [n for n, needs in _FOLDS.items() if set(needs) <= set(primes)]
        terms += [f"{axis}/{n}" for n in of_them if holds(f"{axis}/{n}")][:1]
    text = _told(terms)
    if (off := surface.off(text)) > TOLERANCE:  # what each of them is off adds up
        text = terms[0]
        off = tried[text]
    others = [(off, term) for term, off in tried.items() if off > TOLERANCE]
    best = min(others, default=None)
    return Found(text, off, best and (best[1], best[0]))


def _told(terms: list[str]) -> str:
    """A group in words, of which no term can be left out; the words of few of them first."""
    whole_group = parse_symmetry(" + ".join(terms)) if terms else Symmetry.none()
    if whole_group.sphere:
        return "sphere"
    size = len(whole_group.rotations), whole_group.axis is not None
    if not terms or (size == (4, False) and len(terms) == 3):
        return "box" if terms else "none"
    for count in range(1, len(terms)):
        for chosen in itertools.combinations(terms, count):
            part = parse_symmetry(" + ".join(chosen))
            if (len(part.rotations), part.axis is not None) == size:
                return " + ".join(chosen)
    return " + ".join(terms)


def mismatch(mesh: Mesh, text: str) -> float:
    """How far a symmetry brings the surface of a centred mesh off itself at most, as a share of the
    diagonal of its box."""
    return _Surface(mesh).off(text)


class _Surface:
    """Points of a mesh's surface, and how far it is from them when they are turned."""

    def __init__(self, mesh: Mesh) -> None:
        low, high = mesh.bounds
        self._diagonal = float(np.linalg.norm(high - low))
        o3d = import_open3d()
        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32)
        )
        corners = mesh.vertices[mesh.triangles]
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = np.linalg.norm(np.cross(a, b), axis=1)
        rng = np.random.default_rng(0)
        chosen = rng.choice(len(area), _POINTS, p=area / area.sum())
        u, v = np.sort(rng.random((2, _POINTS)), axis=0)
        sampled = corners[chosen, 0] + u[:, None] * a[chosen] + (v - u)[:, None] * b[chosen]
        # what sticks out is in the corners
        outermost = np.argsort(np.linalg.norm(mesh.vertices, axis=1))[-_POINTS // 10 :]
        self._points = np.concatenate([sampled, mesh.vertices[outermost]])

    def off(self, text: str) -> float:
        symmetry = parse_symmetry(text)
        rotations = symmetry.rotations
        if symmetry.sphere:
            rotations = Rotation.random(20, random_state=0).as_matrix()
        elif symmetry.axis is not None:
            spins = Rotation.from_rotvec(np.deg2rad(_ROUND)[:, None] * symmetry.axis).as_matrix()
            rotations = np.einsum("aij,bjk->abik", spins, rotations).reshape(-1, 3, 3)
        turned = np.einsum("aij,pj->api", rotations, self._points).astype(np.float32)
        distances = self._scene.compute_distance(self._tensor(turned.reshape(-1, 3)))
        return float(distances.numpy().max()) / self._diagonal
