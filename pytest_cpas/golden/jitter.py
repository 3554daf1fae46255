"""Golden tables of several seeds: what they say of a run, and what loss they can show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.facts import fact
from pytest_cpas.golden.pairing import SharedColumn, shared_columns, shared_facts
from pytest_cpas.golden.ranks import Moves
from pytest_cpas.golden.spread import DOUBT, Answers, Spread
from pytest_cpas.golden.tables import RunTable
from pytest_cpas.golden.words import Word

#: How many times the recorded seeds is told what they could show, and up to how many.
_MORE, _MOST = (2, 4, 8), 40


def parse_alarm(text: str) -> float:
    """A probability as ``--cpas-alarm`` takes it: ``0.001`` or ``1/1000``.

    Raises :class:`ValueError` unless it is above 0 and at most :data:`DOUBT`.
    """
    above, slash, below = text.partition("/")
    try:
        alarm = float(above) / (float(below) if slash else 1)
    except (ValueError, ZeroDivisionError):
        alarm = 0.0
    if not 1e-9 <= alarm <= DOUBT:
        raise ValueError(
            f"{text!r}, expected how probable it may be that a run without a change is called"
            f" REGRESSED or IMPROVED: from 1e-9 to {DOUBT:g}, such as 0.001 or 1/1000"
        )
    return alarm


def answers_of(golden: RunTable, run: RunTable, columns: Sequence[SharedColumn]) -> Answers:
    """The samples that both tables have, under all seeds of both: at some columns, and the facts
    of both."""
    both = [
        name
        for name, sample in sorted(run.samples.items())
        if name in golden.samples and golden.samples[name].category == sample.category
    ]
    recorded = _outcomes(golden, both)[..., [column.old for column in columns]]
    new = _outcomes(run, both)[..., [column.new for column in columns]]
    facts = {
        name: Moves(fact(name), _values(golden, both, name), _values(run, both, name))
        for name in shared_facts(golden, run)
        if all(map(_knows_all_seeds, (golden, run)))
    }
    return Answers(
        categories=np.array([golden.samples[name].category for name in both], dtype=str),
        recorded=recorded == b"1",
        run=new == b"1",
        known=(recorded != b"-").all(axis=1) & (new != b"-").all(axis=1),
        facts=facts,
        names=both,
    )


def _outcomes(table: RunTable, names: list[str]) -> NDArray[np.bytes_]:
    """One character per sample, seed and column."""
    text = "".join(outcome for name in names for outcome in table.samples[name].outcomes)
    return np.frombuffer(text.encode(), "S1").reshape(len(names), table.seeds, len(table.columns))


def _knows_all_seeds(table: RunTable) -> bool:
    """Whether it has the facts of every seed: older forms kept those of the first alone."""
    return all(len(sample.answers) == table.seeds for sample in table.samples.values())


def _values(table: RunTable, names: list[str], name: str) -> NDArray[np.float64]:
    """A fact per sample and seed, NaN where it is n/a."""
    values = [[a.facts.get(name) for a in table.samples[each].answers] for each in names]
    return np.array(values, dtype=np.float64).reshape(len(names), table.seeds)


def drift_words(spread: Spread, scope: str, alarm: float) -> dict[Word, list[str]]:
    """What to say of the facts of a category, or of all samples, that moved beside the recorded
    seeds: by verdict, the gravest first."""
    answers = spread.answers
    told: dict[Word, list[str]] = {Word.REGRESSED: [], Word.PROBABLY_WORSE: [], Word.IMPROVED: []}
    for name, moves in answers.facts.items():
        worse, better = (spread.p(scope, name, better=which) for which in (False, True))
        if worse < max(DOUBT, alarm):
            word, p = Word.REGRESSED if worse < alarm else Word.PROBABLY_WORSE, worse
        elif better < alarm:
            word, p = Word.IMPROVED, better
        else:
            continue
        line = moves.told(answers.names, answers.among(scope))
        told[word].append(f"{line} ({moves.recorded.shape[1]} recorded seeds; p = {p:.1g})")
    return told


def loss_words(lucky: Spread, columns: Sequence[SharedColumn], scope: str, alarm: float) -> str:
    """Which loss of samples of a category, or of all, would be called; "" if none would.

    ``lucky``: as of :func:`luckiest`; ``columns``: those of its answers.
    """
    levels = {"REGRESSED": alarm, "PROBABLY WORSE": max(DOUBT, alarm)}
    shown = {word: lucky.loss_shown(scope, level) for word, level in levels.items()}
    called = [(word, *loss) for word, loss in shown.items() if loss]
    if not called:
        return ""
    (word, loss, column), *rest = called
    first = f"a loss of {loss} at {columns[column].label} would be {word}"
    return ", of ".join([first, *(f"{loss} {word}" for word, loss, _ in rest)])


def luckiest(answers: Answers) -> Spread:
    """As if the run had been the recorded seed that got most right, which must lose most; without
    facts, since it is told of counts."""
    best = np.argsort(-(answers.recorded & answers.known[:, None]).sum(axis=(0, 2)), kind="stable")
    drawn = answers.run.shape[1]
    run = answers.recorded[:, np.resize(best, drawn)]
    return Spread(replace(answers, run=run, facts={}))


def recorded_words(table: RunTable, alarm: float) -> Iterator[str]:
    """Lines on what a recorded table can show, and how many seeds would show more."""
    if table.seeds == 1:
        return
    if not any(sample.wavers for sample in table.samples.values()):
        yield f"the {table.seeds} seeds agree in every sample: later runs may lose none"
        return
    first = replace(
        table,
        samples={
            name: replace(sample, outcomes=sample.outcomes[:1], answers=sample.answers[:1])
            for name, sample in table.samples.items()
        },
        seeds=1,
    )
    answers = answers_of(table, first, shared_columns(table, first))
    deterministic = table.provenance.get("deterministic") != "no"
    if deterministic:
        yield "on this platform these seeds must give what they gave: the method is deterministic"
    yield (
        f"{'elsewhere, ' if deterministic else ''}how many a later run of one seed must lose to be"
        " REGRESSED (PROBABLY WORSE), of as many as the best of these seeds gets right:"
    )
    for times in (1, *_MORE):
        seeds = times * table.seeds
        if times > 1 and seeds > _MOST:
            break
        more = replace(answers, recorded=np.tile(answers.recorded, (1, times, 1)))
        spread = luckiest(more)
        losses = [_loss_words(spread, scope, alarm) for scope in more.scopes]
        what = f"these {seeds} seeds" if times == 1 else f"{seeds} seeds that spread like these"
        yield f"  {what}: {', '.join(losses)}"


def _loss_words(spread: Spread, scope: str, alarm: float) -> str:
    surely, probably = (spread.loss_shown(scope, level) for level in (alarm, max(DOUBT, alarm)))
    answers = spread.answers
    right = int((answers.run & answers.known[:, None])[answers.among(scope)].sum(axis=(0, 1)).max())
    if not probably:
        return f"{scope} none of {right}"
    return f"{scope} {surely[0] if surely else 'none'} ({probably[0]}) of {right}"
