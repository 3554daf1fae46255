"""What a pickle is read with: its bytes, a stack, a memo, and what is left of the limits."""

from __future__ import annotations

import re
import sys
from typing import Any, NoReturn

from pytest_cpas.reading.pickle_arrays import NAMES, Name, Unfilled
from pytest_cpas.reading.pickle_limits import MAX_TEXT, Budget, Damaged
from pytest_cpas.types import DataError

#: Bytes that a container of some values and an entry of the memo take, about.
_CONTAINER = 500
_ENTRY = 120


class Machine:
    """The state in which one pickle is read."""

    __slots__ = ("at", "budget", "content", "marked", "memo", "next", "stack")

    def __init__(self, content: bytes, begin: int = 0) -> None:
        """Nothing is read yet, and reading begins at byte ``begin``."""
        self.content = content
        self.at = begin  # where the opcode is that is carried out
        self.next = begin  # where what follows it begins
        self.stack: list[Any] = []
        self.marked: list[list[Any]] = []  # what lies below each MARK
        self.memo: dict[int, Any] = {}
        self.budget = Budget(len(content))

    def take(self, size: int) -> bytes:
        """The next ``size`` bytes."""
        begin = self.next
        self.next = begin + size
        content = self.content[begin : begin + size]
        if len(content) != size:
            raise Damaged(f"{size} bytes should follow, {len(content)} do")
        return content

    def line(self, limit: int) -> bytes:
        """The bytes up to the end of the line."""
        begin = self.next
        end = self.content.find(b"\n", begin, begin + limit + 1)
        if end < 0:
            raise Damaged(f"a line of at most {limit} bytes should follow")
        self.next = end + 1
        return self.content[begin:end]

    def payload(self, size: int) -> bytes:
        """The next ``size`` bytes, counted as memory."""
        content = self.take(size)
        self.budget.take(size + 50)
        return content

    def push_text(self, content: bytes, encoding: str) -> None:
        """Put text onto the stack."""
        if len(content) > MAX_TEXT:
            raise DataError(f"a text has {len(content)} bytes, at most {MAX_TEXT} are read")
        try:
            text = content.decode(encoding)
            if encoding == "raw-unicode-escape" and not text.isascii():
                text.encode()  # half a pair of surrogates is no character
        except (UnicodeDecodeError, UnicodeEncodeError) as error:
            raise Damaged(f"a text is not in {encoding} ({error.reason})") from None
        self.budget.take(sys.getsizeof(text))
        self.stack.append(text)

    def pop(self) -> Any:
        """The value on top of the stack."""
        if not self.stack:
            raise Damaged("an opcode takes a value, and there is none")
        return self.stack.pop()

    def pop_two(self) -> tuple[Any, Any]:
        """The value on top of the stack, and the one below."""
        stack = self.stack
        if len(stack) < 2:
            raise Damaged("an opcode takes two values, and there are none")
        return stack.pop(), stack.pop()

    def top(self, kind: type, what: str) -> Any:
        """The value on top of the stack, which stays there."""
        if not self.stack or type(self.stack[-1]) is not kind:
            raise Damaged(f"{what}, which is not there")
        return self.stack[-1]

    def pop_mark(self) -> list[Any]:
        """The values above the last MARK."""
        if not self.marked:
            raise Damaged("an opcode takes the values above a MARK, and there is none")
        values = self.stack
        self.stack = self.marked.pop()
        return values

    def push_container(self, value: Any) -> None:
        """Put a container onto the stack."""
        self.budget.take(_CONTAINER)
        self.stack.append(value)

    def remember(self, index: int) -> None:
        """Put the value on top of the stack into the memo."""
        self.budget.take(_ENTRY)
        if not self.stack:
            raise Damaged("an opcode remembers a value, and there is none")
        self.memo[index] = self.stack[-1]

    def recall(self, index: int) -> None:
        """Put a value of the memo onto the stack."""
        if index not in self.memo:
            raise Damaged(f"it takes up value {index}, which it has not put down")
        value = self.memo[index]
        if type(value) is Unfilled and value.array is not None:
            value = value.array
        self.stack.append(value)

    def name(self, module: str, name: str) -> Name:
        """What a name stands for; :class:`DataError` for all but those that arrays need."""
        known = NAMES.get((module, name))
        if known is None:
            shown = f"{module}.{name}"
            if not re.fullmatch(r"[\w.]{1,200}", shown, re.ASCII):
                shown = ascii(shown[:200])
            self.refuse(f"the pickle names {shown}")
        return known

    def refuse(self, seen: str) -> NoReturn:
        """For what could run code."""
        raise DataError(
            f"{seen}, and only plain values and numpy arrays are read, because loading anything"
            " else could run code. If you trust where it comes from, load it yourself and save the"
            " arrays again"
        )
