import pytest

from pytest_cpas.metrics.definitions import DEFINITIONS, definition, require_same_definition
from pytest_cpas.types import ContractError


def test_an_id_names_everything_that_the_number_depends_on() -> None:
    fscore = definition("fscore", "strict")
    ours = fscore.id(delta_m=0.01, frame="camera", points=10_000)
    assert ours == "fscore:strict:1[delta_m=0.01,frame=camera,points=10000]"
    require_same_definition(ours, fscore.id(points=10_000, frame="camera", delta_m=0.01))
    with pytest.raises(ContractError, match=r"frame=camera.*frame=object"):
        require_same_definition(ours, fscore.id(delta_m=0.01, frame="object", points=10_000))


def test_the_ious_differ() -> None:
    ious = [entry.id() for entry in DEFINITIONS.values() if entry.name in ("iou", "iou_plus")]
    assert len(set(ious)) == len(ious) >= 5
    with pytest.raises(ContractError, match="different definitions"):
        require_same_definition(
            definition("iou", "oriented").id(), definition("iou", "nocs-legacy").id()
        )


def test_missing_parameters_and_names_are_refused() -> None:
    with pytest.raises(ContractError, match="expected \\['frame', 'points'\\]"):
        definition("cd", "mean").id(points=100)
    with pytest.raises(ContractError, match=r"cd:sum does not exist; .*cd:mean"):
        definition("cd", "sum")
