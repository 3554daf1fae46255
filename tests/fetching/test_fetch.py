"""Fetching from a local server that interrupts, lies and hands out malicious archives."""

import hashlib
import io
import re
import shutil
import stat
import struct
import subprocess
import sys
import tarfile
import threading
import time
import zipfile
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import filelock
import numpy as np
import pytest

from pytest_cpas import cli
from pytest_cpas.datasets.sources import Source, SourceFile, how_to_get, published_sources
from pytest_cpas.fetching import download as downloading
from pytest_cpas.fetching.command import FetchError, fetch, find_source
from pytest_cpas.fetching.download import Checksums, download
from pytest_cpas.reading import archives
from pytest_cpas.reading.archives import ArchiveError, unpack
from pytest_cpas.registry import resolve

requests = pytest.importorskip("requests")
pytest.importorskip("pooch")


@dataclass
class Served:
    """One file of the server, and how it misbehaves."""

    content: bytes
    tag: str | None = '"1"'
    ranges: bool = True
    cut: list[int] = field(default_factory=list)  # per request: bytes until the line goes dead
    shorter: int = 0  # bytes that are announced and never come
    stall: float = 0
    length: bool = True
    status: int = 200


class Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, Served] = {}
        self.requests: list[tuple[str, str, str | None]] = []

    def url(self, name: str, content: bytes, **how) -> str:
        self.files["/" + name] = Served(content, **how)
        return f"http://127.0.0.1:{self.server_port}/{name}"

    def gets(self) -> list[str | None]:
        """The Range headers of the GET requests so far."""
        return [wanted for method, _, wanted in self.requests if method == "GET"]


class Handler(BaseHTTPRequestHandler):
    def log_message(self, *args):
        pass

    def do_HEAD(self):
        self.answer(body=False)

    def do_GET(self):
        self.answer(body=True)

    def answer(self, body: bool) -> None:
        wanted = self.headers.get("Range")
        self.server.requests.append((self.command, self.path, wanted))
        served = self.server.files.get(self.path)
        if served is None or served.status != 200:
            self.send_error(served.status if served else 404)
            return
        content, start = served.content, 0
        if wanted and served.ranges and self.headers.get("If-Range") == served.tag:
            start = int(re.fullmatch(r"bytes=(\d+)-", wanted)[1])
            if start >= len(content):
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{len(content)}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        else:
            self.send_response(200)
        rest = content[start:]
        if served.length:
            self.send_header("Content-Length", str(len(rest) + served.shorter))
        if served.tag:
            self.send_header("ETag", served.tag)
        self.end_headers()
        if body:
            self.wfile.write(rest[: served.cut.pop(0)] if served.cut else rest)
            self.wfile.flush()
            threading.Event().wait(served.stall)
        self.close_connection = True


