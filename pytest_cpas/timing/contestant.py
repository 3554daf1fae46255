"""A method that is timed: in this process, or in a worker that this file is when it is run.

A worker can be made to import another revision of the adapter, and of this package with it. So
this file imports nothing of the package at the top, and what it needs of it has to be old.
"""

from __future__ import annotations

import gc
import importlib.util
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, TypedDict

if TYPE_CHECKING:
    from pytest_cpas.documents import Clock, MemoryDocument

#: What peak memory is of.
PREDICTIONS: Final = "predictions"
PROCESS: Final = "process"

#: Linux tells here how long a thread was ready to run while its core had other work.
SCHEDSTAT = Path("/proc/thread-self/schedstat")

#: What :func:`now` is, in the document.
CLOCKS: tuple[Clock, Clock] = ("wall clock", "wall clock without waiting for a core")


def now() -> float:
    """Seconds of a clock that stands still while this thread waits for a core that others have.

    On a busy machine this is most of the noise. Sleeping, reading and waiting for a device or for
    threads of one's own count. Where the system does not tell, it is the wall clock.
    """
    while True:
        waited = _waited()
        instant = time.perf_counter()
        if _waited() == waited:  # else some of it may lie before the instant, and some behind
            return instant - waited


def _waited() -> float:
    try:
        return int(SCHEDSTAT.read_bytes().split()[1]) / 1e9
    except OSError:
        return 0.0


def synchroniser(device: str) -> Callable[[], None]:
    """What waits for all that ``device`` still computes: nothing, unless it is one of CUDA."""
    torch = sys.modules.get("torch")
    if torch is None or not device.startswith("cuda"):
        return lambda: None
    return lambda: torch.cuda.synchronize(device)


def seconds_of(call: Callable[[], object], synchronise: Callable[[], None]) -> float:
    """Seconds that a call takes, to the end of what it started on a device.

    The garbage collector waits meanwhile.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        synchronise()
        start = now()
        call()
        synchronise()
        return now() - start
    finally:
        if collects:
            gc.enable()


class Examined(TypedDict):
    """Some ``predictions`` of a method: the ``total`` of their seconds, that of each of their
    ``stages`` by name, and the peak of ``memory``; ``transfer``: seconds of the way to a method in
    another interpreter and back, None for one that is here."""

    predictions: int
    total: float
    stages: dict[str, float]
    memory: MemoryDocument
    transfer: float | None


class ProcessFacts(TypedDict):
    """What is known of a process that times: its ``clock``, the ``device``'s name, and ``threads``
    and ``versions`` of the libraries in it."""

    clock: Clock
    device: str
    threads: dict[str, int]
    versions: dict[str, str]


class Contestant:
    """A loaded method and the observations that it is timed with."""

    def __init__(self, method: Any, observations: Sequence[Any], seed: int, device: str) -> None:
        self._method, self._observations = method, observations
        self._seed, self._device = seed, device
        self._synchronise = synchroniser(device)
        self._repetitions, self._settled = 1, False
        #: A method in another interpreter times itself, or the way there would count.
        self._is_elsewhere = hasattr(method, "own_seconds")

    def settle(self, repetitions: int) -> None:
        """After the warm-up: what is held now is no garbage, until :meth:`close`; and from now on,
        a prediction is timed as the mean of so many."""
        gc.collect()
        gc.freeze()
        self._repetitions, self._settled = repetitions, True

    def close(self) -> None:
        """Undo what :meth:`settle` did to this process."""
        gc.unfreeze()

    def run(self, index: int) -> float:
        """Seconds of one prediction, for the ``index``-th observation."""
        if self._settled:  # else it would go through all that the process holds
            gc.collect()
        before = self._method.own_seconds if self._is_elsewhere else 0.0
        seconds = self.timed(lambda: self._predict(index))
        if self._is_elsewhere:
            seconds = self._method.own_seconds - before
        return seconds / self._repetitions

    def timed(self, call: Callable[[], object]) -> float:
        """Seconds of any call that uses this method's device."""
        return seconds_of(call, self._synchronise)

    def _predict(self, index: int) -> None:
        for _ in range(self._repetitions):
            self._method.predict([self._observations[index]], self._seed)

    def examine(self) -> Examined:
        """Some predictions for each observation."""
        from pytest_cpas.stages import StageClock

        clock = StageClock(now, self._synchronise)
        transfer = self._method.transfer_seconds if self._is_elsewhere else 0.0
        memory = self._method.memory() if self._is_elsewhere else PeakMemory(self._device)
        with clock.listening():
            seconds = [self.run(index) for index in range(len(self._observations))]
        return {
            "predictions": self._repetitions * len(seconds),
            "total": self._repetitions * sum(seconds),
            "stages": clock.seconds,
            "memory": memory.peak(),
            "transfer": self._method.transfer_seconds - transfer if self._is_elsewhere else None,
        }

    def facts(self) -> ProcessFacts:
        """What is known of the process of the method."""
        if self._is_elsewhere:
            told: ProcessFacts = self._method.process_facts()
            return told
        from threadpoolctl import threadpool_info

        threads = {pool["internal_api"]: int(pool["num_threads"]) for pool in threadpool_info()}
        versions = {"numpy": str(sys.modules["numpy"].__version__)}
        device = self._device
        torch = sys.modules.get("torch")
        if torch is not None:
            threads["torch"] = int(torch.get_num_threads())
            versions["torch"] = str(torch.__version__)
            if device.startswith("cuda"):
                device = str(torch.cuda.get_device_name(device))
                versions["cuda"] = str(torch.version.cuda)
                versions |= _driver()
        clock = CLOCKS[SCHEDSTAT.exists()]
        return {"clock": clock, "device": device, "threads": threads, "versions": versions}


