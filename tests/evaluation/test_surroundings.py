"""What a method reaches without an import is part of its program, and is named when it changed."""

import importlib
import os
import sys
from pathlib import Path

import pytest
import tiny

from pytest_cpas.evaluation import MethodRun, ResultsFile, Shard, surroundings
from pytest_cpas.evaluation.program import program_of

#: How a method gets at an angle that a file has, by what that file is called; no import tells of
#: it, and none of the names is in the method's text.
WAYS = {
    "exec": ("net/model.py", "exec(Path(at).read_text(), found)"),
    "runpy": ("net/model.py", "found |= runpy.run_path(at)"),
    "process": (
        "net/model.py",
        "exec(subprocess.run([sys.executable, '-c', 'import sys; print(open(sys.argv[1]).read())',"
        " at], capture_output=True, text=True).stdout, found)",
    ),
    "a file's path": (
        "net/model.py",
        "spec = importlib.util.spec_from_file_location('m', at)\n"
        "module = importlib.util.module_from_spec(spec); spec.loader.exec_module(module)\n"
        "found |= vars(module)",
    ),
    "sys.path": (
        "net/a_model.py",
        "sys.path.insert(0, str(Path(at).parent))\n"
        "found |= vars(importlib.import_module(Path(at).stem))\n"
        "sys.modules.pop(Path(at).stem); del sys.path[0]; sys.dont_write_bytecode = True",
    ),
    "settings": ("config/run.yaml", "exec(Path(at).read_text(), found)"),
    "a table": ("config/run.json", "exec(Path(at).read_text(), found)"),
    "a library": ("lib/ops.so", "exec(Path(at).read_text(), found)"),
    "an archive": ("lib/ops.zip", "exec(Path(at).read_text(), found)"),
}

METHOD = """
import importlib.util, os, runpy, subprocess, sys
from pathlib import Path
from tiny import *

class Mine(Perfect):
    def load(self, assets, device):
        super().load(assets, device)
        at, found = os.environ["AT"], {{}}
{how}
        self.angle = found["angle"]

    def predict(self, batch, seed):
        if self.angle:
            return [Prediction.failed("turned") for _ in batch]
        return super().predict(batch, seed)
"""


