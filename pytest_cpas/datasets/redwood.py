"""REDWOOD75 (Bruns & Jensfelt): 75 annotated frames of handheld objects from the Redwood scans.

::

    annotations.json             sequence -> category, mesh, scale, pose_anns
    MESH.obj                     metric, closed, in the axes of the annotations
    CATEGORY/rgbd/SEQUENCE/rgb/FILE.jpg      8-bit colour
    CATEGORY/rgbd/SEQUENCE/depth/FILE.png    16-bit depth in millimetres, 0 = missing

``scale`` holds half the extents in metres; each of ``pose_anns`` holds ``position`` (metres),
``orientation`` (quaternion, scalar last), ``rgb_file`` and ``depth_file``. The annotations' y axis
points down and their x axis is the ShapeNet frame's z.

No masks are published. As in the paper's toolbox, the mask is the mesh rendered at its pose, less
the pixels where something was measured more than 1 cm nearer: a hand in front.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np

from pytest_cpas.datasets._files import below
from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._masks import visible
from pytest_cpas.datasets._meshes import read_mesh
from pytest_cpas.datasets._numbers import numbers, quaternion_rotation
from pytest_cpas.datasets._tree import Tree, find_root
from pytest_cpas.datasets.nocs import symmetry_of
from pytest_cpas.sources import how_to_get
from pytest_cpas.types import (
    Camera,
    ContractError,
    GroundTruth,
    Mesh,
    Observation,
    Pose,
    Sample,
    SampleRef,
)

REDWOOD_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)

#: The annotations' object coordinates -> ShapeNet ones: y -> -y, x -> z (and so z -> x).
_SHAPENET_FROM_ANNOTATION = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])

_CATEGORIES = ("bottle", "bowl", "mug")


class Redwood75(Tree):
    """REDWOOD75: 3 categories x 5 sequences x 5 frames.

    All annotated samples are listed; those in ``absent`` have no frame here, so that their truth
    can be had but not their images.
    """

    camera = REDWOOD_CAMERA

    def __init__(self, data_dir: Path | None) -> None:
        """Find the annotations in ``data_dir`` or ``data_dir/redwood75``.

        Raises :class:`FileNotFoundError` that says what to fetch, :class:`ContractError` if the
        annotations cannot be read.
        """
        super().__init__(
            "redwood75",
            find_root("redwood75", data_dir, "annotations.json"),
        )
        self._mesh = functools.cache(self._read_mesh)

    def scan(self, scan: Scan) -> None:
        """List the annotated poses, and which of them have no frame."""
        for sequence, annotation in sorted(scan.read_json("annotations.json").items()):
            where = f"{self.root / 'annotations.json'}: sequence {sequence}"
            try:
                samples = self._read_sequence(sequence, annotation, where)
            except ContractError as error:
                scan.damaged.append(str(error))
                continue
            if scan.has(annotation["mesh"]):
                scan.hash(annotation["mesh"])
            for ref, pose in samples:
                detail = {"mesh": annotation["mesh"], "scale": annotation["scale"], **pose}
                scan.add(ref, detail)
                if not all(scan.has(path) for path in _frame(ref, pose)):
                    scan.absent.append(ref.id)
        if scan.absent:
            scan.missing.append(
                f"the frames of {len(scan.absent)} samples, first {scan.absent[0]}: left out."
                f"\n{how_to_get('redwood75')}"
            )

    def _read_sequence(
        self, sequence: str, annotation: Any, where: str
    ) -> list[tuple[SampleRef, dict[str, Any]]]:
        below(self.root, sequence, where)
        wanted = ("category", "mesh", "scale", "pose_anns")
        if not isinstance(annotation, dict) or not set(wanted) <= set(annotation):
            raise ContractError(f"{where}: expected {', '.join(wanted)}")
        category = annotation["category"]
        if category not in _CATEGORIES:
            raise ContractError(
                f"{where}: category {category!r}, expected one of {', '.join(_CATEGORIES)}"
            )
        below(self.root, annotation["mesh"], where)
        if not isinstance(annotation["pose_anns"], list):
            raise ContractError(f"{where}: pose_anns is not a list")
        samples = []
        for index, pose in enumerate(annotation["pose_anns"]):
            keys = ("position", "orientation", "rgb_file", "depth_file")
            if not isinstance(pose, dict) or not set(keys) <= set(pose):
                raise ContractError(f"{where}: pose {index} lacks one of {', '.join(keys)}")
            for key in ("rgb_file", "depth_file"):
                below(self.root, pose[key], f"{where}, pose {index}")
            ref = SampleRef(f"{sequence}/{index}", category, sequence, sequence)
            samples.append((ref, pose))
        return samples

    def load(self, ref: SampleRef) -> Sample:
        """Read one sample; :class:`ContractError` names the file that is damaged or missing."""
        rgb_path, depth_path = (self.root / path for path in _frame(ref, self._details[ref.id]))
        if ref.id in self.absent:
            raise ContractError(
                f"{rgb_path} or {depth_path}: no such file. {how_to_get('redwood75')}"
            )
        truth = self.truth(ref)
        depth = self._read_depth(depth_path, REDWOOD_CAMERA)
        mask = visible(self._mesh(self._details[ref.id]["mesh"]), truth.pose, depth, REDWOOD_CAMERA)
        if not mask.any():
            raise ContractError(f"{depth_path}: the object is hidden or out of the image")
        rgb = self._read_rgb(rgb_path, REDWOOD_CAMERA)
        return Sample(ref, Observation(ref.category, rgb, depth, mask, REDWOOD_CAMERA), truth)

    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about a sample, without its images."""
        where = f"{self.root / 'annotations.json'}: {ref.id}"
        detail = self._details[ref.id]
        half = numbers(detail["scale"], (3,), f"{where}: scale")
        extents = 2 * np.abs(_SHAPENET_FROM_ANNOTATION) @ half
        rotation = quaternion_rotation(detail["orientation"], f"{where}: orientation")
        position = numbers(detail["position"], (3,), f"{where}: position")
        pose = Pose(rotation @ _SHAPENET_FROM_ANNOTATION.T, position)
        return GroundTruth(pose, extents, symmetry_of(ref.category), self._mesh(detail["mesh"]))

    def _read_mesh(self, name: str) -> Mesh:
        return read_mesh(self.root / name, _SHAPENET_FROM_ANNOTATION)


def _frame(ref: SampleRef, pose: dict[str, Any]) -> tuple[str, str]:
    """Where a pose's colour and depth image are, below the root."""
    folder = f"{ref.category}/rgbd/{ref.scene}"
    return f"{folder}/rgb/{pose['rgb_file']}", f"{folder}/depth/{pose['depth_file']}"
