"""Contract checks that ask again: what must not matter, does not."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from pytest_cpas.checks.contract.checking import (
    MethodSubject,
    NotCheckedError,
    contract,
    difference,
)
from pytest_cpas.checks.outcome import Finding, Outcome
from pytest_cpas.types import MethodInfo, Observation

__all__ = [
    "check_background",
    "check_batch",
    "check_colour",
    "check_depth",
    "check_fresh_instance",
    "check_global_random_state",
    "check_global_random_state_untouched",
    "check_no_evidence",
    "check_order",
    "check_repeatable",
    "check_threads",
]


def _deterministic(info: MethodInfo) -> bool:
    return info.deterministic


def _several(subject: MethodSubject) -> int:
    count = len(subject.samples)
    if count < 2:
        raise NotCheckedError("this takes two samples")
    return count


@contract(smoke=True, demanded=_deterministic)
def check_repeatable(subject: MethodSubject) -> None:
    """The same observation and seed give the same answer, twice in a row."""
    subject.answers()
    if subject.first.again:
        raise subject.first.again


@contract(demanded=_deterministic)
def check_global_random_state(subject: MethodSubject) -> None:
    """The global random states of python, numpy and torch do not matter."""
    expected = subject.repeated_answers()[-1]
    subject.same(
        subject.predict(subject.observations[-1:], random_state=1)[0],
        expected,
        "the global random state changed the answer: draw from the passed seed",
    )


@contract(demanded=lambda info: False)
def check_global_random_state_untouched(subject: MethodSubject) -> None:
    """A call neither draws from the global random states nor seeds them."""
    subject.answers()
    if subject.first.changed_state:
        names = ", ".join(sorted(subject.first.changed_state))
        raise Finding(
            Outcome.DREW_GLOBAL_RANDOM,
            f"predict draws from or seeds the global state of {names}: what runs after it changes;"
            " use a generator of its own",
        )


@contract(demanded=_deterministic)
def check_order(subject: MethodSubject) -> None:
    """The order of the samples does not matter."""
    expected = subject.repeated_answers()
    for index in reversed(range(_several(subject) - 1)):
        subject.same(
            subject.predict([subject.observations[index]])[0],
            expected[index],
            "the order of the samples changed the answer: something is kept from one call to the"
            " next; reset it at the start of predict",
        )


@contract(
    demanded=lambda info: info.deterministic and "depth" in info.needs,
    applies=lambda info: "depth" in info.needs,
)
def check_no_evidence(subject: MethodSubject) -> None:
    """Without depth in the mask there is an answer or a reason, whatever was asked before."""
    subject.repeated_answers()
    own = [observation for observation, _ in subject.of_each_category()]
    if len(own) == 1:
        own = subject.observations[:2]
    for index, observation in enumerate(own):
        seen = np.where(observation.mask, 0, observation.depth).astype(np.float32)
        _no_evidence(subject, replace(observation, depth=seen), [observation, own[index - 1]])


def _no_evidence(
    subject: MethodSubject, blank: Observation, previous: Sequence[Observation]
) -> None:
    said = []
    for observation in previous:
        before = subject.predict([observation])[0]
        try:
            said.append(subject.predict([blank])[0])
        except Finding as finding:
            raise Finding(
                finding.outcome,
                f"no depth in the mask: {finding}; {subject.say_why}",
            ) from finding
        if said[-1].hypotheses and not difference(said[-1], before, 0):
            raise Finding(
                Outcome.VIOLATED,
                f"without depth in the mask of a {blank.category}, the answer is the previous"
                f" sample's; {subject.say_why}",
            )
    for again in said[1:]:
        subject.same(
            again,
            said[0],
            f"without depth in the mask of a {blank.category}, the answer depends on the sample"
            f" before; {subject.say_why}",
        )


@contract(demanded=_deterministic)
def check_fresh_instance(subject: MethodSubject) -> None:
    """A new instance that has seen nothing gives the same answer."""
    if subject.fresh is None:
        raise NotCheckedError("there is no way to make another instance")
    expected = subject.repeated_answers()[-1]
    try:
        fresh = subject.fresh()
    except Exception as error:
        raise Finding(
            Outcome.RAISED,
            f"a second instance cannot be loaded: {error!r}; load must not use anything up",
        ) from error
    subject.same(
        subject.predict(subject.observations[-1:], method=fresh)[0],
        expected,
        "a new instance gives another answer: what ran before is kept in the instance, or load"
        " draws at random",
    )


@contract(demanded=_deterministic)
def check_batch(subject: MethodSubject) -> None:
    """The other observations of a batch, and their order, do not matter."""
    expected = subject.repeated_answers()
    order = list(reversed(range(_several(subject))))
    together = subject.predict([subject.observations[index] for index in order])
    for position, index in enumerate(order):
        subject.same(
            together[position],
            expected[index],
            "in a batch the answer is another one: answers in the order of the batch; no batch norm"
            " in training mode (network.eval()), no statistics over the batch, one generator per"
            " observation",
        )
    empty = subject.predict([])
    if empty:
        raise Finding(Outcome.VIOLATED, f"{len(empty)} answers for an empty batch, expected none")


@contract(demanded=_deterministic)
def check_threads(subject: MethodSubject) -> None:
    """The number of threads does not matter."""
    expected = subject.repeated_answers()[-1]
    torch: Any = sys.modules.get("torch")
    pools = [int(pool["num_threads"]) for pool in threadpool_info()]
    now = max([*pools, torch.get_num_threads() if torch else 1])
    count = 1 if now > 1 else 2
    with _threads(count, torch):
        again = subject.predict(subject.observations[-1:])[0]
    subject.same(
        again,
        expected,
        f"with {count} threads instead of {now} the answer is another one: no work shared by"
        " chance; if it is float noise, declare MethodInfo(tolerance=...)",
    )


@contextmanager
def _threads(count: int, torch: Any) -> Iterator[None]:
    """Let BLAS, OpenMP and torch use ``count`` threads."""
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(count))
        if torch:
            stack.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(count)
        yield


@contract(applies=lambda info: "rgb" not in info.needs, demanded=_deterministic)
def check_colour(subject: MethodSubject) -> None:
    """Colour does not matter to a method that does not declare to need it."""
    _unchanged(subject, "rgb", 'declare "rgb" in info.needs, or do not use it')


@contract(applies=lambda info: "depth" not in info.needs, demanded=_deterministic)
def check_depth(subject: MethodSubject) -> None:
    """Depth does not matter to a method that does not declare to need it."""
    _unchanged(subject, "depth", 'declare "depth" in info.needs, or do not use it')


def _unchanged(subject: MethodSubject, part: str, advice: str) -> None:
    for observation, expected in subject.of_each_category():
        noise = np.random.default_rng(0).random(getattr(observation, part).shape, np.float32)
        subject.same(
            subject.predict([replace(observation, **{part: noise})])[0],
            expected,
            f"{part} changed the answer: {advice}",
        )


@contract(demanded=lambda info: False)
def check_background(subject: MethodSubject) -> None:
    """Pixels outside of the mask do not matter."""
    for observation, expected in subject.of_each_category():
        rgb, depth = observation.rgb.copy(), observation.depth.copy()
        rgb[~observation.mask], depth[~observation.mask] = 0, 0
        subject.same(
            subject.predict([replace(observation, rgb=rgb, depth=depth)])[0],
            expected,
            "colour or depth outside of the mask changed the answer",
        )
