"""Samples are predicted together, and judged as if each had been alone."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from pytest_cpas.evaluation import MethodRun, SampleError, batches_of
from pytest_cpas.types import ContractError

REFS = tiny.Tiny(None).samples


class Counts(tiny.Perfect):
    """Keeps how many it was asked about at once, and under which seed."""

    def __init__(self):
        self.asked = []

    def predict(self, batch, seed):
        self.asked.append((len(batch), seed))
        return super().predict(batch, seed)


class RaisesAt(Counts):
    """Cannot answer one sample, which ends the whole batch."""

    error = ValueError("no such bowl")

    def answer(self, index):
        if index == 5:
            raise self.error
        return super().answer(index)


class FewerAnswers(Counts):
    def predict(self, batch, seed):
        return super().predict(batch, seed)[: max(len(batch) - 1, 1)]


class HasRoomFor(Counts):
    """Memory for some samples at once."""

    room, error = 3, MemoryError()

    def predict(self, batch, seed):
        if len(batch) > self.room:
            self.asked.append((-len(batch), seed))
            raise self.error
        return super().predict(batch, seed)


def planned(method, size=4, dataset=None, *, ahead=False, seeds=1, refs=REFS):
    run = MethodRun(method, dataset or tiny.Tiny(None), seeds=seeds)
    run.batches.plan([refs[at : at + size] for at in range(0, len(refs), size)], ahead=ahead)
    return run


def outcomes(run, refs=REFS):
    found = {}
    for ref in refs:
        try:
            found[ref.id] = run.judge(ref)
        except SampleError as error:
            found[ref.id] = str(error)
    return found


ALONE = outcomes(MethodRun(tiny.Perfect(), tiny.Tiny(None)))


@pytest.mark.parametrize("ahead", [False, True])
@pytest.mark.parametrize("size", [1, 3, 5, 16])
def test_rows_are_those_of_samples_alone(size, ahead):
    method = Counts()
    assert outcomes(planned(method, size, ahead=ahead)) == ALONE
    assert [count for count, _ in method.asked] == [min(size, 12 - at) for at in range(0, 12, size)]


def test_any_order_gives_the_same_rows():
    method = Counts()
    order = [REFS[i] for i in np.random.default_rng(0).permutation(12)]
    assert outcomes(planned(method), order) == ALONE
    assert [count for count, _ in method.asked] == [4, 4, 4]


def test_each_seed_has_batches_of_its_own():
    method = Counts()
    run = planned(method, 6, seeds=2)
    assert all(len(row.answers) == 2 for row in outcomes(run).values())
    assert method.asked == [(6, 0), (6, 1), (6, 0), (6, 1)]


def test_a_sample_that_is_asked_for_once_more_is_alone():
    method = Counts()
    run = planned(method)
    first = run.judge(REFS[0])
    assert run.judge(REFS[0]) == first
    assert [run.judge(ref) for ref in REFS[1:4]] == [ALONE[ref.id] for ref in REFS[1:4]]
    assert [count for count, _ in method.asked] == [4, 1]


def test_one_that_raises_is_the_only_one_without_an_answer():
    run = planned(RaisesAt())
    found = outcomes(run)
    lost = {name: told for name, told in found.items() if isinstance(told, str)}
    assert lost.keys() == {"scene_1/0005"}
    assert "sample scene_1/0005 (mug): the method raised ValueError('no such bowl')" in str(lost)
    assert {name: row for name, row in found.items() if name not in lost} == {
        name: row for name, row in ALONE.items() if name not in lost
    }
    assert run.notes == [
        "4 samples at once: ValueError: no such bowl; each was asked for alone then"
    ]


def test_the_cause_is_kept_for_its_traceback():
    with pytest.raises(SampleError) as caught:
        planned(RaisesAt(), refs=REFS[4:8]).judge(REFS[5])
    assert caught.value.__cause__ is RaisesAt.error


def test_too_few_answers_are_the_answers_of_nobody():
    run = planned(FewerAnswers())
    told = outcomes(run)
    assert all("3 of them, expected 4, one per observation" in str(line) for line in told.values())
    assert len(told) == 12


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("CUDA out of memory. Tried to allocate 20.00 MiB"),
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: 10 bytes"),
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling cublasCreate"),
        type("OutOfMemoryError", (RuntimeError,), {})("of the device"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_memory_that_runs_out_halves_the_batches(error):
    method = HasRoomFor()
    method.error = error
    run = planned(method, 8)
    assert outcomes(run) == ALONE
    # of 8 none, of 4 none; the batch that comes later is not tried whole
    assert [count for count, _ in method.asked] == [-8, -4, 2, 2, 2, 2, 2, 2]
    assert run.notes == [
        "memory ran out with 8 samples at once: 4 then",
        "memory ran out with 4 samples at once: 2 then",
    ]


def test_memory_that_does_not_serve_for_one_is_told_of_that_one():
    method = HasRoomFor()
    method.room = 0
    told = outcomes(planned(method))
    assert all("the method raised MemoryError()" in str(line) for line in told.values())


def test_a_damaged_sample_is_no_business_of_the_others():
    method = Counts()
    found = outcomes(planned(method, dataset=tiny.Torn(None), ahead=True))
    assert "the data is bad: 0005_depth.png is truncated" in found.pop("scene_1/0005")
    assert found == {name: row for name, row in ALONE.items() if name in found}
    assert [count for count, _ in method.asked] == [4, 3, 4]


def test_a_method_that_cannot_be_loaded_is_no_business_of_a_batch():
    class Unloadable(Counts):
        def load(self, assets, device):
            raise OSError("no weights")

    run = planned(Unloadable())
    assert all("cannot be loaded: no weights" in str(told) for told in outcomes(run).values())
    assert run.notes == []


def test_observations_are_not_those_of_the_next_seed():
    class Writes(Counts):
        def predict(self, batch, seed):
            found = super().predict(batch, seed)
            for seen in batch:
                seen.rgb[...] = 0
            return found

    rows = outcomes(planned(Writes(), seeds=2))
    assert all(row.answers[0] == row.answers[1] for row in rows.values())


def test_what_is_not_seen_is_not_asked_for():
    class Blind(tiny.Tiny):
        def unseen(self, ref):
            return "behind a wall" if ref.id == "scene_1/0006" else None

    method = Counts()
    found = outcomes(planned(method, dataset=Blind(None), ahead=True))
    assert found["scene_1/0006"].answers[0].failure == "behind a wall"
    assert [count for count, _ in method.asked] == [4, 3, 4]


def test_a_data_set_is_read_by_one_thread_at_a_time():
    class OneAtATime(tiny.Tiny):
        reading = 0

        def load(self, ref):
            assert OneAtATime.reading == 0
            OneAtATime.reading += 1
            try:
                return super().load(ref)
            finally:
                OneAtATime.reading -= 1

        def unseen(self, ref):
            assert OneAtATime.reading == 0

    assert outcomes(planned(Counts(), 2, OneAtATime(None), ahead=True)) == ALONE


def test_batches_of_items():
    each = [[ref] for ref in REFS[:5]]
    assert batches_of(each, 2, {REFS[1].id}) == [[REFS[0], REFS[2]], [REFS[3], REFS[4]]]
    scenes = [REFS[:3], REFS[3:5]]
    assert batches_of(scenes, 2, set()) == [REFS[:2], [REFS[2]], REFS[3:5]]
    assert batches_of([], 2, set()) == []


@pytest.mark.parametrize("batch", [0, -1, 2.0, True, "4", 5000])
def test_declared_batches_are_counts(batch):
    with pytest.raises(ContractError, match="expected how many observations predict is given"):
        replace(tiny.Perfect.info, batch=batch)


def test_a_method_has_the_batch_that_it_declares():
    class Several(tiny.Perfect):
        info = replace(tiny.Perfect.info, batch=8)

    assert MethodRun(Several(), tiny.Tiny(None)).batch == 8
    assert MethodRun(Several(), tiny.Tiny(None), batch=2).batch == 2


def test_samples_are_those_that_were_asked_for():
    class Misnamed(tiny.Tiny):
        def load(self, ref):
            return replace(super().load(ref), ref=replace(ref, id="scene_0/0000"))

    assert outcomes(planned(Counts(), dataset=Misnamed(None))) == ALONE
