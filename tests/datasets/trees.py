"""Frames of our own to write in the layouts of data sets: objects rendered at known poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from pytest_cpas._open3d import import_open3d
from pytest_cpas.datasets import shapes
from pytest_cpas.datasets.rendering import Rendering, camera_rays, render
from pytest_cpas.types import Camera, GroundTruth, Mesh, Pose, Sample

import_open3d()  # a test with pytester forgets what it imports, and Open3D is imported only once

#: Three objects side by side and one behind them, metres and rotation vectors.
PLACES = {
    "mug": ([-0.15, 0.03, 0.75], [0.5, 0.6, 0.1]),
    "bowl": ([0.02, 0.05, 0.7], [0.6, -0.2, 0.3]),
    "bottle": ([0.2, -0.02, 0.8], [0.3, 0.4, -0.2]),
    "laptop": ([0.0, -0.1, 1.1], [0.4, 2.8, 0.0]),
}


@dataclass(frozen=True)
class Placed:
    """An object: its shape, metric and in ShapeNet axes, and its pose in the camera."""

    category: str
    mesh: Mesh
    pose: Pose


@dataclass(frozen=True)
class Frame:
    """A rendered frame. ``millimetres`` (H, W) uint16, 0 on every tenth row, as if not measured."""

    camera: Camera
    objects: list[Placed]
    seen: Rendering
    millimetres: NDArray[np.uint16]
    colour: NDArray[np.uint8]

    def mask(self, index: int) -> NDArray[np.bool_]:
        return self.seen.instance == index

    def object_points(self, index: int) -> NDArray[np.float64]:
        """The surface points (N, 3) seen in the mask's pixels, in the object's frame."""
        mask = self.mask(index)
        points = camera_rays(self.camera)[mask] * self.seen.depth[mask][:, None]
        return self.objects[index].pose.inverse().apply(points)


def frame(camera: Camera, number: int, categories: tuple[str, ...] = ("mug", "bowl")) -> Frame:
    """The objects of a frame, moved a little from one number to the next."""
    objects = []
    for category in categories:
        place, turn = PLACES[category]
        rotation = Rotation.from_rotvec(turn) * Rotation.from_rotvec([0, 0.3 * number, 0])
        # ShapeNet's y is up, the camera's y down
        upright = Rotation.from_rotvec([np.pi, 0, 0]) * rotation
        pose = Pose(upright.as_matrix(), np.add(place, [0.01 * number, 0, 0]))
        objects.append(Placed(category, shapes.mean_shape(category), pose))
    seen = render([(item.mesh, item.pose) for item in objects], camera)
    millimetres = np.round(1000 * seen.depth).astype(np.uint16)
    millimetres[seen.instance < 0] = 2000
    millimetres[::10] = 0
    colour = np.array(
        [[20, 20, 20], [200, 0, 0], [0, 200, 0], [0, 0, 200], [200, 200, 0]], np.uint8
    )
    return Frame(camera, objects, seen, millimetres, colour[seen.instance + 1])


def save(path: Path, pixels: NDArray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def save_obj(path: Path, vertices: NDArray, triangles: NDArray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["v {} {} {}".format(*vertex) for vertex in vertices]
    lines += ["f {} {} {}".format(*triangle) for triangle in triangles + 1]
    path.write_text("\n".join(lines) + "\n")


def check(
    sample: Sample,
    frame: Frame,
    index: int,
    *,
    angle: float = 0.01,
    distance: float = 1e-5,
    mesh: bool = True,
    category: str | None = None,
    lossless: bool = True,
) -> GroundTruth:
    """That a loaded sample is this object of the frame: within degrees, and metres."""
    item, observed, truth = frame.objects[index], sample.observation, sample.truth
    assert observed.category == (category or item.category)
    assert observed.camera == frame.camera
    np.testing.assert_array_equal(observed.mask, frame.mask(index))
    np.testing.assert_allclose(observed.depth, frame.millimetres / 1000, atol=1e-6)
    difference = np.abs(observed.rgb - frame.colour / np.float32(255))
    assert difference.max() < 1e-6 if lossless else difference.mean() < 0.02
    relative = Rotation.from_matrix(item.pose.rotation.T @ truth.pose.rotation)
    assert np.degrees(relative.magnitude()) < angle
    assert np.linalg.norm(truth.pose.translation - item.pose.translation) < distance
    low, high = item.mesh.bounds
    np.testing.assert_allclose(truth.extents, high - low, atol=2 * distance)
    assert (truth.symmetry.axis is None) == (item.category not in ("bottle", "bowl", "can"))
    if mesh:
        # the surface lies on what is seen: every vertex of ours is one of theirs
        assert truth.surface is not None
        np.testing.assert_allclose(truth.surface.vertices, item.mesh.vertices, atol=2 * distance)
        corners = truth.surface.vertices[truth.surface.triangles]
        volume = np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        assert volume > 0  # its outside is outside
    else:
        assert truth.surface is None
    return truth
