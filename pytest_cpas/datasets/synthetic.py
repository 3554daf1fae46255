"""The embedded data sets: rendered on first use, in the layout of REAL275.

``synthetic-tabletop``
    Upright objects on a table, several in an image, occluding each other: like REAL275, with its
    camera. 6 scenes of 5 frames.
``synthetic-handheld``
    One object in a hand, turned uniformly over SO(3): like REDWOOD75, with its camera. 18 scenes
    (3 instances of each category) of 7 frames.

Neither needs a download, so that a method, the plugin and a continuous integration can be tried
anywhere; and the step between the two shows what upright data hides.

On disk they are laid out as :mod:`pytest_cpas.datasets.nocs` describes, and read by it. What the
published REAL275 does, and this does too:

* ``gt_RTs`` and the ``.obj`` and ``.txt`` files of the meshes are all in NOCS axes, metric. Checked
  on scene_1/0000, whose meshes fit mask and depth as they are (IoU 0.95 to 0.98; median residual
  6 mm for the bowl, 4 mm for camera and mug) and in no other axes (IoU below 0.7 for camera and
  mug). The can is 16 mm off the depth in any axes, as is its published NOCS map.
* ``coord.png`` has red = x + 1/2, green = y + 1/2, blue = 1 - (z + 1/2) of the NOCS point, whose
  unit is the box diagonal.

Our meshes are closed; they lie in ``obj_models`` and, as the loader prefers, in
``fixed_real_test_obj_models``. ``digest.txt`` adds a digest of the decoded content.

The depth of a pixel is measured as a structured-light sensor would:

* Gaussian noise along z that grows with the square of the distance and towards grazing angles:
  C. V. Nguyen, S. Izadi, D. Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction
  and tracking", 3DIMPVT 2012, their axial model; their lateral noise is left out;
* nothing at grazing angles (surely beyond 85 degrees, never below 70) and, mostly, at depth edges,
  where projector or camera are shadowed;
* rounded to millimetres.

Everything follows from one seed. Shapes and poses are rounded before they are used, and images
come from elementwise arithmetic, so that the trees are the same from run to run and do not depend
on the vector instructions of numpy and BLAS; the ray caster's only choose between triangles.
"""

from __future__ import annotations

import hashlib
import pickle
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from pytest_cpas._files import cache_folder
from pytest_cpas.datasets import _mug, _patterns, _rings, _scenes, rendering, shapes
from pytest_cpas.datasets._patterns import second_colour
from pytest_cpas.datasets._scenes import SCENERY, HandheldScene, Item, Shapes, Stock, TabletopScene
from pytest_cpas.datasets.nocs import REAL_CAMERA, NocsTree
from pytest_cpas.datasets.rendering import Rendering, camera_rays, dot, render
from pytest_cpas.types import Array, Camera, DataError
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET

__all__ = [
    "HANDHELD",
    "TABLETOP",
    "Split",
    "Synthetic",
    "SyntheticHandheld",
    "SyntheticTabletop",
    "View",
    "cached",
    "generate",
    "measure",
    "recipe",
]

HANDHELD_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)

SEED = 20230517

#: The modules that decide what is made, beside this one.
MAKERS = (shapes, _rings, _mug, rendering, _scenes, _patterns)

#: An object of which fewer pixels are seen with depth, or less of its box in the image, is left
#: out: nobody could tell its pose.
_MIN_PIXELS, _MIN_SHARE = 500, 0.15

#: So many views are tried.
_ATTEMPTS = 200


class View(Protocol):
    """What a sensor has of a composed scene: what is there, ``seen``, and what it measures of it,
    ``depth`` (H, W) in millimetres, 0 = missing."""

    seen: Rendering
    depth: NDArray[np.uint16]

    def photograph(self, rng: np.random.Generator) -> NDArray[np.uint8]:
        """The colour image (H, W, 3)."""


@dataclass(frozen=True)
class Split:
    """What a rendered data set is made of."""

    name: str
    key: int  # tells its random numbers from those of the other split
    camera: Camera
    scenes: int
    frames: int
    kind: type[TabletopScene] | type[HandheldScene]
    stock: Stock | None = None  # the embedded shapes if None
    look: Callable[[list[Item], Camera, np.random.Generator], View] | None = None  # else plain
    most_lost: float = 1.0  # share of an object's pixels without depth; with more it is left out