@pytest.fixture
def server():
    with Server() as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        yield running
        running.shutdown()
        thread.join()


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(downloading.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(downloading, "TIMEOUT", (2, 0.2))


CONTENT = bytes(range(256)) * 2000


# -- downloads ----------------------------------------------------------------------------------


def test_download(server, tmp_path):
    url = server.url("a.bin", CONTENT)
    digest = download(url, tmp_path / "new" / "a.bin", None)
    assert digest == hashlib.sha256(CONTENT).hexdigest()
    assert (tmp_path / "new" / "a.bin").read_bytes() == CONTENT
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.bin"]
    download(url, tmp_path / "new" / "a.bin", digest)
    assert server.gets() == [None]  # what is there is not fetched again


def test_interrupted_download_is_gone_on_with(server, tmp_path):
    url = server.url("a.bin", CONTENT, cut=[100_000, 0, 200_000])
    download(url, tmp_path / "a.bin", None)
    assert (tmp_path / "a.bin").read_bytes() == CONTENT
    assert server.gets() == [None, "bytes=65536-", "bytes=65536-", "bytes=262144-"]


def test_next_command_goes_on(server, tmp_path):
    url = server.url("a.bin", CONTENT, cut=[100_000] + [0] * 10)
    with pytest.raises(FetchError, match="the same command goes on where it stopped"):
        download(url, tmp_path / "a.bin", None)
    assert not (tmp_path / "a.bin").exists()
    assert len(server.gets()) == 1 + downloading.ATTEMPTS  # and no more: it does not try for ever
    server.files["/a.bin"].cut = []
    download(url, tmp_path / "a.bin", None)
    assert (tmp_path / "a.bin").read_bytes() == CONTENT
    assert server.gets()[-1] == "bytes=65536-"
    assert [path.name for path in tmp_path.iterdir()] == ["a.bin"]


def test_killed_download_is_gone_on_with(server, tmp_path):
    url = server.url("a.bin", CONTENT, cut=[200_000], stall=60)
    code = f"""
from pathlib import Path
from pytest_cpas.fetching.download import download
download({url!r}, Path({str(tmp_path / "a.bin")!r}), None)
"""
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL) as process:
        part, deadline = tmp_path / "a.bin.part", time.monotonic() + 30
        while not (part.is_file() and part.stat().st_size) and time.monotonic() < deadline:
            threading.Event().wait(0.05)
        process.kill()
    have = part.stat().st_size
    assert 0 < have < len(CONTENT)
    server.files["/a.bin"].stall = 0
    download(url, tmp_path / "a.bin", None)
    assert (tmp_path / "a.bin").read_bytes() == CONTENT
    assert server.gets() == [None, f"bytes={have}-"]


@pytest.mark.parametrize(
    "how",
    [{"tag": '"2"'}, {"ranges": False}, {"tag": None}, {"tag": 'W/"1"'}],
    ids=["published anew", "no ranges", "no version", "weak version"],
)
def test_part_of_another_version_is_not_used(server, tmp_path, how):
    """Bytes of two versions in one file would be the worst outcome."""
    old = bytes(len(CONTENT))
    first = how | ({"tag": '"1"'} if how.get("tag") == '"2"' else {})
    url = server.url("a.bin", old, cut=[100_000] + [0] * 10, **first)
    with pytest.raises(FetchError):
        download(url, tmp_path / "a.bin", None)
    server.url("a.bin", CONTENT, **how)
    download(url, tmp_path / "a.bin", None)
    assert (tmp_path / "a.bin").read_bytes() == CONTENT


def test_part_that_is_whole_already(server, tmp_path):
    url = server.url("a.bin", CONTENT)
    (tmp_path / "a.bin.part").write_bytes(CONTENT)
    (tmp_path / "a.bin.part.version").write_text('"1"')
    download(url, tmp_path / "a.bin", None)
    assert (tmp_path / "a.bin").read_bytes() == CONTENT
    assert server.gets() == [f"bytes={len(CONTENT)}-"]
    # and one that is longer than the file
    (tmp_path / "b.bin.part").write_bytes(CONTENT + b"more")
    (tmp_path / "b.bin.part.version").write_text('"1"')
    download(server.url("b.bin", CONTENT), tmp_path / "b.bin", None)
    assert (tmp_path / "b.bin").read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"shorter": 1000}, "interrupted"),
        ({"stall": 0.5, "cut": [0] * 20}, "interrupted"),
        ({"status": 404}, "404 .*has it moved?"),
        ({"status": 500}, "500 "),
    ],
    ids=["truncated", "stalled", "gone", "broken"],
)
def test_bad_server(server, tmp_path, how, words):
    url = server.url("a.bin", CONTENT[:1000], **how)
    with pytest.raises(FetchError, match=words):
        download(url, tmp_path / "a.bin", None)
    assert not (tmp_path / "a.bin").exists()


def test_no_server(tmp_path):
    with pytest.raises(FetchError, match="interrupted"):
        download("http://127.0.0.1:9/a.bin", tmp_path / "a.bin", None)
    with pytest.raises(FetchError, match="is there a connection"):
        downloading.announced_size("http://127.0.0.1:9/a.bin")


