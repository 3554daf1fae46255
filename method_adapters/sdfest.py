"""``sdfest``: Signed Distance Field Estimation (Bruns & Jensfelt, RA-L 2022).

A network gives a first estimate of pose, size and latent shape from the object's points; then the
decoded distance field is rendered, and all four are refined until it looks like the depth image.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from method_adapters._assets import Needy
from method_adapters._crop import NoAnswerError, require_depth_pixels
from method_adapters._declaration import port_info
from method_adapters._level_set import level_set
from method_adapters._sdfest_configuration import Configuration, read_configuration, released
from method_adapters._so3_grid import rotation_grid
from pytest_cpas.adapting import (
    OPENCV_FROM_OPENGL,
    Array,
    Asset,
    ContractError,
    Hypothesis,
    Mesh,
    Observation,
    Pose,
    Prediction,
    draw,
    heard_by,
    sample_surface,
    stage,
    tap,
)

if TYPE_CHECKING:
    from method_adapters._networks.sdfest import InitNet, SdfVae
    from method_adapters._sdf_renderer import Gradient
    from method_adapters._sdfest_estimation import Estimate, View
    from method_adapters._sdfest_together import Together

CATEGORIES = ("bottle", "bowl", "mug")
#: Depth beyond this is not used, metres.
FAR = 2.0
#: Steps of refinement.
ITERATIONS = 50
#: The surface is where the decoded distance is this, in half-widths of the volume.
LEVEL = 0.02
POINT_COUNT = 10_000

#: Object axes of older networks -> ShapeNet's. Their distance fields have y and z exchanged, which
#: mirrors the object; bottles, bowls and mugs are their own mirror images in x, and mirrored in x
#: as well, they are only turned.
SHAPENET_FROM_Z_UP = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])

RELEASE = "https://github.com/roym899/sdfest/releases/download/v0.1.0"
OLDER = "https://github.com/roym899/sdfest/tree/ral_submission/sdf_estimation/models"


def asset(name: str, *, older: bool = False) -> Asset:
    """A file of weights, of the release or older."""
    return Asset(path=f"sdfest/{name}", url=OLDER if older else f"{RELEASE}/{name}", licence="MIT")


@dataclass(frozen=True)
class Model:
    """What is trained for one category; ``grid``: its rotations as quaternions (n, 4); ``axes``
    (3, 3) take its object frame to ShapeNet's."""

    init: InitNet
    vae: SdfVae
    grid: Array
    axes: Array


