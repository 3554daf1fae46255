"""A mistake in one category is found, whichever one it is."""

import pytest
from planted import Planted, Scenes, sound

from pytest_cpas.checks.contract import CONTRACT, MethodSubject, check_contract
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.session.contract_stage import further_samples, smoke_samples
from pytest_cpas.types import Prediction

CATEGORIES = sorted({ref.category for ref in Scenes().samples})


class Remembers(Planted):
    """Without depth in the mask of one category, the answer is the one before."""

    category = ""
    last: Prediction | None = None

    def predict(self, batch, seed):
        answers = []
        for observation in batch:
            seen = observation.depth[observation.mask]
            if observation.category == self.category and not seen.any() and self.last:
                answers.append(self.last)
                continue
            answer = sound(observation, seed)
            if answer.hypotheses:
                type(self).last = answer
            answers.append(answer)
        return answers


@pytest.mark.parametrize("category", CATEGORIES)
def test_no_evidence_is_asked_of_every_category(category):
    method = type("Mine", (Remembers,), {"category": category, "last": None})()
    run = MethodRun(method, Scenes())
    samples = smoke_samples(run)
    further = further_samples(run, samples)
    assert {s.ref.category for s in (*samples, *further)} == set(CATEGORIES)
    method.load(None, "cpu")
    subject = MethodSubject(method, samples, further=further)
    result = check_contract(subject, CONTRACT["no_evidence"])
    assert result.violated
    assert f"of a {category}" in result.message


@pytest.mark.parametrize("category", CATEGORIES)
def test_background_is_disturbed_for_every_category(category):
    class Peeks(Planted):
        def predict(self, batch, seed):
            answers = []
            for observation in batch:
                answer = sound(observation, seed)
                blank = not observation.depth[~observation.mask].any()
                failed = Prediction.failed("no background")
                answers.append(failed if blank and observation.category == category else answer)
            return answers

    method = Peeks()
    method.load(None, "cpu")
    run = MethodRun(method, Scenes())
    samples = smoke_samples(run)
    subject = MethodSubject(method, samples, further=further_samples(run, samples))
    assert check_contract(subject, CONTRACT["background"]).violated
