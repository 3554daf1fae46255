"""Collected runs, their verdicts and their documents; no run of pytest is needed."""

import json

import pytest
import tiny

from pytest_cpas.checks.contract import CONTRACT, ContractResult
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.evaluation import MethodRun, ResultsFile, SampleError, Shard, read_results
from pytest_cpas.evaluation.program import program_of
from pytest_cpas.session.collected import CollectedRun, ItemResult
from pytest_cpas.session.judging import JudgedRun, judge, record_run
from pytest_cpas.session.reporting import Reporter

SHARD = Shard.parse("1/1")


def items(run: MethodRun) -> list[ItemResult]:
    """What the items of a run find: a kept contract, then one item per sample."""
    found = [
        ItemResult(contract=ContractResult(name, Outcome.PASSED, demanded=True))
        for name in CONTRACT
    ]
    for ref in run.samples:
        try:
            found.append(ItemResult(rows=[run.judge(ref)]))
        except SampleError as error:
            found.append(ItemResult(errors=[(ref.id, str(error))]))
    return found


def collected(method: type, **keywords: object) -> CollectedRun:
    """A run of tests/tiny.py, all of whose items have come back, the last one first."""
    run = MethodRun(method(), tiny.Tiny(None), **keywords)
    whole = CollectedRun(run)
    for result in reversed(items(run)):
        # as from a worker
        whole.add(ItemResult.of(json.loads(json.dumps(result.plain()))))
    return whole


def words(judged: JudgedRun) -> list[str]:
    return [f"{verdict.word.value} {verdict.category}" for verdict in judged.verdicts]


def test_rows_are_in_the_order_of_the_data_set():
    run = collected(tiny.Perfect)
    assert [row.sample for row in run.ordered_rows] == [ref.id for ref in run.run.samples]
    assert list(run.rows) == [ref.id for ref in reversed(run.run.samples)]
    assert run.contract.keys() == CONTRACT.keys()
    assert run.errors == {}
    assert run.speed is None


def test_what_an_item_found_is_the_same_in_another_process():
    broken = collected(tiny.Raises)
    assert broken.errors.keys() == {"scene_1/0005"}
    assert "the network exploded" in broken.errors["scene_1/0005"]
    again = {row.sample: row for row in collected(tiny.Perfect).ordered_rows}
    run = MethodRun(tiny.Perfect(), tiny.Tiny(None))
    assert {ref.id: run.judge(ref) for ref in run.samples} == again


def test_run_is_judged_by_its_golden_table(tmp_path):
    good = collected(tiny.Perfect)
    assert words(judge(good, tmp_path)) == ["NOT CHECKED all"]
    recorded = record_run(good, tmp_path, failed_items=0)
    assert words(recorded) == ["RECORDED all"]
    assert words(judge(good, tmp_path)) == ["MATCHES bowl", "MATCHES mug"]
    worse = judge(collected(tiny.Biased), tmp_path)
    assert words(worse) == ["MATCHES bowl", "REGRESSED mug"]
    assert worse.golden is not None
    table = tmp_path / "recorded" / "perfect" / "tiny" / "cpas.toml"
    table.write_text(table.read_text().replace('"6/6"', '"5/6"'))
    assert words(judge(good, tmp_path)) == ["DAMAGED all"]


def test_bad_verdict_says_what_explains_it(tmp_path):
    record_run(collected(tiny.Perfect), tmp_path, failed_items=0)
    judged = judge(collected(tiny.Undeclared), tmp_path)
    lines = [line for explanation in judged.explanations for line in explanation.lines()]
    assert lines
    assert all(lines[0] in verdict.details for verdict in judged.verdicts)
    assert not judge(collected(tiny.Perfect), tmp_path).explanations


@pytest.mark.parametrize(
    ("run", "failed", "why"),
    [
        (lambda: collected(tiny.Perfect), 1, "1 items failed"),
        (lambda: CollectedRun(MethodRun(tiny.Perfect(), tiny.Tiny(None))), 0, "contract"),
        (lambda: collected(tiny.Raises), 0, "mug 5 of 6"),
    ],
)
def test_what_is_not_recorded(tmp_path, run, failed, why):
    judged = record_run(run(), tmp_path, failed_items=failed)
    assert words(judged) == ["NOT RECORDED all"]
    assert why in judged.verdicts[0].details
    assert not list(tmp_path.iterdir())


def test_rows_are_kept_while_the_run_is_open(tmp_path):
    program_of.cache_clear()  # what it was to another test, in another folder, is no matter
    run = MethodRun(tiny.Raises(), tiny.Tiny(None))
    found = items(run)
    with CollectedRun(run, ResultsFile(tmp_path, run, SHARD)) as whole:
        for result in found:
            whole.add(result)
    (path,) = tmp_path.iterdir()
    kept = read_results(path)
    assert kept.rows == whole.rows
    assert kept.errors == whole.errors
    assert kept.contract.keys() == CONTRACT.keys()
    # the next run begins with the rows, and tries again what has none
    again = CollectedRun(run, ResultsFile(tmp_path, run, SHARD))
    assert again.rows == kept.rows, again.origin
    assert again.errors == {}


def test_document_has_what_was_judged_and_measured(tmp_path):
    run = collected(tiny.Biased)
    record_run(collected(tiny.Perfect), tmp_path, failed_items=0)
    reporter = Reporter(require_golden=False, folder=None, others=(), lists=lambda count: False)
    document = reporter.document(judge(run, tmp_path))
    assert document["outcome"] == "failed"
    assert [verdict["outcome"] for verdict in document["verdicts"]] == ["passed", "failed"]
    assert len(document["flips"]) == 6
    assert document["samples"] == []
    interrupted = reporter.document(JudgedRun.unjudged(run))
    assert (interrupted["judged"], interrupted["verdicts"]) == (12, [])


def test_report_is_written_where_it_is_asked_for(tmp_path):
    run = collected(tiny.Biased)
    asked = Reporter(require_golden=False, folder=tmp_path / "r", others=(), lists=lambda _: False)
    document = asked.document(judge(run, tmp_path))
    assert len(document["samples"]) == 12
    assert asked.write([run], [document], 0) == tmp_path / "r" / "report.html"
    (told,) = json.loads((tmp_path / "r" / "report.json").read_text())["runs"]
    assert told["up_axes"] is not None
    assert document["up_axes"] is None  # who made the document keeps it as it was
    silent = Reporter(require_golden=False, folder=None, others=(), lists=lambda _: True)
    assert silent.write([run], [silent.document(judge(run, tmp_path))], 0) is None
