"""Tracing a method on a data set, sample by sample, and comparing it with a reference."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pytest_cpas.evaluation import MethodError, MethodRun, RevisionError, SampleError, measure
from pytest_cpas.protocols import count_columns, judge_outcomes
from pytest_cpas.traces.comparing import Comparison, compare
from pytest_cpas.traces.files import DEFAULT_MOST, Header, read_header, stem_of, write_sample
from pytest_cpas.traces.maps import NameMap
from pytest_cpas.traces.parity import SampleParity
from pytest_cpas.traces.proposing import Proposal, propose
from pytest_cpas.traces.recording import Trace, answer_of, draws_of, record
from pytest_cpas.traces.references import NoTraceError, Reference
from pytest_cpas.traces.spread import with_spread
from pytest_cpas.traces.values import Array
from pytest_cpas.types import DataError, Prediction, Sample, SampleRef, words_of

__all__ = ["Plan", "Traced", "TracedRun"]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is done with traces: ``folder``, where they are recorded, each sample in at most about
    ``most`` bytes; ``spread``: whether the noise of the method is measured; ``proposes``:
    whether a map of names is; ``names``: how the reference's values are called here; ``draw``:
    makes pictures, as plain values, of a value here and in the reference, if it can."""

    folder: Path | None = None
    most: int = DEFAULT_MOST
    spread: bool = False
    proposes: bool = False
    names: NameMap = field(default_factory=NameMap)
    draw: Callable[[Array, Array], Mapping[str, Any] | None] | None = None


@dataclass(frozen=True, kw_only=True)
class Traced:
    """What became of a sample: ``written`` bytes, 0 if it was there already; ``lacking``: the
    reference has no trace of it; ``parity``: how it compares; ``proposal``: of a map of names;
    ``pictures``: of the value at which it parts, as of :class:`Plan`."""

    sample: str
    written: int = 0
    kept: bool = False
    lacking: bool = False
    parity: SampleParity | None = None
    proposal: Proposal = field(default_factory=dict)
    pictures: Mapping[str, Any] | None = None

    def plain(self) -> dict[str, Any]:
        """As plain values, which travel on test reports."""
        return {**vars(self), "parity": self.parity and self.parity.plain()}

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> Traced:
        """The inverse of :meth:`plain`."""
        parity = plain["parity"]
        return cls(**{**plain, "parity": parity and SampleParity.of_plain(parity)})


