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
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pytest_cpas.datasets._files import below, read_json
from pytest_cpas.datasets._images import read_depth, read_rgb
from pytest_cpas.datasets._meshes import read_mesh
from pytest_cpas.datasets.nocs import symmetry_of
from pytest_cpas.datasets.rendering import hidden, render
from pytest_cpas.types import (
    Array,
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

_DOWNLOAD = """\
REDWOOD75 consists of annotations and meshes (MIT) and of frames of the Redwood scans (public \
domain). Fetch into one folder:
  annotations.json and the 15 .obj files: data/redwood_annotations of \
https://github.com/roym899/sdfest
  the frames of each sequence: https://s3.us-west-1.wasabisys.com/redwood-3dscan/rgbd/SEQUENCE.zip
    -> CATEGORY/rgbd/SEQUENCE/{rgb,depth}/  (15 sequences; 5 frames of each are annotated)
and pass that folder, or its parent if it is called redwood75, with --cpas-data DIR or CPAS_DATA."""


class Redwood75:
    """REDWOOD75: 3 categories x 5 sequences x 5 frames.

    All annotated samples are listed; those in ``absent`` have no frame here, so that their truth
    can be had but not their images.
    """

    name = "redwood75"

    def __init__(self, data_dir: Path | None) -> None:
        """Find the annotations in ``data_dir`` or ``data_dir/redwood75``.

        Raises :class:`FileNotFoundError` that says what to fetch, :class:`ContractError` if the
        annotations cannot be read.
        """
        folders = [] if data_dir is None else [data_dir, data_dir / "redwood75"]
        found = [folder for folder in folders if (folder / "annotations.json").is_file()]
        if not found:
            lack = f"no annotations.json in {data_dir}" if data_dir else "redwood75 needs a folder"
            raise FileNotFoundError(f"{lack}.\n{_DOWNLOAD}")
        self.root = found[0]
        self.missing: list[str] = []
        self.damaged: list[str] = []
        self._poses: dict[str, tuple[str, dict[str, Any]]] = {}
        self._mesh = functools.cache(self._read_mesh)
        self._annotations = read_json(self.root / "annotations.json")
        self.samples: Sequence[SampleRef] = self._list()
        self.absent = frozenset(ref.id for ref in self.samples if not self._has_frame(ref))
        if self.absent:
            self.missing.append(
                f"the frames of {len(self.absent)} of {len(self.samples)} samples, first"
                f" {min(self.absent)}: left out.\n{_DOWNLOAD}"
            )

    @functools.cached_property
    def digest(self) -> str:
        """Of the annotations and meshes."""
        digest = hashlib.sha256((self.root / "annotations.json").read_bytes())
        for sequence in sorted({ref.scene for ref in self.samples}):
            path = self._mesh_path(sequence)
            digest.update(path.read_bytes() if path.is_file() else b"")
        return digest.hexdigest()

    def _list(self) -> list[SampleRef]:
        samples = []
        for sequence, annotation in sorted(self._annotations.items()):
            where = f"{self.root / 'annotations.json'}: sequence {sequence}"
            try:
                samples += self._read_sequence(sequence, annotation, where)
            except ContractError as error:
                self.damaged.append(str(error))
        return samples

    def _read_sequence(self, sequence: str, annotation: Any, where: str) -> list[SampleRef]:
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
            ref = SampleRef(f"{sequence}/{index}", category, sequence)
            self._poses[ref.id] = (f"{where}, pose {index}", pose)
            samples.append(ref)
        return samples

    def _frame(self, ref: SampleRef) -> tuple[Path, Path]:
        folder = self.root / ref.category / "rgbd" / ref.scene
        _, pose = self._poses[ref.id]
        return folder / "rgb" / pose["rgb_file"], folder / "depth" / pose["depth_file"]

    def _has_frame(self, ref: SampleRef) -> bool:
        return all(path.exists() for path in self._frame(ref))

    def _mesh_path(self, sequence: str) -> Path:
        return self.root / cast(str, self._annotations[sequence]["mesh"])

    def load(self, ref: SampleRef) -> Sample:
        """Read one sample; :class:`ContractError` names the file that is damaged or missing."""
        if ref.id in self.absent:
            raise ContractError(
                f"{' or '.join(map(str, self._frame(ref)))}: no such file. {_DOWNLOAD}"
            )
        rgb_path, depth_path = self._frame(ref)
        truth, mesh = self._truth(ref)
        depth = read_depth(depth_path, REDWOOD_CAMERA)
        mask = visible(mesh, truth.pose, depth, REDWOOD_CAMERA)
        if not mask.any():
            raise ContractError(f"{depth_path}: the object is hidden or out of the image")
        rgb = read_rgb(rgb_path, REDWOOD_CAMERA)
        return Sample(ref, Observation(ref.category, rgb, depth, mask, REDWOOD_CAMERA), truth)

    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about a sample, without its images."""
        return self._truth(ref)[0]

    def _truth(self, ref: SampleRef) -> tuple[GroundTruth, Mesh]:
        where, annotation = self._poses[ref.id]
        quaternion = _numbers(annotation["orientation"], 4, f"{where}: orientation")
        if abs(np.linalg.norm(quaternion) - 1) > 1e-3:
            raise ContractError(
                f"{where}: orientation {quaternion.tolist()}, expected a unit quaternion"
            )
        rotation = Rotation.from_quat(quaternion).as_matrix()
        position = _numbers(annotation["position"], 3, f"{where}: position")
        mesh = self._mesh(ref.scene)
        half = _numbers(self._annotations[ref.scene]["scale"], 3, f"{where}: scale")
        extents = 2 * np.abs(_SHAPENET_FROM_ANNOTATION) @ half
        pose = Pose(rotation @ _SHAPENET_FROM_ANNOTATION.T, position)
        return GroundTruth(pose, extents, symmetry_of(ref.category), mesh), mesh

    def _read_mesh(self, sequence: str) -> Mesh:
        return read_mesh(self._mesh_path(sequence), _SHAPENET_FROM_ANNOTATION)


def visible(
    mesh: Mesh, pose: Pose, depth: NDArray[np.float32], camera: Camera
) -> NDArray[np.bool_]:
    """Where (H, W) a posed mesh is seen and nothing was measured in front of it.

    ``depth`` (H, W): measured metres, 0 = missing. A pixel without a measurement counts as seen.
    """
    rendered = render([(mesh, pose)], camera).depth
    mask: NDArray[np.bool_] = (rendered > 0) & ~hidden(rendered, depth)
    return mask


def _numbers(value: object, count: int, what: str) -> Array:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise ContractError(f"{what}: {value}, expected {count} finite numbers")
    return array
