"""What a run is: something that judges samples."""

from __future__ import annotations

import platform
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from threadpoolctl import threadpool_info

from pytest_cpas.datasets.perturbed import RobustnessPoint
from pytest_cpas.evaluation.opened import digest_of_opened
from pytest_cpas.evaluation.rows import Row
from pytest_cpas.facts import fact, in_order
from pytest_cpas.protocols import (
    PAPER,
    Column,
    Protocol,
    Ranking,
    count_columns,
    facts_of,
    ranking_columns,
    score_columns,
    shipped_protocol,
)
from pytest_cpas.submissions import Given
from pytest_cpas.types import (
    CATEGORIES,
    DataError,
    GroundTruth,
    MethodInfo,
    SampleRef,
    ToldError,
    shortened,
)
from pytest_cpas.types.names import checked_name
from pytest_cpas.types.samples import evenly

__all__ = ["Run", "SampleError", "Selection"]


#: Facts that every run measures, whatever its protocols need: of the pose, of the box and of the
#: shape, so that a golden table guards everything that a method gives.
_ALWAYS = ("position_m", "rotation_deg", "iou", "fscore_1cm")


def kernels() -> str:
    """Which code for linear algebra and which instructions of the processor numpy uses: what makes
    the last bits of sums other ones on another machine."""
    # others may be loaded later, or not at all
    own = [pool for pool in threadpool_info() if "numpy" in str(pool.get("filepath"))]
    words = sorted(
        f"{pool.get('internal_api')} {pool.get('version')} {pool.get('architecture', '')}".strip()
        for pool in own
    )
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    return ", ".join([*words, *found[-1:]]) or "unknown"


#: Lines that a run keeps of what is missing, or damaged.
_MOST_LINES = 1000


def _told(lines: Sequence[str]) -> tuple[str, ...]:
    """Lines as a run keeps them: neither endless, nor without end."""
    kept = tuple(shortened(line) for line in lines[:_MOST_LINES])
    more = len(lines) - _MOST_LINES
    return (*kept, f"and {more} more") if more > 0 else kept


class SampleError(ToldError):
    """A sample could not be judged: damaged data, a method that raised, a broken contract."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Which samples to judge: those of ``categories`` (all if empty), of them ``limit``, evenly
    spaced, and of those the ``shard``-th (from 1) of ``shards`` parts."""

    categories: Sequence[str] = ()
    limit: int | None = None
    shard: int = 1
    shards: int = 1

    def of(self, samples: Sequence[SampleRef]) -> list[SampleRef]:
        """The selected samples, in order."""
        chosen = [s for s in samples if not self.categories or s.category in self.categories]
        limited = chosen if self.limit is None else evenly(chosen, self.limit)
        return limited[self.shard - 1 :: self.shards]

    def check(self, there: Collection[str]) -> None:
        """Raise :class:`ValueError` for a category that is asked for and not ``there``."""
        if unknown := [name for name in self.categories if name not in there]:
            raise ValueError(
                f"--cpas-category {', '.join(unknown)}: no sample is of that category; those that"
                f" can be judged are of {', '.join(sorted(there))}"
            )


