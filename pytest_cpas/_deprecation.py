"""What has another name now: the old one goes on working for a while, and says what to write.

:func:`deprecated` warns; :data:`MOVED` lists the modules that were moved, which are found under
their old path as well. docs/stability.md says for how long.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

__all__ = ["MOVED", "deprecated", "find_moved_modules"]

#: The version that no longer has the paths of :data:`MOVED`.
_REMOVAL = "0.3"

#: Old path of a module, where it is now, and the path to import from.
MOVED: dict[str, tuple[str, str]] = {
    "pytest_cpas.bop_export": (
        "pytest_cpas.evaluation.bop_export",
        "pytest_cpas.evaluation.bop_export",
    ),
    "pytest_cpas.checks.dataset.report": (
        "pytest_cpas.report.sphere_picture",
        "pytest_cpas.report.sphere_picture",
    ),
    "pytest_cpas.comparison": ("pytest_cpas.golden.comparison", "pytest_cpas.golden"),
    "pytest_cpas.estimates": ("pytest_cpas.evaluation.estimates", "pytest_cpas.evaluation"),
    "pytest_cpas.fetch": ("pytest_cpas.fetching.command", "pytest_cpas.fetching"),
    "pytest_cpas.frames": ("pytest_cpas.types.frames", "pytest_cpas.types.frames"),
    "pytest_cpas.predictions": ("pytest_cpas.evaluation.predictions", "pytest_cpas.evaluation"),
    "pytest_cpas.published": ("pytest_cpas.golden.published", "pytest_cpas.golden"),
    "pytest_cpas.results": ("pytest_cpas.evaluation", "pytest_cpas.evaluation"),
    "pytest_cpas.robustness": ("pytest_cpas.datasets.perturbed", "pytest_cpas.datasets.perturbed"),
    "pytest_cpas.snapshot": ("pytest_cpas.golden.snapshot", "pytest_cpas.golden.snapshot"),
    "pytest_cpas.sources": ("pytest_cpas.datasets.sources", "pytest_cpas.datasets.sources"),
    "pytest_cpas.spread": ("pytest_cpas.golden.spread", "pytest_cpas.golden.spread"),
}


def deprecated(old: str, new: str, removal: str, *, stacklevel: int = 1) -> None:
    """Warn that ``old`` goes in version ``removal``, and that ``new`` is what to write instead.

    With a ``stacklevel`` of 1 the warning is at the line that called the caller of this function.
    """
    warnings.warn(
        f"{old} is deprecated, and goes in pytest-cpas {removal}: write {new}",
        DeprecationWarning,
        stacklevel=stacklevel + 2,
    )


class _MovedModules(MetaPathFinder, Loader):
    """Finds a module under its old path: the very module that it is now, and a warning."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname in MOVED else None

    def create_module(self, spec: ModuleSpec) -> None:
        """The default: an empty module, which :meth:`exec_module` replaces."""

    def exec_module(self, module: ModuleType) -> None:
        old = module.__name__
        where, public = MOVED[old]
        # the frames of the import system in between do not count
        deprecated(old, public, _REMOVAL)
        sys.modules[old] = importlib.import_module(where)


def find_moved_modules() -> None:
    """Have the import system find modules under their old paths, after all else."""
    if not any(isinstance(finder, _MovedModules) for finder in sys.meta_path):
        sys.meta_path.append(_MovedModules())