def _driver() -> dict[str, str]:
    """NVIDIA's kernel module says its version in a file, where it is loaded."""
    try:
        first = Path("/proc/driver/nvidia/version").read_text().splitlines()[0]
    except (OSError, IndexError):
        return {}
    words = first.split()
    numbers = [word for word in words if word[0].isdigit() and "." in word]
    return {"driver": numbers[0]} if numbers else {}


class PeakMemory:
    """The peak of what this process, and torch on a device, hold from here on."""

    def __init__(self, device: str) -> None:
        self._torch = sys.modules.get("torch") if device.startswith("cuda") else None
        self._device = device
        if self._torch is not None:
            self._torch.cuda.reset_peak_memory_stats(device)
        try:
            # Linux: the high-water mark of the resident memory begins anew
            Path("/proc/self/clear_refs").write_text("5")
            self._source: Literal["predictions", "process"] = PREDICTIONS
        except OSError:
            self._source = PROCESS

    def peak(self) -> MemoryDocument:
        """What was held at most."""
        host = _high_water_mark() if self._source == PREDICTIONS else _peak_of_process()
        on_device = None
        if self._torch is not None:
            on_device = int(self._torch.cuda.max_memory_allocated(self._device))
        source = None if host is None else self._source
        return {"host_bytes": host, "host_source": source, "device_bytes": on_device}


def _high_water_mark() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return int(kilobytes) * 1024


def _peak_of_process() -> int | None:
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak) * (1 if sys.platform == "darwin" else 1024)


# -- as a worker --------------------------------------------------------------------------------


def main() -> None:
    """Serve a method; its order says ``seed`` and ``observations`` (a file) as well."""
    file = Path(__file__).parents[1] / "evaluation" / "served_method.py"
    spec = importlib.util.spec_from_file_location(file.stem, file)
    served: Any = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    spec.loader.exec_module(served)  # type: ignore[union-attr]

    def contestant(method: Any, order: dict[str, Any]) -> Contestant:
        observations = served.read_observations(Path(order["observations"]))
        return Contestant(method, observations, order["seed"], order["device"])

    served.serve(contestant)


if __name__ == "__main__":
    main()
