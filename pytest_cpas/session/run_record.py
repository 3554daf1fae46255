"""What is known of a run, in memory that outlives the process that writes it."""

from __future__ import annotations

import mmap
import os
import struct
import time
from pathlib import Path

__all__ = ["Record"]

_TOLD = (
    "no verdict was told",
    "not all verdicts were told",
    "its verdicts were told, but it had not finished",
)


class Record:
    """What is known of a run, in memory that outlives the process that writes it.

    A copy of the process, which a method may make, does not write.
    """

    def __init__(self) -> None:
        self._page = mmap.mmap(-1, 2 * mmap.PAGESIZE)
        #: Whether a parent waits for this process.
        self.held = False
        self.adopt()

    def adopt(self) -> None:
        """Make this process the one that writes."""
        self._writer = os.getpid()

    def begin(self, item: str) -> None:
        """Note that an item began."""
        content = item.encode("utf-8", "replace")[: mmap.PAGESIZE - 32] + b"\0"
        self._write(32, content)

    def expect(self, note: Path) -> None:
        """Note in which file it is said if the run is ended because its time is over."""
        self._write(mmap.PAGESIZE, os.fsencode(note) + b"\0")

    def interrupt(self) -> None:
        """Note that the run was interrupted, now."""
        self._write(8, struct.pack("d", time.monotonic()))

    def lose_output(self) -> None:
        """Note that what pytest prints may not arrive."""
        self._write(2, b"\1")

    def tell(self, how: int) -> None:
        """Note that some verdicts were told (1), or all (2)."""
        self._write(3, bytes([max(how, self._page[3])]))

    def finish(self, status: int) -> None:
        """Note that the session is over, and pytest's exit status."""
        self._write(0, bytes([1, status & 0xFF]))

    def _write(self, start: int, content: bytes) -> None:
        if os.getpid() == self._writer:
            self._page[start : start + len(content)] = content

    @property
    def item(self) -> str:
        """The item that began last; empty before the first."""
        return self._page[32 : mmap.PAGESIZE].partition(b"\0")[0].decode("utf-8", "replace")

    @property
    def note(self) -> Path | None:
        """The file of :meth:`expect`, if it is there."""
        name = self._page[mmap.PAGESIZE :].partition(b"\0")[0]
        return Path(os.fsdecode(name)) if name and os.path.isfile(name) else None

    @property
    def interrupted(self) -> float:
        """When the run was interrupted, by the monotonic clock; 0 if it was not."""
        when: float = struct.unpack("d", self._page[8:16])[0]
        return when

    @property
    def output_lost(self) -> bool:
        """Whether what pytest printed may not have arrived."""
        return bool(self._page[2])

    @property
    def told(self) -> str:
        """Which verdicts were told, in words."""
        return _TOLD[self._page[3]]

    @property
    def status(self) -> int | None:
        """The exit status of pytest; None if the session is not over."""
        return self._page[1] if self._page[0] else None