TABLETOP = Split("synthetic-tabletop", 0, REAL_CAMERA, 6, 5, TabletopScene)
HANDHELD = Split("synthetic-handheld", 1, HANDHELD_CAMERA, 18, 7, HandheldScene)


class Synthetic(NocsTree):
    """A tree in the cache, made when it is first asked for."""

    split: Split
    #: Modules beside :data:`MAKERS` that decide the content.
    makers: tuple[ModuleType, ...] = ()

    def __init__(self, data_dir: Path | None) -> None:
        """``data_dir`` is not used: the data set makes itself."""
        split = self.split
        root = cached(split.name, recipe(*self.makers), lambda folder: generate(split, folder))
        super().__init__(self.split.name, root, self.split.camera)
        self.digest = (root / "digest.txt").read_text().strip()


class SyntheticTabletop(Synthetic):
    """Upright objects on a table; see the module's docstring."""

    split = TABLETOP
    #: What ``synthetic-tabletop:DIR`` is, for :func:`pytest_cpas.registry.resolve`.
    in_folder = "pytest_cpas.datasets.own_meshes:OwnTabletop"


class SyntheticHandheld(Synthetic):
    """One freely turned object in a hand; see the module's docstring."""

    split = HANDHELD
    in_folder = "pytest_cpas.datasets.own_meshes:OwnHandheld"


def cached(name: str, key: str, make: Callable[[Path], None]) -> Path:
    """The folder of a data set below ``CPAS_CACHE`` or the user's cache, made if it is not there.

    ``make`` fills a folder; what another ``key`` has made is not used.
    """
    folder = cache_folder()
    root = folder / f"{name}-{key}"
    if root.is_dir():
        return root
    try:
        folder.mkdir(parents=True, exist_ok=True)
        unfinished = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=folder))
    except OSError as error:
        raise RuntimeError(
            f"{name} is made on first use, but nothing can be written to {folder} ({error})."
            " Set CPAS_CACHE to a folder that is writable"
        ) from error
    try:
        make(unfinished)
        try:
            unfinished.rename(root)
        except OSError:
            if not root.is_dir():  # else another process was faster, with the same content
                raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return root


def recipe(*further: ModuleType) -> str:
    """A digest of the code that decides the content: a changed recipe gets another folder."""
    digest = hashlib.sha256()
    for file in (*(module.__file__ for module in (*MAKERS, *further)), __file__):
        digest.update(Path(str(file)).read_bytes())
    return digest.hexdigest()[:12]


def generate(split: Split, root: Path, scenes: Sequence[int] | None = None) -> None:
    """Write ``split``, or only some of its ``scenes`` (numbered from 1), to the folder ``root``.

    A scene does not depend on the others. Raises :class:`ImportError` where Open3D is missing, and
    :class:`DataError` naming objects that cannot be seen well.
    """
    writer = _Writer(root)
    stock = Shapes(SEED, split.key) if split.stock is None else split.stock
    for number in range(1, split.scenes + 1) if scenes is None else scenes:
        scene = split.kind(stock, SEED, split.key, number, split.camera)
        for frame in range(split.frames):
            rng = np.random.default_rng([SEED, split.key, 2, number, frame])
            try:
                writer.add(number, frame, _capture(split, scene, rng))
            except DataError as error:
                raise DataError(f"{split.name}, scene {number}: {error}") from None
    writer.finish()


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame's images, and the objects to be listed by their mask ids."""

    colour: NDArray[np.uint8]
    depth: NDArray[np.uint16]
    mask: NDArray[np.uint8]
    coord: NDArray[np.uint8]
    objects: dict[int, Item]


