"""A method is asked for several answers at once, while each sample is judged by itself.

What a sample's answer is does not depend on with which others it was asked for: a method owes that
(the contract checks it), and here no more than the samples' order goes into a batch.
"""

from __future__ import annotations

import gc
import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from pytest_cpas.evaluation.loading import MethodError
from pytest_cpas.reading.text import terminal_line
from pytest_cpas.types import AnswerError, DataError, Prediction, Sample, SampleRef, shortened

__all__ = ["Batches", "Predicted", "batches_of", "check_count"]

#: What libraries say when memory runs out, in lower case.
_OUT_OF_MEMORY = (
    "out of memory",
    "outofmemory",
    "memoryerror",
    "alloc_failed",
    "t allocate memory",
)


#: Lines that are kept of how batches went.
_MOST_TOLD = 20


@dataclass(frozen=True)
class Predicted:
    """A sample, and under each seed what the method answered or raised."""

    sample: Sample
    answers: Sequence[Prediction | Exception]


class Batches:
    """The samples of a run that are predicted together, each batch when its first one is wanted.

    ``told``: what should be known of how that went, a line each.
    """

    def __init__(
        self,
        read: Callable[[SampleRef], Sample | None],
        predict: Callable[[Sequence[Sample], int], Sequence[Prediction]],
        seeds: Sequence[int],
    ) -> None:
        """Nothing is predicted with another one before :meth:`plan` says so.

        ``read``: a sample, None where nothing is seen of it; raises :class:`DataError`.
        ``predict``: the answers under one seed, whatever the method gives or raises.
        """
        self._read, self._predict, self._seeds = read, predict, seeds
        self._planned: dict[str, Sequence[SampleRef]] = {}
        self._next: dict[str, Sequence[SampleRef]] = {}
        self._predicted: dict[str, Predicted | DataError] = {}
        self._largest: int | None = None
        self._reader: ThreadPoolExecutor | None = None
        self._ahead: dict[str, Future[Sample | None]] = {}
        self.told: list[str] = []

    def plan(self, batches: Sequence[Sequence[SampleRef]], *, ahead: bool) -> None:
        """Take in which samples go together. ``ahead``: the batches come one after another, so that
        the samples of each can be read, in a thread, while the one before is predicted."""
        self._planned = {ref.id: batch for batch in batches for ref in batch}
        if ahead:
            pairs = itertools.pairwise(batches)
            self._next = {ref.id: after for batch, after in pairs for ref in batch}
            self._reader = ThreadPoolExecutor(1, thread_name_prefix="cpas-reading")

    def of(self, ref: SampleRef) -> Predicted:
        """A sample of which something is seen, with its answers; :class:`DataError` if it is
        damaged."""
        if ref.id not in self._predicted:
            batch = self._planned.get(ref.id, [ref])
            for other in batch:  # whoever is asked for once more is asked for alone
                self._planned.pop(other.id, None)
            after = self._next.pop(ref.id, ())
            samples = dict(self._samples(batch))
            if self._reader is not None:
                self._ahead = {r.id: self._reader.submit(self._read, r) for r in after}
            # by what was asked for: what was read may have another name
            whole = {name: each for name, each in samples.items() if isinstance(each, Sample)}
            answers = [self.asked([*whole.values()], seed) for seed in self._seeds]
            self._predicted |= {
                name: error for name, error in samples.items() if isinstance(error, DataError)
            }
            self._predicted |= {
                name: Predicted(sample, of_it)
                for (name, sample), of_it in zip(
                    whole.items(), zip(*answers, strict=True), strict=True
                )
            }
        found = self._predicted.pop(ref.id)
        if isinstance(found, DataError):
            raise found
        return found

    def _samples(self, refs: Sequence[SampleRef]) -> Iterator[tuple[str, Sample | DataError]]:
        for ref in refs:
            try:
                ahead = self._ahead.pop(ref.id, None)
                sample = self._read(ref) if ahead is None else ahead.result()
                if sample is not None:
                    yield ref.id, sample
            except DataError as error:
                yield ref.id, error

    def asked(self, samples: Sequence[Sample], seed: int) -> list[Prediction | Exception]:
        """Answers under one seed, or what was raised: for each sample what it gets alone, if all at
        once raise."""
        found: list[Prediction | Exception] = []
        while (at := len(found)) < len(samples):
            most = self._largest or len(samples)
            found += self._at_once(samples[at : at + most], seed)
        return found

    def _at_once(self, samples: Sequence[Sample], seed: int) -> Sequence[Prediction | Exception]:
        try:
            return check_count(self._predict(samples, seed), len(samples))
        except MethodError:
            raise
        except AnswerError as error:
            return [error] * len(samples)
        except Exception as error:
            if len(samples) == 1:
                return [error]
            words, full = f"{type(error).__name__}: {error}", _memory_ran_out(error)
        if full:
            gc.collect()  # the exception is gone, and with it what its frames held
            self._largest = len(samples) // 2
            self.tell(f"memory ran out with {len(samples)} samples at once: {self._largest} then")
            return self.asked(samples, seed)
        self.tell(f"{len(samples)} samples at once: {words}; each was asked for alone then")
        return [answer for sample in samples for answer in self._at_once([sample], seed)]

    def tell(self, line: str) -> None:
        """Take in what should be known, once."""
        line = shortened(terminal_line(line))
        if line not in self.told and len(self.told) < _MOST_TOLD:
            self.told.append(line)


def check_count(answers: Sequence[Prediction], count: int) -> Sequence[Prediction]:
    """The answers to a batch; :class:`AnswerError` if they are not ``count``."""
    if not isinstance(answers, Sequence) or len(answers) != count:
        seen = f"{len(answers)} of them" if isinstance(answers, Sequence) else type(answers)
        each = "one Prediction for a batch of one"
        raise AnswerError(
            f"predict: {seen}, expected {each if count == 1 else f'{count}, one per observation'}"
        )
    return answers


def _memory_ran_out(error: Exception) -> bool:
    words = f"{type(error).__name__}: {error}".lower()
    return any(part in words for part in _OUT_OF_MEMORY)


def batches_of(
    items: Sequence[Sequence[SampleRef]], size: int, done: Collection[str]
) -> list[list[SampleRef]]:
    """Samples in batches of ``size``, in the order of their items; an item of several samples
    shares no batch with another one. Those that are ``done`` are left out."""
    kept = [[ref for ref in refs if ref.id not in done] for refs in items]
    if all(len(refs) <= 1 for refs in items):
        kept = [[ref for refs in kept for ref in refs]]
    return [refs[at : at + size] for refs in kept for at in range(0, len(refs), size)]
