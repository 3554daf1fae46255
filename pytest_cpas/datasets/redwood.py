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

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from pytest_cpas.datasets._derived import BY_CATEGORY, PROJECTED, RENDERED
from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._records import Record, RecordTree
from pytest_cpas.datasets._tree import find_root
from pytest_cpas.datasets.sources import how_to_get
from pytest_cpas.reading.numbers import numbers, quaternion_rotation
from pytest_cpas.reading.paths import below
from pytest_cpas.types import Camera, ContractError, DataError, Sample, SampleRef, raised_as
from pytest_cpas.types.frames import permute_extents

REDWOOD_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)

#: The annotations' object coordinates -> ShapeNet ones: y -> -y, x -> z (and so z -> x).
_SHAPENET_FROM_ANNOTATION = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])

_CATEGORIES = ("bottle", "bowl", "mug")


class Redwood75(RecordTree):
    """REDWOOD75: 3 categories x 5 sequences x 5 frames.

    All annotated samples are listed; those in ``absent`` have no frame here, so that their truth
    can be had but not their images.
    """

    several = False
    all_derived = (RENDERED, BY_CATEGORY)

    camera = REDWOOD_CAMERA
    mesh_axes = _SHAPENET_FROM_ANNOTATION
    published_axes = _SHAPENET_FROM_ANNOTATION.T

    def __init__(self, data_dir: Path | None) -> None:
        """Find the annotations in ``data_dir`` or ``data_dir/redwood75``.

        Raises :class:`FileNotFoundError` that says what to fetch, :class:`DataError` if the
        annotations cannot be read.
        """
        super().__init__("redwood75", find_root("redwood75", data_dir, "annotations.json"))

    def scan(self, scan: Scan) -> None:
        """List the annotated poses, and which of them have no frame."""
        for sequence, annotation in sorted(scan.read_json("annotations.json").items()):
            where = f"{self.root / 'annotations.json'}: sequence {sequence}"
            try:
                below(self.root, sequence, where)
                poses = self._check_sequence(annotation, where)
            except ContractError as error:
                scan.damaged.append(str(error))
                continue
            if scan.has(annotation["mesh"]):
                scan.hash(annotation["mesh"])
            for index, pose in enumerate(poses):
                try:
                    ref = SampleRef(
                        id=f"{sequence}/{index}",
                        category=annotation["category"],
                        scene=sequence,
                        model=sequence,
                    )
                    record = self._record(ref, annotation, pose, f"{where}, pose {index}")
                except ContractError as error:
                    scan.damaged.append(str(error))
                    continue
                scan.add(ref, record)
                if not (scan.has(record.rgb) and scan.has(record.depth)):
                    scan.absent.append(ref.id)
                    scan.derives(PROJECTED, ref.id)
        if scan.absent:
            scan.missing.append(
                f"the frames of {len(scan.absent)} samples, first {scan.absent[0]}: left out."
                f"\n{how_to_get('redwood75')}"
            )

    def _check_sequence(self, annotation: Any, where: str) -> list[Any]:
        """The poses of a sequence, of which the rest is found right."""
        wanted = ("category", "mesh", "scale", "pose_anns")
        if not isinstance(annotation, dict) or not set(wanted) <= set(annotation):
            raise DataError(f"{where}: expected {', '.join(wanted)}")
        if annotation["category"] not in _CATEGORIES:
            raise DataError(
                f"{where}: category {annotation['category']!r}, expected one of"
                f" {', '.join(_CATEGORIES)}"
            )
        below(self.root, annotation["mesh"], where)
        if not isinstance(annotation["pose_anns"], list):
            raise DataError(f"{where}: pose_anns is not a list")
        return annotation["pose_anns"]

    def _record(self, ref: SampleRef, annotation: dict[str, Any], pose: Any, where: str) -> Record:
        keys = ("position", "orientation", "rgb_file", "depth_file")
        if not isinstance(pose, dict) or not set(keys) <= set(pose):
            raise DataError(f"{where}: it lacks one of {', '.join(keys)}")
        for key in ("rgb_file", "depth_file"):
            below(self.root, pose[key], where)
        folder = f"{ref.category}/rgbd/{ref.scene}"
        rotation = quaternion_rotation(pose["orientation"], f"{where}: orientation")
        half = numbers(annotation["scale"], (3,), f"{where}: scale")
        return Record(
            rgb=f"{folder}/rgb/{pose['rgb_file']}",
            depth=f"{folder}/depth/{pose['depth_file']}",
            camera=list(dataclasses.astuple(REDWOOD_CAMERA)),
            rotation=(rotation @ _SHAPENET_FROM_ANNOTATION.T).ravel().tolist(),
            translation=numbers(pose["position"], (3,), f"{where}: position").tolist(),
            extents=permute_extents(2 * half, _SHAPENET_FROM_ANNOTATION).tolist(),
            mesh=annotation["mesh"],
        )

    @raised_as(DataError)
    def load(self, ref: SampleRef) -> Sample:
        """Read one sample; :class:`DataError` names the file that is damaged or missing."""
        if ref.id in self.absent:
            record = Record(*self._details[ref.id])
            raise DataError(
                f"{self.root / record.rgb} or {self.root / record.depth}: no such file."
                f" {how_to_get('redwood75')}"
            )
        return super().load(ref)