def _capture(
    split: Split, scene: TabletopScene | HandheldScene, rng: np.random.Generator
) -> _Frame:
    """Compose until enough objects are seen well, then take the images."""
    camera, look = split.camera, split.look or _PlainView
    for _ in range(_ATTEMPTS):
        items = scene.compose(rng)
        view = look(items, camera, rng)
        seen, depth = view.seen, view.depth
        listed = [
            index
            for index, item in enumerate(items)
            if item.class_id != SCENERY
            and _well_seen(item, depth[seen.instance == index], split.most_lost, camera)
        ]
        if sum(items[index].class_id > 0 for index in listed) >= scene.wanted:
            break
    else:
        names = ", ".join(item.model for item in items if item.class_id > 0)
        raise DataError(
            f"of {names}, {scene.wanted} are never seen well at once, in {_ATTEMPTS} views: with"
            f" {_MIN_PIXELS} pixels that have a depth, and {_MIN_SHARE:.0%} of the box that they"
            " span. What is small, or thin as wire, is not; take it out"
        )
    first = next(i for i, item in enumerate(items) if item.class_id != SCENERY)
    mask = np.full(depth.size, 255, dtype=np.uint8)
    coord = np.full((depth.size, 3), 255, dtype=np.uint8)
    for index in listed:
        pixels, points = object_points(items[index], index, seen, camera)
        mask[pixels] = index - first + 1
        coord[pixels] = _nocs_colours(items[index], points)
    objects = {index - first + 1: items[index] for index in listed}
    return _Frame(
        view.photograph(rng),
        depth,
        mask.reshape(depth.shape),
        coord.reshape(*depth.shape, 3),
        objects,
    )


def _well_seen(item: Item, measured: NDArray[np.uint16], most_lost: float, camera: Camera) -> bool:
    """Whether the pixels that were ``measured`` of an object, 0 where there is no depth, are enough
    to see, also of what its box spans."""
    count = int(np.count_nonzero(measured))
    if count < _MIN_PIXELS or len(measured) - count > most_lost * len(measured):
        return False
    corners = camera.project(item.pose.apply(item.mesh.vertices))
    span = corners.max(axis=0) - corners.min(axis=0)
    return bool(count >= _MIN_SHARE * span[0] * span[1])


def measure(seen: Rendering, camera: Camera, rng: np.random.Generator) -> NDArray[np.uint16]:
    """What a structured-light sensor measures of a rendering: (H, W) millimetres, 0 = missing.

    The model is described in the module's docstring.
    """
    z = seen.depth
    rays = camera_rays(camera)
    cosine = -dot(seen.normal, rays) / np.sqrt(dot(rays, rays))
    angle = np.arccos(np.clip(cosine, 0, 1))
    with np.errstate(divide="ignore"):
        grazing = 1e-4 / np.sqrt(z) * (angle / (np.pi / 2 - np.minimum(angle, 1.5))) ** 2
    sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2 + np.where(angle > np.deg2rad(60), grazing, 0)
    measured = z + np.where(z > 0, sigma, 0) * rng.normal(size=z.shape)
    lost = rng.random(z.shape) < (np.rad2deg(angle) - 70) / 15
    # a step of more than 2 % within a pixel's neighbours is an edge, not a slope
    step = ndimage.maximum_filter(z, 3) - ndimage.minimum_filter(z, 3)
    lost |= (step > 0.02 * z) & (rng.random(z.shape) < 0.8)
    millimetres = np.clip(np.round(1000 * measured), 0, 65535)
    return np.where(lost | (z == 0), 0, millimetres).astype(np.uint16)


def object_points(
    item: Item, index: int, seen: Rendering, camera: Camera
) -> tuple[NDArray[np.int64], Array]:
    """The pixels (N,), flat, that see the item of an index, and what they see of it (N, 3), in its
    own frame, metres."""
    pixels = np.flatnonzero(seen.instance == index)
    rays = camera_rays(camera).reshape(-1, 3)[pixels]
    moved = rays * seen.depth.reshape(-1, 1)[pixels] - item.pose.translation
    r = item.pose.rotation
    return pixels, moved[:, :1] * r[0] + moved[:, 1:2] * r[1] + moved[:, 2:] * r[2]


def _nocs_colours(item: Item, points: Array) -> NDArray[np.uint8]:
    nocs: Array = points @ NOCS_FROM_SHAPENET.T / _diagonal(item) + 0.5
    nocs[:, 2] = 1 - nocs[:, 2]
    return _bytes(nocs)


def _bytes(colours: Array) -> NDArray[np.uint8]:
    levels: NDArray[np.uint8] = np.round(255 * np.clip(colours, 0, 1)).astype(np.uint8)
    return levels


