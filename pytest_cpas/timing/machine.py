"""On what a run time was measured."""

from __future__ import annotations

import functools
import os
import platform

from cpuinfo import get_cpu_info

from pytest_cpas.documents import MachineDocument
from pytest_cpas.timing.contestant import ProcessFacts


def machine(facts: ProcessFacts) -> MachineDocument:
    """This machine, on which a process times."""
    return {
        "clock": facts["clock"],
        "cpu": _cpu(),
        "cores": _cores(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "device": facts["device"],
        "threads": dict(facts["threads"]),
        "versions": dict(facts["versions"]),
    }


@functools.cache
def _cpu() -> str:
    """The model's name, by the cpuinfo that pytest-benchmark brings and uses itself."""
    return str((get_cpu_info() or {}).get("brand_raw") or platform.machine())


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
