"""A data set and methods for the harness's own tests; copied beside the run that uses them.

The first pixel's colour tells which sample an image is, so that a method can know the truth and
be wrong in exactly the way that a test wants.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_cpas.types import (
    Camera,
    ContractError,
    Dataset,
    GroundTruth,
    Hypothesis,
    Mesh,
    MethodInfo,
    Observation,
    Pose,
    Prediction,
    Sample,
    SampleRef,
    Symmetry,
)

CAMERA = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)
COUNT = 12
CATEGORIES = ("bowl", "mug")
EXTENTS = np.array([0.10, 0.08, 0.12])


POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3)) * EXTENTS


def truth(index: int) -> GroundTruth:
    rotation = Rotation.random(rng=np.random.default_rng(index)).as_matrix()
    symmetry = Symmetry.about([0, 1, 0]) if index % 2 == 0 else Symmetry.none()
    return GroundTruth(
        pose=Pose(rotation, [0.01 * index, 0, 0.8]),
        extents=EXTENTS,
        symmetry=symmetry,
        surface=POINTS,
    )


class Tiny(Dataset):
    name = "tiny"
    digest = "tiny-1"
    missing = ()
    damaged = ()

    def __init__(self, data_dir: Path | None) -> None:
        self.samples = [
            SampleRef(
                id=f"scene_{i // 4}/{i:04d}", category=CATEGORIES[i % 2], scene=f"scene_{i // 4}"
            )
            for i in range(COUNT)
        ]

    def load(self, ref: SampleRef) -> Sample:
        index = int(ref.id.split("/")[1])
        rgb = np.zeros((6, 8, 3), np.float32)
        rgb[0, 0, 0] = index / 255
        depth = np.full((6, 8), 0.8, np.float32)
        mask = np.zeros((6, 8), bool)
        mask[2:4, 3:6] = True
        observation = Observation(
            category=ref.category, rgb=rgb, depth=depth, mask=mask, camera=CAMERA
        )
        return Sample(ref, observation, truth(index))


class Renewed(Tiny):
    digest = "tiny-2"


class Torn(Tiny):
    """One sample cannot be read."""

    def load(self, ref: SampleRef) -> Sample:
        if ref.id == "scene_1/0005":
            raise ContractError("0005_depth.png is truncated")
        return super().load(ref)


class Damaged(Tiny):
    damaged = ("scene_9/0000_meta.txt: line 'x', expected 'mask_id class_id model'",)


class Perfect:
    info = MethodInfo(
        name="perfect",
        categories=CATEGORIES,
        needs=frozenset({"rgb"}),
        gives=frozenset({"extents", "shape"}),
        licence="MIT",
    )

    def load(self, assets: Path | None, device: str) -> None:
        self.loaded = True

    def predict(self, batch: list[Observation], seed: int) -> list[Prediction]:
        assert self.loaded
        return [self.answer(round(float(o.rgb[0, 0, 0]) * 255)) for o in batch]

    def answer(self, index: int) -> Prediction:
        true = truth(index)
        return Prediction(
            (
                Hypothesis(
                    rotation=true.pose.rotation,
                    translation=true.pose.translation,
                    extents=EXTENTS,
                    points=POINTS,
                ),
            )
        )


class Biased(Perfect):
    """7 degrees off about z, in mugs alone."""

    def answer(self, index: int) -> Prediction:
        true = truth(index)
        bias = Rotation.from_euler("z", 7.0 if index % 2 else 0.0, degrees=True).as_matrix()
        rotation = true.pose.rotation @ bias
        return Prediction(
            (
                Hypothesis(
                    rotation=rotation,
                    translation=true.pose.translation,
                    extents=EXTENTS,
                    points=POINTS,
                ),
            )
        )


class Refuses(Perfect):
    def answer(self, index: int) -> Prediction:
        return Prediction.failed("too few points") if index == 3 else super().answer(index)


class OnlyMugs(Perfect):
    info = replace(Perfect.info, categories=("mug",))


class OnlyPose(Perfect):
    info = MethodInfo(
        name="only-pose",
        categories=CATEGORIES,
        needs=frozenset({"rgb"}),
        gives=frozenset(),
        licence="MIT",
    )

    def answer(self, index: int) -> Prediction:
        pose = truth(index).pose
        return Prediction((Hypothesis(rotation=pose.rotation, translation=pose.translation),))


class OtherFrames(Perfect):
    """The same answers in OpenGL camera axes and NOCS object axes."""

    info = MethodInfo(
        name="perfect",
        categories=CATEGORIES,
        needs=frozenset({"rgb"}),
        gives=frozenset({"extents", "shape"}),
        licence="MIT",
        object_frame="nocs",
        camera_frame="opengl",
    )

    def answer(self, index: int) -> Prediction:
        pose = truth(index).pose
        gl = np.diag([1.0, -1.0, -1.0])
        # scalar last; turns ShapeNet coordinates into NOCS ones
        nocs = Rotation.from_quat([0, -np.sqrt(0.5), 0, np.sqrt(0.5)]).as_matrix()
        rotation, translation = gl @ pose.rotation @ nocs.T, gl @ pose.translation
        points = POINTS @ nocs.T
        return Prediction(
            (
                Hypothesis(
                    rotation=rotation,
                    translation=translation,
                    extents=EXTENTS[[2, 1, 0]],
                    points=points,
                ),
            )
        )


class Several(OtherFrames):
    """Up to three hypotheses, whose scores do not fall, with points or meshes; one failure."""

    info = replace(OtherFrames.info, gives=frozenset({"extents", "shape", "score"}))

    def answer(self, index: int) -> Prediction:
        if index == 3:
            return Prediction.failed("too few points\nin the mask")
        [best] = super().answer(index).hypotheses
        rng = np.random.default_rng(index)
        made = []
        for n in range(1 + index % 3):
            turn = Rotation.from_rotvec(0.1 * n * rng.normal(size=3)).as_matrix()
            points = best.points + 0.01 * rng.normal(size=3)
            mesh = Mesh(points, np.arange(198).reshape(-1, 3)) if (index + n) % 2 else None
            made.append(
                replace(
                    best,
                    rotation=best.rotation @ turn,
                    translation=best.translation + 0.01 * n * rng.normal(size=3),
                    extents=best.extents * rng.uniform(0.9, 1.1, 3),
                    points=points.astype(np.float32) if mesh is None else None,
                    mesh=mesh,
                    score=float(rng.normal()),
                )
            )
        return Prediction(tuple(made))


class Undeclared(OtherFrames):
    """... and says nothing about it."""

    info = Perfect.info


class Broken(Perfect):
    """Breaks the contract at sample 5 in the way its subclass says."""

    def answer(self, index: int) -> Prediction:
        return self.broken(index) if index == 5 else super().answer(index)


class GivesNan(Broken):
    def broken(self, index: int) -> Prediction:
        return Prediction(
            (
                Hypothesis(
                    rotation=np.eye(3), translation=[np.nan, 0, 1], extents=EXTENTS, points=POINTS
                ),
            )
        )


class LeftHanded(Broken):
    def broken(self, index: int) -> Prediction:
        return Prediction(
            (
                Hypothesis(
                    rotation=np.diag([1, 1, -1]),
                    translation=[0, 0, 1],
                    extents=EXTENTS,
                    points=POINTS,
                ),
            )
        )


class Scaled(Broken):
    def broken(self, index: int) -> Prediction:
        return Prediction(
            (
                Hypothesis(
                    rotation=0.2 * np.eye(3), translation=[0, 0, 1], extents=EXTENTS, points=POINTS
                ),
            )
        )


class NegativeExtents(Broken):
    def broken(self, index: int) -> Prediction:
        return Prediction(
            (
                Hypothesis(
                    rotation=np.eye(3), translation=[0, 0, 1], extents=-EXTENTS, points=POINTS
                ),
            )
        )


class ForgetsShape(Broken):
    def broken(self, index: int) -> Prediction:
        return Prediction((Hypothesis(rotation=np.eye(3), translation=[0, 0, 1], extents=EXTENTS),))


class Raises(Broken):
    def broken(self, index: int) -> Prediction:
        raise RuntimeError("the network exploded")


class Interrupted(Broken):
    def broken(self, index: int) -> Prediction:
        raise KeyboardInterrupt


class Dies(Broken):
    def broken(self, index: int) -> Prediction:
        os._exit(9)


class CannotLoad(Perfect):
    tried = 0

    def load(self, assets: Path | None, device: str) -> None:
        CannotLoad.tried += 1
        raise ValueError(f"w.pt is truncated (try {CannotLoad.tried})")


class CountsLoads(Perfect):
    def load(self, assets: Path | None, device: str) -> None:
        super().load(assets, device)
        with Path("loads").open("a") as file:
            file.write(f"{os.getpid()}\n")


class WrongLength(Perfect):
    def predict(self, batch: list[Observation], seed: int) -> list[Prediction]:
        return super().predict(batch, seed) * 2


class NoInfo:
    pass


class Wobbles(Perfect):
    """Wrong by chance, which the seed decides, in every other sample."""

    info = replace(Perfect.info, deterministic=False)

    def predict(self, batch: list[Observation], seed: int) -> list[Prediction]:
        return [self.by_chance(round(float(o.rgb[0, 0, 0]) * 255), seed) for o in batch]

    def by_chance(self, index: int, seed: int) -> Prediction:
        lucky = index % 4 < 2 or np.random.default_rng([seed, index]).random() < 0.5
        return self.answer(index) if lucky else Prediction.failed("no luck")


class Millimetres(Perfect):
    def answer(self, index: int) -> Prediction:
        (best,) = super().answer(index).hypotheses
        return Prediction((replace(best, translation=1000 * best.translation),))


class Explodes(Perfect):
    def answer(self, index: int) -> Prediction:
        raise RuntimeError("the network exploded")


class Inexact(Perfect):
    """Noise from a generator of its own: half a millimetre, never the same."""

    def load(self, assets: Path | None, device: str) -> None:
        super().load(assets, device)
        self.generator = np.random.default_rng(0)

    def answer(self, index: int) -> Prediction:
        (best,) = super().answer(index).hypotheses
        moved = best.translation + 5e-4 * self.generator.random(3)
        return Prediction((replace(best, translation=moved),))


class DeclaredInexact(Inexact):
    info = replace(Perfect.info, deterministic=False)


class DeclaredBiased(Biased):
    info = DeclaredInexact.info


class Shifts(Perfect):
    """In a batch, each answer is further off than the one before."""

    def predict(self, batch: list[Observation], seed: int) -> list[Prediction]:
        best = [prediction.hypotheses[0] for prediction in super().predict(batch, seed)]
        return [
            Prediction((replace(hypothesis, translation=hypothesis.translation + 1e-3 * index),))
            for index, hypothesis in enumerate(best)
        ]
