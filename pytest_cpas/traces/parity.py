"""The parity of a method and a reference: what each sample shows, and the verdict on all."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pytest_cpas.reading.text import terminal_line
from pytest_cpas.traces.comparing import Comparison, Difference
from pytest_cpas.types import Verdict, VerdictWord, some_of
from pytest_cpas.types.samples import ALL

__all__ = ["ParityWord", "Parting", "SampleParity", "first_parting", "judge_parity"]

#: Values around the first that parts, which are told.
BEFORE, BEHIND = 3, 2


class ParityWord(VerdictWord):
    """What two codes come to."""

    #: Every value that both name is the same to the last bit.
    EXACT = "EXACT", "passed"
    #: They differ by no more than two right codes may.
    FLOAT_NOISE = "FLOAT NOISE", "passed"
    #: Here they differ by more, and everything before it agrees; the name follows.
    PARTS = "PARTS AT", "failed"
    #: There is no value that both name, or no sample.
    NOT_COMPARED = "NOT COMPARED", "failed"


@dataclass(frozen=True, kw_only=True)
class SampleParity:
    """What comparing one sample has shown.

    ``place``: of the first value that parts; ``parting``: how; ``count``: values that were
    compared, beside the observation, and ``exact`` those that are the same to the last bit;
    ``around``: those beside the parting one. ``noise``: the largest difference before it.
    ``undecided``: from where on nothing was compared. ``replayed``: what is found where the
    reference's draws are taken over, if that was tried. ``flips``: the
    columns in which one of the two answers is correct and the other is not. ``in_vain``: what a map
    of names has that is called so on no side.
    """

    sample: str
    count: int
    exact: int
    place: int | None = None
    parting: Difference | None = None
    noise: Difference | None = None
    around: Sequence[Difference] = field(default_factory=list)
    fits: Sequence[str] = field(default_factory=list)
    near: Sequence[str] = field(default_factory=list)
    degrees: float | None = None
    millimetres: float | None = None
    flips: Sequence[str] = field(default_factory=list)
    undecided: str = ""
    only_here: tuple[int, str] = (0, "")
    only_there: tuple[int, str] = (0, "")
    replayed: str = ""
    in_vain: Sequence[str] = field(default_factory=list)

    @classmethod
    def of(
        cls, sample: str, found: Comparison, flips: Sequence[str] = (), replayed: str = ""
    ) -> SampleParity:
        """What a comparison has shown."""
        all_of = found.differences
        place = next((i for i, each in enumerate(all_of) if each.word == "PARTS"), None)
        upto = all_of if place is None else all_of[:place]
        noisy = [each for each in upto if each.word == "FLOAT NOISE"]
        around: list[Difference] = []
        if place is not None:
            around = [*all_of[max(place - BEFORE, 0) : place + 1 + BEHIND]]
        # what both have seen says nothing of them, unless it parts
        made = [each for each in all_of if each.kind != "observation" or each.word == "PARTS"]
        return cls(
            sample=sample,
            count=len(made),
            exact=sum(each.word == "EXACT" for each in made),
            place=place,
            parting=found.parting,
            noise=max(noisy, key=lambda each: each.relative, default=None),
            around=around,
            fits=[*found.explanation.fits],
            near=[*found.explanation.near],
            degrees=found.degrees,
            millimetres=found.millimetres,
            flips=[*flips],
            undecided=found.undecided,
            only_here=(len(found.only_here), some_of(found.only_here)),
            only_there=(len(found.only_there), some_of(found.only_there)),
            replayed=replayed,
        )

    @property
    def parts_at(self) -> str:
        """The name of the first value that parts, whichever call of it; empty if none does."""
        return self.parting.name.partition(", call ")[0] if self.parting else ""

    def plain(self) -> dict[str, Any]:
        """As plain values, which travel on test reports."""
        told = {name: getattr(self, name) for name in self.__dataclass_fields__}
        for name in ("parting", "noise"):
            told[name] = told[name] and told[name].plain()
        told["around"] = [each.plain() for each in self.around]
        for name in ("fits", "near", "flips", "in_vain", "only_here", "only_there"):
            told[name] = list(told[name])
        return told

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> SampleParity:
        """The inverse of :meth:`plain`."""
        told = dict(plain)
        for name in ("parting", "noise"):
            told[name] = told[name] and Difference.of_plain(told[name])
        told["around"] = [Difference.of_plain(each) for each in told["around"]]
        for name in ("only_here", "only_there"):
            told[name] = tuple(told[name])
        return cls(**told)


@dataclass(frozen=True, kw_only=True)
class Parting:
    """Where samples part from the reference: ``name``, the first value at which they do; ``here``:
    those that part there, of ``parted``, all that part; ``difference``: how the ``worst`` does."""

    name: str
    here: Sequence[SampleParity]
    parted: Sequence[SampleParity]
    worst: SampleParity
    difference: Difference

    @property
    def degrees(self) -> float | None:
        """How far the two answers of a sample are apart at most; None if none has both."""
        return max((e.degrees for e in self.parted if e.degrees is not None), default=None)

    @property
    def millimetres(self) -> float | None:
        """The same of their positions."""
        return max((e.millimetres for e in self.parted if e.millimetres is not None), default=None)

    @property
    def changed(self) -> int:
        """Samples of which one answer is correct and the other is not, in some column."""
        return sum(bool(each.flips) for each in self.parted)

    @property
    def columns(self) -> Counter[str]:
        """How many those are in each column."""
        return Counter(column for each in self.parted for column in each.flips)


def first_parting(samples: Sequence[SampleParity]) -> Parting | None:
    """Where they part first, and most of them; None if none does."""
    parted = [each for each in samples if each.parting is not None]
    if not parted:
        return None
    first = min(each.place for each in parted if each.place is not None)
    names = Counter(each.parts_at for each in parted if each.place == first)
    name = names.most_common(1)[0][0]
    here = [(each, each.parting) for each in parted if each.parting and each.parts_at == name]
    worst, difference = max(here, key=lambda pair: pair[1].relative)
    return Parting(
        name=name,
        here=[each for each, _ in here],
        parted=parted,
        worst=worst,
        difference=difference,
    )


def judge_parity(
    samples: Sequence[SampleParity],
    reference: str,
    lacking: int = 0,
    notes: Sequence[str] = (),
    broken: int = 0,
) -> Verdict:
    """The verdict on all samples; its first line says where the two part.

    ``reference``: what was compared with, in words; ``lacking``: samples of which it has no trace;
    ``notes``: what is told besides; ``broken``: items that could not compare their samples.
    """
    verdict = _judged(samples, reference, lacking)
    if broken:
        told = f"{broken} items could not compare their samples, and say why"
        if not samples:
            verdict = Verdict(ParityWord.NOT_COMPARED, ALL, told)
        elif verdict.failed:
            verdict = dataclasses.replace(verdict, details=f"{verdict.details}\n  {told}")
        else:
            verdict = Verdict(ParityWord.NOT_COMPARED, ALL, f"{told}; of the others: {verdict}")
    return dataclasses.replace(verdict, details="\n  ".join([verdict.details, *notes]))


def _judged(samples: Sequence[SampleParity], reference: str, lacking: int) -> Verdict:
    compared = [each for each in samples if each.count]
    left = f"; {reference} has no trace of {lacking} other samples" if lacking else ""
    if not compared:
        why = f"{len(samples)} samples share no value with {reference}" if samples else "no sample"
        return Verdict(
            ParityWord.NOT_COMPARED,
            ALL,
            f"{why}{left}; name values by tap in both, or in a map (--cpas-parity-map)",
        )
    if found := first_parting(compared):
        return _parts(found, compared, reference, left)
    noise = max(
        (each.noise for each in compared if each.noise),
        key=lambda each: each.relative,
        default=None,
    )
    values = sum(each.count for each in compared)
    of_them = f"{values} values of {len(compared)} samples"
    if noise is None:
        told = f"{of_them} are those of {reference}{left}"
        return _with_lines(ParityWord.EXACT, ALL, told, compared)
    exact = sum(each.exact for each in compared)
    return _with_lines(
        ParityWord.FLOAT_NOISE,
        ALL,
        f"{of_them}: {exact} are those of {reference} to the last bit; the largest relative"
        f" difference is {noise.relative:.1e} at {noise.name}, of {noise.allowed:.1e} allowed"
        f"{left}",
        compared,
    )


def _parts(found: Parting, compared: Sequence[SampleParity], reference: str, left: str) -> Verdict:
    name, here, worst, parting = found.name, found.here, found.worst, found.difference
    stage = f", in the stage {parting.stage}" if parting.stage else ""
    drawn = ", which is drawn at random" if parting.kind == "draw" else ""
    told = [
        f"{difference_words(parting)}{drawn}{stage} ({worst.sample}); {len(here)} of"
        f" {len(compared)} samples part from {reference} here{left}"
    ]
    told += [f"explained by: {words}" for words in agreed([each.fits for each in here])]
    if len(told) == 1:
        told += [f"known of it: {words}" for words in agreed([each.near for each in here])]
        told += [] if drawn else ["no usual mistake that was tried explains it"]
    if replays := {each.replayed for each in here if each.replayed}:
        told += [f"with what {reference} has drawn: {words}" for words in sorted(replays)[:3]]
    told += _effect(found)
    told.append("around it:")
    told += [
        f"  {each.word:11} {each.name}"
        f"{'' if each.word == 'EXACT' else ': ' + difference_words(each)}"
        for each in worst.around
    ]
    others = Counter(each.parts_at for each in found.parted)
    del others[name]
    if others:
        listed = ", ".join(f"{other} ({count})" for other, count in others.most_common(3))
        told.append(f"other samples part first at: {listed}")
    return _with_lines(ParityWord.PARTS, name, "\n  ".join(told), compared)


def difference_words(difference: Difference) -> str:
    """How large a difference is."""
    if difference.problem:
        return difference.problem
    at = f" at {list(difference.at)}" if difference.at else ""
    return f"relative L2 {difference.relative:.1e}, the largest {difference.largest:.2g}{at}"


def agreed(said: Sequence[Sequence[str]]) -> list[str]:
    """What is said of all samples, or of how many it is; numbers of single samples aside."""
    count = Counter(words for each in said for words in each)
    told = []
    for words, times in count.most_common(3):
        told.append(words if times == len(said) else f"{words} ({times} of {len(said)} samples)")
    return told


def _effect(found: Parting) -> list[str]:
    """What the difference does to the answers and to the outcome."""
    lines = []
    both = sum(each.degrees is not None for each in found.parted)
    if found.degrees is not None and found.millimetres is not None:
        lines.append(
            f"poses of the answers: up to {found.degrees:.2g} deg and {found.millimetres:.2g} mm"
            f" apart ({both} of {len(found.parted)} samples that part have both)"
        )
    listed = ", ".join(f"{column} {count}" for column, count in found.columns.most_common(4))
    lines.append(
        f"outcomes: of {found.changed} samples one is correct and the other is not ({listed})"
        if found.changed
        else "outcomes: none is another at any threshold"
    )
    return lines


def _with_lines(
    word: ParityWord, subject: str, details: str, compared: Sequence[SampleParity]
) -> Verdict:
    """The verdict, with what one side alone names."""
    lines = [details]
    if undecided := [each.undecided for each in compared if each.undecided]:
        lines.append(
            f"of {len(undecided)} samples nothing is compared from {undecided[0]} on: float noise"
            " makes another choice there"
        )
    everywhere = set.intersection(*(set(each.in_vain) for each in compared))
    if vain := [terminal_line(words) for words in compared[0].in_vain if words in everywhere]:
        lines.append(f"nothing is called as the map has it: {some_of(vain)}")
    for attribute, side in (("only_here", "the method"), ("only_there", "the reference")):
        most = max(compared, key=lambda each: getattr(each, attribute)[0])
        number, names = getattr(most, attribute)
        if number:
            lines.append(f"named by {side} alone: {number}, such as {names}")
    return Verdict(word, subject, "\n  ".join(lines))
