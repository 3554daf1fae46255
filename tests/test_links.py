"""Nothing is written through a link below the folder that was named, whichever of its parts is one;
the folder itself may be one."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tables import CPAS, GOLDEN, a_run, rows, table

from pytest_cpas._files import check_no_link
from pytest_cpas.checks.known import KnownFailure, record_known
from pytest_cpas.evaluation.bop_export import export_bop
from pytest_cpas.evaluation.results import Shard
from pytest_cpas.evaluation.results_file import ResultsFile
from pytest_cpas.golden import GoldenError, find_golden, read_golden, record
from pytest_cpas.golden.waiting import put
from pytest_cpas.report.document import document
from pytest_cpas.report.files import write_report
from pytest_cpas.timing.intervals import Interval
from pytest_cpas.timing.records import SpeedRecord, record_path, write_record


def golden(folder: Path) -> None:
    record(folder, table(s_03=9 if (folder / "recorded").exists() else 4))


def results(folder: Path) -> None:
    with ResultsFile(folder, a_run(), Shard(1, 1)) as file:
        file.add(rows()[0])


def report(folder: Path) -> None:
    write_report(document([], 0, CPAS), folder, {})


def speed(folder: Path) -> None:
    made = SpeedRecord({"data": "d"}, {}, {"scene_0/0000": 1.5}, Interval(1.0, 0.9, 1.1, 0.99))
    path = record_path(folder, "m", "d", {"cpu": "A CPU", "device": "cpu"})
    write_record(folder, path, made)


def known(folder: Path) -> None:
    cell = KnownFailure(check="box_iou.touching", reason="seen", case="{}")
    record_known(folder, "mine", [cell])


def bop(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    data = folder.with_name(f"{folder.name}-bop")
    for part in ("test/000001", "models_eval"):
        (data / part).mkdir(parents=True, exist_ok=True)
    (data / "models_eval/models_info.json").write_text("{}")
    run = a_run()
    run.dataset = "bop-mine"
    with (file := ResultsFile(data, run, Shard(1, 1))):
        pass
    export_bop(file.path, data, folder / "mine.csv")


WRITERS: dict[str, Callable[[Path], None]] = {
    writer.__name__: writer for writer in (golden, results, report, speed, known, bop)
}


def parts(writer: str, folder: Path) -> Iterator[Path]:
    """Whatever a writer makes below the folder that it is given."""
    WRITERS[writer](folder)
    yield from sorted(path.relative_to(folder) for path in folder.rglob("*"))


def written(folder: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("target", ["there", "dangling"])
@pytest.mark.parametrize("writer", WRITERS)
def test_nothing_is_written_through_a_link(writer, target, tmp_path):
    outside = tmp_path / "outside"
    for number, part in enumerate(parts(writer, tmp_path / "whole")):
        folder = tmp_path / str(number)
        WRITERS[writer](folder)
        place = folder / part
        aside = outside / f"{number}-{part.name}"
        aside.parent.mkdir(exist_ok=True)
        place.rename(aside)
        if target == "dangling":
            aside.rename(tmp_path / f"away-{number}")
        elif writer == "results":
            aside.write_bytes(b"0123456789abcdef")  # as the beginning of a header
        place.symlink_to(aside)
        before = written(outside)
        if part.name == ".gitattributes" and target == "there":
            WRITERS[writer](folder)  # it is not written again
        else:
            told = r"is a link to .* below .*; remove it|is missing"
            with pytest.raises(Exception, match=told) as raised:
                WRITERS[writer](folder)
            assert type(raised.value).__name__ in OWN
            assert place.name in str(raised.value)
        assert written(outside) == before


OWN = ("GoldenError", "ResultsError", "LinkError", "RecordError")


@pytest.mark.parametrize("writer", WRITERS)
def test_the_named_folder_may_be_a_link(writer, tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    WRITERS[writer](tmp_path / "link")
    assert list((tmp_path / "real").iterdir())


def test_results_file_that_becomes_a_link_is_not_followed(tmp_path):
    file = ResultsFile(tmp_path, a_run(), Shard(1, 1))
    (tmp_path / "victim").write_bytes(b"")
    file.path.symlink_to(tmp_path / "victim")
    with pytest.raises(Exception, match="cannot be written"), file:
        pass
    assert (tmp_path / "victim").read_bytes() == b""


def test_link_above_the_folder_is_none_of_its_parts(tmp_path):
    check_no_link(tmp_path, tmp_path / "a" / "b")
    with pytest.raises(ValueError, match="subpath"):
        check_no_link(tmp_path / "a", tmp_path / "b")


#: What somebody else may keep in the folder of a table.
FOREIGN = {
    ".notes.part": b"a person's",
    ".run.part": b"",
    ".waiting-x-y": b"z",
    f".waiting-{'0' * 32}-{'1' * 32}-facts.csv": b"not what its name tells",
    f".waiting-{'0' * 64}-facts.csv": b"of another version",
    f".waiting-{'0' * 32}-{'1' * 32}-..": b"no name of ours",
    "samples.csv": b"no table of an older form",
    "table.toml": b"format = 2\nsamples_sha256 = 'of another file'\n",
}


def test_nobody_removes_what_no_update_has_written(tmp_path):
    folder = record(tmp_path, GOLDEN)
    (folder / ".waiting-folder").mkdir()
    for name, content in FOREIGN.items():
        (folder / name).write_bytes(content)
    before = written(folder)
    assert find_golden(tmp_path, "m", "d") == read_golden(folder) == GOLDEN
    assert written(folder) == before
    new = table(s_03=9)
    record(tmp_path, new)
    assert read_golden(folder) == new
    after = written(folder)
    assert {path: after.get(path) for path in before if Path(path).name in FOREIGN} == {
        str(folder / name): content for name, content in FOREIGN.items()
    }
    assert after.keys() == before.keys()


def test_what_is_in_the_way_of_an_update_is_not_overwritten(tmp_path):
    path = put(tmp_path, "0" * 32, "facts.csv", b"whole")
    path.write_bytes(b"who")  # half of it was on the disk when the writer died
    assert put(tmp_path, "0" * 32, "facts.csv", b"whole").read_bytes() == b"whole"
    path.write_bytes(b"other")
    with pytest.raises(GoldenError, match="no update has written it; remove it"):
        put(tmp_path, "0" * 32, "facts.csv", b"whole")
    path.unlink()
    path.symlink_to(tmp_path / "away")
    with pytest.raises(GoldenError, match="no update has written it; remove it"):
        put(tmp_path, "0" * 32, "facts.csv", b"whole")
    assert not (tmp_path / "away").exists()
