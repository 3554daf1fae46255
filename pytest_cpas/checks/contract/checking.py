"""The checks of the contract as a registry, and a method under test."""

from __future__ import annotations

import functools
import random
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_cpas.checks.outcome import Finding, Outcome
from pytest_cpas.evaluation import check_answers
from pytest_cpas.remote import RaisedThereError, WorkerError
from pytest_cpas.types import (
    AnswerError,
    Array,
    ContractError,
    Hypothesis,
    Mesh,
    Method,
    MethodInfo,
    Observation,
    Prediction,
    Sample,
    shortened,
)
from pytest_cpas.types.frames import to_standard

__all__ = [
    "CONTRACT",
    "ContractCheck",
    "ContractResult",
    "FirstAnswers",
    "MethodSubject",
    "NotCheckedError",
    "check_contract",
    "contract",
    "difference",
]


class NotCheckedError(Exception):
    """Why a check could not look at anything."""


class _Call(NamedTuple):
    """The answers to a batch, and what the call changed."""

    answers: list[Prediction]
    changed_inputs: list[str]
    changed_state: list[str]


@dataclass(frozen=True)
class FirstAnswers:
    """The answers to the samples, asked for one by one before any check asks for more.

    ``finding``: what is wrong with the first one that breaks the contract; ``answers`` end before
    it. ``again``: what is wrong when the last one is asked for again. ``changed_inputs``: arrays of
    observations that were changed; ``changed_state``: owners of global random states that were.
    """

    answers: tuple[Prediction, ...]
    finding: Finding | None
    again: Finding | None
    changed_inputs: frozenset[str]
    changed_state: frozenset[str]


