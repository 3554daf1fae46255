"""`reading` is the only room that opens what others wrote: a scan of all sources, and of what is
planted into them."""

import ast
import re
from collections.abc import Collection, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

#: Functions and methods that read a file, or make something of a file's bytes, by their last name
#: and, where others have that name too, by the name before it.
READERS = {
    "open", "fdopen", "read_text", "read_bytes", "read_1_0", "fromfile", "genfromtxt", "loadtxt",
    "memmap", "fromregex", "DataFile", "load_mesh", "load_scene", "load_path", "loadmat", "mmap",
    "getlines", "file_digest", "unpack_archive", "extractall",
    "json.load", "json.loads", "json.JSONDecoder", "tomllib.load", "tomllib.loads",
    "np.load", "numpy.load", "format.read_array", "torch.load", "jit.load", "trimesh.load",
    "pickle.load", "pickle.loads", "pickle.Unpickler", "marshal.load", "marshal.loads",
    "shelve.open", "joblib.load", "csv.reader", "csv.DictReader", "OpenEXR.File",
    "OpenEXR.InputFile", "zipfile.ZipFile", "tarfile.TarFile", "gzip.GzipFile", "bz2.BZ2File",
    "lzma.LZMAFile", "io.FileIO", "ElementTree.parse", "minidom.parse", "sqlite3.connect",
    "configparser.ConfigParser", "h5py.File", "yaml.load", "yaml.safe_load", "yaml.full_load",
    "yaml.unsafe_load", "runpy.run_path", "io.read_triangle_mesh", "io.read_image",
    "io.read_point_cloud",
}  # fmt: skip

#: Modules that are of no use but to read or write what others read.
MODULES = {
    "pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "tomllib", "yaml",
    "zipfile", "tarfile", "gzip", "bz2", "lzma", "csv", "sqlite3", "xml", "configparser", "mmap",
    "fileinput", "linecache", "h5py", "imageio", "cv2", "tifffile", "trimesh", "OpenEXR",
}  # fmt: skip

#: Where a reader is used outside of `reading`, and why that opens nothing that others wrote.
EXCEPTIONS = {
    # writing, in ways that the scan does not see
    ("pytest_cpas/_files.py", "open"): "a folder, to wait until the disk has its names",
    ("pytest_cpas/fetching/download.py", "open"): "the part that is written, anew or gone on with",
    ("pytest_cpas/golden/texts.py", "import csv"): "writes facts.csv; it is read by reading",
    ("pytest_cpas/report/export.py", "import csv"): "writes the tables of a report",
    ("pytest_cpas/report/_html.py", "import xml"): "builds a page, and parses none",
    ("pytest_cpas/datasets/synthetic.py", "import pickle"): "writes a truth file of the cache",
    (
        "pytest_cpas/submissions/writing.py",
        "import pickle",
    ): "writes NOCS's pickles, and reads none",
    ("pytest_cpas/evaluation/elsewhere.py", "read_text"): "what pip wrote of what is installed",
    ("pytest_cpas/evaluation/results_file.py", "open"): "the file that is written, no link",
    ("pytest_cpas/evaluation/results_file.py", "io.FileIO"): "the type of the file being written",
    # what ships in the wheel
    ("pytest_cpas/new_adapter.py", "read_text"): "the templates that ship with the package",
    ("pytest_cpas/report/page/__init__.py", "read_text"): "style and script of a page, which ship",
    ("method_adapters/_icp_prior.py", "open"): "the prior that ships beside the module",
    ("method_adapters/_icp_prior.py", "numpy.load"): "the prior that ships beside the module",
    ("pytest_cpas/metric_subjects/trimesh.py", "import trimesh"): "its metrics; it is given arrays",
    # the cache that the package writes itself
    ("pytest_cpas/datasets/synthetic.py", "read_text"): "the digest of a data set that it has made",
    ("pytest_cpas/datasets/synthetic.py", "read_bytes"): "its own sources, which name the cache",
    # between processes of one run
    ("pytest_cpas/evaluation/watching.py", "json.loads"): "what the watched process writes to it",
    ("pytest_cpas/evaluation/watching.py", "read_bytes"): "the dump of the watched process",
    ("pytest_cpas/session/time_limit.py", "json.loads"): "a note of a worker of this run",
    ("pytest_cpas/session/time_limit.py", "read_text"): "a note of a worker of this run",
    ("pytest_cpas/session/run_record.py", "import mmap"): "memory shared with the parent, no file",
    ("pytest_cpas/session/holding.py", "json.loads"): "a note of the child of this process",
    ("pytest_cpas/session/holding.py", "read_text"): "a note of the child of this process",
    ("pytest_cpas/session/run_record.py", "mmap"): "memory shared with the parent, no file",
    ("pytest_cpas/remote/worker.py", "io.FileIO"): "the pipe to the parent",
    ("pytest_cpas/remote/worker.py", "json.loads"): "a request of the parent over a pipe",
    (
        "pytest_cpas/evaluation/served_method.py",
        "json.loads",
    ): "a request of the parent over a pipe",
    ("pytest_cpas/evaluation/served_method.py", "numpy.load"): "what the parent has written",
    ("pytest_cpas/traces/proposing.py", "json.loads"): "entries that the same module has made",
    ("pytest_cpas/evaluation/method_process.py", "json.loads"): "a worker's answer over a pipe",
    ("pytest_cpas/golden/snapshot.py", "json.loads"): "what serialize() of the same class has made",
    # of the system, and of the user's own repository
    ("pytest_cpas/remote/reached.py", "read_text"): "/proc: which machine this is",
    ("pytest_cpas/remote/worker.py", "open"): "/proc, and bytes of sources, for their digest",
    ("pytest_cpas/timing/contestant.py", "read_bytes"): "/proc: how long this thread has waited",
    ("pytest_cpas/timing/contestant.py", "read_text"): "/proc: memory, and the driver's version",
    ("pytest_cpas/evaluation/revisions.py", "import tarfile"): "what git archive has just packed",
    ("pytest_cpas/evaluation/revisions.py", "open"): "what git archive has just packed",
    ("pytest_cpas/evaluation/revisions.py", "extractall"): "what git archive has packed, filtered",
}


