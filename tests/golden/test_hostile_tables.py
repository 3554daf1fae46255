"""Golden tables of strangers: what no run can give is refused, with every digest recomputed."""

import hashlib
import re
from dataclasses import replace

import pytest
from tables import GOLDEN, table

from pytest_cpas.golden import GoldenError, find_golden, record
from pytest_cpas.golden.older import parse_older
from pytest_cpas.golden.parsing import parse_table
from pytest_cpas.golden.texts import table_texts
from pytest_cpas.protocols import RankedDetection, Ranking, ranking_columns, shipped_protocol

NOCS = shipped_protocol("nocs")
COLUMNS = len(ranking_columns([NOCS]))


def ranked(counted: int = 5, right: int = 5, score: float = 0.5, category: str = "can"):
    """A table with detections, of which so many are right of so many objects."""
    made = {
        f"f/{i}": RankedDetection(category, score, "1" * COLUMNS if i < right else "0" * COLUMNS)
        for i in range(6)
    }
    ranking = object.__new__(Ranking)  # which would refuse what is wrong
    object.__setattr__(ranking, "detections", made)
    object.__setattr__(ranking, "counted", {"can": (counted,) * COLUMNS})
    return replace(table(), protocols=(NOCS,), ranking=ranking)


def with_facts(column: str, value: str, failure: str = "") -> dict[str, str]:
    """The texts of a table with another field in its first line, and what follows from it."""
    texts = table_texts(GOLDEN)
    head, empty, first, *rest = texts["facts.csv"].split("\n")
    fields = first.split(",")
    fields[head.split(",").index(column)] = value
    if failure:
        fields[-1] = failure
    return {**texts, "facts.csv": "\n".join([head, empty, ",".join(fields), *rest])}


FACTS = [
    *((name, value) for name in ("position_m", "rotation_deg", "iou", "fscore_1cm", "nad")
      for value in ("-1", "nan", "1e400", "-inf", "inf", "x", "0x1", "9" * 400)
      if (name, value) not in (("position_m", "1e29"),)),
    ("rotation_deg", "180.001"), ("iou", "1.000001"), ("fscore_1cm", "2"),
    ("category", "all"), ("category", "completeness"), ("category", ""), ("category", "a\x1b"),
    ("sample", ""), ("sample", "x" * 600), ("sample", "a\x85"), ("seed", "1"), ("seed", "9" * 400),
]  # fmt: skip


@pytest.mark.parametrize(("column", "value"), FACTS, ids=[f"{c}={v[:12]!r}" for c, v in FACTS])
def test_fact_that_no_run_gives_is_refused(column, value):
    with pytest.raises(GoldenError, match=r"facts\.csv, line 3: (?!.*damaged)"):
        parse_table("m", "d", with_facts(column, value))


@pytest.mark.parametrize("column", ["position_m", "iou"])
def test_a_failure_meets_no_limit(column):
    with pytest.raises(GoldenError, match="where there is a failure"):
        parse_table("m", "d", with_facts(column, "0.5", failure="it failed"))


RANKINGS = {
    "more right than counted": (
        {"counted": 5, "right": 6},
        r"can: \[6, .* are right by column, but \[5",
    ),
    "right of none": ({"counted": 0, "right": 1}, r"can: \[1, .* are right by column, but \[0"),
    "counted more than there are": ({"counted": 6}, "counted of can is 6, but facts.csv has 5"),
    "counted 10**400": ({"counted": 10**400}, "at most 256 characters"),
    "counted beyond floats": ({"counted": 2**63 - 1}, "expected an integer, from 0 to"),
    "of no category": ({"category": "dog", "right": 1}, "counts 0 objects"),
    "category all": ({"category": "all"}, "detections.csv, line .*'all'"),
    **{
        f"score {score}": ({"score": score}, "detections.csv, line")
        for score in (float("inf"), float("nan"), -float("inf"))
    },
}


