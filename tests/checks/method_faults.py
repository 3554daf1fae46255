"""The catalogue of planted method faults: each is ``icp`` as an adapter would get it wrong.

Run as a script it prints for every fault the contract checks that catch it and, if the run would go
on to its samples, what the diagnosis says; it fails on a fault that is not caught as the catalogue
says, on a check that is violated by no fault, and on an alarm about the sound ``icp``::

    python tests/checks/method_faults.py --seeds 20
"""

import argparse
import random
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # when this is run as a script

from planted import Planted, Scenes, sound, spoilt
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_info

from pytest_cpas.checks.contract import CONTRACT
from pytest_cpas.diagnosis.running import diagnose_run
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.golden import RunTable
from pytest_cpas.session.contract_stage import ContractStage
from pytest_cpas.types import CATEGORIES, Hypothesis, Mesh, Observation, Prediction
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET, OPENCV_FROM_OPENGL

DIAGNOSIS = "diagnosis: "


@dataclass(frozen=True)
class Fault:
    """``by``: the check that must catch it, or the finding of the diagnosis that must name it."""

    name: str
    make: type[Planted]
    by: str


FAULTS: list[Fault] = []


def fault(name: str, make: type[Planted], by: str) -> None:
    FAULTS.append(Fault(name, make, by))


def answer(name: str, by: str, change: Callable[..., Any], **declared: Any) -> None:
    fault(name, spoilt(change, **declared), by)


def behaviour(name: str, by: str) -> Callable[[type[Planted]], type[Planted]]:
    def register(make: type[Planted]) -> type[Planted]:
        fault(name, make, by)
        return make

    return register


def of_diagnosis(name: str) -> str:
    return DIAGNOSIS + name


# -- frames ------------------------------------------------------------------------------------

GL, NOCS = OPENCV_FROM_OPENGL, NOCS_FROM_SHAPENET


def in_object_frame(axes: Any) -> Callable[..., Any]:
    """Everything in other object axes, which the adapter does not declare."""
    return lambda h, o: {
        "rotation": h.rotation @ axes.T,
        "points": h.points @ axes.T,
        "extents": np.abs(axes) @ h.extents,
    }


Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])

answer("OpenGL camera", "in_front_of_camera",
       lambda h, o: {"rotation": GL @ h.rotation, "translation": GL @ h.translation})  # fmt: skip
answer("OpenGL camera, rotation alone", of_diagnosis("camera-frame-opengl-rotation"),
       lambda h, o: {"rotation": GL @ h.rotation})  # fmt: skip
answer("OpenGL camera, translation alone", "in_front_of_camera",
       lambda h, o: {"translation": GL @ h.translation})  # fmt: skip
answer("declared OpenGL, given OpenCV", "in_front_of_camera", lambda h, o: {},
       camera_frame="opengl")  # fmt: skip
answer("x of the camera flipped", of_diagnosis("translation-sign-x"),
       lambda h, o: {"translation": h.translation * [-1, 1, 1]})  # fmt: skip
answer("x and y of the camera exchanged", of_diagnosis("translation-x-y-swapped"),
       lambda h, o: {"translation": h.translation[[1, 0, 2]]})  # fmt: skip
answer("NOCS object axes", of_diagnosis("object-frame-nocs"), in_object_frame(NOCS))
answer("declared NOCS, given ShapeNet", of_diagnosis("object-frame-shapenet"), lambda h, o: {},
       object_frame="nocs")  # fmt: skip
answer("NOCS axes in the rotation alone", of_diagnosis("object-frame-nocs"),
       lambda h, o: {"rotation": h.rotation @ NOCS.T})  # fmt: skip
answer("z up", of_diagnosis("object-frame"), in_object_frame(Z_UP))
answer("upside down", of_diagnosis("object-frame"), in_object_frame(np.diag([1.0, -1, -1])))
answer("transposed rotation", of_diagnosis("rotation-transposed"),
       lambda h, o: {"rotation": h.rotation.T})  # fmt: skip
answer("inverse pose", of_diagnosis("pose-inverse"),
       lambda h, o: {"rotation": h.rotation.T, "translation": -h.rotation.T @ h.translation},
       )  # fmt: skip


def as_quaternion(order: Sequence[int]) -> Callable[..., Any]:
    def change(h: Hypothesis, o: Observation) -> dict[str, Any]:
        quaternion = Rotation.from_matrix(h.rotation).as_quat()[list(order)]
        return {"rotation": Rotation.from_quat(quaternion).as_matrix()}

    return change


