"""Show every difference between what two revisions print and write.

    python tools/compare_revisions OLD NEW [--data DIR] [--only CASE ...] [--keep DIR]

OLD and NEW are each a git revision, a checkout, or the folder ``old`` or ``new`` below one that
``--keep`` filled, which is not run again. The cases of ``cases.py`` are run with OLD, then with
NEW, each copied to the same place below the folder of temporary files, with a cache of its own and
the interpreter of this script: paths and versions come out alike and are not masked. What is, see
``MASKS`` and ``in_order``. The exit code is 1 if anything differs. One comparison at a time, about
five minutes per revision.
"""

from __future__ import annotations

import argparse
import difflib
import hashlib
import itertools
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

from cases import ADAPTERS, CASES

ROOT = Path(__file__).parents[2]
PLACE = Path(tempfile.gettempdir()) / "compare_revisions"
CHECKOUT, RUNS = PLACE / "checkout", PLACE / "runs"
DATA, CACHE = PLACE / "data", PLACE / "cache"
SHOWN = 40  # lines of a difference

#: In files of this name: what differs from run to run, and what stands there instead.
MASKS = tuple(
    (re.compile(name), re.compile(pattern, re.MULTILINE), mask)
    for name, pattern, mask in (
        # how long it took; pytest fills that line up with "="
        (r"\.txt$", r"^=* ?(\d.*) in \d+\.\d+s(?: \(\d+:\d\d:\d\d\))? ?=*$", r"\1 in TIME"),
        (r"\.xml$", r' time="\d+\.\d+"', ' time="TIME"'),
        (r"^matrix\.json$", r'"seconds": [\d.e-]+,$', '"seconds": TIME,'),
        # when and where
        (r"\.xml$", r' timestamp="[^"]+"', ' timestamp="TIME"'),
        (r"\.xml$", r' hostname="[^"]+"', ' hostname="HOST"'),
        # pytest-benchmark's defaults, in pytest --help
        (r"\.txt$", r"\b(benchmark|counter_unversioned)_\d{8}_\d{6}", r"\1_TIME"),
        # where in the plugin's source a skip or an error comes from
        (r"\.(txt|xml)$", rf"{CHECKOUT}/[\w/]+\.py:\d+", "SOURCE:LINE"),
        (r"\.(txt|xml)$", r"\bpytest_cpas\.[\w.]+\.(?=[A-Z]\w*Error\b)", ""),
    )
)

#: The letters by which pytest tells how it goes, and how far it is.
PROGRESS = re.compile(r"^([.FEsxX]+)(?: *\[ *\d+%\]([.FEsxX]*))?\n", re.MULTILINE)