class Run(ABC):
    """Something that judges samples: a method on a data set, or stored predictions.

    ``samples`` are those selected; ``listed`` counts per category what there was to select from.
    ``missing`` and ``damaged`` as for a data set, ``derived`` in a line. ``identity`` holds what
    must agree for two runs to be comparable, ``provenance`` what else should be known of this one,
    ``files`` a digest of each file that may be part of the program. ``seeds`` is how often
    each sample is judged. ``info`` is what the method declares, None where only rows are left.
    ``quick_truth``: :meth:`truth` opens no image. ``focal``: the focal length in pixels, if known.
    ``classes``: the categories of the class ids that files of predictions number them by.
    ``robustness_point``: which point of the curves of a robustness profile it is, None for none.
    ``under_contract``: it is a method's first run, which has the checks of the contract.
    ``protocols``: what it is judged under; ``facts``: the names of what is measured for them, and
    of the pose's errors in any case; ``definitions``: the id of what each of those means.
    """

    seeds = 1
    files: Mapping[str, str] = {}
    under_contract = False
    info: MethodInfo | None = None
    quick_truth = True
    focal: float | None = None
    classes: Sequence[str] = CATEGORIES
    robustness_point: RobustnessPoint | None = None
    #: Where answers go that are judged, if somebody keeps them: see :class:`SavedAnswers`.
    take_answer: Callable[[SampleRef, str, Given, Sequence[Given]], None] | None = None

    provenance: Mapping[str, str] = {
        "platform": f"{platform.system()} {platform.machine()}",
        "kernels": kernels(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }

    def __init__(
        self,
        method: str,
        dataset: str,
        samples: Sequence[SampleRef],
        *,
        selection: Selection | None = None,
        missing: Sequence[str] = (),
        derived: str = "",
        damaged: Sequence[str] = (),
        identity: Mapping[str, str],
        protocols: Sequence[Protocol] | None = None,
    ) -> None:
        """List ``samples``, and select some of them (all if ``selection`` is None).

        ``protocols``: the paper's if None. Raises :class:`DataError` if two samples have the same
        id.
        """
        self.method = checked_name("method", method)
        self.dataset = checked_name("data set", dataset)
        _check_ids(self.dataset, samples)
        self.listed = Counter(sample.category for sample in samples)
        self.samples = (selection or Selection()).of(samples)
        self.missing, self.damaged = _told(missing), _told(damaged)
        self.derived = shortened(derived)
        self.identity: Mapping[str, str] = identity
        self.protocols = (shipped_protocol(PAPER),) if protocols is None else tuple(protocols)
        of_samples: tuple[Column, ...] = (
            *count_columns(self.protocols),
            *score_columns(self.protocols),
        )
        self.facts = tuple(in_order((*_ALWAYS, *facts_of(of_samples))))
        ranked = facts_of(ranking_columns(self.protocols))
        self.definitions = {
            name: fact(name).definition for name in in_order((*self.facts, *ranked))
        }

    @property
    def notes(self) -> Sequence[str]:
        """What else people should know of what is judged, one line each."""
        return ()

    @property
    def answers_give(self) -> frozenset[Literal["extents", "shape", "score"]]:
        """What the answers have that :attr:`take_answer` is given."""
        return self.info.gives if self.info else frozenset()

    @abstractmethod
    def judge(self, ref: SampleRef) -> Row:
        """The row of one sample; raises :class:`SampleError`."""

    def digests_of_opened(self, names: Collection[str]) -> Mapping[str, str]:
        """A digest of each of some files, by name, as they are now."""
        return {name: digest_of_opened(name) for name in names}

    def changed_meanwhile(self, *, thoroughly: bool = False) -> Mapping[str, bool]:
        """Names of what has changed of the program since the run was made, and whether golden
        tables tell of it; so nobody knows which of both has answered.

        Files that are new, or that are found by an import now, are seen ``thoroughly`` alone.
        """
        return {}

    def truth(self, ref: SampleRef) -> GroundTruth | None:
        """The truth about one sample; None where only its row is left."""
        return None

    def ranking(self, rows: Sequence[Row]) -> Ranking | None:
        """The detections of the whole data set, ranked for the protocols that ask for it; None
        where what is judged are no detections, or not all of them. ``rows``: those of the run."""
        return None


def _check_ids(dataset: str, samples: Sequence[SampleRef]) -> None:
    counts = Counter(sample.id for sample in samples)
    if repeated := [name for name, count in counts.items() if count > 1]:
        raise DataError(
            f"data set {dataset}: {len(repeated)} sample ids occur more than once, first"
            f" {repeated[0]!r}, {counts[repeated[0]]} times; every sample needs an id of its own"
        )
