"""How a method in another interpreter is reached."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["Spec"]


@dataclass(frozen=True, kw_only=True)
class Spec:
    """How a method is reached.

    ``command`` ends with an interpreter; ``cls`` is ``module:Class`` there; ``path``: folders there
    where modules are looked for first; ``env``: variables set there; ``paths``: folders there, by
    which folder here each is. ``image``: what else tells of the other side, such as the digest of
    an image; ``worker``: where the worker lies there, None to send it; ``shell``: whether the
    command hands its words to a shell, as ssh does. ``name``: what the method is called here, if
    not as it declares; ``folder``: where it is told what is known of it. Seconds are for the worker
    to start, and for the class to be loaded.
    """

    command: tuple[str, ...]
    cls: str
    name: str = ""
    path: tuple[str, ...] = ()
    env: Mapping[str, str] = field(default_factory=dict)
    paths: Mapping[str, Path] = field(default_factory=dict)
    image: str = ""
    worker: str | None = None
    shell: bool = False
    seconds_to_start: float = 120.0
    seconds_to_load: float = 600.0
    folder: Path = Path()

    @property
    def told(self) -> str:
        """What it is called in messages."""
        return self.name or self.cls

    def there(self, path: Path) -> str:
        """What a path of this side is called on the other one."""
        path = Path(os.path.abspath(path))
        for other, here in self.paths.items():
            if path.is_relative_to(here):
                return str(Path(other, path.relative_to(here)))
        return str(path)