def main() -> int:
    """Run what is to be run, and compare."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("old", metavar="OLD", help="revision, checkout or kept outputs")
    parser.add_argument("new", metavar="NEW", help="likewise")
    parser.add_argument("--data", type=Path, metavar="DIR", help="real data, for the cases with it")
    parser.add_argument("--only", nargs="+", choices=CASES, metavar="CASE", default=list(CASES))
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep all outputs in DIR")
    options = parser.parse_args()
    if options.data and not options.data.is_dir():
        parser.error(f"--data {options.data}: there is no such folder")
    cases = []
    for case in options.only:
        if options.data is None and "DATA" in " ".join(CASES[case]):
            print(f"{case}: left out, it needs --data")
        else:
            cases.append(case)
    try:
        PLACE.mkdir()
    except FileExistsError:
        sys.exit(f"{PLACE}: another run is there; if it was killed, remove the folder")
    try:
        if options.data:
            DATA.symlink_to(options.data.resolve())
        keep = (options.keep or PLACE / "kept").resolve()
        old = outputs(options.old, keep / "old", cases)
        new = outputs(options.new, keep / "new", cases)
        different = sum([differences(case, old / case, new / case) for case in cases])
    finally:
        shutil.rmtree(PLACE)
    print(f"{different} files differ" if different else "everything is identical")
    return 1 if different else 0


def outputs(revision: str, folder: Path, cases: Sequence[str]) -> Path:
    """The outputs of a revision: those that are kept, or new ones in ``folder``."""
    given = Path(revision)
    if given.is_dir() and not (given / "pyproject.toml").exists():
        return given
    check_out(revision)
    for case in cases:
        start = time.monotonic()
        run(case)
        shutil.rmtree(folder / case, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        shutil.move(RUNS / case, folder)
        print(f"{revision}: {case} took {time.monotonic() - start:.0f} s", flush=True)
    return folder


def check_out(revision: str) -> None:
    """Put a revision into ``CHECKOUT``, with what an installation would add."""
    for folder in (CHECKOUT, RUNS, CACHE):
        shutil.rmtree(folder, ignore_errors=True)
    if Path(revision).is_dir():
        unused = shutil.ignore_patterns(".*", "__pycache__")
        shutil.copytree(revision, CHECKOUT, ignore=unused)
    else:
        archive = PLACE / "revision.zip"
        git = ("git", "-C", ROOT, "archive", f"--output={archive}", revision)
        if subprocess.run(git).returncode:
            sys.exit(f"{revision}: neither a revision nor a folder")
        shutil.unpack_archive(archive, CHECKOUT)
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text("utf-8"))["project"]
    info = CHECKOUT / f"pytest_cpas-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Name: pytest-cpas\nVersion: {project['version']}\n")
    lines = []
    for group, entries in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    (info / "entry_points.txt").write_text("\n".join(lines))
    module, _, function = project["scripts"]["pytest-cpas"].partition(":")
    text = f"import sys\nfrom {module} import {function}\nsys.exit({function}())\n"
    (CHECKOUT / "pytest-cpas").write_text(text)
    where = (sys.executable, "-c", "import pytest_cpas; print(pytest_cpas.__file__)")
    found = subprocess.run(where, env=environment(), cwd=PLACE, stdout=subprocess.PIPE, text=True)
    if not found.stdout.startswith(f"{CHECKOUT}/"):
        sys.exit(f"{revision}: pytest_cpas is imported from {found.stdout.strip() or 'nowhere'}")


def environment() -> dict[str, str]:
    """The environment of all commands: the checkout's modules, and nothing of the user's."""
    ours = ("CPAS_", "PYTEST_", "PYTHON", "CI", "BUILD_NUMBER")
    users = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    terminal = {"COLUMNS": "160", "NO_COLOR": "1"}
    return users | threads | terminal | {"PYTHONPATH": str(CHECKOUT), "CPAS_CACHE": str(CACHE)}


def run(case: str) -> None:
    """Run the commands of a case; what each prints and its exit code go to a file."""
    here = RUNS / case
    here.mkdir(parents=True)
    (here / "adapters.py").write_text(ADAPTERS)
    (here / "pytest.ini").write_text(
        f"[pytest]\naddopts = -p no:dash -p no:cacheprovider\ncpas_golden = {CHECKOUT}/golden\n"
    )
    programs = {
        "pytest": [str(Path(sys.executable).with_name("pytest"))],
        "pytest-cpas": [sys.executable, str(CHECKOUT / "pytest-cpas")],
    }
    for number, command in enumerate(CASES[case], 1):
        first, *rest = shlex.split(command.replace("DATA", str(DATA)))
        done = subprocess.run(
            [*programs.get(first, [first]), *rest],
            cwd=here,
            env=environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        parts = (f"$ {command}\n".encode(), done.stdout, f"exit code {done.returncode}\n".encode())
        (here / f"terminal-{number}.txt").write_bytes(b"".join(parts))


def differences(case: str, old: Path, new: Path) -> int:
    """Print which files of a case are identical, and how the others differ; count these."""
    if not old.is_dir() or not new.is_dir():
        print(f"{case}: no outputs in {new if old.is_dir() else old}")
        return 1
    files = {
        str(path.relative_to(folder))
        for folder in (old, new)
        for path in folder.rglob("*")
        if path.is_file() and not {"__pycache__", ".hypothesis"} & set(path.parts)
    }
    different = 0
    for name in sorted(files):
        before, after = (comparable(case, folder / name) for folder in (old, new))
        different += before != after
        print(f"{case}/{name}: {'identical' if before == after else 'DIFFERENT'}")
        if before != after:
            print(*(f"    {line[:300]}" for line in diff(before, after)), sep="\n")
    return different


def comparable(case: str, path: Path) -> str:
    """The text of a file without what differs from run to run."""
    if not path.exists():
        return "(there is no such file)"
    content = path.read_bytes()
    try:
        text = content.decode()
    except UnicodeDecodeError:
        return f"(no text; SHA-256 {hashlib.sha256(content).hexdigest()})"
    for name, pattern, mask in MASKS:
        if name.search(path.name):
            text = pattern.sub(mask, text)
    if any(" -n " in command for command in CASES[case]):
        text = in_order(path.suffix, text)
    return text


def diff(before: str, after: str) -> Iterator[str]:
    """The first lines of a unified diff."""
    old, new = short_lines(before), short_lines(after)
    pairs = enumerate(zip(old, new, strict=False))
    start = next((i for i, (a, b) in pairs if a != b), min(len(old), len(new)))
    near = slice(max(start - 3, 0), start + 500)  # difflib takes minutes for a large report
    lines = difflib.unified_diff(old[near], new[near], "OLD", "NEW", lineterm="")
    return itertools.islice(lines, SHOWN)


def short_lines(text: str) -> list[str]:
    """The lines; those of pages and JUnit are broken where one would."""
    lines = text.splitlines()
    broken = (re.split(r"(?<=[>,])", line) if len(line) > 300 else [line] for line in lines)
    return list(itertools.chain.from_iterable(broken))


def in_order(suffix: str, text: str) -> str:
    """The text with what the workers do in any order sorted."""
    if suffix == ".jsonl":
        return "".join(sorted(text.splitlines(keepends=True)))
    if suffix == ".xml":
        return "".join(sorted(re.split(r"(?=<testcase |</testsuite>)", text)))
    if suffix == ".txt":
        letters = sorted("".join(map("".join, PROGRESS.findall(text))))
        return PROGRESS.sub("", text) + "".join(letters)
    return text


if __name__ == "__main__":
    sys.exit(main())