@pytest.fixture
def project(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(surroundings, "_left_out", set())
    (tmp_path / "setup.py").write_text("")
    surroundings._everybodys.cache_clear()  # of the home of a run in this process
    return tmp_path


def a_run(project: Path, text: str = "import tiny\nclass Mine(tiny.Perfect): pass\n") -> MethodRun:
    at = project / "adapters" / "mine.py"
    at.parent.mkdir(exist_ok=True)
    at.write_text(text)
    sys.modules.pop("adapters.mine", None)
    sys.modules.pop("adapters", None)
    importlib.invalidate_caches()
    program_of.cache_clear()
    return MethodRun(importlib.import_module("adapters.mine").Mine(), tiny.Tiny(None))


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize("way", WAYS)
def test_rows_are_not_reused_when_a_file_that_is_reached_changed(project, monkeypatch, way):
    name, how = WAYS[way]
    text = METHOD.format(how="\n".join(f"        {line}" for line in how.splitlines()))
    monkeypatch.setenv("AT", str(project / name))
    failures = []
    for angle, kept in ((0, 0), (0, 1), (1, 0)):
        write(project / name, f"angle = {angle}\n")
        run = a_run(project, text)
        file = ResultsFile(project / "out", run, Shard(1, 1))
        assert len(file.rows) == kept
        with file:
            if not kept:
                row = run.judge(run.samples[0])
                failures.append(row.answers[0].failure)
                file.add(row)
    assert failures == [None, "turned"]
    assert str(file.set_aside) == f"not reused 1 of another program (changed: {name})"


#: Files below a project, and whether they may be part of a method.
COUNTS = {
    "adapters/other.py": True,
    "third_party/net/model.py": True,
    "model.py": True,
    "lib/libops.so.1.2": True,
    "weights/model.pt": True,
    "priors/mean.ply": True,
    "priors/mean.csv": True,
    "priors/mean.json.gz": True,
    "priors/mean.png": True,
    "scripts/tool": True,
    "modefile": True,
    "mean.txt": True,
    "third_party/tests/model.py": False,
    "tests/model.py": False,
    "docs/conf.py": False,
    "adapters/test_mine.py": False,
    "conftest.py": False,
    "pyproject.toml": False,
    "adapters/mine.known.toml": False,
    "README.md": False,
    "log.txt": False,
    "results/mine.jsonl": False,
    ".hidden/model.py": False,
    "adapters/__pycache__/mine.cpython-312.pyc": False,
    "lib/python3.12/site-packages/model.py": False,
    "named/tests/model.py": False,
}


def test_what_counts_and_what_does_not(project):
    seen = []
    for content in (None, "1", "2"):
        for name in COUNTS if content else ():
            write(project / name, content)
        seen.append(a_run(project).files)
    for name, counts in COUNTS.items():
        told = [files.get(name) for files in seen]
        assert len(set(told)) == (3 if counts else 1), (name, told)
    counted = sorted(name for name, counts in COUNTS.items() if counts)
    said = ["; ".join(surroundings.changes(*pair)) for pair in (seen[:2], seen[1:], seen[1::-1])]
    first = f"{', '.join(counted[:3])} and {len(counted) - 3} more"
    assert said == [f"new: {first}", f"changed: {first}", f"gone: {first}"]


def test_what_this_plugin_wrote_does_not_count(project):
    for folder, *beside in (
        ("report", "report.html", "report.json"),
        ("golden/m/d", "run.toml", "facts.csv"),
        ("older/m/d", "table.toml", "samples.csv"),
        ("env", "pyvenv.cfg"),
        ("lookalike", "report.json"),
    ):
        for name in (*beside, "model.py"):
            write(project / folder / name, "")
    names = [name for name in a_run(project).files if name.endswith("/model.py")]
    assert names == ["lookalike/model.py"]


def test_folders_of_data_and_weights_do_not_count(project):
    write(project / "data" / "poses.json", "1")
    assert "data/poses.json" in a_run(project).files
    surroundings.leave_out([project / "data"])
    assert "data/poses.json" not in a_run(project).files


@pytest.mark.parametrize("text", ["'tests'", "'../tests/model.py'"])
def test_a_folder_of_tests_that_is_named_counts(project, text):
    write(project / "tests" / "model.py", "1")
    method = f"import tiny\nclass Mine(tiny.Perfect): at = {text}\n"
    assert "tests/model.py" in a_run(project, method).files


@pytest.mark.parametrize("named", ["file", "folder"])
def test_what_is_named_elsewhere_counts(project, tmp_path_factory, named):
    other = tmp_path_factory.mktemp("elsewhere")
    write(other / "model.py", "1")
    at = other / "model.py" if named == "file" else other
    method = f"import tiny\nclass Mine(tiny.Perfect): at = {str(at)!r}\n"
    before = a_run(project, method).files
    write(other / "model.py", "2")
    after = a_run(project, method).files
    assert "model.py" in "; ".join(surroundings.changes(before, after))


@pytest.mark.parametrize("name", ["code.txt", "mode", "m/mode.csv"])
def test_a_file_of_any_name_that_is_named_elsewhere_counts(project, tmp_path_factory, name):
    other = tmp_path_factory.mktemp("elsewhere")
    at = other if "/" in name else other / name
    method = f"import tiny\nclass Mine(tiny.Perfect): at = {str(at)!r}\n"
    seen = []
    for content in ("1", "2"):
        write(other / name, content)
        seen.append(a_run(project, method).files)
    assert name in "; ".join(surroundings.changes(*seen))


def test_tables_take_no_place_from_code(project, monkeypatch):
    monkeypatch.setattr(surroundings, "_MOST_FILES", 10)
    for index in range(40):
        write(project / "near" / f"{index}.png", "")
    write(project / "far" / "away" / "model.py", "")
    names = a_run(project).files
    assert "far/away/model.py" in names
    assert sum(name.endswith(".png") for name in names) == 10


def test_the_whole_repository_counts(project):
    """An adapter may have a project of its own inside the repository of the method."""
    (project.parent / ".git").mkdir(exist_ok=True)
    try:
        write(project.parent / "sgpa" / "model.py", "1")
        files = a_run(project).files
    finally:
        (project.parent / ".git").rmdir()
    assert "sgpa/model.py" in files
    assert f"{project.name}/adapters/mine.py" in files


def test_installed_methods_count_with_all_that_was_installed(project, monkeypatch):
    site = project / "site-packages"
    files = ("mine_dist/__init__.py", "mine_dist/data.yaml", "mine_ops.so", "mine_dist/log.txt")
    for name in files:
        write(site / name, "one")
    write(site / "mine_dist/__init__.py", "import tiny\nclass Mine(tiny.Perfect): pass\n")
    write(site / "other.py", "")
    info = site / "mine_dist-1.dist-info"
    write(info / "METADATA", "Metadata-Version: 2.1\nName: mine-dist\nVersion: 1\n")
    write(info / "RECORD", "".join(f"{name},,\n" for name in files))
    monkeypatch.syspath_prepend(site)
    importlib.invalidate_caches()
    program_of.cache_clear()
    from pytest_cpas.evaluation import program

    program._distributions.cache_clear()
    try:
        method = importlib.import_module("mine_dist").Mine
        seen = program_of(method).files
    finally:
        program._distributions.cache_clear()
        sys.modules.pop("mine_dist")
    assert {name for name in seen if "mine" in name} == set(files[:3])
    assert "other.py" not in seen


def test_looking_ends(project, monkeypatch):
    """The nearest files are looked at first, however many there are."""
    monkeypatch.setattr(surroundings, "_MOST_ENTRIES", 30)
    for index in range(40):
        write(project / "deep" / "er" / f"x{index:02d}.py", "")
        write(project / "deep" / "er" / "still" / f"x{index:02d}.py", "")
    write(project / "near" / "model.py", "")
    files = a_run(project).files
    assert "near/model.py" in files
    assert "deep/er/x39.py" in files
    assert not [name for name in files if "still" in name]


def test_a_large_file_is_known_by_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr(surroundings, "WHOLE", 2**10)
    monkeypatch.setattr(surroundings, "_PIECE", 2**4)
    path = tmp_path / "model.pt"
    content = bytearray(2**12)
    seen = set()
    for at in (0, 2**11 + 28, 2**12 - 1):
        content[at] = 1
        path.write_bytes(content)
        seen.add(surroundings.digests_of({path: "model.pt"})[path])
    assert len(seen) == 3
    monkeypatch.setattr(surroundings, "_ALL", 0)
    assert surroundings.digests_of({path: "model.pt"}) == {path: "4096 bytes"}


@pytest.mark.parametrize("change", ["where it leads to", "what is there", "nothing"])
def test_a_link_to_a_folder_counts(project, tmp_path_factory, change):
    """Of what it leads to, code and settings; a link back up is no endless tree."""
    first, second = (tmp_path_factory.mktemp(name) for name in ("first", "second"))
    for folder in (first, second):
        write(folder / "deep/angle.yaml", "0")
        write(folder / "0001.png", folder.name)
    os.symlink(first, project / "latest")
    os.symlink(project, first / "deep/back")
    before = a_run(project).files
    if change == "what is there":
        write(first / "deep/angle.yaml", "7")
    elif change == "where it leads to":
        (project / "latest").unlink()
        os.symlink(second, project / "latest")
    else:
        write(first / "0001.png", "another image")
    told = {"what is there": "latest/deep/angle.yaml", "where it leads to": "latest"}.get(change)
    assert [*surroundings.changed_names(before, a_run(project).files)] == [told] * bool(told)


def test_a_link_that_is_left_out_is_not_looked_into(project, tmp_path_factory):
    data = tmp_path_factory.mktemp("data")
    write(data / "scene.json", "0")
    os.symlink(data, project / "data")
    surroundings.leave_out([data])
    before = a_run(project).files
    write(data / "scene.json", "7")
    assert a_run(project).files == before


JOINED = {
    "os.path": "os.path.join(os.path.dirname(__file__), '..', '..', 'third')",
    "pathlib": "str(Path(__file__).resolve().parent.parent.parent / 'third')",
    "deep": "os.path.join(os.path.dirname(__file__), '../../third')",
    "home": "os.path.dirname(__file__) + '/third'",
}


@pytest.mark.parametrize("how", JOINED)
def test_what_a_folder_on_the_path_would_have(project, tmp_path_factory, how):
    """Research code puts a checkout beside its own on the path, in ``load``."""
    other = project / ("adapters/third" if how == "home" else "third")
    if how != "home":
        other = project.parent / "third"
        other.mkdir(exist_ok=True)
    text = f"""
import os, sys
from pathlib import Path
import tiny

class Mine(tiny.Perfect):
    def load(self, assets, device):
        sys.path.insert(0, {JOINED[how]})
        import elsewhere_net
"""
    seen = []
    for angle in (0, 7):
        write(other / "elsewhere_net.py", "import elsewhere_part")
        write(other / "elsewhere_part.py", f"angle = {angle}")
        seen.append(a_run(project, text).provenance["code"])
        assert not [name for name in sys.modules if name.startswith("elsewhere_")]
    assert seen[0] != seen[1]


@pytest.mark.parametrize("folder", ["/proc", "/proc/self", "/sys", "/dev"])
def test_what_the_system_makes_is_not_looked_into(tmp_path, folder):
    found = surroundings.files_around(
        {tmp_path / "m.py": "m"}, {tmp_path / "m.py": {folder}}, (), tmp_path
    )
    assert not [path for path in found if path.is_relative_to(folder)]
