"""trimesh: the volume shared by two box meshes (computed by manifold3d)."""

from typing import Any

import numpy as np
import trimesh

from pytest_cpas.checks.metrics import offer


def _box_iou(*boxes: Any) -> float:
    meshes = []
    for rotation, translation, extents in (boxes[:3], boxes[3:]):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, translation
        meshes.append(trimesh.creation.box(extents, pose))
    shared = trimesh.boolean.intersection(meshes, engine="manifold").volume
    return float(shared / (meshes[0].volume + meshes[1].volume - shared))


METRICS = {"box_iou": offer(_box_iou)}