answer("quaternion w, x, y, z read as x, y, z, w", of_diagnosis("quaternion-order-wxyz"),
       as_quaternion((3, 0, 1, 2)))  # fmt: skip
answer("quaternion x, y, z, w read as w, x, y, z", of_diagnosis("quaternion-order-xyzw"),
       as_quaternion((1, 2, 3, 0)))  # fmt: skip
answer("mirrored rotation", "answers", lambda h, o: {"rotation": h.rotation * [-1, 1, 1]})
answer("quaternion not normalised", "answers",
       lambda h, o: {"rotation": 1.1 * h.rotation})  # fmt: skip
answer("scale left in the rotation", "answers",
       lambda h, o: {"rotation": np.linalg.norm(h.extents) * h.rotation})  # fmt: skip
answer("origin at the foot", "shape_in_box", lambda h, o: {
    "translation": h.translation - h.rotation[:, 1] * h.extents[1] / 2,
    "points": h.points + h.extents * [0, 0.5, 0]})  # fmt: skip
answer("mug not recentred", of_diagnosis("object-origin"), lambda h, o: {
    "translation": h.translation + h.rotation @ [0.03, 0, 0],
    "points": h.points - [0.03, 0, 0]} if o.category == "mug" else {})  # fmt: skip

# -- units, sizes, shapes ----------------------------------------------------------------------

answer("millimetres", "metric_units", lambda h, o: {"translation": 1000 * h.translation})
answer("centimetres", "metric_units", lambda h, o: {"translation": 100 * h.translation})
answer("everything in millimetres", "metric_units", lambda h, o: {
    "translation": 1000 * h.translation, "extents": 1000 * h.extents,
    "points": 1000 * h.points})  # fmt: skip
answer("translation divided by the size", "metric_units",
       lambda h, o: {"translation": h.translation / np.linalg.norm(h.extents)})  # fmt: skip
answer("half extents", "extents_of_shape", lambda h, o: {"extents": h.extents / 2})
answer("doubled extents", "extents_of_shape", lambda h, o: {"extents": 2 * h.extents})
answer("normalised extents", "extents_of_shape",
       lambda h, o: {"extents": h.extents / np.linalg.norm(h.extents)})  # fmt: skip
answer("extents in millimetres", "metric_units", lambda h, o: {"extents": 1000 * h.extents})
answer("permuted extents", "extents_of_shape", lambda h, o: {"extents": h.extents[[1, 2, 0]]})
answer("extents of NOCS axes", "extents_of_shape", lambda h, o: {"extents": h.extents[[1, 0, 2]]})
answer("normalised shape", "shape_in_box",
       lambda h, o: {"points": h.points / np.linalg.norm(h.extents)})  # fmt: skip
answer("normalised shape and extents", "projects_onto_mask", lambda h, o: {
    "points": h.points / np.linalg.norm(h.extents),
    "extents": h.extents / np.linalg.norm(h.extents)})  # fmt: skip
answer("shape in the camera frame", "shape_in_box", lambda h, o: {"points": h.pose.apply(h.points)})
answer("negative extents", "answers", lambda h, o: {"extents": -h.extents})
answer("extents of zero", "answers", lambda h, o: {"extents": 0 * h.extents})
answer("infinite extents for a category", "answers",
       lambda h, o: {"extents": h.extents * (np.inf if o.category == "can" else 1)})  # fmt: skip