def test_file_without_end(server, tmp_path, monkeypatch):
    monkeypatch.setattr(downloading, "MAX_BYTES", 300_000)
    url = server.url("a.bin", CONTENT, length=False)
    with pytest.raises(FetchError, match="it may never end"):
        download(url, tmp_path / "a.bin", None)


def test_wrong_checksum(server, tmp_path):
    url = server.url("a.bin", CONTENT)
    with pytest.raises(FetchError, match="another one than at the first download"):
        download(url, tmp_path / "a.bin", "0" * 64)
    assert not (tmp_path / "a.bin").exists()


def test_damaged_list_of_checksums(tmp_path):
    (tmp_path / "SHA256SUMS").write_text("abc  a.bin\n")
    with pytest.raises(FetchError, match=r"line 'abc  a\.bin', expected"):
        Checksums(tmp_path)


# -- archives -----------------------------------------------------------------------------------


def zipped(*members: tuple[str | zipfile.ZipInfo, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return stream.getvalue()


def tarred(*members: tuple[tarfile.TarInfo | str, bytes], mode: str = "w:gz") -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode=mode) as archive:
        for member, content in members:
            info = tarfile.TarInfo(member) if isinstance(member, str) else member
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return stream.getvalue()


def zip_mode(name: str, kind: int) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.create_system = 3
    info.external_attr = (kind | 0o777) << 16
    return info


def tar_kind(name: str, kind: bytes, target: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


def patched(archive: bytes, old: bytes, new: bytes) -> bytes:
    assert old in archive
    return archive.replace(old, new)


def encrypted() -> bytes:
    archive = bytearray(zipped(("a", b"x")))
    archive[6] |= 1
    archive[archive.index(b"PK\1\2") + 8] |= 1
    return bytes(archive)


def lying_about_size() -> bytes:
    """Declares 10 bytes and has 1000."""
    archive = zipped(("a", b"x" * 1000))
    return archive.replace(struct.pack("<L", 1000), struct.pack("<L", 10))


def overlapping() -> bytes:
    """Two members of the directory share the bytes of the first."""
    stream = io.BytesIO()
    noise = hashlib.shake_128(b"noise").digest(5000)
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a", noise)
        for name in ("b", "c"):
            twin = zipfile.ZipInfo(name)
            first = archive.getinfo("a")
            twin.CRC, twin.file_size, twin.compress_size = first.CRC, 5000, 5000
            twin.header_offset = first.header_offset
            archive.filelist.append(twin)
            archive.NameToInfo[name] = twin
    return stream.getvalue()


GOOD = (("tree/a.txt", b"A"), ("tree/sub/b.txt", b"B"))

MALICIOUS = {
    "zip, up": (zipped(*GOOD, ("../evil", b"x")), "'../evil' leads out of the folder"),
    "zip, up within": (zipped(*GOOD, ("tree/../../evil", b"x")), "leads out of the folder"),
    "zip, absolute": (zipped(*GOOD, ("/evil", b"x")), "leads out of the folder"),
    **{
        f"zip, named {name!r}": (zipped(*GOOD, (name, b"x")), "has control characters")
        for name in ("a\x1b[31m", "a\nb", "a\x85", "a\u202eb", "tree/\x7f")
    },
    "zip, drive": (zipped(*GOOD, ("C:/evil", b"x")), "leads out of the folder"),
    "zip, backslash": (patched(zipped(*GOOD, ("..#evil", b"x")), b"..#e", b"..\\e"), "leads out"),
    "zip, link": (zipped(*GOOD, (zip_mode("l", stat.S_IFLNK), b"/etc/passwd")), "'l' is a link"),
    "zip, device": (zipped(*GOOD, (zip_mode("l", stat.S_IFCHR), b"")), "'l' is a link or a device"),
    "zip, pipe": (zipped(*GOOD, (zip_mode("l", stat.S_IFIFO), b"")), "'l' is a link or a device"),
    "zip, bomb": (zipped(("zeros", bytes(20_000_000))), "a bomb?"),
    "zip, overlapping": (overlapping(), "overlap"),
    "zip, size is a lie": (lying_about_size(), "a"),
    "zip, encrypted": (encrypted(), "'a' is encrypted"),
    "zip, case": (zipped(("a", b"x"), ("A", b"y")), "'A' occurs twice"),
    "zip, file and folder": (zipped(("a", b"x"), ("a/b", b"y")), "'a' is a file and a folder"),
    "zip, empty": (zipped(), "it holds no files"),
    "zip, truncated": (zipped(*GOOD)[:-30], "not a readable archive"),
    "zip, damaged": (patched(zipped(("a", b"A" * 99)), b"\x73\x74", b"\x00\x00"), "a"),
    "tar, up": (tarred(*GOOD, ("../evil", b"x")), "'../evil' leads out of the folder"),
    "tar, absolute": (tarred(*GOOD, ("/evil", b"x")), "leads out of the folder"),
    "tar, link": (tarred(*GOOD, (tar_kind("l", tarfile.SYMTYPE, "/etc"), b"")), "'l' is a link"),
    "tar, link within": (tarred(*GOOD, (tar_kind("l", tarfile.SYMTYPE, "tree"), b"")), "is a link"),
    "tar, hard link": (
        tarred((tar_kind("l", tarfile.LNKTYPE, "/etc/hosts"), b"")),
        "'l' is a link",
    ),
    "tar, device": (tarred(*GOOD, (tar_kind("d", tarfile.CHRTYPE), b"")), "'d' is a link or a dev"),
    "tar, bomb": (tarred(("zeros", bytes(20_000_000))), "a bomb?"),
    "tar, truncated": (tarred(*GOOD, ("n", hashlib.shake_128().digest(9999)))[:-999], "not a read"),
    "web page": (b"<!DOCTYPE html><title>Sign in</title>", "or a web page?"),
    "nothing": (b"", "not a readable archive"),
}


@pytest.mark.parametrize("kind", MALICIOUS)
def test_bad_archive_leaves_nothing(tmp_path, kind):
    content, words = MALICIOUS[kind]
    folder, archive = tmp_path / "outer" / "folder", tmp_path / "archive"
    folder.mkdir(parents=True)
    (folder / "mine").write_text("kept")
    archive.write_bytes(content)
    with pytest.raises(ArchiveError, match=re.escape(words)) as caught:
        unpack(archive, folder)
    assert str(archive) in str(caught.value)
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert left == ["archive", "outer", "outer/folder", "outer/folder/mine"]
    assert not Path("/evil").exists()


@pytest.mark.parametrize(
    "content", [zipped(("tree/", b""), *GOOD), tarred(*GOOD), tarred(*GOOD, mode="w")]
)
def test_good_archive(tmp_path, content):
    (tmp_path / "archive").write_bytes(content)
    for _ in range(2):  # a second time over the first
        assert unpack(tmp_path / "archive", tmp_path / "folder") == 2
        files = {str(p.relative_to(tmp_path)) for p in (tmp_path / "folder").rglob("*.*")}
        assert files == {"folder/tree/a.txt", "folder/tree/sub/b.txt"}
        assert (tmp_path / "folder/tree/sub/b.txt").read_bytes() == b"B"


@pytest.mark.parametrize("mode", ["zip", "w", "w:gz", "w:bz2", "w:xz"])
def test_any_damage_is_an_error_or_harmless(tmp_path, mode):
    """Some bytes exchanged, some cut off: an error that is announced, and nothing left behind."""
    members = (*GOOD, ("noise", bytes(range(256))))
    good = zipped(*members) if mode == "zip" else tarred(*members, mode=mode)
    rng = np.random.default_rng(0)
    outer = tmp_path / "outer"
    for _ in range(60):
        damaged = bytearray(good)
        damaged[rng.integers(len(good))] = rng.integers(256)
        (tmp_path / "archive").write_bytes(damaged[: rng.choice([len(good), len(good) // 2])])
        (outer / "folder").mkdir(parents=True)
        try:
            unpack(tmp_path / "archive", outer / "folder")
        except (ArchiveError, OSError):
            assert list((outer / "folder").iterdir()) == []
        assert [path.name for path in outer.iterdir()] == ["folder"]
        shutil.rmtree(outer)


def test_links_in_the_folder_are_not_followed(tmp_path):
    (tmp_path / "archive").write_bytes(zipped(*GOOD))
    outside, folder = tmp_path / "outside", tmp_path / "folder"
    outside.mkdir()
    folder.mkdir()
    (folder / "tree").symlink_to(outside)
    with pytest.raises(ArchiveError, match="tree is a link or a file, expected a folder"):
        unpack(tmp_path / "archive", folder)
    assert list(outside.iterdir()) == []
    (folder / "tree").unlink()
    (folder / "tree").mkdir()
    (outside / "precious").write_text("mine")
    (folder / "tree" / "a.txt").symlink_to(outside / "precious")
    with pytest.raises(ArchiveError, match=r"a\.txt is a link or a folder, expected a file"):
        unpack(tmp_path / "archive", folder)
    assert (outside / "precious").read_text() == "mine"


def test_too_many_members(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "_FEW", 1)
    (tmp_path / "archive").write_bytes(zipped(*GOOD))
    with pytest.raises(ArchiveError, match="2 members, at most 1 are read"):
        unpack(tmp_path / "archive", tmp_path / "folder")


# -- the command --------------------------------------------------------------------------------


@pytest.fixture
def source(server):
    """A data set of an archive and a single file."""
    files = [
        SourceFile(url=server.url("data.zip", zipped(*GOOD)), unpack="deep", gives="deep/tree"),
        SourceFile(url=server.url("notes.json", b"{}"), to="notes.json"),
    ]
    return Source(name="own", about="our own", licence="CC0", folder="own", file=files)


def run(source, to, agree=True):
    lines = []
    done = fetch(source, to, confirm=lambda question: agree, tell=lines.append)
    return done, "\n".join(lines)


def test_fetch_tells_unpacks_and_remembers(server, source, tmp_path):
    done, told = run(source, tmp_path)
    assert done
    for words in ("own: our own", "licence: CC0", " 0.0 MB  http://127", "2 files are there"):
        assert words in told
    assert (tmp_path / "own/deep/tree/sub/b.txt").read_bytes() == b"B"
    assert (tmp_path / "own/notes.json").read_bytes() == b"{}"
    sums = (tmp_path / "own/.fetched/SHA256SUMS").read_text()
    assert f"{hashlib.sha256(b'{}').hexdigest()}  notes.json\n" in sums
    count = len(server.requests)
    (tmp_path / "own/.fetched/data.zip").unlink()  # the archive is not needed any more
    assert run(source, tmp_path)[0]
    assert len(server.requests) == count


def test_without_agreement_nothing_is_fetched(server, source, tmp_path):
    done, _ = run(source, tmp_path, agree=False)
    assert not done
    assert server.gets() == []
    assert list(tmp_path.iterdir()) == []


def test_exchanged_archive_is_refused(server, source, tmp_path):
    run(source, tmp_path)
    kept = tmp_path / "own/.fetched"
    (kept / "data.zip").unlink()
    (kept / "data.zip.unpacked").unlink()
    server.url("data.zip", zipped(("tree/a.txt", b"evil")))
    with pytest.raises(FetchError, match="another one than at the first download"):
        run(source, tmp_path)
    assert (tmp_path / "own/deep/tree/a.txt").read_bytes() == b"A"
    sums = kept / "SHA256SUMS"  # what the message says to do
    kept_lines = [line for line in sums.read_text().splitlines() if "data.zip" not in line]
    sums.write_text("".join(f"{line}\n" for line in kept_lines))
    assert run(source, tmp_path)[0]
    assert (tmp_path / "own/deep/tree/a.txt").read_bytes() == b"evil"


def test_bad_archive_is_not_trusted(server, source, tmp_path):
    """A sign-in page in place of an archive must not become the first download."""
    server.url("data.zip", b"<!DOCTYPE html>")
    with pytest.raises(FetchError, match=r"or a web page\?.*It came from http://127"):
        run(source, tmp_path)
    assert not (tmp_path / "own/.fetched/data.zip").exists()
    server.url("data.zip", zipped(*GOOD))
    assert run(source, tmp_path)[0]


def test_two_at_once(server, source, tmp_path):
    (tmp_path / "own/.fetched").mkdir(parents=True)
    lock = filelock.FileLock(tmp_path / "own/.fetched/lock")
    with lock, pytest.raises(FetchError, match="another fetch is at work"):
        run(source, tmp_path)
    assert server.gets() == []
    assert run(source, tmp_path)[0]


def test_archive_of_something_else(server, source, tmp_path):
    server.url("data.zip", zipped(("other/a", b"x")))
    with pytest.raises(FetchError, match=r"deep/tree is not there; has .* been published anew\?"):
        run(source, tmp_path)


def test_damaged_file_is_fetched_again(server, source, tmp_path):
    run(source, tmp_path)
    (tmp_path / "own/notes.json").write_bytes(b"{")
    assert run(source, tmp_path)[0]
    assert (tmp_path / "own/notes.json").read_bytes() == b"{}"


def test_steps_are_told(tmp_path, capsys):
    assert cli.main(["fetch", "wild6d", "--to", str(tmp_path)]) == 1
    assert (
        "step 1, by hand: fetch test_set.zip from where https://github.com/OasisYang"
        in capsys.readouterr().out
    )
    assert list(tmp_path.iterdir()) == []


def test_weights_of_a_method():
    pytest.importorskip("torch")
    sgpa = find_source("sgpa")
    assert [file.to for file in sgpa.file] == ["mean_points_emb.npy"]
    (step,) = sgpa.steps
    assert "drive.google.com" in step
    assert "store it as sgpa/real.pth in the folder" in step
    assert "non-commercial" in sgpa.licence
    assert find_source("icp").about == "icp needs no weights"


def test_command(server, source, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pytest_cpas.fetching.command.find_source", lambda name: source)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert cli.main(["fetch", "own", "--to", str(tmp_path)]) == 1
    assert "agree with --yes" in capsys.readouterr().err
    assert cli.main(["fetch", "own", "--to", str(tmp_path), "--yes"]) == 0
    server.url("notes.json", b"{}", status=404)
    (tmp_path / "own/notes.json").unlink()
    assert cli.main(["fetch", "own", "--to", str(tmp_path), "--yes"]) == 1
    assert "error: http://127" in capsys.readouterr().err


def test_unknown_name(capsys, tmp_path):
    assert cli.main(["fetch", "real257", "--to", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "Did you mean 'real275'?" in error
    assert "wild6d" in error


@pytest.mark.parametrize("name", ["real275", "real_train", "camera25", "redwood75", "tod"])
def test_sources_are_complete(name):
    source = find_source(name)
    assert source.licence
    for file in source.file:
        assert bool(file.to) != bool(file.unpack and file.gives)
        assert file.url.startswith(("https://", "http://download.cs.stanford.edu/"))
        assert not {"..", ""} & set((file.to or file.gives).split("/"))
    counts = {"real275": 4, "real_train": 2, "camera25": 3, "redwood75": 31, "tod": 30}
    assert len(source.file) == counts[name]


def test_every_published_data_set_says_how_to_get_it():
    for name, source in published_sources().items():
        text = how_to_get(name)
        assert source.licence in text
        assert "--cpas-data=DIR" in text
        assert (f"pytest-cpas fetch {name} --to DIR" in text) == bool(source.file)
        with pytest.raises(FileNotFoundError) as caught:
            resolve("dataset", name)(None)
        assert text in str(caught.value)