@pytest.mark.parametrize("case", RANKINGS)
def test_average_precision_that_no_detections_have_is_refused(case):
    given, told = RANKINGS[case]
    parse_table("m", "d", table_texts(ranked()))
    sound = table_texts(ranked())
    wrong = ranked(**given)
    if given.get("counted", 0) > 2**53:  # no cell can be written of it
        old, new = f"counted = [{', '.join(['5'] * COLUMNS)}]", f"counted = [{given['counted']}"
        texts = {
            **sound,
            "run.toml": sound["run.toml"].replace(old, new + ", 5" * (COLUMNS - 1) + "]"),
        }
        assert texts != sound
    else:
        texts = table_texts(wrong)
    with pytest.raises(GoldenError, match=told):
        parse_table("m", "d", texts)


RUN = {
    "protocols repeated": ("protocols", '["cpas", "cpas"]'),
    "protocols very often": ("protocols", "[" + '"cpas",' * 100_000 + "]"),
    "many protocols": ("protocols", "[" + ",".join(f'"p{i}"' for i in range(100_000)) + "]"),
    "no protocols": ("protocols", "[]"),
    "long protocol": ("protocols", '["' + "a" * 5000 + '"]'),
    **{f"{key} {value[:9]}": (key, value) for key in ("seeds", "protocols", "detections", "format")
       for value in ("1e999", "nan", "-1", "0x" + "f" * 20000, "[]", "{}", '"x"', "1979-05-27",
                     "9" * 30, "true" if key != "detections" else "1")},
}  # fmt: skip


@pytest.mark.parametrize("case", RUN)
def test_head_of_a_run_that_is_none_is_refused(case):
    key, value = RUN[case]
    texts = table_texts(GOLDEN)
    run = re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", texts["run.toml"], count=1)
    assert run != texts["run.toml"]
    with pytest.raises(GoldenError, match=r"run\.toml") as raised:
        parse_table("m", "d", {**texts, "run.toml": run})
    assert len(str(raised.value)) < 500


@pytest.mark.parametrize("seeds", ["1001", "1_000_000_000", str(2**62), "9" * 30, "0", "true"])
def test_older_table_of_more_seeds_than_are_believed_is_refused(seeds):
    toml = f'format = 2\nseeds = {seeds}\nsamples_sha256 = ""\n[identity]\n[provenance]\n[cells]\n'
    with pytest.raises(GoldenError, match=r"table\.toml: .*(expected 1 to 1000|64 bits)"):
        parse_older("m", "d", toml, "")


OLDER = "a,can,1111,,0.1,1,0.9,0.9,"
OLDER_HEAD = (
    "sample,category,outcome,repeats,translation_error_m,rotation_error_deg,iou,fscore_1cm,failure"
)


@pytest.mark.parametrize("field", range(4, 8))
@pytest.mark.parametrize("value", ["-7", "nan", "1e400", "-inf", "x", "9" * 400])
def test_number_of_an_older_table_that_no_run_gives_is_refused(field, value):
    fields = OLDER.split(",")
    fields[field] = value
    samples = f"{OLDER_HEAD}\n{','.join(fields)}\n"
    sha256 = hashlib.sha256(samples.encode()).hexdigest()
    toml = (
        f'format = 2\nseeds = 1\nsamples_sha256 = "{sha256}"\n[identity]\n[provenance]\n[cells]\n'
    )
    with pytest.raises(GoldenError, match=r"samples\.csv, line 2: "):
        parse_older("m", "d", toml, samples)


@pytest.mark.parametrize("gone", ["run.toml", "facts.csv", "cpas.toml"])
@pytest.mark.parametrize("left", ["nothing", "a link to nowhere", "a link to itself"])
def test_table_without_one_of_its_files_is_damaged(gone, left, tmp_path):
    """Not one that nobody has recorded, which would be green."""
    path = record(tmp_path, GOLDEN) / gone
    path.unlink()
    if left != "nothing":
        path.symlink_to(gone if "itself" in left else "nowhere")
    with pytest.raises(GoldenError, match=f"{gone}.*damaged or edited by hand"):
        find_golden(tmp_path, "m", "d")


@pytest.mark.parametrize("place", [".", "recorded", "recorded/m", "recorded/m/d"])
def test_what_is_no_folder_holds_no_table(place, tmp_path):
    path = tmp_path / "golden" / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    with pytest.raises(GoldenError, match=f"{re.escape(str(path))}: no folder"):
        find_golden(tmp_path / "golden", "m", "d")
