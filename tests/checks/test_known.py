"""Failures that are known: one form for methods, data sets and metrics, and the old ones."""

from __future__ import annotations

import pytest

from pytest_cpas.checks.contract import CONTRACT
from pytest_cpas.checks.dataset import CHECKS
from pytest_cpas.checks.known import KnownFailure, gone, known_failures, read_known, record_known
from pytest_cpas.checks.metrics import PROPERTIES
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.types import ContractError

KINDS = {"contract": CONTRACT, "dataset": CHECKS, "metric": PROPERTIES}

METRIC = KnownFailure(
    check="box_iou.touching",
    outcome=Outcome.RAISED,
    reason="raised 'QhullError'",
    case='{"first": [1, 1, 1]}',
    snippet="subject('box_iou')\n# \u2028\x7f'''\\ \"",
)


def written(tmp_path, text, name="x.known.toml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_one_file_holds_what_is_known_of_all_that_bears_its_name(tmp_path):
    path = written(
        tmp_path,
        """
        [[quirk]]
        name = "for people"
        [[contract]]
        check = "order"
        reason = "a"
        [[dataset]]
        check = "depth"
        sample = "scene_1/*"
        reason = "b"
        [[dataset]]
        check = "depth"
        model = "can_?"
        reason = "c"
        """,
    )
    read = {kind: read_known(path, kind, checks) for kind, checks in KINDS.items()}
    assert read["contract"] == [KnownFailure(check="order", reason="a")]
    assert [str(failure) for failure in read["dataset"]] == [
        "depth sample scene_1/*",
        "depth model can_?",
    ]
    assert read["metric"] == []
    for kind, known in read.items():
        assert known_failures(tmp_path, "x", kind, KINDS[kind]) == known
        assert known_failures(tmp_path, "y", kind, KINDS[kind]) == []


@pytest.mark.parametrize(
    ("kind", "text", "words"),
    [
        ("contract", "check = 'order'\nreason = ' '", "reason missing, expected check, reason"),
        ("contract", "reason = 'x'", "check missing"),
        ("contract", "", "check and reason missing"),
        ("contract", "check = 'odrer'\nreason = 'x'", "no check 'odrer'; the checks are answers,"),
        ("contract", "check = 'order'\nreason = 'x'\nsample = 'y'", "sample, expected some of"),
        ("dataset", "check = 'depth'\nreason = 'x'\nworst = '3 mm'", "expected a number (metres)"),
        ("dataset", "check = 'depth'\nreason = 'x'\nworst = nan", "expected a number"),
        ("dataset", "check = 'depth'\nreason = 'x'\nworst = true", "expected a number"),
        ("dataset", "check = 'poses'\nreason = 'x'\nworst = 1", "'poses' measures nothing"),
        ("dataset", "reason = 'x'\nworst = 1", "None measures nothing"),
        (
            "dataset",
            "check = 'depth'\nreason = 'x'\nrun = 'no'",
            "run is 'no', expected 'left out'",
        ),
        (
            "dataset",
            "check = 'depth'\nreason = 'x'\nrum = 'no'",
            "category, message, run, worst",
        ),
        ("contract", "check = 'order'\nreason = 'x'\nworst = 3", "expected check, reason as text"),
        ("contract", "check = 'order'\nreason = 3", "expected check, reason as text"),
        ("contract", "check = 'order'\nreason = 'x'\n" * 2, "cannot be read"),
        ("dataset", "check = 'deph'\nreason = 'x'", "no check 'deph'; the checks are readable,"),
        ("dataset", "check = 'depth'\nreason = 'x'\nmesh = 'y'", "mesh, expected some of check,"),
        ("metric", "check = 'box_iou.touching'\nreason = 'x'", "outcome and case and snippet miss"),
        (
            "metric",
            "check = 'box_iou.touching'\nreason = 'x'\ncase = '0'\nsnippet = 's'\noutcome = 'odd'",
            "'odd' is not a valid Outcome",
        ),
    ],
)
def test_a_wrong_entry_is_named(tmp_path, kind, text, words):
    path = written(tmp_path, f"[[{kind}]]\n{text}")
    with pytest.raises(ContractError) as caught:
        read_known(path, kind, KINDS[kind])
    assert words in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "[[datasets]]\ncheck = 'depth'",
            "[[datasets]] is no table that is read; write [[",
        ),
        ("[[real275]]\ncheck = 'depth'", "[[real275]] is no table that is read"),
        ("[real275]\ncheck = 'depth'", "[[real275]] is no table that is read"),
        ("[[Dataset]]\nreason = 'x'", "[[Dataset]] is no table"),
        ("[[mine]]\nproperty = 'box_iou'", "([[contract]] or [[metric]] for those of other kinds)"),
        ("check = 'depth'\nreason = 'x'", "check stands above all tables; write [[dataset]] above"),
    ],
)
def test_a_table_that_was_meant_to_be_read_is_named(tmp_path, text, words):
    path = written(tmp_path, f"{text}\n[[quirk]]\nname = 'for people'")
    with pytest.raises(ContractError) as caught:
        read_known(path, "dataset", CHECKS)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_message_tells_kinds_of_a_fault_apart(tmp_path):
    text = "[[dataset]]\ncheck = 'mesh-closed'\nmessage = '*edges are open*'\nreason = 'x'"
    (fault,) = read_known(written(tmp_path, text), "dataset", CHECKS)
    assert str(fault) == "mesh-closed message *edges are open*"
    assert fault.says("it has no closed bottom; 3 edges are open")
    assert not fault.says("its triangles are wound inside out (the volume is negative)")