class TracedRun:
    """A run whose method is traced."""

    def __init__(self, run: MethodRun, plan: Plan, reference: Reference | None) -> None:
        self.run, self.plan, self.reference = run, plan, reference
        self._furthest: dict[str, float] = {}

    @property
    def folder(self) -> Path | None:
        """Where its traces go."""
        folder = self.plan.folder
        return None if folder is None else folder / self.run.method / self.run.dataset

    def trace(self, ref: SampleRef) -> Traced | None:
        """Trace a sample, record it, compare it; None for one that nothing is seen of.

        Raises :class:`pytest_cpas.evaluation.SampleError`, and OSError where a disk does not take
        it.
        """
        run, folder = self.run, self.folder
        where = f"{run.method} on {run.dataset}, sample {ref.id} ({ref.category})"
        header = self._header(ref)
        kept = folder is not None and self._is_recorded(folder, header)
        if kept and self.reference is None:
            return Traced(sample=ref.id, kept=True)
        try:
            if run.unseen(ref):
                return None
            sample = run.read(ref)
            method = run.limited(run.loaded())
        except (DataError, MethodError) as error:
            raise SampleError(f"{where}: {error}") from None
        try:
            trace = record(method, [sample.observation], run.seed)
            spread_of: Mapping[str, str] = {}
            if self.plan.spread and not kept:
                trace, spread_of = with_spread(method, sample.observation, run.seed, trace)
        except Exception as error:
            raise SampleError(f"{where}: while it was traced, {words_of(error)}") from error
        written = 0
        if folder is not None and not kept:
            written = write_sample(folder, replace(header, spread_of=spread_of), trace)
        proposal: dict[str, bool] = {}
        try:
            parity, pictures = self._compared(ref, sample, trace, proposal)
        except (NoTraceError, RevisionError, DataError) as error:
            raise SampleError(f"{where}: {error}") from None
        lacking = self.reference is not None and parity is None
        return Traced(
            sample=ref.id,
            written=written,
            kept=kept,
            lacking=lacking,
            parity=parity,
            proposal=proposal,
            pictures=pictures,
        )

    def _header(self, ref: SampleRef) -> Header:
        run = self.run
        return Header(
            method=run.method,
            dataset=run.dataset,
            sample=ref.id,
            category=ref.category,
            seed=run.seed,
            most=self.plan.most,
            identity=dict(run.identity),
            provenance=dict(run.provenance),
        )

    def _is_recorded(self, folder: Path, header: Header) -> bool:
        """Whether the trace of a sample is there: of the same code, weights, data and limit."""
        try:
            there = read_header(folder / f"{stem_of(header.sample)}.jsonl")
        except DataError:
            return False
        measured = bool(there.spread_of) or not self.plan.spread
        return measured and replace(there, spread_of={}) == header

    def _compared(
        self, ref: SampleRef, sample: Sample, trace: Trace, proposal: dict[str, bool]
    ) -> tuple[SampleParity | None, Mapping[str, Any] | None]:
        """How a trace compares, and pictures; into ``proposal`` goes that of a map, if one is
        asked for."""
        if self.reference is None:
            return None, None
        run, names = self.run, self.plan.names
        theirs = self.reference.trace(ref, sample.observation, run.seed)
        if theirs is None:
            return None, None
        vain = names.in_vain(trace, theirs)
        theirs = names.applied(theirs)
        if self.plan.proposes:
            proposal |= propose(trace, theirs)
        if names.replay:
            trace = self._again(sample, theirs, names.replay)
        found = compare(trace, theirs, names.replay)
        parting, replayed = found.parting, ""
        if parting is not None and parting.kind == "draw":
            drawn = {value.name for value in theirs.values if value.kind == "draw"}
            try:
                again = compare(self._again(sample, theirs, sorted(drawn)), theirs, drawn)
                first = again.parting
                replayed = f"it parts at {first.name}" if first else "no value parts"
            except Exception as error:
                replayed = f"it cannot be used here ({words_of(error)})"
        flips = self._flips(sample, trace, theirs)
        parity = replace(SampleParity.of(ref.id, found, flips, replayed), in_vain=vain)
        return parity, self._pictures(parity, found)

    def _pictures(self, parity: SampleParity, found: Comparison) -> Mapping[str, Any] | None:
        """Of the value at which a sample parts, if it is further off than any before it: so there
        are few, and there is the one of the worst sample."""
        draw, name = self.plan.draw, parity.parts_at
        if draw is None or parity.parting is None or found.pair is None:
            return None
        size = parity.parting.relative
        if size <= self._furthest.get(name, -1.0):
            return None
        self._furthest[name] = size
        own, theirs = found.pair
        return draw(own.kept, theirs.kept) if own.is_whole and theirs.is_whole else None

    def _again(self, sample: Sample, theirs: Trace, names: Sequence[str]) -> Trace:
        """The trace with what the reference has drawn."""
        draws = draws_of(theirs, names)
        return record(self.run.loaded(), [sample.observation], self.run.seed, draws)

    def _flips(self, sample: Sample, trace: Trace, theirs: Trace) -> list[str]:
        """The columns in which one answer is correct and the other is not."""
        columns = count_columns(self.run.protocols)
        found = [answer_of(trace), answer_of(theirs)]
        gives = frozenset(self.run.info.gives) if self.run.info else frozenset()
        if any(each is None or each.shape is None for each in found):
            gives -= {"shape"}
        if any(each is None or each.extents is None for each in found):
            gives -= {"extents"}
        info = replace(
            self.run.unloaded.info, gives=gives, camera_frame="opencv", object_frame="shapenet"
        )
        outcomes = []
        for each in found:
            answer = Prediction.failed("no answer") if each is None else Prediction((each,))
            [measured] = measure(
                self.run.facts, [sample.truth], [answer], info, [sample.observation.camera]
            )
            outcomes += judge_outcomes(columns, [measured.facts])
        return [
            column.label
            for column, own, other in zip(columns, *outcomes, strict=True)
            if own != other and "-" not in (own, other)
        ]
