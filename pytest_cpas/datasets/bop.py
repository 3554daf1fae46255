"""Any data set in BOP format: known objects instead of categories.

::

    DIR/SPLIT/SCENE/rgb/IIIIII.png (or .jpg), depth/IIIIII.png
    DIR/SPLIT/SCENE/mask_visib/IIIIII_GGGGGG.png, else mask/IIIIII_GGGGGG.png
    DIR/SPLIT/SCENE/scene_camera.json    per image cam_K and depth_scale (to millimetres)
    DIR/SPLIT/SCENE/scene_gt.json        per image a list of obj_id, cam_R_m2c, cam_t_m2c
    DIR/SPLIT/SCENE/scene_gt_info.json   per image a list with visib_fract
    DIR/models_eval/ (or models/, models_cad/): obj_NNNNNN.ply (or .obj), models_info.json;
                                         millimetres
    DIR/test_targets_bop19.json          of a test split, the images and objects to be judged

from ``docs/bop_datasets_format.md`` of thodan/bop_toolkit (2018; with the names that its JSON
release of 2019 gave the files) and what reads and writes it today. Images that are gray only
(ITODD) are not read.

An object is a category: ``obj_000001``. Objects of which less than a tenth is visible are left out,
as in BOP's evaluation. Our object frame has BOP's axes, whatever is up, and its origin in the
centre of the model's box: BOP's is close to it, but not always in it. The symmetries are those of
``models_info.json``, without the shifts that they may hold.

``mask/`` shows the whole object, also what others hide: it is taken where ``mask_visib/`` lacks,
less the pixels that were measured nearer than the model. Without either, the model is rendered.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pytest_cpas.datasets._bop_models import (
    HOW,
    MODEL_FILES,
    find_models,
    read_model_mesh,
    read_models,
)
from pytest_cpas.datasets._derived import RENDERED
from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._records import Record, RecordTree
from pytest_cpas.datasets._values import intrinsics, list_of, steps_per_metre
from pytest_cpas.reading.numbers import numbers, whole
from pytest_cpas.reading.paths import natural
from pytest_cpas.reading.structured import parse_json
from pytest_cpas.types import (
    Camera,
    ContractError,
    DataError,
    Derived,
    Mesh,
    Pose,
    SampleRef,
    Symmetry,
)
from pytest_cpas.types._arrays import checked_integer, checked_number

#: Objects of which a smaller part is visible are not judged (BOP Challenge 2019).
_LEAST_VISIBLE = 0.1

#: What a visible mask is made of where only ``mask/`` is there.
_AMODAL = Derived(
    part="mask",
    made_of=frozenset({"mask/", "mesh", "pose", "depth"}),
    how="mask_visib/ has none of it: mask/, which shows also what others hide (amodal), less what"
    " was measured more than 1 cm in front of the mesh",
)

_WHOLE = Derived(
    part="mask",
    made_of=frozenset({"mask/"}),
    how="mask_visib/ has none of it, and there is no mesh: mask/, which shows also what others hide"
    " (amodal)",
)


class Bop(RecordTree):
    """One split of a data set in BOP format."""

    def __init__(self, data_dir: Path | None) -> None:
        """Find the split: ``data_dir`` itself, or the one test split in it.

        Raises :class:`FileNotFoundError` that says what is expected, :class:`DataError` if the
        models' description cannot be read.
        """
        root, self.split = find_split(data_dir)
        self._models_info = find_models(root)
        self._models, self._damaged_models = read_models(root / self._models_info)
        self._models_folder = self._models_info.rpartition("/")[0]
        self.published_centres = {object_name(n): m.centre for n, m in self._models.items()}
        self.class_names = tuple(self.published_centres)
        name = re.sub(r"[^A-Za-z0-9._-]", "-", f"bop-{root.resolve().name}-{self.split}")
        super().__init__(name, root)

    def scan(self, scan: Scan) -> None:
        """List the annotated objects that are seen well enough."""
        scan.read(self._models_info)
        scan.damaged += self._damaged_models
        self._meshes = self._find_meshes(scan)
        self._without_mesh: Counter[str] = Counter()
        self._without_info: list[str] = []
        targets = self._targets(scan)
        for scene in sorted(scan.names(self.split), key=natural):
            if whole(scene) is None:
                continue
            try:
                self._scan_scene(scan, scene, targets)
            except ContractError as error:
                scan.damaged.append(str(error))
        for path in self._meshes.values():
            scan.hash(path)
        if scenes := self._without_info:
            scan.missing.append(
                f"scene_gt_info.json of {len(scenes)} scenes, first {scenes[0]}: which objects are"
                " hidden is not said, and all are listed (bop_toolkit's scripts/calc_gt_info.py"
                " writes it)"
            )
        if lacking := self._without_mesh:
            scan.missing.append(
                f"models of {len(lacking)} objects, first {self._models_folder}/{min(lacking)}.ply:"
                f" shape metrics of {lacking.total()} samples are n/a"
            )

    def _find_meshes(self, scan: Scan) -> dict[int, str]:
        """The file of each object's model. An OBJ file must have the box that is described."""
        found = {}
        for number, model in sorted(self._models.items()):
            paths = [f"{self._models_folder}/{object_name(number)}{end}" for end in MODEL_FILES]
            path = next(filter(scan.has, paths), None)
            if path is None:
                continue
            if path.endswith(".obj"):
                try:
                    read_model_mesh(self.root / path, model)
                except ContractError as error:
                    scan.damaged.append(str(error))
                    continue
            found[number] = path
        return found

    def _targets(self, scan: Scan) -> set[tuple[int, int, int]] | None:
        """The (scene, image, object) to be judged; None for all."""
        file = "test_targets_bop19.json"
        if not self.split.startswith("test") or not scan.has(file):
            return None
        try:
            listed = parse_json(self.root / file, scan.read(file), list)
            keys = ("scene_id", "im_id", "obj_id")
            found = {tuple(_number(target[key], key) for key in keys) for target in listed}
            return {(scene, image, number) for scene, image, number in found}
        except (TypeError, KeyError, ContractError) as error:
            raise DataError(
                f"{self.root / file}: expected a list of scene_id, im_id and obj_id ({error!r})"
            ) from error

    def _scan_scene(
        self, scan: Scan, scene: str, targets: set[tuple[int, int, int]] | None
    ) -> None:
        folder = f"{self.split}/{scene}"
        lacks = [f for f in ("scene_gt", "scene_camera") if not scan.has(f"{folder}/{f}.json")]
        for file in lacks:
            scan.lacks(f"scenes without {file}.json", scene)
        if lacks:
            return
        truths = scan.read_json(f"{folder}/scene_gt.json")
        cameras = scan.read_json(f"{folder}/scene_camera.json")
        info = f"{folder}/scene_gt_info.json"
        infos = scan.read_json(info) if scan.has(info) else {}
        if not scan.has(info):
            self._without_info.append(scene)
        size: tuple[int, int] | None = None
        self._name_unlisted(scan, folder, truths)
        file = f"{self.root / folder}/scene_camera.json"
        scales = ["depth_scale" in camera for camera in cameras.values() if type(camera) is dict]
        if not all(scales):
            raise DataError(
                f"{file}: {scales.count(False)} of {len(scales)} images have no depth_scale, which"
                " the format demands: the millimetres of one step of depth. Write it for each"
                ' image, "depth_scale": 1.0 if depth is in millimetres'
            )
        for key in sorted(truths, key=natural):
            where = f"{self.root / folder}/scene_gt.json: image {key}"
            with _damage(scan, where):
                found = self._image(scan, folder, key, cameras.get(key))
                if found is None:
                    continue
                size = size or scan.image_size(found[0])
                with _named(f"{file}: image {key}"):
                    frame = _frame(*found, cameras[key], size)
                objects = list_of(truths[key], "scene_gt.json")
                visible = _visible(infos, key, len(objects))
                for index, truth in enumerate(objects):
                    with _damage(scan, f"{where}, object {index}"):
                        number = self._object(truth)
                        wanted = targets is None or (int(scene), int(key), number) in targets
                        if wanted and visible(index) >= _LEAST_VISIBLE:
                            ref_id = f"{scene}/{int(key):06d}/{index}"
                            self._add(scan, frame, ref_id, number, truth)

    def _name_unlisted(self, scan: Scan, folder: str, truths: Collection[str]) -> None:
        """Name the images of a scene that ``scene_gt.json`` lacks."""
        listed = {whole(key) for key in truths}
        for file in sorted(scan.names(f"{folder}/rgb")):
            stem, _, end = file.rpartition(".")
            if end in ("png", "jpg") and whole(stem) not in listed:
                scan.lacks("images that scene_gt.json does not list", f"{folder}/rgb/{file}")

    def _object(self, truth: Any) -> int:
        number = _number(truth.get("obj_id") if isinstance(truth, dict) else None, "obj_id")
        if number not in self._models:
            raise DataError(f"obj_id {number} is not in {self._models_info}")
        return number

    def _image(self, scan: Scan, folder: str, key: str, camera: Any) -> tuple[str, str] | None:
        number = whole(key)
        if number is None or not isinstance(camera, dict):
            raise DataError("not an image number with an entry in scene_camera.json")
        stem = f"{number:06d}"
        rgb = [p for p in (f"{folder}/rgb/{stem}.{e}" for e in ("png", "jpg")) if scan.has(p)]
        depth = f"{folder}/depth/{stem}.png"
        if not rgb:
            scan.lacks("images without colour (rgb/)", f"{folder}/{stem}")
        if not scan.has(depth):
            scan.lacks("images without depth (depth/)", f"{folder}/{stem}")
        return (rgb[0], depth) if rgb and scan.has(depth) else None

    def _add(
        self, scan: Scan, frame: Record, ref_id: str, number: int, truth: dict[str, Any]
    ) -> None:
        scene, image, index = ref_id.split("/")
        model, mesh = self._models[number], self._meshes.get(number)
        file = f"{image}_{int(index):06d}.png"
        masks = [f"{self.split}/{scene}/{kind}/{file}" for kind in ("mask_visib", "mask")]
        mask = next(filter(scan.has, masks), None)
        if mask is None and mesh is None:
            scan.lacks("objects with neither mask (mask_visib/, mask/) nor model", ref_id)
            return
        if mesh is None:
            self._without_mesh[object_name(number)] += 1
        rotation = numbers(truth.get("cam_R_m2c"), (3, 3), "cam_R_m2c")
        translation = numbers(truth.get("cam_t_m2c"), (3,), "cam_t_m2c") / 1000
        pose = Pose(rotation, translation + rotation @ model.centre)
        record = frame._replace(
            rotation=pose.rotation.ravel().tolist(),
            translation=pose.translation.tolist(),
            extents=model.extents.tolist(),
            mesh=mesh,
            mask=mask,
            amodal=mask == masks[1],
        )
        if mask != masks[0]:
            derived = RENDERED if mask is None else _WHOLE if mesh is None else _AMODAL
            scan.derives(derived, ref_id)
            scan.note(f"{ref_id} {mask}\n")  # what a method sees is another thing then
        name = object_name(number)
        scan.add(SampleRef(id=ref_id, category=name, scene=scene, model=name), record)

    def _symmetry(self, ref: SampleRef, record: Record) -> Symmetry:
        return self._models[object_number(ref.category)].symmetry

    def _read_mesh(self, name: str) -> Mesh:
        return read_model_mesh(self.root / name, self._models[object_number(Path(name).stem)])


