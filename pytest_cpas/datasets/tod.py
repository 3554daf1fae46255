"""TOD, the transparent objects of KeyPose (Liu et al., CVPR 2020).

::

    data/OBJECT/SEQUENCE/IIIIII_L.png        left image, 8-bit colour
    data/OBJECT/SEQUENCE/IIIIII_L.pbtxt      kp_target: camera (fx, fy, cx, cy, resx, resy) and
                                             keypoints (u, v in pixels, z in metres)
    data/OBJECT/SEQUENCE/IIIIII_mask.png     the object is where it is not 0
    data/OBJECT/SEQUENCE/IIIIII_Dt.exr       depth of the transparent object, channel D, metres
    objects/OBJECT.obj                       "o mesh": vertices, metres; "o kp.K": keypoint K

from ``keypose/README.md``, ``data.proto``, the sample sequence and ``objects/`` of
google-research/google-research (2020; e4457e7), which that repository has and which were looked at;
that the channel is called D and holds metres, from the converter hoenigpeter/keypose_to_bop_format
(2024; 20748b7). The EXR files of the full download have not been tried.

No pose of the object is published, but where its keypoints are: the pose is the rigid motion from
the model's keypoints to these. One or two of them leave a turn open, in objects of revolution
alone, which are symmetric about it. A category is an object's name without its number. The models
have vertices only: these are the surface's points. Their z axis is up, and turned into ShapeNet's
y. The depth is what the sensor measures of the transparent object, not ``Do``, that of its opaque
twin.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._records import Record, RecordTree
from pytest_cpas.datasets._tree import find_root
from pytest_cpas.datasets._values import integers
from pytest_cpas.datasets.nocs import symmetry_of
from pytest_cpas.reading.files import read_text
from pytest_cpas.reading.numbers import numbers, whole
from pytest_cpas.reading.paths import natural
from pytest_cpas.similarity import rigid
from pytest_cpas.types import Array, ContractError, DataError, Derived, SampleRef, Symmetry
from pytest_cpas.types.frames import SHAPENET_FROM_Z_UP

CATEGORIES = ("ball", "bottle", "cup", "heart", "mug", "tree")

_SYMMETRIES = {"ball": Symmetry.full(), "cup": symmetry_of("bottle")}

#: Bytes of a model; reading it takes some 30 times as many of memory.
_LARGEST_MODEL = 2**25

#: Farthest that a keypoint may be from where the posed model has it, metres.
_FITS = 0.01

#: Bytes of a ``.pbtxt``; one has a few thousand.
_LARGEST_TARGET = 2**20

_CAMERA = ("resx", "resy", "fx", "fy", "cx", "cy")


class Model(NamedTuple):
    """An object in ShapeNet axes, centred on its box: vertices and keypoints, metres."""

    vertices: Array
    keypoints: Array


class Tod(RecordTree):
    """All sequences of TOD."""

    several = False
    all_derived = (
        Derived(
            part="pose",
            made_of=frozenset({"keypoints", "mesh"}),
            how="fitted to the keypoints of model and image",
        ),
        Derived(
            part="extents",
            made_of=frozenset({"mesh"}),
            how="the side lengths of the box of the model's vertices",
        ),
        Derived(
            part="symmetry",
            made_of=frozenset({"category"}),
            how="by category: ball about everything, bottle and cup about y, others none",
        ),
    )

    def __init__(self, data_dir: Path | None) -> None:
        """Find the tree in ``data_dir`` or ``data_dir/tod``; FileNotFoundError says how."""
        super().__init__("tod", find_root("tod", data_dir, "objects"))

    def scan(self, scan: Scan) -> None:
        """List the frames of the objects of which there is a model."""
        for name in sorted(scan.names("data"), key=natural):
            category = name.rstrip("0123456789").rstrip("_")
            file = f"objects/{name}.obj"
            if not scan.has(file):
                scan.lacks("objects without a model (objects/)", name)
                continue
            try:
                if category not in CATEGORIES:
                    raise DataError(
                        f"{self.root / 'data' / name}: expected an object of"
                        f" {', '.join(CATEGORIES)}, such as bottle_0"
                    )
                scan.read(file, _LARGEST_MODEL)
                model = read_model(self.root / file)
            except ContractError as error:
                scan.damaged.append(str(error))
                continue
            for sequence in sorted(scan.names(f"data/{name}"), key=natural):
                self._scan_sequence(scan, f"{name}/{sequence}", category, model)

    def _scan_sequence(self, scan: Scan, sequence: str, category: str, model: Model) -> None:
        folder = f"data/{sequence}"
        images = {m[1] for m in map(re.compile(r"(\d+)_L\.").match, scan.names(folder)) if m}
        extents = (model.vertices.max(axis=0) - model.vertices.min(axis=0)).tolist()
        for image in sorted(images):
            stem = f"{folder}/{image}"
            target, *files = (f"{stem}{end}" for end in ("_L.pbtxt", "_L.png", "_Dt.exr"))
            mask = f"{stem}_mask.png"
            lacks = [file for file in (target, *files, mask) if not scan.has(file)]
            for file in lacks:
                scan.lacks(f"frames without {file.removeprefix(stem)}", f"{sequence}/{image}")
            if lacks:
                continue
            try:
                content = scan.read(target)
                if len(content) > _LARGEST_TARGET:
                    raise DataError(
                        f"{self.root / target}: {len(content)} bytes, at most {_LARGEST_TARGET}"
                        " are read"
                    )
                text = content.decode("utf-8", "replace")
                camera, keypoints = read_target(text, str(self.root / target))
                if len(keypoints) != len(model.keypoints):
                    raise DataError(
                        f"{self.root / target}: {len(keypoints)} keypoints, but the model has"
                        f" {len(model.keypoints)}"
                    )
            except ContractError as error:
                scan.damaged.append(str(error))
                continue
            rotation, translation = rigid(model.keypoints, keypoints)
            apart = np.linalg.norm(model.keypoints @ rotation.T + translation - keypoints, axis=1)
            if apart.max() > _FITS:
                scan.damaged.append(
                    f"{self.root / target}: keypoint {apart.argmax()} is"
                    f" {1000 * apart.max():.0f} mm from where the model has it, at most"
                    f" {1000 * _FITS:g} mm are taken"
                )
                continue
            record = Record(
                rgb=files[0],
                depth=files[1],
                camera=camera,
                rotation=rotation.ravel().tolist(),
                translation=translation.tolist(),
                extents=extents,
                mesh=f"objects/{sequence.split('/')[0]}.obj",
                mask=mask,
                fit_error=float(apart.max()),
            )
            ref_id = f"{sequence}/{image}"
            name = sequence.split("/")[0]
            ref = SampleRef(id=ref_id, category=category, scene=sequence, model=name)
            scan.add(ref, record)

    def _symmetry(self, ref: SampleRef, record: Record) -> Symmetry:
        return _SYMMETRIES.get(ref.category, symmetry_of(ref.category))

    def _read_mesh(self, name: str) -> Array:
        return read_model(self.root / name).vertices


def read_model(path: Path) -> Model:
    """The vertices and keypoints of an object, whose keypoints are small meshes of their own."""
    parts: dict[str, list[list[str]]] = {}
    part = parts.setdefault("", [])
    for line in read_text(path, errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["o"] and len(words) > 1:
            part = parts.setdefault(words[1], [])
        elif words[:1] == ["v"]:
            part.append(words[1:4])
    found = {name: numbers(v, (len(v), 3), f"{path}: {name}") for name, v in parts.items() if v}
    points = {whole(n[3:]): v.mean(axis=0) for n, v in found.items() if n.startswith("kp.")}
    if "mesh" not in found or not points or set(points) != set(range(len(points))):
        raise DataError(f"{path}: expected objects 'mesh', 'kp.000', 'kp.001', ...")
    vertices = found["mesh"] @ SHAPENET_FROM_Z_UP.T
    centre = (vertices.max(axis=0) + vertices.min(axis=0)) / 2
    keypoints = np.stack([points[i] for i in range(len(points))]) @ SHAPENET_FROM_Z_UP.T
    return Model(vertices - centre, keypoints - centre)


def read_target(text: str, where: str) -> tuple[list[float], Array]:
    """Camera (width, height, fx, fy, cx, cy) and keypoints (k, 3), metres, of a ``.pbtxt``."""
    # blocks do not nest below these two
    blocks = re.findall(r"\b(camera|keypoints)\s*+\{([^{}]*+)\}", text.partition("proj_targets")[0])
    fields = [(kind, _fields(body, where)) for kind, body in blocks]
    cameras = [values for kind, values in fields if kind == "camera"]
    points = [values for kind, values in fields if kind == "keypoints"]
    if len(cameras) != 1 or not points:
        raise DataError(f"{where}: expected kp_target with a camera and keypoints")
    camera = numbers([cameras[0].get(key) for key in _CAMERA], (6,), f"{where}: {_CAMERA}").tolist()
    uvz = [[point.get(key) for key in "uvz"] for point in points]
    u, v, z = numbers(uvz, (len(uvz), 3), f"{where}: keypoints").T
    if (z <= 0).any() or min(camera[:4]) <= 0:
        raise DataError(f"{where}: a keypoint behind the camera, or no camera")
    integers(camera[:2], 2, f"{where}: resx, resy")
    _, _, fx, fy, cx, cy = camera
    return camera, np.stack([(u - cx) * z / fx, (v - cy) * z / fy, z], axis=-1)


def _fields(body: str, where: str) -> dict[str, str]:
    """What is given as ``name: value`` in a block."""
    words = body.replace(":", " : ").split()
    named = [at - 1 for at, word in enumerate(words) if word == ":" and 0 < at < len(words) - 1]
    fields = {words[at]: words[at + 2] for at in named}
    if len(fields) < len(named):
        raise DataError(f"{where}: a block gives a value twice")
    return fields
