"""``pytest-cpas fetch``: data sets and weights from where they are published.

Only addresses of ``sources.toml`` and of registered methods are fetched from. Archives and their
checksums stay in ``DIR/.fetched``; the first download of a file is trusted, and later ones must
have its checksum.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from urllib.parse import urlsplit

import filelock

from pytest_cpas import registry
from pytest_cpas._files import write_file
from pytest_cpas.datasets.sources import Source, SourceFile, published_sources
from pytest_cpas.fetching.download import (
    Checksums,
    FetchError,
    announced_size,
    download,
    sha256,
)
from pytest_cpas.reading.archives import KEPT, ArchiveError, unpack
from pytest_cpas.reading.files import read_text
from pytest_cpas.types import Asset, MethodInfo

__all__ = ["FetchError", "fetch", "find_source"]

#: Pages that hand out files only to a browser.
_FOR_BROWSERS = frozenset({"drive.google.com", "www.dropbox.com", "onedrive.live.com"})


def find_source(name: str) -> Source:
    """The source of a data set or of a method's weights; :class:`FetchError` for another name."""
    sources = published_sources()
    if name in sources:
        return sources[name]
    methods = [entry.name for entry in registry.registered("method")]
    if name in methods:
        try:
            info = registry.resolve("method", name).info
        except registry.RegistryError as error:
            raise FetchError(str(error)) from error
        return _of_method(info)
    known = sorted([*sources, *methods])
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    raise FetchError(f"{name!r} is not known.{hint} Known: {', '.join(known)}")


def _of_method(info: MethodInfo) -> Source:
    files = [SourceFile(url=asset.url, to=asset.path) for asset in info.assets if _direct(asset)]
    steps = [
        f"open {asset.url}, and store it as {asset.path} in the folder"
        for asset in info.assets
        if not _direct(asset)
    ]
    licences = dict.fromkeys(asset.licence for asset in info.assets)
    about = f"weights of {info.name}" if info.assets else f"{info.name} needs no weights"
    return Source(
        name=info.name,
        about=about,
        licence="; ".join(licences) or "n/a",
        folder=".",
        file=files,
        steps=steps,
    )


def _direct(asset: Asset) -> bool:
    """Whether the address is the file's own, and not a page about it."""
    address = urlsplit(asset.url)
    return (
        re.fullmatch(r"https?://\S+\.\w+", asset.url) is not None
        and address.hostname not in _FOR_BROWSERS
    )


def fetch(
    source: Source,
    to: Path,
    *,
    confirm: Callable[[str], bool],
    tell: Callable[[str], None] = print,
) -> bool:
    """Fetch a source into ``to``; whether everything is there now.

    What is to be fetched is told with size and licence, and ``confirm`` is asked. What a program
    cannot fetch is told as steps. Raises :class:`FetchError`.
    """
    folder = to / source.folder
    kept = folder / KEPT
    tell(f"{source.name}: {source.about}\nlicence: {source.licence}\nfolder: {folder}")
    wanted = [file for file in source.file if not _is_done(file, folder, kept)]
    if wanted:
        _import_pooch()
        for file in wanted:
            tell(f"  {_megabytes(announced_size(file.url)):>12}  {file.url}")
        if not confirm(f"Fetch {len(wanted)} files under these terms?"):
            return False
        kept.mkdir(parents=True, exist_ok=True)
        try:
            with filelock.FileLock(kept / "lock", timeout=0):
                for file in wanted:
                    _fetch_file(file, folder, kept, tell)
        except filelock.Timeout as error:
            raise FetchError(f"another fetch is at work in {folder}; wait for it") from error
    if source.file:
        tell(f"{len(source.file)} files are there")
    for number, step in enumerate(source.steps, start=1):
        tell(f"step {number}, by hand: {step}")
    return not source.steps


def _archive_name(file: SourceFile) -> str:
    return PurePosixPath(urlsplit(file.url).path).name


def _is_done(file: SourceFile, folder: Path, kept: Path) -> bool:
    """Whether the file was fetched, and unpacked, and is still there."""
    if not file.unpack:
        known = Checksums(kept).get(file.to)
        return (
            known is not None and (folder / file.to).is_file() and sha256(folder / file.to) == known
        )
    mark = kept / f"{_archive_name(file)}.unpacked"
    known = Checksums(kept).get(_archive_name(file))
    return (
        mark.is_file()
        and (folder / file.gives).exists()
        and known is not None
        and read_text(mark) == known
    )


def _fetch_file(file: SourceFile, folder: Path, kept: Path, tell: Callable[[str], None]) -> None:
    sums = Checksums(kept)
    if not file.unpack:
        digest = download(file.url, folder / file.to, sums.get(file.to), sums.path)
        sums.record(file.to, digest)
        return
    name = _archive_name(file)
    archive = kept / name
    digest = download(file.url, archive, sums.get(name), sums.path)
    try:
        count = unpack(archive, folder / file.unpack)
    except ArchiveError as error:
        if sums.get(name) is None:  # it was never good: do not keep it, or it would be trusted
            archive.unlink()
        raise FetchError(f"{error}. It came from {file.url}") from error
    except OSError as error:
        raise FetchError(
            f"{archive}: it cannot be unpacked ({error}); if there is space left, it is damaged:"
            " remove it, and fetch it again"
        ) from error
    sums.record(name, digest)
    if not (folder / file.gives).exists():
        raise FetchError(
            f"{archive}: unpacked to {folder / file.unpack}, but {folder / file.gives} is not"
            f" there; has {file.url} been published anew?"
        )
    write_file(kept / f"{name}.unpacked", digest)
    tell(f"{name}: {count} files unpacked; {archive} may be removed")


def _import_pooch() -> None:
    try:
        import pooch  # noqa: F401
        import tqdm  # noqa: F401
    except ImportError as error:
        raise FetchError(
            f"fetching needs pooch and tqdm ({error}): pip install 'pytest-cpas[fetch]'"
        ) from error


def _megabytes(size: int | None) -> str:
    return "size unknown" if size is None else f"{size / 1e6:.1f} MB"