class MethodSubject:
    """A loaded method, the samples that it is checked on, and its answers to them.

    Every call gets its own writable copies of the arrays, and the same global random state. The
    answers and what was seen while they were made are facts that all checks share; nothing is kept
    of the calls that a check makes itself.
    """

    def __init__(
        self,
        method: Method,
        samples: Sequence[Sample],
        *,
        further: Sequence[Sample] = (),
        seed: int = 0,
        fresh: Callable[[], Method] | None = None,
    ) -> None:
        """``further``: one sample of each category that ``samples`` lack, for checks that blank or
        disturb what is seen; ``fresh``: gives another instance of the method, loaded."""
        self.method, self.samples, self.seed, self.fresh = method, samples, seed, fresh
        self.further = further
        self.info: MethodInfo = method.info

    @property
    def say_why(self) -> str:
        """What to do where there is no answer."""
        if getattr(self.method, "is_plain", False):  # in another interpreter
            return 'return {"failed": "why"}'
        return "return Prediction.failed with the reason"

    @property
    def observations(self) -> list[Observation]:
        """What the method sees of the samples."""
        return [sample.observation for sample in self.samples]

    @functools.cached_property
    def first(self) -> FirstAnswers:
        """The answer to each observation alone, in order, and to the last one again; made once.

        :class:`NotCheckedError` if there are no samples.
        """
        if not self.samples:
            raise NotCheckedError("no sample can be read")
        calls: list[_Call] = []
        finding = again = None
        try:
            calls += [self._call([each], self.method, 0) for each in self.observations]
        except Finding as broken:
            finding = broken
        else:
            again = self._asked_again(calls[-1].answers[0])
        return FirstAnswers(
            tuple(answer for call in calls for answer in call.answers),
            finding,
            again,
            frozenset(name for call in calls for name in call.changed_inputs),
            frozenset(name for call in calls for name in call.changed_state),
        )

    def _asked_again(self, last: Prediction) -> Finding | None:
        try:
            again = self.predict(self.observations[-1:])[0]
            seen = difference(again, last, self.info.tolerance)
        except Finding as broken:
            return broken
        advice = (
            "the same seed gave another answer: make a generator from the passed seed in every"
            f" call of predict, and keep no counter, clock or generator between ({seen})"
        )
        return Finding(Outcome.VIOLATED, advice) if seen else None

    def answers(self) -> Sequence[Prediction]:
        """The answer to each observation alone, in order.

        :class:`NotCheckedError` if one breaks the contract: that is the finding of the check
        `answers`.
        """
        if self.first.finding:
            raise NotCheckedError("there are no valid answers to look at")
        return self.first.answers

    def repeated_answers(self) -> Sequence[Prediction]:
        """As :meth:`answers`, to compare others with; :class:`NotCheckedError` for a method that
        does not repeat them."""
        answers = self.answers()
        if self.first.again:
            raise NotCheckedError("asked twice, the method gives two answers: see repeatable")
        return answers

    def has_moved(self) -> bool:
        """Whether the last sample has another answer by now, of a method that repeated it first."""
        if not self.samples or self.first.finding or self.first.again:
            return False
        return self._asked_again(self.first.answers[-1]) is not None

    def anew(self) -> MethodSubject | None:
        """The same with a fresh instance; None if none can be made."""
        if self.fresh is None:
            return None
        try:
            method = self.fresh()
        except Exception:
            return None  # which is the finding of the check `fresh_instance`
        return MethodSubject(
            method, self.samples, further=self.further, seed=self.seed, fresh=self.fresh
        )

    @functools.cached_property
    def _of_further(self) -> list[Prediction]:
        return [self.predict([sample.observation])[0] for sample in self.further]

    def of_each_category(self) -> list[tuple[Observation, Prediction]]:
        """One observation of each category, and the answer to it; else as
        :meth:`repeated_answers`."""
        answers = self.repeated_answers()
        pairs = [
            *zip(self.observations, answers, strict=True),
            *zip((sample.observation for sample in self.further), self._of_further, strict=True),
        ]
        return list({pair[0].category: pair for pair in pairs}.values())

    def hypotheses(self) -> list[tuple[Observation, Hypothesis]]:
        """The observations that have an answer, and the best one in the standard frames."""
        return [
            (observation, to_standard(prediction.hypotheses[0], self.info))
            for observation, prediction in zip(self.observations, self.answers(), strict=True)
            if prediction.hypotheses
        ]

    def predict(
        self,
        batch: Sequence[Observation],
        *,
        method: Method | None = None,
        random_state: int = 0,
    ) -> list[Prediction]:
        """Call ``predict``; :class:`Finding` if it raises or its answers break the contract.

        ``random_state`` seeds the global random states, which are put back afterwards.
        """
        return self._call(batch, method or self.method, random_state).answers

    def _call(self, batch: Sequence[Observation], method: Method, random_state: int) -> _Call:
        given = [observation.copy() for observation in batch]
        with _global_random_state(random_state) as changed_state:
            try:
                answers = method.predict(given, self.seed)
            except ContractError as error:
                raise Finding(Outcome.VIOLATED, str(error)) from None
            except (RaisedThereError, WorkerError) as error:
                raise Finding(Outcome.RAISED, f"predict raised {error}") from None
            except Exception as error:
                *_, last = traceback.extract_tb(error.__traceback__)
                where = f"{last.filename}, line {last.lineno}"
                raise Finding(Outcome.RAISED, f"predict raised {error!r} at {where}") from error
        changed_inputs = [
            name
            for before, after in zip(batch, given, strict=True)
            for name in ("rgb", "depth", "mask")
            if not np.array_equal(getattr(before, name), getattr(after, name))
        ]
        try:
            if not isinstance(answers, Sequence) or len(answers) != len(batch):
                count = len(answers) if isinstance(answers, Sequence) else type(answers).__name__
                raise AnswerError(
                    f"predict: {count} for a batch of {len(batch)}; return one Prediction for each"
                    " observation, in order"
                )
            valid = [check_answers([answer], self.info) for answer in answers]
        except ContractError as error:
            raise Finding(Outcome.VIOLATED, str(error)) from None
        return _Call(valid, changed_inputs, changed_state)

    def same(self, prediction: Prediction, expected: Prediction, advice: str) -> None:
        """Expect the same answer within the declared tolerance; ``advice`` says what to do."""
        seen = difference(prediction, expected, self.info.tolerance)
        if seen:
            raise Finding(Outcome.VIOLATED, f"{advice} ({seen})")


def difference(one: Prediction, other: Prediction, tolerance: float) -> str:
    """How the best hypotheses differ by more than ``tolerance`` (metres, radians); else empty.

    Of lengths above a metre, the tolerance is a share: so does float noise grow.
    """
    if not one.hypotheses or not other.hypotheses:
        if bool(one.hypotheses) == bool(other.hypotheses):
            return "" if one.reason == other.reason else f"{one.reason!r}, not {other.reason!r}"
        return f"failed once: {one.reason or other.reason}"
    a, b = one.hypotheses[0], other.hypotheses[0]
    angle = float(Rotation.from_matrix(a.rotation.T @ b.rotation).magnitude())
    parts = [(f"rotation differs by {np.degrees(angle):.3g} deg", angle)]
    for name, x, y in (
        ("translation", a.translation, b.translation),
        ("extents", a.extents, b.extents),
        ("shape", _points(a), _points(b)),
    ):
        if (x is None) != (y is None) or (x is not None and y is not None and x.shape != y.shape):
            return f"{name} is of another kind"
        if x is not None and y is not None:
            apart = float(np.abs(x - y).max())
            unit = max(1.0, float(np.abs(x).max()))
            parts.append((f"{name} differs by {1000 * apart:.3g} mm", apart / unit))
    if a.score is not None and b.score is not None:
        apart = abs(a.score - b.score)
        parts.append((f"score differs by {apart:.3g}", apart))
    return ", ".join(words for words, amount in parts if not amount <= tolerance)


