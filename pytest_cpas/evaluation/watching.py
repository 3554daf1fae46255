"""The process beside a watched one: it ends that one when a call takes too long.

It is of the standard library alone, started as a file by :mod:`pytest_cpas.evaluation.watchdog`,
and has no part in what may hang: no thread, lock or signal handler of the watched process is needed
to find that its time is up. Each line of its standard input that begins with a word which the two
share is a call that began, as JSON; the word alone says that the call ended. Other lines were
written by somebody else. It ends when the watched process does, or when its input does and no call
is under way: one that is may have cut the line, and is watched all the same.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import signal
import sys
import time
from pathlib import Path
from typing import Any

#: Where it is said what calls begin and end.
INPUT = 0

#: Seconds from one look at the clock to the next. Longer gaps count as one: the machine was busy,
#: or this process was stopped, and the watched one with it.
TICK, LONGEST_TICK = 0.1, 0.5

#: Seconds until a dump of stacks that does not grow is whole, and until none is waited for.
_WHOLE, _LONGEST_DUMP = 0.2, 3.0

#: What calls the foreign code.
_CALLER = str(Path(__file__).with_name("watchdog.py"))

_FRAME = re.compile(r'  File "(.*)", line (\d+|\?\?\?) in (.*)')


class Watch:
    """What is watched: a process, the signal upon which it dumps its stacks, and the file of it.

    ``note``: where it is written for others what was found, as JSON; None for nowhere.
    """

    def __init__(self, pid: int, number: int, dump: Path, word: str, note: Path | None) -> None:
        self.pid, self.number, self.dump, self.note = pid, number, dump, note
        self.call: dict[str, Any] | None = None
        self.spent = 0.0
        self._word = word.encode()
        self._rest = b""
        # readable when the process ends, whichever process has its number then
        self._ended = [os.pidfd_open(pid)] if hasattr(os, "pidfd_open") else []
        self._inputs = [INPUT]

    def read(self, timeout: float) -> None:
        """Take in what calls began and ended, at most the last."""
        if INPUT not in select.select([*self._inputs, *self._ended], [], [], timeout)[0]:
            return
        content = os.read(INPUT, 1 << 16)
        if not content:
            self._inputs = []
        *lines, rest = (self._rest + content).split(b"\n")
        self._rest = rest[-(1 << 16) :]
        lines = [line for line in lines if line.startswith(self._word)]
        if lines:
            told = lines[-1].removeprefix(self._word)
            self.call = json.loads(told) if told else None
            self.spent = 0.0

    @property
    def ended(self) -> bool:
        """Whether the watched process has ended."""
        if self._ended:
            return bool(select.select(self._ended, [], [], 0)[0])
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return True
        return False

    def run(self) -> None:
        """Watch until there is nothing to watch, or until it has been ended."""
        last = time.monotonic()
        while not self.ended and (self._inputs or self.call):
            self.read(TICK if self.call else 10 * TICK)
            now = time.monotonic()
            self.spent += min(now - last, LONGEST_TICK)
            last = now
            # what has been said meanwhile is heard before anything is done
            if self.over:
                self.read(0)
            if self.over:
                self.end()
                return

    @property
    def over(self) -> bool:
        """Whether a call has taken too long."""
        return self.call is not None and self.spent > self.call["seconds"]

    def end(self) -> None:
        """Dump the stacks of the watched process, say what is known, and kill it."""
        try:
            self.tell(self.call or {})
        except OSError:
            pass  # whatever somebody has closed or removed meanwhile
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)

    def tell(self, call: dict[str, Any]) -> None:
        """Say what is known, in the note and on the terminal."""
        stacks = self.stacks()
        text = (
            f"{call['what']} took longer than {call['seconds']:g} s; {where(stacks, call)}.\n"
            f"{call['hint']}"
        )
        # the first line for those who take only one
        content = f"{text}\nStacks of all threads:\n{stacks.rstrip() or 'unknown'}"
        said = False
        with contextlib.suppress(OSError):
            os.write(2, f"\nERROR: {content}\n".encode("utf-8", "backslashreplace"))
            said = not os.path.samestat(os.fstat(2), os.stat(os.devnull))
        if self.note is not None:
            unfinished = self.note.with_suffix(".unfinished")
            told = {**call, "text": content, "said": said}
            unfinished.write_text(json.dumps(told), encoding="utf-8")
            unfinished.replace(self.note)

    def stacks(self) -> str:
        """What the watched process dumps; empty if it cannot."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, self.number)
        began = changed = time.monotonic()
        content = b""
        while time.monotonic() < began + _LONGEST_DUMP:
            time.sleep(0.05)
            before = content
            with contextlib.suppress(OSError):  # it may have been removed
                content = self.dump.read_bytes()
            if content != before:
                changed = time.monotonic()
            elif content and time.monotonic() > changed + _WHOLE:
                break
        return foreign(content.decode("utf-8", "backslashreplace"))


def foreign(stacks: str) -> str:
    """Stacks without the frames that led to the foreign code: ours, and pytest's below."""
    lines: list[str] = []
    ours = False
    for line in stacks.splitlines():
        match = _FRAME.match(line)
        ours = match is not None and (ours or match[1] == _CALLER)
        lines += [] if ours else [line]
    return "\n".join(lines)


def where(stacks: str, call: dict[str, Any]) -> str:
    """Where the thread of the call was, in words: its last frame, and the last in the method."""
    frames: list[tuple[str, str, str]] = []
    inside = False
    for line in stacks.splitlines():
        if match := _FRAME.match(line):
            frames += [match.groups()] if inside else []  # type: ignore[list-item]
        elif line:
            inside = f"{call['thread']:016x}" in line
    if not frames:
        return "it cannot be told where the method was"
    told = [frame for frame in frames if frame[0] == call["file"]][:1]
    places = [f"{path}:{line} ({name})" for path, line, name in dict.fromkeys([frames[0], *told])]
    return f"the method was in {', called from '.join(places)}"


if __name__ == "__main__":
    # who interrupts a run means the run; the end of this process follows from the end of that
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(each, signal.SIG_IGN)
    pid, number, dump, word, *note = sys.argv[1:]
    watch = Watch(int(pid), int(number), Path(dump), word, Path(note[0]) if note else None)
    if os.fork():
        os._exit(0)  # the other half has no parent that could wait for it, or end it as a child
    os.write(1, str(os.getpid()).encode())
    try:
        watch.run()
    finally:
        watch.dump.unlink(missing_ok=True)