class _PlainView:
    """Two colours, lit from one side without shadows; depth as :func:`measure` has it."""

    def __init__(self, items: list[Item], camera: Camera, rng: np.random.Generator) -> None:
        self._items, self._camera = items, camera
        self.seen = render([(item.mesh, item.pose) for item in items], camera)
        self.depth = measure(self.seen, camera, rng)

    def photograph(self, rng: np.random.Generator) -> NDArray[np.uint8]:
        """The colour image (H, W, 3)."""
        seen = self.seen
        colour = np.zeros((seen.depth.size, 3), dtype=np.uint8)
        light = rng.normal(size=3) + np.array([0.0, -2.0, -2.0])  # from above, behind the camera
        light /= np.sqrt(np.sum(light**2))
        for index, item in enumerate(self._items):
            pixels, points = object_points(item, index, seen, self._camera)
            colour[pixels] = _shade(item, points, seen.normal.reshape(-1, 3)[pixels], light)
        return colour.reshape(*seen.depth.shape, 3)


def _shade(item: Item, points: Array, normals: Array, light: Array) -> NDArray[np.uint8]:
    """Lambertian shading (N, 3) of a two-coloured surface."""
    low, high = item.mesh.bounds
    albedo = item.colours[second_colour(item.pattern, points, points / (high - low)).astype(int)]
    lit = 0.4 + 0.6 * np.clip(dot(normals, light), 0, 1)
    return _bytes(albedo * lit[:, None])


def _diagonal(item: Item) -> float:
    low, high = item.mesh.bounds
    return float(np.sqrt(np.sum((high - low) ** 2)))


class _Writer:
    """Writes frames and meshes in REAL275's layout, and digests their content."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._digest = hashlib.sha256()
        self._models: dict[str, Item] = {}

    def add(self, scene: int, number: int, frame: _Frame) -> None:
        folder = self._root / "real_test" / f"scene_{scene}"
        folder.mkdir(parents=True, exist_ok=True)
        for kind in ("color", "depth", "mask", "coord"):
            pixels = getattr(frame, "colour" if kind == "color" else kind)
            Image.fromarray(pixels).save(folder / f"{number:04d}_{kind}.png", compress_level=2)
            self._digest.update(pixels.astype(pixels.dtype.newbyteorder("<")).tobytes())
        lines = [f"{i} {item.class_id} {item.model}" for i, item in frame.objects.items()]
        self._write_text(folder / f"{number:04d}_meta.txt", lines)
        objects = [item for item in frame.objects.values() if item.class_id > 0]
        self._models.update({item.model: item for item in objects})
        truth = (
            self._root / "gts" / "real_test" / f"results_real_test_scene_{scene}_{number:04d}.pkl"
        )
        truth.parent.mkdir(parents=True, exist_ok=True)
        poses = np.stack([_scaled_pose(item) for item in objects])
        self._digest.update(poses.astype("<f8").tobytes())
        content = {"gt_RTs": poses, "image_path": f"real_test/scene_{scene}/{number:04d}_color.png"}
        # protocol 3, as published: protocol 2 would name a global for bytes
        truth.write_bytes(pickle.dumps(content, protocol=3))

    def finish(self) -> None:
        """Write the meshes of all objects seen, and the digest."""
        originals = self._root / "obj_models" / "real_test"
        closed = self._root / "fixed_real_test_obj_models"
        originals.mkdir(parents=True)
        closed.mkdir()
        for name, item in sorted(self._models.items()):
            vertices = item.mesh.vertices @ NOCS_FROM_SHAPENET.T + 0.0
            lines = ["v {:.7f} {:.7f} {:.7f}".format(*v) for v in vertices.tolist()]
            lines += ["f {} {} {}".format(*t) for t in (item.mesh.triangles + 1).tolist()]
            self._write_text(closed / f"{name}.obj", lines)
            shutil.copyfile(closed / f"{name}.obj", originals / f"{name}.obj")
            extents = vertices.max(axis=0) - vertices.min(axis=0)
            self._write_text(originals / f"{name}.txt", [f"{e:.18e}" for e in extents.tolist()])
        (self._root / "digest.txt").write_text(self._digest.hexdigest() + "\n")

    def _write_text(self, path: Path, lines: list[str]) -> None:
        content = "".join(line + "\n" for line in lines).encode()
        self._digest.update(content)
        path.write_bytes(content)


def _scaled_pose(item: Item) -> Array:
    """The (4, 4) matrix of ``gt_RTs``: NOCS object axes, rotation times box diagonal."""
    matrix = item.pose.matrix
    matrix[:3, :3] = item.pose.rotation @ NOCS_FROM_SHAPENET.T * _diagonal(item)
    return np.round(matrix, 9) + 0.0
