"""Whose fault it is: damage in a data set is never told as the method's, nor the reverse."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from pytest_cpas.checks.contract import CONTRACT, MethodSubject, check_contract
from pytest_cpas.diagnosis import diagnose_run
from pytest_cpas.evaluation import MethodRun, SampleError
from pytest_cpas.golden import RunTable
from pytest_cpas.types import (
    AnswerError,
    Camera,
    ContractError,
    DataError,
    DeclarationError,
    GroundTruth,
    Hypothesis,
    Mesh,
    Observation,
    Pose,
    Prediction,
    Symmetry,
    raised_as,
)

LINE = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
EYE, AHEAD = np.eye(3), [0, 0, 1]


def given(**parts):
    answer = {"rotation": EYE, "translation": AHEAD, "extents": tiny.EXTENTS, "points": tiny.POINTS}
    return Hypothesis(**answer | parts)


#: Samples that cannot be read: the error comes while a data set makes them.
UNREADABLE = {
    "pose scaled": lambda s: Pose(2 * EYE, AHEAD),
    "pose mirrored": lambda s: Pose(-EYE, AHEAD),
    "pose not finite": lambda s: Pose(EYE, [np.nan, 0, 1]),
    "matrix transposed": lambda s: Pose.from_matrix(np.eye(4) + np.eye(4, k=-3)),
    "camera without focal length": lambda s: Camera(8, 6, 0, 10, 3.5, 2.5),
    "mesh without triangles": lambda s: Mesh(LINE, np.empty((0, 3), int)),
    "mesh of missing vertices": lambda s: Mesh(LINE, [[0, 1, 3]]),
    "mesh not finite": lambda s: Mesh(LINE * np.nan, [[0, 1, 2]]),
    "symmetry about nothing": lambda s: Symmetry.about([0, 0, 0]),
    "extents negative": lambda s: replace(s.truth, extents=-s.truth.extents),
    "extents zero": lambda s: replace(s.truth, extents=0 * s.truth.extents),
    "extents of two sides": lambda s: replace(s.truth, extents=[1, 1]),
    "surface flat": lambda s: replace(s.truth, surface=np.zeros((5, 2))),
    "surface not finite": lambda s: replace(s.truth, surface=np.full((5, 3), np.inf)),
    "mask empty": lambda s: replace(s.observation, mask=np.zeros((6, 8), bool)),
    "depth negative": lambda s: replace(s.observation, depth=-s.observation.depth),
    "colour in bytes": lambda s: replace(s.observation, rgb=s.observation.rgb * 255),
}

#: Truths that can be read, and with which no answer can be compared.
INCOMPARABLE = {
    "mesh in a line": Mesh(LINE, [[0, 1, 2]]),
    "mesh in a point": Mesh(0 * LINE, [[0, 1, 2]]),
    "no points": np.empty((0, 3)),
}

#: Answers that break the contract, made when they are asked for.
ANSWERS = {
    "rotation scaled": lambda: given(rotation=2 * EYE),
    "rotation mirrored": lambda: given(rotation=-EYE),
    "translation not finite": lambda: given(translation=[0, 0, np.nan]),
    "extents negative": lambda: given(extents=[1, 1, -1]),
    "no points": lambda: given(points=np.empty((0, 3))),
    "points flat": lambda: given(points=np.zeros((5, 2))),
    "mesh in a line": lambda: given(points=None, mesh=Mesh(LINE, [[0, 1, 2]])),
    "mesh in a point": lambda: given(points=None, mesh=Mesh(0 * LINE, [[0, 1, 2]])),
    "mesh without triangles": lambda: given(mesh=Mesh(LINE, np.empty((0, 3), int))),
    "mesh of something": lambda: given(mesh="mug.obj"),
    "score not finite": lambda: given(score=np.inf),
    "score undeclared": lambda: given(score=1.0),
    "extents missing": lambda: given(extents=None),
    "shape missing": lambda: given(points=None),
    "a dictionary": lambda: {"rotation": EYE},
}


class Damaged(tiny.Tiny):
    """Sample 5 is not what it was."""

    def __init__(self, damage):
        super().__init__(None)
        self._damage = damage

    def load(self, ref):
        sample = super().load(ref)
        if ref is not self.samples[5]:
            return sample
        found = self._damage(sample)
        return replace(sample, truth=found) if isinstance(found, GroundTruth) else sample


def judged(method, dataset):
    run = MethodRun(method, dataset)
    with pytest.raises(SampleError) as caught:
        run.judge(run.samples[5])
    others = [run.judge(ref) for ref in run.samples if ref is not run.samples[5]]
    assert all(row.failure is None for row in others)
    return str(caught.value)


def is_told_of_data(sentence):
    return ": the data is bad: " in sentence and "answer" not in sentence


def is_told_of_answer(sentence):
    return ": the answer breaks the contract: " in sentence and "data is bad" not in sentence


@pytest.mark.parametrize("damage", UNREADABLE.values(), ids=UNREADABLE)
def test_sample_that_cannot_be_read_is_the_datas(damage):
    dataset = Damaged(damage)
    assert is_told_of_data(judged(tiny.Perfect(), dataset))
    run = MethodRun(tiny.Perfect(), dataset)
    with pytest.raises(DataError):
        run.read(run.samples[5])
    with pytest.raises(DataError):
        run.truth(run.samples[5])


def with_surface(surface):
    return Damaged(lambda sample: replace(sample.truth, surface=surface))


@pytest.mark.parametrize("surface", INCOMPARABLE.values(), ids=INCOMPARABLE)
def test_truth_that_no_answer_can_be_compared_with_is_the_datas(surface):
    dataset = with_surface(surface)
    assert is_told_of_data(judged(tiny.Perfect(), dataset))


def checked(dataset):
    subject = MethodSubject(tiny.Perfect(), [dataset.load(ref) for ref in dataset.samples[4:7]])
    results = [check_contract(subject, check) for check in CONTRACT.values()]
    return [(result.outcome, result.message) for result in results]


@pytest.mark.parametrize("surface", INCOMPARABLE.values(), ids=INCOMPARABLE)
def test_damaged_truth_breaks_no_check_of_the_contract(surface):
    assert checked(with_surface(surface)) == checked(tiny.Tiny(None))


@pytest.mark.parametrize("surface", INCOMPARABLE.values(), ids=INCOMPARABLE)
def test_damaged_truth_is_no_mistake_of_the_method(surface):
    run = MethodRun(tiny.Perfect(), with_surface(surface))
    rows = [run.judge(ref) for ref in run.samples if ref is not run.samples[5]]
    # a run far below what is expected, so that the truth of every sample is read
    assert diagnose_run(run, rows, RunTable.of(run, rows), {}) == []


@pytest.mark.parametrize("answer", ANSWERS.values(), ids=ANSWERS)
def test_answer_that_breaks_the_contract_is_the_methods(answer):
    class Breaks(tiny.Broken):
        def broken(self, index):
            return Prediction([answer()])

    assert is_told_of_answer(judged(Breaks(), tiny.Tiny(None)))


def test_what_a_method_builds_while_it_predicts_is_its_own():
    """Also an observation, which would be the data's anywhere else."""

    class Crops(tiny.Broken):
        def broken(self, index):
            return Observation(
                category="mug",
                rgb=np.zeros((6, 8, 3), np.float32),
                depth=np.zeros((6, 8), np.float32),
                mask=np.zeros((6, 8), bool),
                camera=tiny.CAMERA,
            )

    assert is_told_of_answer(judged(Crops(), tiny.Tiny(None)))


def test_the_border_decides():
    """Also over a data set that builds answers, or reads declarations, while it reads a sample."""
    for error in (AnswerError, DeclarationError, DataError, ContractError):

        def damage(sample, error=error):
            raise error("torn")

        assert judged(tiny.Perfect(), Damaged(damage)).endswith(": the data is bad: torn")


def test_error_that_is_of_the_kind_stays_the_same():
    class Torn(DataError):
        """What a data set of somebody's raises."""

    with pytest.raises(Torn, match="depth"), raised_as(DataError):
        raise Torn("depth")


def test_message_and_cause_stay():
    def convert():
        with raised_as(DataError):
            try:
                int("x")
            except ValueError as error:
                raise ContractError("no number") from error

    with pytest.raises(DataError, match=r"^no number$") as caught:
        convert()
    assert isinstance(caught.value.__cause__, ValueError)
