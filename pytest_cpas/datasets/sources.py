"""Where data is published, under which terms, and how one gets it: ``sources.toml``."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pytest_cpas.reading.structured import read_toml

__all__ = ["Source", "SourceFile", "how_to_get", "published_sources"]

#: So many addresses are written out in an error message.
_WRITTEN_OUT = 5


@dataclass(frozen=True, kw_only=True)
class SourceFile:
    """A file to fetch: where it goes below the source's folder.

    ``to``: the file's path; or ``unpack``: the folder of an archive's content. ``gives``: what must
    then be there.
    """

    url: str
    to: str = ""
    unpack: str = ""
    gives: str = ""


@dataclass(frozen=True, kw_only=True)
class Source:
    """What is published of a data set or a method, and what a person must do for the rest.

    ``folder``: where it goes, below the folder that holds all.
    """

    name: str
    about: str
    licence: str
    folder: str
    file: Sequence[SourceFile] = ()
    steps: Sequence[str] = ()


@functools.cache
def published_sources() -> dict[str, Source]:
    """The data sets of ``sources.toml``, by name."""
    content = read_toml(Path(__file__).with_name("sources.toml"))
    sources = {}
    for name, values in content.items():
        files = [SourceFile(**entry) for entry in values.pop("file", ())]
        sources[name] = Source(name=name, file=files, **values)
    return sources


def how_to_get(name: str) -> str:
    """What to do to have a data set: for the error messages of those who miss it."""
    source = published_sources()[name]
    folder = f"DIR/{source.folder}"
    lines = [f"{source.about}. Licence: {source.licence}."]
    if source.file:
        lines += [f"  pytest-cpas fetch {name} --to DIR", f"fetches it; by hand, to {folder}:"]
        lines += [f"  {file.url} -> {file.to or file.gives}" for file in _some(source.file)]
        if len(source.file) > _WRITTEN_OUT:
            lines.append(
                f"  and {len(source.file) - _WRITTEN_OUT} more (pytest_cpas/datasets/sources.toml)"
            )
    else:
        lines += [f"By hand, to {folder}:", *(f"  {step}" for step in source.steps)]
    return "\n".join([*lines, "Then pass --cpas-data=DIR (or set CPAS_DATA)."])


def _some(files: Sequence[SourceFile]) -> Sequence[SourceFile]:
    """All files; of many the first and the last ones, which are of another kind."""
    if len(files) <= _WRITTEN_OUT:
        return files
    return [*files[: _WRITTEN_OUT - 2], *files[-2:]]
