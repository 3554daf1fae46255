"""When a run began, which is before pytest has imported anything of a method."""

from __future__ import annotations

import time

import pytest

__all__ = ["began", "note"]

_BEGAN = pytest.StashKey[int]()


def note(config: pytest.Config) -> None:
    """It is now."""
    config.stash[_BEGAN] = time.time_ns()


def began(config: pytest.Config) -> int:
    """Nanoseconds since 1970; now, if nobody has noted it."""
    return config.stash.get(_BEGAN, time.time_ns())
