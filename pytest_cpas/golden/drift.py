"""Facts that moved without crossing a threshold: whether that is judged, and how.

**On the platform of the recording** a deterministic method gives the same answers: facts that moved
by more than a tolerance are a change of the method, whatever the thresholds say.

**Elsewhere** processors, libraries and devices round in other ways. Moves within the tolerance are
ties. Of the others the signs are looked at: where nothing changed, worse and better are as probable
in every scene (samples of one scene are alike, so the signs of a scene go together). The
probability of at least as many worse ones is exact, by convolution over the scenes. There is one
such question for every fact, direction, and category or all samples, and the level of the run is
shared out among them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from pytest_cpas.facts import fact
from pytest_cpas.golden.pairing import Pairing, SharedColumn
from pytest_cpas.golden.tables import RunTable, differences
from pytest_cpas.types.declarations import TOLERANCE

__all__ = ["Drift", "drifts", "may_not_move", "other_platform"]

#: What an identity tells of a platform.
_DEVICE = {"device"}

#: Distributions that compute nothing: another version of one is no other platform.
_NO_NUMBERS = {
    "absl-py", "attrs", "certifi", "charset-normalizer", "click", "colorama", "cycler", "execnet",
    "filelock", "fonttools", "fsspec", "h5py", "hydra-core", "idna", "imageio",
    "importlib-metadata", "iniconfig", "jinja2", "jsonschema", "kiwisolver", "libusb-package",
    "loguru", "markdown", "markupsafe", "matplotlib", "omegaconf", "packaging", "pip",
    "platformdirs", "pluggy", "protobuf", "psutil", "pygments", "pyparsing", "pytest",
    "python-dateutil", "pyyaml", "requests", "rich", "setuptools", "six", "tensorboard",
    "termcolor", "threadpoolctl", "tomli", "tqdm", "typing-extensions", "urllib3", "wandb",
    "wheel", "yacs", "zipp",
}  # fmt: skip

#: What of a table's provenance says nothing about the machine that it was made on.
_NOT_PLATFORM = (
    "code",
    "data_code",
    "conftest",
    "plugins",
    "revision",
    "deterministic",
    "tolerance",
    "weights_folder",
)


@dataclass(frozen=True)
class Drift:
    """How a fact moved in the samples of a category.

    ``moved``: name, before and after, of the samples whose fact moved by more than the tolerance;
    ``nets``: per scene how many more of them are worse than better.
    """

    fact: str
    moved: Sequence[tuple[str, float, float]]
    judged: int
    nets: Sequence[int]

    @property
    def worse(self) -> float:
        """The probability of as many worse ones where nothing changed."""
        return _tail(self.nets)

    @property
    def better(self) -> float:
        """The same of better ones."""
        return _tail([-net for net in self.nets])

    def summary(self) -> str:
        """In a few words: in how many samples."""
        return f"{self.fact} in {len(self.moved)} of {self.judged} samples"

    def told(self) -> str:
        """In words: how many samples, by how much, and the one that moved most."""
        made = fact(self.fact)
        name, before, after = max(self.moved, key=lambda entry: abs(entry[2] - entry[1]))
        shift = made.factor * median(now - then for _, then, now in self.moved)
        first, second = (
            made.pattern.format(f"{made.factor * value:.4g}") for value in (before, after)
        )
        return (
            f"{self.fact} moved in {len(self.moved)} of {self.judged} samples, median move"
            f" {made.pattern.format(f'{shift:+.2g}')}, most in {name}: {first} -> {second}"
        )


def drifts(
    pairing: Pairing,
    columns: Sequence[SharedColumn],
    names: Sequence[str],
    scenes: Mapping[str, str],
    tolerance: float = TOLERANCE,
) -> Iterator[Drift]:
    """The facts of those ``names`` that moved in samples of which nothing flipped.

    ``columns``: those of both tables; ``scenes`` by sample, as far as they are known;
    ``tolerance``: the one that the method declares.
    """
    still = [
        sample
        for sample in pairing.both
        if all(
            pairing.old[sample].outcome[column.old] == pairing.new[sample].outcome[column.new]
            for column in columns
        )
    ]
    for name in names:
        made, moved, judged = fact(name), [], 0
        signs: dict[str, int] = {}
        for sample in still:
            old, new = pairing.old[sample].facts.get(name), pairing.new[sample].facts.get(name)
            # who did not answer is among the flips
            if old is None or new is None or not (math.isfinite(old) and math.isfinite(new)):
                continue
            judged += 1
            if made.is_close(old, new, tolerance):
                continue
            moved.append((sample, old, new))
            sign = 1 if bool(new > old) == (made.better == "lower") else -1
            scene = scenes.get(sample, sample)
            signs[scene] = signs.get(scene, 0) + sign
        if moved:
            yield Drift(name, moved, judged, list(signs.values()))


def _tail(nets: Sequence[int]) -> float:
    """The probability of a sum of at least that of ``nets``, if the sign of each is a fair coin;
    exact."""
    sizes = [abs(net) for net in nets]
    total = sum(sizes)
    ways = np.zeros(2 * total + 1)
    ways[total] = 1.0
    for size in sizes:
        if size:
            ways = (np.roll(ways, size) + np.roll(ways, -size)) / 2
    return float(ways[total + sum(nets) :].sum())


def other_platform(golden: RunTable, new: RunTable, category: str) -> list[str]:
    """What differs, in words, between the machines of a run and of a category's recording; empty
    where nothing does that computes, as far as is told."""
    then, now = (
        {
            key: _computing(told) if key == "packages" else told
            for key, told in table.provenance_of(category).items()
            if key not in _NOT_PLATFORM
        }
        for table in (golden, new)
    )
    if golden.identity.keys() >= _DEVICE <= new.identity.keys():
        then["device"], now["device"] = golden.identity["device"], new.identity["device"]
    return differences(then, now)


def _computing(packages: str) -> str:
    """Of "NAME VERSION, ..." those that compute; of Python the language alone."""
    kept = []
    for each in packages.split(", "):
        name, _, version = each.partition(" ")
        if name == "python":
            version = ".".join(version.split(".")[:2])
        if name.lower().replace("_", "-") not in _NO_NUMBERS:
            kept.append(f"{name} {version}")
    return ", ".join(kept)


def may_not_move(golden: RunTable, new: RunTable, category: str) -> bool:
    """Whether facts must be the same: those of a method that was recorded as a deterministic one,
    on a machine like that of the recording."""
    recorded = golden.provenance_of(category).get("deterministic")
    return recorded != "no" and not other_platform(golden, new, category)
