"""``icaps``: Iterative Category-level Object Pose and Shape Estimation (Deng et al., RA-L 2022).

Written from descriptions of the method, not from its code. From depth and mask alone a particle
filter compares crops with a codebook of rotations; then a latent shape and the pose improve each
other. A sequence can be tracked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from method_adapters._assets import NOCS_TERMS, Needy
from method_adapters._crop import NoAnswerError
from method_adapters._declaration import port_info
from method_adapters._level_set import level_set
from method_adapters._particle_filter import Belief, View, first_belief, next_belief
from pytest_cpas.adapting import (
    CATEGORIES,
    NOCS_FROM_SHAPENET,
    Asset,
    Hypothesis,
    Mesh,
    Observation,
    Prediction,
    draw,
    stage,
    tap,
)

if TYPE_CHECKING:
    from method_adapters._networks.icaps import Shape
    from method_adapters._networks.icaps_matching import Matcher
    from method_adapters._networks.icaps_refinement import Placed, Refiner

Array = NDArray[np.float64]

#: Diagonal of a category's box where its bounding sphere has radius 1, as published.
RATIOS = {
    "bottle": 2.149, "bowl": 2.7, "camera": 2.328, "can": 2.327, "laptop": 2.076, "mug": 2.199
}  # fmt: skip

#: Adam's steps, 0.002 long, go on until the end, so float noise may decide where the last ones go;
#: 0.0032 was seen between one thread and two. Radians, and more than it is in metres.
TOLERANCE = 5e-3

_SOURCE = (
    "https://drive.google.com/file/d/1AvLMnHssLOpmWkDuWGsUvFNIfGjBC-ok (a tar; unpack it below"
    " icaps/, and name the category's file so)"
)
#: Files of a category, below checkpoints/.
_FILES = (
    "aae_ckpts/{}/model.pth",
    "aae_ckpts/{}/codebook.pth",
    "latentnet_ckpts/{}/model.pth",
    "deepsdf_ckpts/{}/ModelParameters/2000.pth",
)
_ASSETS = {
    category: tuple(
        Asset(
            path=f"icaps/checkpoints/{path.format(category)}",
            url=_SOURCE,
            licence=f"no licence stated; {NOCS_TERMS}",
        )
        for path in _FILES
    )
    for category in CATEGORIES
}


class Track(NamedTuple):
    """What is known of an object from one frame to the next."""

    belief: Belief
    placed: Placed
    shape: Shape
    mesh: Mesh


class ICaps(Needy):
    """iCaps as a :class:`pytest_cpas.types.Method`; every category has networks of its own."""

    extra = "sdf"
    packages = (("torch", "torch"), ("skimage", "scikit-image"))
    info = replace(
        port_info(
            "icaps",
            *(asset for assets in _ASSETS.values() for asset in assets),
            needs=frozenset({"depth"}),
            object_frame="shapenet",
        ),
        tolerance=TOLERANCE,
    )

    def load(self, assets: Path | None, device: str) -> None:
        """Look for the files of all categories below the folder ``assets``; a category's 300 MB
        are read when it is first asked for.

        Raises FileNotFoundError, or ValueError for a device that is not there.
        """
        from method_adapters._networks.running import device_named

        self._paths = {
            category: [asset.locate(assets) for asset in files]
            for category, files in _ASSETS.items()
        }
        self._device = device_named(device)
        self._networks: dict[str, tuple[Matcher, Refiner]] = {}

    def predict(self, batch: Sequence[Observation], seed: int) -> list[Prediction]:
        """One prediction per observation, each from its single view.

        Raises :class:`method_adapters._assets.AssetError` for files that are not what they should
        be.
        """
        return [self.track([observation], seed)[0] for observation in batch]

    def track(self, frames: Sequence[Observation], seed: int) -> list[Prediction]:
        """One prediction per frame of a sequence that shows one object.

        The first frame gives the shape; in the others only the pose is followed. A frame without
        an answer is a failed prediction that says why, and the next one is a first one again.

        Raises ValueError for frames of several categories, and as :meth:`predict`.
        """
        categories = sorted({frame.category for frame in frames})
        if len(categories) > 1:
            raise ValueError(f"frames of {', '.join(categories)}: a sequence shows one object")
        generator = np.random.default_rng(seed)
        predictions: list[Prediction] = []
        track: Track | None = None
        for frame in frames:
            try:
                track = self._step(frame, track, generator)
                predictions.append(Prediction((_hypothesis(track),)))
            except NoAnswerError as error:
                track = None
                predictions.append(Prediction.failed(str(error)))
        return predictions

    def _step(
        self, observation: Observation, last: Track | None, generator: np.random.Generator
    ) -> Track:
        from method_adapters._networks.icaps_refinement import distance_grid, spread

        with stage("pre-processing"):
            view = View.of(observation)
            tap("input", {"depth": view.depth, "corner": view.corner, "cloud": view.cloud})
        matcher, refiner = self._category(observation.category)
        with stage("pre-processing"):
            points = draw("spread", spread(view.cloud, generator))
        rotations = matcher.codebook.quaternions
        if last is None:
            with stage("particle filter"):
                belief = first_belief(view, matcher, rotations, generator)
            with stage("refinement"):
                placed, shape = refiner(points, _placed(belief))
            with stage("post-processing"):
                grid = tap("distances", distance_grid(shape))
                mesh = level_set(grid, 0, half_width=placed.unit, closed=False)
        else:
            with stage("particle filter"):
                belief = next_belief(view, last.belief, matcher, rotations, generator)
            with stage("refinement"):
                placed = refiner.follow(points, _placed(belief), last.shape)
            shape, mesh = last.shape, last.mesh
        tap("placed", vars(placed))
        belief = belief.corrected(view, placed.rotation @ NOCS_FROM_SHAPENET.T, placed.translation)
        return Track(belief, placed, shape, mesh)

    def _category(self, category: str) -> tuple[Matcher, Refiner]:
        """The networks of a category, read when it is first asked for."""
        from method_adapters._networks.icaps import AutoEncoder, DeepSdf, LatentNet
        from method_adapters._networks.icaps_matching import Codebook, Matcher
        from method_adapters._networks.icaps_refinement import Refiner
        from method_adapters._networks.running import load_weights

        if category not in CATEGORIES:
            raise NoAnswerError(
                f"category {category!r}: {self.info.name} knows {', '.join(CATEGORIES)}"
            )
        if category not in self._networks:
            encoder, codebook, latent_net, decoder = self._paths[category]
            networks = AutoEncoder(), LatentNet(), DeepSdf()
            for network, path in zip(networks, (encoder, latent_net, decoder), strict=True):
                load_weights(network, path)
                network.to(self._device).eval()
            auto_encoder, latents, distances = networks
            self._networks[category] = (
                Matcher(auto_encoder, Codebook(codebook, self._device)),
                Refiner(latents, distances, RATIOS[category]),
            )
        return self._networks[category]


def _placed(belief: Belief) -> Placed:
    from method_adapters._networks.icaps_refinement import Placed

    # the codebook's axes are NOCS's
    return Placed(belief.rotation @ NOCS_FROM_SHAPENET, belief.translation, belief.radius)


def _hypothesis(track: Track) -> Hypothesis:
    return Hypothesis(
        rotation=track.placed.rotation,
        translation=track.placed.translation,
        extents=2 * np.abs(track.mesh.vertices).max(axis=0),
        mesh=track.mesh,
    )