answer("triangles from 1", "answers", lambda h, o: {
    "mesh": Mesh(h.points, np.arange(3 * (len(h.points) // 3)).reshape(-1, 3) + 3)})  # fmt: skip
answer("rotation as a list of 9", "answers", lambda h, o: {"rotation": h.rotation.ravel()})
answer("integers", "in_front_of_camera", lambda h, o: {"translation": h.translation.astype(int)})
answer("a score that is not declared", "answers", lambda h, o: {"score": 0.5})
answer("no shape, though declared", "answers", lambda h, o: {"points": None})
answer("NaN for a category", "answers", lambda h, o: {
    "translation": h.translation * (np.nan if o.category == "can" else 1)})  # fmt: skip

# -- the camera --------------------------------------------------------------------------------


def seen_by(camera: Callable[[Any], Any]) -> type[Planted]:
    """What icp answers for another camera: intrinsics that are not those of the image."""

    class Seen(Planted):
        def answer(self, observation: Observation, seed: int) -> Prediction:
            return sound(replace(observation, camera=camera(observation.camera)), seed)

    return Seen


fault("principal point in the middle of the image", seen_by(
    lambda c: replace(c, cx=(c.width - 1) / 2, cy=(c.height - 1) / 2)), "shift")  # fmt: skip
fault("principal point of another camera", seen_by(
    lambda c: replace(c, cx=c.cx + 12, cy=c.cy - 9)), of_diagnosis("principal-point"))  # fmt: skip
fault("principal point at 0", seen_by(lambda c: replace(c, cx=0.0, cy=0.0)), "projects_onto_mask")
fault("cx and cy exchanged", seen_by(lambda c: replace(c, cx=c.cy, cy=c.cx)), "projects_onto_mask")
fault("focal length of another camera", seen_by(
    lambda c: replace(c, fx=525.0, fy=525.0)), "resolution")  # fmt: skip


@behaviour("depth in another sensor's unit", "metric_units")
class DeepDepth(Planted):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        depth = (observation.depth * 2.5).astype(np.float32)
        return sound(replace(observation, depth=depth), seed)


@behaviour("image flipped for augmentation", "shift")
class FlippedImage(Planted):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        depth, mask = (
            np.ascontiguousarray(x[:, ::-1]) for x in (observation.depth, observation.mask)
        )
        return sound(replace(observation, depth=depth, mask=mask), seed)


@behaviour("rows taken for columns", "shift")
class Transposed(Planted):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        rgb = np.ascontiguousarray(observation.rgb.transpose(1, 0, 2))
        depth, mask = (np.ascontiguousarray(x.T) for x in (observation.depth, observation.mask))
        c = observation.camera
        camera = replace(c, width=c.height, height=c.width)
        return sound(
            Observation(
                category=observation.category, rgb=rgb, depth=depth, mask=mask, camera=camera
            ),
            seed,
        )


answer("always upright", "roll", lambda h, o: {"rotation": upright(h.rotation)})


def upright(rotation: Any) -> Any:
    """The nearest rotation whose y axis is up in the image, seen from 35 degrees above."""
    up = Rotation.from_euler("x", 215, degrees=True).as_matrix()
    yaw = Rotation.from_matrix(up.T @ rotation).as_rotvec()[1]
    return up @ Rotation.from_euler("y", yaw).as_matrix()


answer("size grows with the distance", "distance", lambda h, o: {
    "extents": h.extents * h.translation[2] ** 4 / 0.36,
    "points": h.points * h.translation[2] ** 4 / 0.36})  # fmt: skip
answer("leaves the image's middle to the right", "mirror", lambda h, o: {
    "translation": h.translation + 0.03 * np.array([h.translation[0] > 0, 0, 0])})  # fmt: skip


# -- seeds and global state --------------------------------------------------------------------


def other_seed(draw: Callable[[], int]) -> type[Planted]:
    class OtherSeed(Planted):
        def answer(self, observation: Observation, seed: int) -> Prediction:
            return sound(observation, draw())

    return OtherSeed


fault("no seed", other_seed(lambda: int(np.random.default_rng().integers(1000))), "repeatable")
fault("the clock for a seed", other_seed(lambda: time.perf_counter_ns() % 997), "repeatable")
fault("numpy's global generator", other_seed(
    lambda: np.random.randint(1000)), "global_random_state")  # noqa: NPY002 # fmt: skip
fault("python's global generator", other_seed(
    lambda: random.randrange(1000)), "global_random_state")  # fmt: skip


@behaviour("seeds numpy's global generator", "global_random_state_untouched")
class Seeds(Planted):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        np.random.seed(seed)  # noqa: NPY002
        return sound(observation, np.random.randint(1000))  # noqa: NPY002


@behaviour("a generator kept since load", "repeatable")
class KeptGenerator(Planted):
    def load(self, assets: Path | None, device: str) -> None:
        self.generator = np.random.default_rng(0)

    def answer(self, observation: Observation, seed: int) -> Prediction:
        return sound(observation, int(self.generator.integers(1000)))


@behaviour("one generator for the batch", "batch")
class BatchGenerator(Planted):
    def predict(self, batch: Sequence[Observation], seed: int) -> Any:
        generator = np.random.default_rng(seed)
        return [sound(each, int(generator.integers(1000))) for each in batch]


@behaviour("a counter for a seed", "repeatable")
class Counter(Planted):
    calls = 0

    def answer(self, observation: Observation, seed: int) -> Prediction:
        type(self).calls += 1
        return sound(observation, seed + self.calls % 50)


@behaviour("weights drawn at load", "fresh_instance")
class DrawnAtLoad(Planted):
    def load(self, assets: Path | None, device: str) -> None:
        self.seed = int(np.random.default_rng().integers(1000))

    def answer(self, observation: Observation, seed: int) -> Prediction:
        return sound(observation, self.seed)


@behaviour("load uses its file up", "fresh_instance")
class LoadsOnce(Planted):
    loaded = 0

    def load(self, assets: Path | None, device: str) -> None:
        type(self).loaded += 1
        if self.loaded > 1:
            raise FileNotFoundError("weights.pth was moved")


# -- leaks -------------------------------------------------------------------------------------


class Remembers(Planted):
    before: Observation | None = None
    said: Prediction | None = None


@behaviour("the previous sample's answer", "repeatable")
class Late(Remembers):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        said, self.said = self.said, sound(observation, seed)
        return said or self.said


@behaviour("smoothed over time", "repeatable")
class Smoothed(Remembers):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        now = sound(observation, seed)
        if self.said is not None and now.hypotheses and self.said.hypotheses:
            best, last = now.hypotheses[0], self.said.hypotheses[0]
            moved = 0.9 * best.translation + 0.1 * last.translation
            now = Prediction((replace(best, translation=moved),))
        self.said = now
        return now


@behaviour("the previous answer where there is none", "no_evidence")
class Falls(Remembers):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        now = sound(observation, seed)
        if now.hypotheses or self.said is None:
            self.said = now
        return self.said


@behaviour("the previous sample's category", "repeatable")
class LateCategory(Remembers):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        before, self.before = self.before or observation, observation
        return sound(replace(observation, category=before.category), seed)


@behaviour("the first sample's category for all", "fresh_instance")
class FirstCategory(Remembers):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        self.before = self.before or observation
        return sound(replace(observation, category=self.before.category), seed)


@behaviour("drifts with the number of samples", "order")
class Drifts(Planted):
    def load(self, assets: Path | None, device: str) -> None:
        self.asked: list[Any] = []

    def answer(self, observation: Observation, seed: int) -> Prediction:
        key = observation.mask.tobytes()
        if not self.asked or self.asked[-1] != key:
            self.asked.append(key)
        now = sound(observation, seed)
        if len(self.asked) < 6 or not now.hypotheses:
            return now
        best = now.hypotheses[0]
        return Prediction((replace(best, translation=best.translation * 1.001),))


@behaviour("answers kept by the mask", "no_evidence")
class KeptByMask(Planted):
    def load(self, assets: Path | None, device: str) -> None:
        self.kept: dict[bytes, Prediction] = {}

    def answer(self, observation: Observation, seed: int) -> Prediction:
        key = observation.mask.tobytes()
        if key not in self.kept:
            self.kept[key] = sound(observation, seed)
        return self.kept[key]


@behaviour("millimetres made in place", "inputs_unmodified")
class ChangesDepth(Planted):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        prediction = sound(observation, seed)
        observation.depth[:] *= 1000
        return prediction


@behaviour("mask eroded in place", "inputs_unmodified")
class ChangesMask(Planted):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        prediction = sound(observation, seed)
        observation.mask[1:] &= observation.mask[:-1]
        return prediction


@behaviour("channels exchanged in place", "inputs_unmodified")
class ChangesColour(Planted):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        prediction = sound(observation, seed)
        observation.rgb[:] = observation.rgb[..., ::-1].copy()
        return prediction


# -- batches and threads -----------------------------------------------------------------------


@behaviour("batch norm in training mode", "batch")
class BatchNorm(Planted):
    def predict(self, batch: Sequence[Observation], seed: int) -> Any:
        mean = np.mean([each.depth.mean() for each in batch])
        found = []
        for each in batch:
            now = sound(each, seed)
            if now.hypotheses:
                best = now.hypotheses[0]
                shift = [0, 0, 0.01 * (each.depth.mean() - mean)]
                now = Prediction((replace(best, translation=best.translation + shift),))
            found.append(now)
        return found


@behaviour("batch sorted by category", "batch")
class Sorted(Planted):
    def predict(self, batch: Sequence[Observation], seed: int) -> Any:
        ordered = sorted(batch, key=lambda each: CATEGORIES.index(each.category))
        return [sound(each, seed) for each in ordered]


@behaviour("first of the batch only", "batch")
class First(Planted):
    def predict(self, batch: Sequence[Observation], seed: int) -> Any:
        return [sound(each, seed) for each in batch[:1]]


@behaviour("empty batch raises", "batch")
class NotEmpty(Planted):
    def predict(self, batch: Sequence[Observation], seed: int) -> Any:
        np.stack([each.depth for each in batch])
        return super().predict(batch, seed)


@behaviour("a generator instead of a list", "answers")
class Yields(Planted):
    def predict(self, batch: Sequence[Observation], seed: int) -> Any:
        return (sound(each, seed) for each in batch)


@behaviour("matrices instead of predictions", "answers")
class Matrices(Planted):
    def predict(self, batch: Sequence[Observation], seed: int) -> Any:
        return [sound(each, seed).hypotheses[0].pose.matrix for each in batch]


@behaviour("leaves out what it cannot answer", "no_evidence")
class LeavesOut(Planted):
    def predict(self, batch: Sequence[Observation], seed: int) -> Any:
        return [found for each in batch if (found := sound(each, seed)).hypotheses]


@behaviour("raises without depth", "no_evidence")
class Raises(Planted):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        np.median(observation.depth[observation.mask & (observation.depth > 0)][0])
        return sound(observation, seed)


@behaviour("as many parts of the work as threads", "threads")
class Threads(Planted):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        threads = max(int(pool["num_threads"]) for pool in threadpool_info())
        return sound(observation, seed + threads)


# -- what is not declared ----------------------------------------------------------------------


@behaviour("colour weighs in", "colour")
class UsesColour(Planted):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        return sound(
            observation, seed + round(100 * float(observation.rgb[observation.mask].mean()))
        )


@behaviour("depth, though declared to need colour alone", "depth")
class UsesDepth(Planted):
    info = replace(Planted.info, needs=frozenset({"rgb"}))


@behaviour("depth of the background weighs in", "background")
class UsesBackground(Planted):
    def answer(self, observation: Observation, seed: int) -> Prediction:
        return sound(observation, seed + round(float(observation.depth[~observation.mask].mean())))


# -- running -----------------------------------------------------------------------------------


def caught(make: type[Planted], seed: int = 0) -> list[str]:
    """The contract checks that the method violates, and what the diagnosis makes of its answers,
    as far as there are any."""
    run = MethodRun(make(), Scenes(), seed=seed)
    stage = ContractStage(run)
    results = [stage.result(check) for check in CONTRACT.values()]
    names = [result.check for result in results if result.violated]
    return names if "answers" in names else names + diagnosed(run)


def diagnosed(run: MethodRun) -> list[str]:
    """What the diagnosis says, as the catalogue names it."""
    rows = [run.judge(ref) for ref in run.samples]
    # the sound icp's table is full
    table = RunTable.of(run, rows)
    expected = {(c, label): 1.0 for c, cells in table.table.items() for label in cells}
    return [DIAGNOSIS + found.name for found in diagnose_run(run, rows, table, expected)]


def is_named(fault: Fault, names: Sequence[str]) -> bool:
    if fault.by.startswith(DIAGNOSIS):
        return any(name.startswith(fault.by) for name in names)
    return fault.by in names


def caught_in(index: int) -> list[str]:
    """What catches a fault; by its index, which other processes know."""
    return caught(FAULTS[index].make)


def alarms_of(seed: int) -> list[str]:
    """What the sound icp is accused of."""
    return caught(Planted, seed)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20, help="seeds of the sound icp")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    start = time.perf_counter()
    missed, alarms, seen = [], [], set()
    with ProcessPoolExecutor(options.processes) as pool:
        results = pool.map(caught_in, range(len(FAULTS)))
        for planted, names in zip(FAULTS, results, strict=True):
            seen |= set(names)
            print(f"method: {planted.name}\n    {', '.join(names) or '-'}", flush=True)
            if not is_named(planted, names):
                missed.append(f"{planted.name}: expected {planted.by}")
    # processes of their own: a planted fault may have spoilt what the others share
    with ProcessPoolExecutor(options.processes) as pool:
        seeds = range(options.seeds)
        for seed, names in zip(seeds, pool.map(alarms_of, seeds), strict=True):
            alarms += [f"seed {seed}: {name}" for name in names]
    idle = [name for name in CONTRACT if name not in seen]
    seconds = time.perf_counter() - start
    print(
        f"\n{len(FAULTS)} method faults, {len(CONTRACT)} checks, {options.seeds} seeds of the"
        f" sound icp: {seconds:.0f} s"
    )
    for words, lines in (
        ("faults that are not caught as expected", missed),
        ("checks that catch nothing", idle),
        ("alarms about the sound icp", alarms),
    ):
        print(f"{words}: {len(lines)}")
        for line in lines:
            print(f"    {line}")
    return bool(missed or idle or alarms)


if __name__ == "__main__":
    sys.exit(main())
