"""``pytest-cpas golden diff``: what the tables of two revisions differ in, with a real git."""

import os
import shutil
import subprocess
import sys

import pytest
from older_tables import record_older
from tables import GOLDEN, table

from pytest_cpas.cli import main
from pytest_cpas.golden import GoldenError, golden_diff, record, revisions


def git(folder, *arguments) -> None:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def repository(tmp_path):
    git(tmp_path, "init", "-q")
    record(tmp_path / "golden", GOLDEN)
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "one")
    return tmp_path


def test_no_difference(repository, capsys, monkeypatch):
    monkeypatch.chdir(repository)
    assert main(["golden", "diff"]) == 0
    assert capsys.readouterr().out == "golden: no table differs from HEAD\n"
    assert main(["golden", "diff", "--golden=nowhere"]) == 2
    assert "nowhere: no such folder" in capsys.readouterr().err


def test_flips_are_named(repository, capsys, monkeypatch):
    record(repository / "golden", table(s_03=9))
    monkeypatch.chdir(repository)
    assert main(["golden", "diff"]) == 1
    told = capsys.readouterr().out
    assert "m/d: REGRESSED mug: 5 deg, 1 cm: 5 -> 4 of 5 correct" in told
    assert "s/03" in told
    git(repository, "commit", "-qam", "two")
    assert main(["golden", "diff"]) == 0
    assert main(["golden", "diff", "HEAD~1"]) == 1


def test_tables_that_came_and_went(repository):
    (repository / "golden" / "recorded" / "m" / "d").rename(
        repository / "golden" / "recorded" / "m" / "e"
    )
    assert list(golden_diff(repository / "golden", "HEAD")) == [
        "m/d: there is none any more",
        "m/e: there was none in HEAD",
    ]


def test_a_table_of_the_older_form_is_read_from_the_revision(tmp_path):
    git(tmp_path, "init", "-q")
    record_older(tmp_path / "golden", GOLDEN)
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "one")
    record(tmp_path / "golden", table(s_03=9))
    (line,) = golden_diff(tmp_path / "golden", "HEAD")
    assert line.startswith("m/d: REGRESSED mug: ")


@pytest.mark.parametrize("revision", ["nothing", "--help", "-x", "HEAD~9", ""])
def test_what_is_no_revision_is_told(repository, revision):
    with pytest.raises(GoldenError, match="a revision such as HEAD~1"):
        list(golden_diff(repository / "golden", revision))


def test_what_is_not_under_version_control_is_told(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    record(tmp_path / "golden", GOLDEN)
    assert main(["golden", "diff", "--golden", str(tmp_path / "golden")]) == 2
    assert "under version control" in capsys.readouterr().err
    assert main(["golden", "diff", "--golden", str(tmp_path / "none")]) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere names of files are text")
def test_names_that_are_no_text(repository):
    golden = repository / "golden"
    recorded = os.fsencode(golden / "recorded")
    shutil.copytree(recorded + b"/m", recorded + b"/\xff\n::error::")
    told = "\\udcff\\n::error::/d: there "
    assert list(golden_diff(golden, "HEAD")) == [f"{told}was none in HEAD"]
    git(repository, "add", ".")
    git(repository, "commit", "-qm", "two")
    assert list(golden_diff(golden, "HEAD")) == []
    shutil.rmtree(recorded + b"/\xff\n::error::")
    assert list(golden_diff(golden, "HEAD")) == [f"{told}is none any more"]


def test_what_is_no_table_is_not_missed(repository):
    for name in ("x", "m/x", "m/d/more/run.toml", "m/e/notes.txt"):
        path = repository / "golden" / "recorded" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("x")
    git(repository, "add", ".")
    git(repository, "commit", "-qm", "two")
    assert list(golden_diff(repository / "golden", "HEAD")) == []


DAMAGE = {
    "large": (b"#" * 5000, r"facts\.csv: 5000 bytes, at most 4096 are read"),
    "no text": (b"\xff", r"facts\.csv, line 1: not text in UTF-8"),
    "no table": (b"a,b\n", r"facts\.csv: expected category"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_table_of_a_revision_is_named(repository, damage, monkeypatch):
    content, words = DAMAGE[damage]
    path = repository / "golden/recorded/m/d/facts.csv"
    sound = path.read_bytes()
    path.write_bytes(content)
    git(repository, "commit", "-qam", "two")
    path.write_bytes(sound)
    monkeypatch.setattr(revisions, "LARGEST", 4096)
    with pytest.raises(GoldenError, match=f"HEAD:recorded/m/d: {words}"):
        list(golden_diff(repository / "golden", "HEAD"))
