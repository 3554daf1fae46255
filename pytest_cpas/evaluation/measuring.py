"""From predictions to answers with their facts."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from pytest_cpas.evaluation.estimates import encode_estimate
from pytest_cpas.evaluation.rows import Answer
from pytest_cpas.facts import fact, failed_facts, measure_facts
from pytest_cpas.types import Camera, GroundTruth, Hypothesis, MethodInfo, Prediction
from pytest_cpas.types.frames import to_standard

__all__ = ["measure"]


def measure(
    names: Collection[str],
    truths: Sequence[GroundTruth],
    predictions: Sequence[Prediction],
    info: MethodInfo,
    cameras: Sequence[Camera | None] | None = None,
) -> list[Answer]:
    """The facts of those ``names`` of each prediction's first hypothesis, which is its best.

    Further hypotheses count only for facts that are about all of them. Frames are converted as
    ``info`` declares. ``cameras``: of each image, None where it is not known. Raises
    :class:`pytest_cpas.types.AnswerError` for a hypothesis without the shape that ``info``
    declares, or with one that has no area; :class:`pytest_cpas.types.DataError` for such a truth.
    """
    best: dict[int, Hypothesis] = {
        index: to_standard(prediction.hypotheses[0], info)
        for index, prediction in enumerate(predictions)
        if prediction.hypotheses
    }
    others = None
    if any(fact(name).of_all for name in names):
        others = [[to_standard(h, info) for h in predictions[i].hypotheses[1:]] for i in best]
    facts = dict(
        zip(
            best,
            measure_facts(
                names,
                [truths[i] for i in best],
                list(best.values()),
                info.gives,
                [cameras[i] for i in best] if cameras else None,
                others,
            ),
            strict=True,
        )
    )
    return [
        Answer(facts=facts[index], estimate=encode_estimate(best[index]))
        if index in best
        else Answer(
            facts=failed_facts(names, truth, info.gives, cameras[index] if cameras else None),
            failure=prediction.reason,
        )
        for index, (truth, prediction) in enumerate(zip(truths, predictions, strict=True))
    ]
