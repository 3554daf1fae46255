"""What a method is, and what it declares about itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Literal, Protocol, runtime_checkable

from pytest_cpas.types.answers import Prediction
from pytest_cpas.types.errors import DeclarationError, raised_as, shown
from pytest_cpas.types.names import checked_name
from pytest_cpas.types.samples import Observation

__all__ = ["EQUIVARIANCES", "Asset", "Method", "MethodInfo", "assets_of"]


@dataclass(frozen=True, kw_only=True)
class Asset:
    """A file that a method needs: ``path`` below the weights folder, where it is published, and
    under which licence."""

    path: str
    url: str
    licence: str

    def __post_init__(self) -> None:
        path = PurePath(self.path)
        if path.is_absolute() or not path.parts or ".." in path.parts:
            raise DeclarationError(
                f"asset {shown(self.path)}: expected a file below the weights folder"
            )

    def locate(self, weights: Path | None) -> Path:
        """The file below the weights folder; :class:`FileNotFoundError` if it is not there."""
        if weights is None or not (weights / self.path).is_file():
            where = f"{weights / self.path} does not exist" if weights else "no --cpas-weights"
            raise FileNotFoundError(
                f"{self.path}: {where}. It is published at {self.url} ({self.licence}); fetch it,"
                " and pass its folder with --cpas-weights DIR or CPAS_WEIGHTS"
            )
        return weights / self.path


#: Changes of the image whose effect on the answer geometry dictates: the image shifted, at half its
#: resolution, seen from further away, mirrored, rolled about the optical axis by 90 degrees.
EQUIVARIANCES = ("shift", "resolution", "distance", "mirror", "roll")


#: The tolerance of a method that declares none, metres and radians.
TOLERANCE = 1e-5


#: Observations that a method may be asked about at once: each has some megabytes.
MOST_AT_ONCE = 1024


@dataclass(frozen=True, kw_only=True)
class MethodInfo:
    """What a method declares about itself; the checks that are demanded of it follow from it.

    ``needs``: the parts of an observation that it uses. ``gives``: the parts of a hypothesis
    beside the pose that it estimates. ``object_frame`` and ``camera_frame``: the axes in which
    its hypotheses are expressed (the harness converts). ``deterministic``: the same seed gives
    the same answer. ``tolerance``: by how much, in metres and radians, answers may differ that
    must be the same: what batch size and threads do to sums of floats. ``equivariances``: what a
    method claims to follow, see :data:`EQUIVARIANCES`. ``batch``: about how many observations it is
    asked at once.
    """

    name: str
    categories: tuple[str, ...]
    needs: frozenset[Literal["rgb", "depth"]]
    gives: frozenset[Literal["extents", "shape", "score"]]
    licence: str
    object_frame: Literal["shapenet", "nocs"] = "shapenet"
    camera_frame: Literal["opencv", "opengl"] = "opencv"
    deterministic: bool = True
    assets: tuple[Asset, ...] = ()
    tolerance: float = TOLERANCE
    equivariances: frozenset[str] = frozenset()
    batch: int = 1

    def __post_init__(self) -> None:
        for name, allowed in (
            ("needs", {"rgb", "depth"}),
            ("gives", {"extents", "shape", "score"}),
            ("equivariances", set(EQUIVARIANCES)),
        ):
            seen = frozenset(getattr(self, name))
            if not seen <= allowed:
                raise DeclarationError(
                    f"method {self.name!r}: {name} has {sorted(seen - allowed)}, expected some of"
                    f" {sorted(allowed)}"
                )
            object.__setattr__(self, name, seen)
        for name, choices in (
            ("object_frame", ("shapenet", "nocs")),
            ("camera_frame", ("opencv", "opengl")),
        ):
            if getattr(self, name) not in choices:
                raise DeclarationError(
                    f"method {self.name!r}: {name} is {getattr(self, name)!r}, expected one of"
                    f" {choices}"
                )
        if not 0 <= self.tolerance < 0.1:
            raise DeclarationError(
                f"method {self.name!r}: tolerance is {self.tolerance}, expected metres and radians"
                " that float noise explains, below 0.1"
            )
        if type(self.batch) is not int or not 1 <= self.batch <= MOST_AT_ONCE:
            raise DeclarationError(
                f"method {self.name!r}: batch is {self.batch!r}, expected how many observations"
                f" predict is given at once, 1 to {MOST_AT_ONCE}"
            )
        if not self.categories:
            raise DeclarationError(f"method {self.name!r}: it declares no categories")
        with raised_as(DeclarationError):
            checked_name("method", self.name)


@runtime_checkable
class Method(Protocol):
    """A categorical pose and shape method. Made without arguments, then loaded once.

    For ``assets_in``, which it may have as well, see :func:`assets_of`.
    """

    info: MethodInfo

    def load(self, assets: Path | None, device: str) -> None:
        """Read weights below ``assets`` (None for a method without any) onto ``device``."""

    def predict(self, batch: Sequence[Observation], seed: int) -> Sequence[Prediction]:
        """One prediction per observation, in order; all randomness comes from ``seed``."""


def assets_of(method: Method | type[Method], folder: Path | None) -> Sequence[Asset]:
    """The files that a method, or its class, loads from a weights folder.

    Those that it declares, unless it has a class method ``assets_in(folder)``, which says so where
    it depends on what is there.
    """
    assets_in: Callable[[Path], Sequence[Asset]] | None = getattr(method, "assets_in", None)
    if assets_in is None or folder is None:
        return method.info.assets
    return assets_in(folder)
