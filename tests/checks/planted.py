"""Small scenes, and ``icp`` on them: what the catalogue of method faults spoils."""

import functools
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from observing import observe
from scipy.spatial.transform import Rotation

from method_adapters.icp import Icp
from pytest_cpas.datasets.shapes import mean_shape
from pytest_cpas.types import (
    CATEGORIES,
    Dataset,
    GroundTruth,
    Hypothesis,
    Mesh,
    Observation,
    Pose,
    Prediction,
    Sample,
    SampleRef,
    Symmetry,
)

#: Scenes of one object each, per category; mugs, which have faults of their own, are more.
SCENES = dict.fromkeys(CATEGORIES, 4) | {"mug": 10}
ROUND = ("bottle", "bowl", "can")


class Scenes(Dataset):
    """A data set: objects of slightly varied sizes, seen from above, turned and moved at random."""

    name = "scenes"
    digest = "scenes-1"
    missing = ()
    damaged = ()

    def __init__(self, data_dir: Path | None = None) -> None:
        self.samples = [
            SampleRef(id=f"scene_{i}/{category}", category=category, scene=f"scene_{i}")
            for category, count in SCENES.items()
            for i in range(count)
        ]

    def load(self, ref: SampleRef) -> Sample:
        sample = _scene(ref)
        seen = sample.observation
        # arrays of its own: some faults write into them
        own = replace(seen, rgb=seen.rgb.copy(), depth=seen.depth.copy(), mask=seen.mask.copy())
        return replace(sample, observation=own)

    def truth(self, ref: SampleRef) -> GroundTruth:
        return _scene(ref).truth


@functools.cache
def _scene(ref: SampleRef) -> Sample:
    rng = np.random.default_rng(
        [int(ref.scene.removeprefix("scene_")), CATEGORIES.index(ref.category)]
    )
    turn = Rotation.from_euler("x", rng.uniform(205, 225), degrees=True)
    # handles and screens are seen
    yaw = rng.uniform(-60, 60) if ref.category == "laptop" else rng.uniform(-180, 180)
    if ref.category == "mug":
        yaw = rng.uniform(20, 160)
    turn *= Rotation.from_euler("y", yaw, degrees=True)
    mean = mean_shape(ref.category)
    mesh = Mesh(mean.vertices * rng.uniform(0.92, 1.08), mean.triangles)
    pose = Pose(turn.as_matrix(), rng.uniform([-0.09, -0.05, 0.7], [0.09, 0.05, 0.85]))
    observation = observe(mesh, pose, ref.category)
    rgb = np.full(observation.rgb.shape, 0.5, np.float32)
    rgb[observation.mask] = rng.uniform(0.2, 0.8, 3)
    symmetry = Symmetry.about((0, 1, 0)) if ref.category in ROUND else Symmetry.none()
    if ref.category == "can":
        symmetry = Symmetry.about((0, 1, 0), flip=True)
    truth = GroundTruth(
        pose=pose, extents=np.ptp(mesh.bounds, axis=0), symmetry=symmetry, surface=mesh
    )
    return Sample(ref, replace(observation, rgb=rgb), truth)


_ICP = Icp()
_ANSWERS: dict[tuple[Any, ...], Prediction] = {}


def sound(observation: Observation, seed: int) -> Prediction:
    """The real icp's answer; it is a function of all that stands in the key, so it is kept."""
    arrays = (observation.rgb, observation.depth, observation.mask)
    content = hashlib.sha256(b"".join(np.ascontiguousarray(x).tobytes() for x in arrays)).digest()
    key = (observation.category, observation.camera, content, seed)
    if key not in _ANSWERS:
        _ANSWERS[key] = _ICP.predict([observation], seed)[0]
    return _ANSWERS[key]


class Planted:
    """icp as a method whose parts can be spoilt."""

    info = Icp.info

    def load(self, assets: Path | None, device: str) -> None: ...

    def predict(self, batch: Sequence[Observation], seed: int) -> Any:
        return [self.answer(observation, seed) for observation in batch]

    def answer(self, observation: Observation, seed: int) -> Prediction:
        return sound(observation, seed)


def spoilt(change: Callable[..., Any], **declared: Any) -> type[Planted]:
    """``change(hypothesis, observation)`` gives the parts of it that are other ones; all that was
    valid is made valid again, as an adapter's constructor does."""

    class Spoilt(Planted):
        info = replace(Icp.info, **declared)

        def answer(self, observation: Observation, seed: int) -> Prediction:
            prediction = sound(observation, seed)
            if not prediction.hypotheses:
                return prediction
            best = prediction.hypotheses[0]
            parts = {
                name: getattr(best, name)
                for name in ("rotation", "translation", "extents", "points", "mesh", "score")
            }
            return Prediction((Hypothesis(**{**parts, **change(best, observation)}),))

    return Spoilt