def test_a_check_stands_once(tmp_path):
    entry = "[[contract]]\ncheck = 'order'\nreason = 'x'\n"
    with pytest.raises(ContractError, match="entry 2: check 'order' is there twice"):
        read_known(written(tmp_path, entry * 2), "contract", CONTRACT)


@pytest.mark.parametrize("text", ["[[contract", "contract = 3", "contract = ['order']", "\udc80"])
def test_what_is_no_list_of_entries(tmp_path, text):
    path = tmp_path / "x.known.toml"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ContractError, match=r"x\.known\.toml"):
        read_known(path, "contract", CONTRACT)
    with pytest.raises(ContractError, match="cannot be read"):
        read_known(tmp_path / "none.toml", "contract", CONTRACT)


def test_what_must_have_happened():
    both = [KnownFailure(check="depth", reason=reason) for reason in "ab"]
    assert gone(both, [], complete=False) == []
    assert gone(both, both[:1], complete=True) == both[1:]


# -- recorded -----------------------------------------------------------------------------------


def test_what_is_recorded_is_read_back(tmp_path):
    path = record_known(tmp_path, "x", [METRIC])
    assert read_known(path, "metric", PROPERTIES) == [METRIC]
    assert record_known(tmp_path, "x", []) == path
    assert list(tmp_path.iterdir()) == []


def test_what_others_wrote_is_not_overwritten(tmp_path):
    text = "[[contract]]\ncheck = 'order'\nreason = 'x'\n"
    path = written(tmp_path, text)
    with pytest.raises(ContractError, match="it holds contract as well"):
        record_known(tmp_path, "x", [METRIC])
    assert path.read_text() == text


# -- older versions -----------------------------------------------------------------------------


def test_the_file_of_a_method_had_another_name(tmp_path):
    old = written(tmp_path, "[[contract]]\ncheck = 'order'\nreason = 'x'", "x.expectations.toml")
    with pytest.warns(FutureWarning, match=r"is kept in x\.known\.toml; rename the file"):
        known = known_failures(tmp_path, "x", "contract", CONTRACT)
    assert known == [KnownFailure(check="order", reason="x")]
    written(tmp_path, "")
    with pytest.raises(ContractError, match=r"x\.known\.toml is there as well; move its entries"):
        known_failures(tmp_path, "x", "contract", CONTRACT)
    assert old.is_file()


def test_the_table_of_a_data_set_had_another_name(tmp_path):
    path = written(tmp_path, "[[fault]]\ncheck = 'depth'\nreason = 'x'\nmodel = 'can'")
    with pytest.warns(FutureWarning, match=r"write \[\[dataset\]\] for \[\[fault\]\]$"):
        known = read_known(path, "dataset", CHECKS)
    assert known == [KnownFailure(check="depth", reason="x", model="can")]


def test_recorded_violations_had_another_file_and_other_keys(tmp_path):
    written(
        tmp_path,
        "[[violation]]\nproperty = 'box_iou.touching'\noutcome = 'raised'\nmessage = 'seen'\n"
        "case = '0'\nsnippet = 's'",
        "x.violations.toml",
    )
    with (
        pytest.warns(FutureWarning, match=r"is kept in x\.known\.toml"),
        pytest.warns(FutureWarning, match=r"write \[\[metric\]\] for .* check for property, reas"),
    ):
        (known,) = known_failures(tmp_path, "x", "metric", PROPERTIES)
    assert (known.check, known.outcome, known.reason) == (
        "box_iou.touching",
        Outcome.RAISED,
        "seen",
    )
    # recorded anew it is the new file alone
    path = record_known(tmp_path, "x", [METRIC])
    assert list(tmp_path.iterdir()) == [path]


def test_a_run_says_what_to_write(pytester):
    lab = pytester.mkpydir("lab")
    (lab / "mine.py").write_text(
        "from pytest_cpas.metric_subjects.cpas import METRICS as OURS\n"
        "METRICS = {'diameter': OURS['diameter']}\n"
    )
    written(lab, "", "mine.violations.toml")
    told = pytester.runpytest_subprocess("--cpas-metrics=lab.mine", "-k", "diameter")
    assert told.ret == 0
    told.stderr.fnmatch_lines(["*mine.violations.toml: what is known is kept in mine.known.toml;*"])