def object_name(number: int) -> str:
    """The category of an object."""
    return f"obj_{number:06d}"


def object_number(name: str) -> int:
    """The number of an object, from its category; :class:`DataError` if it is none."""
    number = whole(name.removeprefix("obj_"))
    if number is None or name != object_name(number):
        raise DataError(f"{name[:80]!r} is no object, expected a name such as {object_name(1)}")
    return number


@contextmanager
def _named(where: str) -> Generator[None]:
    """Say which file it is of which something is wrong."""
    try:
        yield
    except ContractError as error:
        raise _NamedError(f"{where}: {error}") from None


class _NamedError(DataError):
    """Says itself which file is wrong."""


@contextmanager
def _damage(scan: Scan, where: str) -> Generator[None]:
    try:
        yield
    except _NamedError as error:
        scan.damaged.append(str(error))
    except ContractError as error:
        scan.damaged.append(f"{where}: {error}")


def _frame(rgb: str, depth: str, entry: dict[str, Any], size: tuple[int, int]) -> Record:
    """What the objects of an image share."""
    camera = intrinsics(entry.get("cam_K"), "cam_K")
    Camera(*size, *camera)
    steps = steps_per_metre(entry["depth_scale"], "depth_scale, millimetres of a step", 1000)
    return Record(rgb, depth, [*size, *camera], [], [], depth_per_metre=steps)