def _points(hypothesis: Hypothesis) -> Array | None:
    shape = hypothesis.shape
    return shape.vertices if isinstance(shape, Mesh) else shape


@dataclass(frozen=True)
class ContractCheck:
    """A plain function ``body(subject)`` that raises :class:`Finding`.

    ``statement``: one line. ``demanded``: of a method that declares this; else its finding is
    information. ``applies``: whether it makes sense at all. ``smoke``: it needs little more than
    the answers to the few samples, and runs before all others.
    """

    name: str
    statement: str
    body: Callable[[MethodSubject], None]
    demanded: Callable[[MethodInfo], bool]
    applies: Callable[[MethodInfo], bool]
    smoke: bool


#: All checks by name, in the order in which they run.
CONTRACT: dict[str, ContractCheck] = {}


def _always(info: MethodInfo) -> bool:
    return True


def contract(
    *,
    demanded: Callable[[MethodInfo], bool] = _always,
    applies: Callable[[MethodInfo], bool] = _always,
    smoke: bool = False,
) -> Callable[[Callable[[MethodSubject], None]], Callable[[MethodSubject], None]]:
    """Register ``check_NAME``; the first line of its docstring is the statement."""

    def register(body: Callable[[MethodSubject], None]) -> Callable[[MethodSubject], None]:
        name = body.__name__.removeprefix("check_")
        statement = (body.__doc__ or "").split("\n")[0].rstrip(".")
        CONTRACT[name] = ContractCheck(name, statement, body, demanded, applies, smoke)
        return body

    return register


@dataclass(frozen=True)
class ContractResult:
    """The outcome of one check of one method.

    ``known``: its violation is recorded, and happened or should have; ``recorded``: it is recorded,
    and a run of a part of the samples did not come across it.
    """

    check: str
    outcome: Outcome
    demanded: bool
    message: str = ""
    known: bool = False
    recorded: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "outcome", Outcome(self.outcome))
        object.__setattr__(self, "message", shortened(self.message))

    def plain(self) -> dict[str, Any]:
        """Values to make it of again, in another process as well."""
        return {**asdict(self), "outcome": self.outcome.value}

    @property
    def wrong(self) -> bool:
        """Whether the adapter must be mended."""
        return self.demanded and self.violated

    @property
    def violated(self) -> bool:
        """Whether the check found something."""
        return self.outcome not in (Outcome.PASSED, Outcome.NOT_OFFERED)


def check_contract(subject: MethodSubject, check: ContractCheck) -> ContractResult:
    """Run one check; what it finds does not depend on the checks before it.

    What is found of a method that has not kept still since its first answers is looked for again on
    a fresh instance, if there is one: the calls of another check may have left something behind.
    """
    result = _run(subject, check)
    if result.violated and subject.has_moved() and (anew := subject.anew()):
        return _run(anew, check)
    return result


def _run(subject: MethodSubject, check: ContractCheck) -> ContractResult:
    demanded = check.demanded(subject.info)
    if not check.applies(subject.info):
        return ContractResult(check.name, Outcome.NOT_OFFERED, demanded, "does not apply")
    try:
        check.body(subject)
    except NotCheckedError as reason:
        return ContractResult(check.name, Outcome.NOT_OFFERED, demanded, str(reason))
    except Finding as finding:
        return ContractResult(check.name, finding.outcome, demanded, str(finding))
    return ContractResult(check.name, Outcome.PASSED, demanded)


@contextmanager
def _global_random_state(seed: int) -> Iterator[list[str]]:
    """Seed the global generators of python, numpy and torch; gives who was drawn from or seeded,
    and puts all back."""
    changed: list[str] = []
    torch: Any = sys.modules.get("torch")
    before = random.getstate(), np.random.get_state()  # noqa: NPY002
    before_torch = torch.random.get_rng_state() if torch else None
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    if torch:
        torch.random.default_generator.manual_seed(seed)
    start = _states(torch)
    try:
        yield changed
    finally:
        changed += [name for name, state in _states(torch).items() if state != start[name]]
        random.setstate(before[0])
        np.random.set_state(before[1])  # noqa: NPY002
        if torch:
            torch.random.set_rng_state(before_torch)


def _states(torch: Any) -> dict[str, Any]:
    numpy_state: Any = np.random.get_state()  # noqa: NPY002
    states = {"random": random.getstate(), "numpy.random": (bytes(numpy_state[1]), numpy_state[2])}
    if torch:
        states["torch"] = torch.random.get_rng_state().numpy().tobytes()
    return states
