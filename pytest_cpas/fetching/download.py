"""Downloading files: resumed, checked against the first download.

Pooch does the bookkeeping (what is there, is it right, move it into place). Its own downloader
starts anew after an interruption; the one here goes on with what is there, if the server says that
the file is still the same.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from pathlib import Path
from typing import Any

from pytest_cpas._files import write_file
from pytest_cpas.reading.files import read_text
from pytest_cpas.types import ToldError, shown

#: Seconds to wait for a connection, and for the next bytes.
TIMEOUT = (30, 60)

#: Attempts in a row that bring nothing new, before it is given up.
ATTEMPTS = 4

#: Longest file that is taken, bytes.
MAX_BYTES = 200 * 2**30

#: Largest file of checksums, bytes.
_LARGEST_SUMS = 2**22


class FetchError(ToldError):
    """Something cannot be fetched: why, and what to do about it."""


class Checksums:
    """A file ``SHA256SUMS``, as ``sha256sum --check`` reads it: trust on first use."""

    def __init__(self, folder: Path) -> None:
        """Read the file in ``folder``, if there is one."""
        self.path = folder / "SHA256SUMS"
        self._known: dict[str, str] = {}
        if self.path.is_file():
            for line in read_text(self.path, _LARGEST_SUMS, errors="replace").splitlines():
                match = re.fullmatch(r"([0-9a-f]{64})  (.+)", line)
                if match is None:
                    raise FetchError(
                        f"{self.path}: line {shown(line)}, expected a SHA-256 sum, two blanks and a"
                        " name; mend or remove the line"
                    )
                self._known[match[2]] = match[1]

    def get(self, name: str) -> str | None:
        """The sum of the first download of ``name``."""
        return self._known.get(name)

    def record(self, name: str, digest: str) -> None:
        """Remember a sum, on disk before this returns."""
        self._known[name] = digest
        write_file(self.path, "".join(f"{d}  {n}\n" for n, d in sorted(self._known.items())))


def sha256(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    import pooch

    return str(pooch.file_hash(str(path), alg="sha256"))


def announced_size(url: str) -> int | None:
    """How many bytes a server says a file has; None if it does not say."""
    import requests

    try:
        answer = requests.head(
            url, allow_redirects=True, timeout=TIMEOUT, headers={"Accept-Encoding": "identity"}
        )
    except requests.RequestException as error:
        raise FetchError(f"{url}: no answer ({error}); is there a connection?") from error
    return _length(answer.headers) if answer.ok else None


def _length(headers: Any) -> int | None:
    """How many bytes are to come, as the server says; None if it says nothing of use."""
    length: str = headers.get("Content-Length", "")
    return int(length) if re.fullmatch("[0-9]{1,15}", length) else None


def download(url: str, path: Path, known: str | None, sums: Path | None = None) -> str:
    """Have the file at ``url`` in ``path``, and return its SHA-256.

    What is there already is used if it has the sum ``known`` (any, if None), which is in the file
    ``sums`` (in the folder of ``path``, if None). An interrupted
    download stays in ``path`` with ``.part`` appended and is gone on with. Raises
    :class:`FetchError`.
    """
    import pooch
    import requests

    pooch.get_logger().setLevel("WARNING")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        pooch.retrieve(
            url,
            known_hash=None if known is None else f"sha256:{known}",
            fname=path.name,
            path=path.parent,
            downloader=_Resuming(path.with_name(f"{path.name}.part")),
        )
    except requests.HTTPError as error:
        raise FetchError(f"{url}: {error}; has it moved?") from error
    except requests.RequestException as error:
        raise FetchError(
            f"{url}: interrupted ({error}); the same command goes on where it stopped"
        ) from error
    except ValueError as error:
        raise FetchError(
            f"{url}: its checksum is another one than at the first download ({known}). It was"
            " damaged on the way, or published anew, or exchanged; if you trust it, remove its line"
            f" from {sums or path.parent / 'SHA256SUMS'}"
        ) from error
    except OSError as error:
        raise FetchError(f"{path}: it cannot be written ({error})") from error
    return sha256(path)


class _Resuming:
    """A downloader for pooch that keeps what it has in ``part``."""

    def __init__(self, part: Path) -> None:
        self._part = part
        self._note = part.with_name(f"{part.name}.version")

    def __call__(self, url: str, output_file: str, pooch: object) -> None:
        """Download ``url`` to ``output_file``."""
        import requests

        best, idle = self._size(), 0
        while True:
            try:
                self._go_on(url)
                break
            except (
                requests.ConnectionError,
                requests.Timeout,
                requests.exceptions.ChunkedEncodingError,
            ):
                idle = 0 if self._size() > best else idle + 1
                best = max(best, self._size())
                if idle == ATTEMPTS:
                    raise
                time.sleep(idle)
        os.replace(self._part, output_file)
        self._note.unlink(missing_ok=True)

    def _size(self) -> int:
        return self._part.stat().st_size if self._part.is_file() else 0

    def _go_on(self, url: str) -> None:
        import requests
        from tqdm import tqdm

        have = self._size()
        version = read_text(self._note, 2**12, errors="replace") if self._note.is_file() else ""
        headers = {"Accept-Encoding": "identity"}
        if have and version:
            headers |= {"Range": f"bytes={have}-", "If-Range": version}
        with requests.get(url, stream=True, timeout=TIMEOUT, headers=headers) as answer:
            if answer.status_code == 416:  # nothing is left, or the file is shorter by now
                if answer.headers.get("Content-Range") == f"bytes */{have}":
                    return
                self._part.unlink(missing_ok=True)
                raise requests.ConnectionError("the file has changed meanwhile")
            answer.raise_for_status()
            start = have if answer.status_code == 206 else 0
            said = answer.headers.get("Content-Range", "")
            if answer.status_code == 206 and not said.startswith(f"bytes {start}-"):
                raise requests.RequestException(
                    f"asked for bytes from {start} on, got {shown(said)}"
                )
            length = _length(answer.headers)
            total = None if length is None else start + length
            free = shutil.disk_usage(self._part.parent).free
            if total is not None and total - start > free:
                raise FetchError(f"{url}: {total - start} bytes are to come, {free} are free")
            if start == 0:  # first the bytes go: a part must never bear the name of a later version
                self._part.unlink(missing_ok=True)
                self._note.write_text(_version(answer.headers))
            with (
                self._part.open("ab" if start else "wb") as file,
                tqdm(
                    desc=self._part.stem, initial=start, total=total, unit="B", unit_scale=True
                ) as bar,
            ):
                for chunk in answer.iter_content(2**16):
                    file.write(chunk)
                    bar.update(len(chunk))
                    if file.tell() > MAX_BYTES:
                        raise FetchError(f"{url}: more than {MAX_BYTES} bytes; it may never end")
        if total is not None and self._size() < total:
            raise requests.ConnectionError(f"{self._size()} of {total} bytes came")


def _version(headers: Any) -> str:
    """What tells two versions of a file apart, fit for If-Range; empty if nothing does."""
    tag: str = headers.get("ETag", "")
    return headers.get("Last-Modified", "") if not tag or tag.startswith("W/") else tag