def _number(value: Any, key: str) -> int:
    """The number of a scene, an image or an object."""
    return checked_integer(value, key, 0, 10**9)


def _visible(infos: dict[str, Any], image: str, count: int) -> Callable[[int], float]:
    """Which part of each of an image's objects is visible; all of it where nothing is said."""
    if image not in infos:
        return lambda index: 1.0
    entries = list_of(infos[image], "scene_gt_info.json")
    if len(entries) != count:
        raise DataError(
            f"scene_gt_info.json has {len(entries)} entries, and {count} objects are seen"
        )

    def visible(index: int) -> float:
        if not isinstance(entries[index], dict):
            raise DataError("scene_gt_info.json: no entry of the object, but something else")
        return checked_number(entries[index].get("visib_fract"), "visib_fract", 0, 1)

    return visible


def find_split(data_dir: Path | None) -> tuple[Path, str]:
    """The data set's folder and the split that ``data_dir`` names."""
    if data_dir is None or not data_dir.is_dir():
        raise FileNotFoundError(f"no folder {data_dir or 'was given'}.\n{HOW}")

    def is_split(folder: Path) -> bool:
        return folder.is_dir() and any(
            whole(scene.name) is not None and scene.is_dir() for scene in folder.iterdir()
        )

    if is_split(data_dir):
        folder = data_dir.resolve()
        return folder.parent, folder.name
    splits = sorted(folder.name for folder in data_dir.iterdir() if is_split(folder))
    tests = [name for name in splits if name.startswith("test")]
    if "test" in tests:
        return data_dir, "test"
    if len(tests) != 1:
        found = ", ".join(splits) or "none"
        raise FileNotFoundError(f"{data_dir}: splits are {found}; name one of them.\n{HOW}")
    return data_dir, tests[0]
