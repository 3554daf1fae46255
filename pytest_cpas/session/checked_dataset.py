"""A data set that is checked: which samples, what was measured of them, the verdicts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pytest_cpas.checks.dataset import CHECKS
from pytest_cpas.checks.dataset.facts import ImageFacts, MeshFacts, SampleFacts, Survey
from pytest_cpas.checks.dataset.verdicts import judge
from pytest_cpas.checks.known import KnownFailure
from pytest_cpas.evaluation import Selection
from pytest_cpas.session.known_faults import known_faults
from pytest_cpas.types import Dataset, SampleRef, Verdict

__all__ = ["CheckedDataset", "plain_survey"]


class CheckedDataset:
    """The samples of a data set to look at, and what has come back of them."""

    def __init__(
        self, dataset: Dataset, refs: Sequence[SampleRef], known: Sequence[KnownFailure] = ()
    ) -> None:
        self.name, self.refs = dataset.name, refs
        self.categories = {ref.category for ref in dataset.samples}
        self._dataset, self._known = dataset, known
        self._survey = Survey.of(dataset)
        #: Keys of the meshes that this process has measured.
        self._meshes: set[str] = set()

    @classmethod
    def of(cls, dataset: Dataset, selection: Selection, files: Sequence[Path]) -> CheckedDataset:
        """With the known failures that stand beside the data set's module, and those in ``files``.

        Raises :class:`pytest_cpas.types.DeclarationError` for a damaged file.
        """
        return cls(dataset, selection.of(dataset.samples), known_faults(dataset, files))

    @property
    def survey(self) -> Survey:
        """What the items have measured."""
        return self._survey

    def measure(self, refs: Sequence[SampleRef]) -> Survey:
        """Look at some samples, in this process; each mesh is measured once."""
        survey = Survey.of(self._dataset, self._meshes)
        for ref in refs:
            survey.examine(self._dataset, ref)
        self._meshes.update(survey.meshes)
        return survey

    def add(self, content: Any) -> None:
        """Take in what :func:`plain_survey` gave, in this process or another one."""
        samples, meshes, unreadable = content
        for values in samples:
            image = values["image"] and ImageFacts(**_tuples(values["image"]))
            facts = SampleFacts(**_tuples(values) | {"image": image})
            self._survey.samples[facts.sample] = facts
        for values in meshes:
            mesh = MeshFacts(**_tuples(values))
            self._survey.meshes.setdefault(mesh.key, mesh)
        self._survey.unreadable.update(unreadable)

    def verdicts(self) -> Iterator[Verdict]:
        """The verdict of each check, when everything has come back."""
        self._survey.sort()
        for check in CHECKS:
            yield judge(self._survey, check, self._known)


def plain_survey(survey: Survey) -> Any:
    """What was measured as values that xdist can send; :meth:`CheckedDataset.add` takes them."""
    samples = [asdict(facts) for facts in survey.samples.values()]
    meshes = [asdict(facts) for facts in survey.meshes.values()]
    return samples, meshes, survey.unreadable


def _tuples(values: dict[str, Any]) -> dict[str, Any]:
    """The values as they were: what travels between processes has lists for tuples."""
    return {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
