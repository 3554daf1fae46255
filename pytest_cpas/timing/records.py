"""Recorded ratios of a method's time to the calibration kernel's: ``golden/speed``.

One file per method, data set and kind of machine, for a ratio means nothing on another one:
``speed/METHOD/DATASET/MACHINE.toml``.
"""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pytest_cpas._files import toml_string, write_file
from pytest_cpas.documents import MachineDocument
from pytest_cpas.golden import differences
from pytest_cpas.reading.files import NoFileError, read_text
from pytest_cpas.reading.structured import LARGEST_TOML, parse_toml
from pytest_cpas.timing.intervals import (
    RECORD_CONFIDENCE,
    RECORD_LOOK_CONFIDENCE,
    Interval,
    median_interval,
    quotient,
    relative_to_others,
)
from pytest_cpas.types import ToldError, shown
from pytest_cpas.types._arrays import MAX, checked_number

FORMAT = 1

#: What thread counts are called in an identity; a library that only one of two has is no matter.
_THREADS = "threads of "


class RecordError(ToldError):
    """A recorded ratio that cannot be read or written."""


@dataclass(frozen=True)
class SpeedRecord:
    """``ratios``: by sample, the median of its quadruples. ``spread``: how far the median of as
    many quadruples, relative to their samples, may be off by chance; about 1. ``identity`` must
    agree for two ratios to be comparable, ``provenance`` need not."""

    identity: Mapping[str, str]
    provenance: Mapping[str, str]
    ratios: Mapping[str, float]
    spread: Interval

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        by_sample: Sequence[Sequence[float]],
        identity: Mapping[str, str],
        provenance: Mapping[str, str],
    ) -> SpeedRecord:
        """Of samples' ratios, at least two for each."""
        around = median_interval(relative_to_others(by_sample), RECORD_CONFIDENCE)
        spread = Interval(
            1.0, around.lower / around.median, around.upper / around.median, around.confidence
        )
        medians = [statistics.median(ratios) for ratios in by_sample]
        return cls(identity, provenance, dict(zip(names, medians, strict=True)), spread)

    def slowdown(self, ratios: Sequence[tuple[str, float]]) -> Interval:
        """Of (sample, ratio): how many times as long it takes as when this was recorded."""
        now = [ratio / self.ratios[sample] for sample, ratio in ratios]
        return quotient(median_interval(now, RECORD_LOOK_CONFIDENCE), self.spread)

    def toml(self) -> str:
        """The text of the file."""
        lines = [
            "# Recorded by pytest-cpas; --cpas-benchmark --snapshot-update records it anew.",
            "# Seconds of the method per second of the calibration kernel, by sample.",
            f"format = {FORMAT}",
            "",
            "[spread]",
            f"lower = {self.spread.lower:.6g}",
            f"upper = {self.spread.upper:.6g}",
            f"confidence = {self.spread.confidence:.6g}",
        ]
        for title, values in (("identity", self.identity), ("provenance", self.provenance)):
            lines += ["", f"[{title}]"]
            lines += [
                f"{toml_string(key)} = {toml_string(value)}"
                for key, value in sorted(values.items())
            ]
        lines += ["", "[ratios]"]
        lines += [
            f"{toml_string(name)} = {ratio:.6g}" for name, ratio in sorted(self.ratios.items())
        ]
        return "\n".join(lines) + "\n"

    @classmethod
    def parse(cls, text: str) -> SpeedRecord:
        """The inverse of :meth:`toml`; raises ValueError, TypeError or KeyError."""
        content = parse_toml("the record", text)
        if content.get("format") != FORMAT:
            raise ValueError(f"format is {content.get('format')!r}, this version reads {FORMAT}")
        spread, ratios = (_positive(name, content[name]) for name in ("spread", "ratios"))
        if spread.keys() != {"lower", "upper", "confidence"}:
            raise ValueError(f"spread has {', '.join(spread)}, expected lower, upper, confidence")
        if not (spread["lower"] <= 1 <= spread["upper"] and spread["confidence"] <= 1):
            raise ValueError("spread: expected lower <= 1 <= upper, and confidence of 1 at most")
        if not ratios:
            raise ValueError("ratios are empty")
        identity, provenance = (_texts(name, content[name]) for name in ("identity", "provenance"))
        return cls(identity, provenance, ratios, Interval(1.0, **spread))


def _positive(name: str, values: Mapping[str, object]) -> dict[str, float]:
    return {
        key: checked_number(value, f"{name}, {shown(key)}", math.ulp(0.0), MAX)
        for key, value in values.items()
    }


def _texts(name: str, values: Mapping[str, object]) -> dict[str, str]:
    if not all(isinstance(value, str) for value in values.values()):
        raise ValueError(f"{name} must be texts")
    return {key: str(value) for key, value in values.items()}


def identity_of(run: Mapping[str, str], machine: MachineDocument, kernel: str) -> dict[str, str]:
    """What must agree: data, seed and device of the run's identity, the kernel, the machine."""
    threads = {f"{_THREADS}{name}": str(n) for name, n in machine["threads"].items()}
    return {
        **{key: run[key] for key in ("data", "seed", "device")},
        "kernel": kernel,
        "clock": machine["clock"],
        "cpu": machine["cpu"],
        "cores": str(machine["cores"]),
        "device name": machine["device"],
        **threads,
    }


def provenance_of(machine: MachineDocument) -> dict[str, str]:
    """What else is known of the machine."""
    return {
        "system": machine["system"],
        "python": machine["python"],
        **machine["versions"],
    }


def incomparable(record: SpeedRecord, identity: Mapping[str, str], names: Sequence[str]) -> str:
    """Why a record says nothing about a run; empty if it does."""
    keys = [
        key
        for key in sorted({*record.identity, *identity})
        if not key.startswith(_THREADS) or (key in record.identity and key in identity)
    ]
    recorded, now = (
        {key: given.get(key, "") for key in keys} for given in (record.identity, identity)
    )
    reasons = differences(recorded, now)
    other = [name for name in names if name not in record.ratios]
    if other:
        reasons.append(f"{len(other)} of {len(names)} samples are others, such as {other[0]}")
    return "; ".join(reasons)


def record_path(golden: Path, method: str, dataset: str, machine: MachineDocument) -> Path:
    """Where the ratio of a method on a data set and a machine is recorded."""
    device = machine["cpu"] if machine["device"] == "cpu" else machine["device"]
    slug = re.sub(r"[^a-z0-9]+", "-", device.lower()).strip("-") or "unknown"
    return golden / "speed" / method / dataset / f"{slug}.toml"


def read_record(path: Path) -> SpeedRecord | None:
    """What is recorded, if anything; :class:`RecordError` for a file that is damaged."""
    try:
        return SpeedRecord.parse(read_text(path, LARGEST_TOML))
    except NoFileError:
        return None
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise RecordError(
            f"{path}: {error!r}; it was damaged or edited by hand. Restore it from version control,"
            " or record it anew with --cpas-benchmark --snapshot-update"
        ) from error


def write_record(golden: Path, path: Path, record: SpeedRecord) -> None:
    """Write the file, which is below ``golden``, as a whole or not at all; :class:`RecordError` if
    that fails, or if it would lead out of there through a link."""
    try:
        write_file(path, record.toml(), below=golden)
    except OSError as error:
        raise RecordError(f"{path}: the ratio cannot be recorded ({error})") from error