def is_writing(call: ast.Call, imported: Collection[str]) -> bool:
    """Whether a call opens a file of our own making: its mode says so in plain text.

    ``path.open(mode)`` has it first; ``open(path, mode)``, and that of a module, second.
    """
    function = call.func
    if isinstance(function, ast.Attribute):
        if function.attr not in ("open", "fdopen"):
            return False
        place = 1 if isinstance(function.value, ast.Name) and function.value.id in imported else 0
    else:
        place = 1
    modes = [*call.args[place : place + 1], *(w.value for w in call.keywords if w.arg == "mode")]
    return any(
        isinstance(mode, ast.Constant) and re.fullmatch("[wxa][bt]?", str(mode.value))
        for mode in modes
    )


def uses(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and name of every reader that a module calls, hands on or imports."""
    aliases: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                aliases[alias.asname or alias.name.partition(".")[0]] = alias.name
                if alias.name.partition(".")[0] in MODULES:
                    yield node.lineno, f"import {alias.name.partition('.')[0]}"
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            top = node.module.partition(".")[0]
            if top in MODULES:
                yield node.lineno, f"import {top}"
            for alias in node.names:
                aliases[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    writing = {
        id(n.func) for n in ast.walk(tree) if isinstance(n, ast.Call) and is_writing(n, aliases)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            base = node.value
            before = base.attr if isinstance(base, ast.Attribute) else getattr(base, "id", "")
            before = aliases.get(before, before).rpartition(".")[2]
            names = {node.attr, f"{before}.{node.attr}"}
        elif isinstance(node, ast.Name):
            whole = aliases.get(node.id, node.id)
            if whole.startswith("pytest_cpas."):  # the door's own, or what adapters have of it
                continue
            names = {whole.rpartition(".")[2], ".".join(whole.split(".")[-2:])}
            if isinstance(node.ctx, ast.Store):
                continue
        else:
            continue
        if id(node) not in writing and (found := sorted(names & READERS)):
            yield node.lineno, found[-1]


def found(root: Path) -> dict[tuple[str, str], list[int]]:
    """The lines of every use outside of `reading`, by file and name."""
    lines: dict[tuple[str, str], list[int]] = {}
    for package in ("pytest_cpas", "method_adapters"):
        for path in sorted((root / package).rglob("*.py")):
            name = path.relative_to(root).as_posix()
            if not name.startswith("pytest_cpas/reading/"):
                for line, what in uses(ast.parse(path.read_bytes())):
                    lines.setdefault((name, what), []).append(line)
    return lines


def test_nothing_else_opens_what_others_wrote():
    unknown = {use: lines for use, lines in found(ROOT).items() if use not in EXCEPTIONS}
    assert unknown == {}, "read it through pytest_cpas.reading, or say why it is ours"


def test_no_exception_is_left_over():
    assert set(EXCEPTIONS) - set(found(ROOT)) == set()
    assert all(len(reason) > 20 for reason in EXCEPTIONS.values())


@pytest.mark.parametrize(
    "line",
    [
        "open('x')",
        "open('x', 'rb')",
        "open('x', mode='r+')",
        "import io\nio.open('x')",
        "import os\nos.open('x', os.O_RDONLY)",
        "import os\nos.fdopen(3)",
        "from pathlib import Path\nPath('x').open()",
        "from pathlib import Path\nPath('x').read_text()",
        "from pathlib import Path\nread = Path.read_bytes",
        "import numpy as np\nnp.load('x')",
        "from numpy import load\nload('x')",
        "from numpy import load as get\nget('x')",
        "import numpy\nnumpy.fromfile('x')",
        "import numpy as np\nnp.genfromtxt('x')",
        "import numpy as np\nnp.loadtxt('x')",
        "import pickle",
        "from pickle import loads",
        "import torch\ntorch.load('x')",
        "from torch import load\nload('x')",
        "import json\njson.load(3)",
        "import json as j\nj.loads('x')",
        "from json import loads\nloads('x')",
        "import tomllib",
        "def late():\n    import yaml",
        "from PIL import Image\nImage.open('x')",
        "import zipfile",
        "import tarfile",
        "import gzip",
        "from csv import reader",
        "import trimesh",
        "from shutil import unpack_archive\nunpack_archive('x')",
        "import sqlite3",
        "import xml.etree.ElementTree as et",
    ],
)
def test_planted_reader_is_found(line, tmp_path):
    for room in ("pytest_cpas/metrics", "method_adapters", "pytest_cpas/reading"):
        (tmp_path / room).mkdir(parents=True)
        (tmp_path / room / "mine.py").write_text(f"{line}\n")
    assert {name for name, _ in found(tmp_path)} == {
        "pytest_cpas/metrics/mine.py",
        "method_adapters/mine.py",
    }


@pytest.mark.parametrize(
    "line",
    [
        "open('x', 'w')",
        "from pathlib import Path\nPath('x').open('xb', buffering=0)",
        "from pytest_cpas.reading.files import opened, read_text\nread_text(opened)",
        "import json\njson.dumps({})",
        "import numpy as np\nnp.save('x', 1)",
        "opened = 3",
    ],
)
def test_writing_and_the_door_are_let_through(line):
    assert list(uses(ast.parse(line))) == []
