"""``asmnet``: ASM-Net, pose and shape by parametric deformation (Akizuki & Hashimoto, BMVC 2021).

Written from descriptions of the method, not from its code. From depth and mask alone a network
estimates orientation, scale and the coefficients of an active shape model; ICP then moves the shape
onto the visible points.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from method_adapters._assets import NOCS_TERMS, Needy
from method_adapters._crop import MIN_DEPTH_PIXELS, NoAnswerError
from method_adapters._declaration import port_info
from method_adapters._shape_model import COMPONENTS, ShapeModel, read_shape_model
from pytest_cpas.adapting import (
    CATEGORIES,
    Asset,
    Hypothesis,
    Observation,
    Prediction,
    draw,
    import_open3d,
    stage,
    tap,
)

Array = NDArray[np.float64]

#: Points that the network takes.
POINT_COUNT = 800
#: Depth from here on is background: so many standard deviations beyond the mean, and metres.
FAR_DEVIATIONS = 2.0
FARTHEST = 3.0
#: Neighbours and deviations of the outlier removal of the observed cloud and of the shape.
OBSERVED_OUTLIERS = (100, 2.0)
SHAPE_OUTLIERS = (20, 1.0)
#: Voxel size of both clouds before ICP, and ICP's largest correspondence distance, metres.
VOXEL = 0.005
CORRESPONDENCE = 0.02
#: Radius of the spherical projection that finds hidden points (Katz et al., 2007), metres.
HIDDEN_RADIUS = 50.0
#: Clouds of so few points are not registered.
TOO_FEW = 3

_SOURCE = "https://drive.google.com/file/d/1fxc9UoRhfTsoV3ZML3Mx_mc79904zpcx (a zip; unpack it"
_ASSETS = tuple(
    Asset(
        path=f"asmnet/params/{path}",
        url=f"{_SOURCE} below asmnet/)",
        licence=f"no licence stated; {NOCS_TERMS}",
    )
    for category in CATEGORIES
    for path in (f"weights/{category}/model.pth", f"asm_params/{category}/train/info.npz")
)


class Inputs(NamedTuple):
    """``points`` (3, 800): what the network takes, (cloud - ``centre``) / ``factor``; ``cloud``
    (N, 3), ``centre`` (3,) and ``factor`` in metres, camera frame."""

    points: NDArray[np.float32]
    cloud: Array
    centre: Array
    factor: float


class AsmNet(Needy):
    """ASM-Net as a :class:`pytest_cpas.types.Method`; every category has a network and a shape
    model of its own."""

    extra = "open3d,torch"
    packages = (("torch", "torch"), ("open3d", "Open3D"))
    info = port_info("asmnet", *_ASSETS, needs=frozenset({"depth"}))

    def load(self, assets: Path | None, device: str) -> None:
        """Read the networks and shape models of all categories below the folder ``assets``.

        Raises FileNotFoundError, :class:`method_adapters._assets.AssetError`, ImportError where
        Open3D is missing, or ValueError for a device that is not there.
        """
        from method_adapters._networks.asmnet import AsmNet as Network
        from method_adapters._networks.running import Runner, load_weights

        import_open3d()
        self._run, self._models = {}, {}
        for category, weights, model in zip(CATEGORIES, _ASSETS[::2], _ASSETS[1::2], strict=True):
            network = Network()
            load_weights(network, weights.locate(assets))
            self._run[category] = Runner(network, device)
            self._models[category] = read_shape_model(model.locate(assets))

    def predict(self, batch: Sequence[Observation], seed: int) -> list[Prediction]:
        """One prediction per observation; those of a category go through its network together."""
        predictions: dict[int, Prediction] = {}
        inputs: dict[int, Inputs] = {}
        alike: dict[str, list[int]] = defaultdict(list)
        with stage("pre-processing"):
            for i, seen in enumerate(batch):
                try:
                    inputs[i] = tap("input", self.prepare(seen, np.random.default_rng(seed)))
                    alike[seen.category].append(i)
                except NoAnswerError as error:
                    predictions[i] = Prediction.failed(str(error))
        for category, group in alike.items():
            with stage("network"):
                outputs = self._run[category](np.stack([inputs[i].points for i in group]))
            with stage("post-processing"):
                for i, shape, quaternion in zip(group, *outputs, strict=True):
                    try:
                        found = interpret(inputs[i], self._models[category], shape, quaternion)
                        predictions[i] = Prediction((found,))
                    except NoAnswerError as error:
                        predictions[i] = Prediction.failed(str(error))
        return [predictions[i] for i in range(len(batch))]

    def prepare(self, observation: Observation, generator: np.random.Generator) -> Inputs:
        """What the network sees of an observation; raises :class:`NoAnswerError`."""
        if observation.category not in CATEGORIES:
            raise NoAnswerError(
                f"category {observation.category!r}: {self.info.name} knows {', '.join(CATEGORIES)}"
            )
        depth = np.rint(observation.depth.astype(float) * 1000) / 1000  # whole millimetres
        tap("depth", depth)
        seen = observation.mask & (depth > 0)
        if seen.any():
            values = depth[seen]
            # the nearest stay: where all depths are one, the limit is that depth
            seen &= (depth < values.mean() + FAR_DEVIATIONS * values.std()) | (
                depth == values.min()
            )
        seen &= depth < FARTHEST
        if np.count_nonzero(seen) < MIN_DEPTH_PIXELS:
            raise NoAnswerError(
                f"{np.count_nonzero(seen)} pixels of the mask have a depth that counts, expected"
                f" at least {MIN_DEPTH_PIXELS}"
            )
        tap("seen", seen)
        cloud = without_outliers(observation.camera.back_project(depth, seen), *OBSERVED_OUTLIERS)
        centre = cloud.mean(axis=0)
        factor = float(np.linalg.norm(cloud - centre, axis=1).max())
        tap("cloud", cloud)
        chosen = draw(
            "picked", generator.choice(len(cloud), POINT_COUNT, replace=len(cloud) < POINT_COUNT)
        )
        points = ((cloud[chosen] - centre) / factor).T.astype(np.float32)
        return Inputs(np.ascontiguousarray(points), cloud, centre, factor)


def interpret(inputs: Inputs, model: ShapeModel, shape: Array, quaternion: Array) -> Hypothesis:
    """The answer from a network's outputs for one sample, (4,) each.

    Raises :class:`NoAnswerError` for a scale that is not positive: the shape would be mirrored
    through its origin.
    """
    scale = float(shape[COMPONENTS])
    if not np.isfinite(shape).all():
        raise NoAnswerError(f"the network's estimate of the shape is {shape.tolist()}")
    if scale <= 0:
        raise NoAnswerError(f"the estimated scale is {scale:g}, not positive")
    points = tap("deformed", model.deformed(shape[:COMPONENTS]))
    points = without_outliers(points, *SHAPE_OUTLIERS)
    points = tap("shape", points * scale * inputs.factor)
    rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    posed = tap("posed", points @ rotation.T + inputs.centre)
    motion = tap("motion", registration(posed, inputs.cloud))
    posed = posed @ motion[:3, :3].T + motion[:3, 3]
    rotation = motion[:3, :3] @ rotation
    # of the box along the camera's axes, as published
    translation = (posed.min(axis=0) + posed.max(axis=0)) / 2
    points = (posed - translation) @ rotation
    return Hypothesis(
        rotation=rotation,
        translation=translation,
        extents=2 * np.abs(points).max(axis=0),
        points=points,
    )


def registration(posed: Array, cloud: Array) -> Array:
    """The rigid motion (4, 4) that ICP finds from a posed shape (N, 3) to an observed cloud
    (M, 3), camera frame, metres; the identity for too few points.

    Only what the camera would see of the shape takes part. Raises :class:`NoAnswerError` for a
    shape of which nothing is seen.
    """
    open3d = import_open3d()
    source = _cloud(posed).voxel_down_sample(VOXEL)
    target = _cloud(cloud).voxel_down_sample(VOXEL)
    if min(len(source.points), len(target.points)) <= TOO_FEW:
        return np.eye(4)
    try:
        _, visible = source.hidden_point_removal(np.zeros(3), HIDDEN_RADIUS)
    except RuntimeError as error:  # qhull's
        raise NoAnswerError(
            f"the estimated shape lies in a plane with the camera: {np.ptp(posed, axis=0)} m"
        ) from error
    source = source.select_by_index(visible)
    if len(source.points) <= TOO_FEW:
        return np.eye(4)
    method = open3d.pipelines.registration
    found = method.registration_icp(
        source,
        target,
        CORRESPONDENCE,
        np.eye(4),
        method.TransformationEstimationPointToPoint(),
        method.ICPConvergenceCriteria(max_iteration=30),
    )
    # Open3D adds up correspondences in the order in which its threads finish
    return np.round(np.asarray(found.transformation), 9)


def without_outliers(points: Array, neighbours: int, deviations: float) -> Array:
    """The points (N, 3) whose mean distance to their nearest neighbours is within so many
    standard deviations of the mean over all. Raises :class:`NoAnswerError` if none is left."""
    kept, _ = _cloud(points).remove_statistical_outlier(neighbours, deviations)
    if not kept.points:
        raise NoAnswerError(f"of {len(points)} points all are outliers: they are one point")
    return np.asarray(kept.points)


def _cloud(points: Array) -> Any:
    open3d = import_open3d()
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