class Sdfest(Needy):
    """SDFEst as a :class:`pytest_cpas.types.Method`; :meth:`predict_views` takes several views.

    ``sdfest/`` below the weights folder holds the files of the release v0.1.0, or an older set
    with configuration files; see :func:`configuration`. ``gradient`` and ``iterations`` may be
    changed.
    """

    extra = "sdf"
    #: Older networks have configurations in YAML.
    packages = (("torch", "torch"), ("skimage", "scikit-image"), ("yaml", "PyYAML"))
    info = port_info(
        "sdfest",
        *(asset(name) for category in CATEGORIES for name in released(category).weights),
        needs=frozenset({"depth"}),
        licence="MIT",
        object_frame="shapenet",
        categories=CATEGORIES,
    )
    gradient: Gradient = "correct"
    iterations = ITERATIONS

    def __init__(self) -> None:
        super().__init__()
        self._models: dict[str, Model] = {}
        self._together: dict[tuple[SdfVae, Gradient], Together] = {}

    @classmethod
    def assets_in(cls, folder: Path) -> tuple[Asset, ...]:
        """What :meth:`load` reads from a weights folder.

        Raises :class:`method_adapters._assets.AssetError` for a configuration that is none.
        """
        read: list[Asset] = []
        for category in cls.info.categories:
            layers, configured = configuration(folder, category)
            names = layers.weights if configured is None else (configured.name, *layers.weights)
            read += [asset(name, older=layers.z_up) for name in names]
        return tuple(read)

    def load(self, assets: Path | None, device: str) -> None:
        """Read the weights of all categories below the folder ``assets``.

        Raises FileNotFoundError, :class:`method_adapters._assets.AssetError`, or ValueError for a
        device that is not there.
        """
        from method_adapters._networks.running import device_named, load_weights
        from method_adapters._networks.sdfest import InitNet, SdfVae

        self._device = device_named(device)
        self._models = {}
        self._together = {}
        for category in self.info.categories:
            layers, _ = configuration(assets, category)
            model = Model(
                InitNet(layers),
                SdfVae(layers),
                rotation_grid(layers.head.resolution),
                SHAPENET_FROM_Z_UP if layers.z_up else np.eye(3),
            )
            for network, name in zip((model.init, model.vae), layers.weights, strict=True):
                load_weights(network, asset(name, older=layers.z_up).locate(assets))
                network.eval().requires_grad_(False).to(self._device)
            self._models[category] = model

    def predict(self, batch: Sequence[Observation], seed: int) -> list[Prediction]:
        """One prediction per observation; a GPU refines those of a category together."""
        here = Pose(np.eye(3), np.zeros(3))
        alike: dict[str, list[int]] = defaultdict(list)
        for i, seen in enumerate(batch):
            alike[seen.category].append(i)
        predictions: dict[int, Prediction] = {}
        for category, group in alike.items():
            objects = [[(batch[i], here)] for i in group]
            predictions |= zip(group, self._predict(category, objects, seed), strict=True)
        return [predictions[i] for i in range(len(batch))]

    def predict_views(self, views: Sequence[tuple[Observation, Pose]], seed: int) -> Prediction:
        """One prediction from several views of an object that does not move.

        With each observation comes its camera's pose, camera (OpenCV axes) to world; the hypothesis
        is posed in the world. The first view gives the first estimate, as published, and all of
        them refine it. Raises :class:`pytest_cpas.types.ContractError` for views of different
        categories, or none.
        """
        categories = {seen.category for seen, _ in views}
        if len(categories) != 1:
            raise ContractError(f"views of {sorted(categories)}; expected views of one object")
        return self._predict(categories.pop(), [views], seed)[0]

    def _predict(
        self,
        category: str,
        objects: Sequence[Sequence[tuple[Observation, Pose]]],
        seed: int,
    ) -> list[Prediction]:
        """One prediction per object of a category, from its views."""
        from method_adapters._networks.running import full_precision
        from method_adapters._sdfest_estimation import first_estimate

        if category not in self._models:
            known = ", ".join(self.info.categories)
            reason = f"category {category!r}: {self.info.name} knows {known}"
            return [Prediction.failed(reason) for _ in objects]
        model = self._models[category]
        predictions: dict[int, Prediction] = {}
        taken: dict[int, list[View]] = {}
        with stage("pre-processing"):
            for i, views in enumerate(objects):
                try:
                    taken[i] = [tap("input", self._view(seen, camera)) for seen, camera in views]
                except NoAnswerError as error:
                    predictions[i] = Prediction.failed(str(error))
        with full_precision():
            with stage("network"):
                first = [
                    first_estimate(model.init, model.grid, views[0]) for views in taken.values()
                ]
            with stage("refinement"):
                refined = self._refined(model, first, list(taken.values()))
            with stage("post-processing"):
                for i, found in zip(taken, refined, strict=True):
                    try:
                        mesh = reconstruct(model.vae, found)
                        hypothesis = interpret(found, mesh, model.axes, seed)
                        predictions[i] = Prediction((hypothesis,))
                    except NoAnswerError as error:
                        predictions[i] = Prediction.failed(str(error))
        return [predictions[i] for i in range(len(objects))]

    def _refined(
        self, model: Model, first: Sequence[Estimate], taken: Sequence[Sequence[View]]
    ) -> list[Estimate]:
        """What the refinement makes of first estimates."""
        from method_adapters._networks.graphs import queued
        from method_adapters._sdfest_estimation import refine
        from method_adapters._sdfest_together import Together

        found: list[Estimate | None] = [None] * len(first)
        # what happens within a graph cannot be heard
        if heard_by() is None and all(len(x) == 1 and queued(x[0].points) for x in taken):
            together = self._together.setdefault(
                (model.vae, self.gradient), Together(model.vae, self.gradient)
            )
            found = together(first, [views[0] for views in taken], self.iterations)
        return [
            refine(model.vae, start, views, self.iterations, self.gradient)
            if done is None
            else done
            for start, views, done in zip(first, taken, found, strict=True)
        ]

    def _view(self, seen: Observation, camera: Pose) -> View:
        from torch import as_tensor

        from method_adapters._sdfest_estimation import View

        used = tap("seen", seen.mask & (seen.depth <= FAR))
        points = seen.camera.back_project(seen.depth, used)
        require_depth_pixels(len(points))
        points = points @ OPENCV_FROM_OPENGL
        directions = points / np.linalg.norm(points, axis=1, keepdims=True)
        parts = (directions, points, camera.rotation @ OPENCV_FROM_OPENGL, camera.translation)
        single = (np.array(part, dtype=np.float32) for part in parts)
        return View(*(as_tensor(part, device=self._device) for part in single))


def configuration(assets: Path | None, category: str) -> tuple[Configuration, Path | None]:
    """What the files in the weights folder are for a category, and the file that says it.

    With ``robust_CATEGORY.yaml``, or else ``CATEGORY.yaml``, what that says; the robust networks
    were trained with inexact masks, like the release. Without, the release v0.1.0.
    """
    for name in (f"robust_{category}.yaml", f"{category}.yaml"):
        if assets is not None and (path := assets / asset(name).path).is_file():
            return read_configuration(path), path
    return released(category), None


def reconstruct(vae: SdfVae, found: Estimate) -> Mesh:
    """The closed surface of an estimate in its own frame, metres; raises :class:`NoAnswerError`."""
    from torch import inference_mode

    half_width = float(found.half_width)
    if not 0 < half_width < np.inf:
        raise NoAnswerError(f"the half-width of the volume became {half_width:g} m")
    with inference_mode():
        distances = tap("distances", vae(found.latent[None])[0, 0]).cpu().numpy()
    return level_set(distances, LEVEL, half_width=half_width, closed=True)


def interpret(found: Estimate, mesh: Mesh, axes: Array, seed: int) -> Hypothesis:
    """The answer in the world frame, object axes turned by ``axes`` (3, 3): pose, mesh, points on
    it, and the box around these that has its centre at the origin."""
    mesh = Mesh(mesh.vertices @ axes.T, mesh.triangles)
    tap("mesh", {"vertices": mesh.vertices, "triangles": mesh.triangles})
    points = draw("sampled", sample_surface(mesh, POINT_COUNT, seed))
    return Hypothesis(
        rotation=Rotation.from_quat(found.quaternion.cpu().numpy()).as_matrix() @ axes.T,
        translation=found.position.cpu().numpy(),
        extents=2 * np.abs(points).max(axis=0),
        points=points,
        mesh=mesh,
    )
