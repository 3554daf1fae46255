"""HouseCat6D (Jung et al., CVPR 2024), the test scenes.

::

    test_sceneN/rgb/IIIIII.png            8-bit colour
    test_sceneN/depth/IIIIII.png          16-bit depth in millimetres, 0 = missing
    test_sceneN/instance/IIIIII.png       instance id per pixel, first channel, 0 = background
    test_sceneN/labels/IIIIII_label.pkl   class_ids, instance_ids, rotations (n, 3, 3),
                                          translations (n, 3) and gt_scales (n, 3), metres
    test_sceneN/intrinsics.txt            K (3, 3)
    test_sceneN/meta.txt                  lines "instance_id class_id CATEGORY-NAME"
    obj_models_small_size_final/CATEGORY/CATEGORY-NAME.obj    metres, centred

from the data set's own code, ``VI-Net/provider/housecat6d_dataset_new.py`` and
``visualization/vis_obj.py`` of Junggy/HouseCat6D (2024; 578eb13, 61744e2), which says of the
licence: CC BY 4.0. It has not been tried on the real files.

The object's y axis is taken to be up: that code turns bottle, can and glass about it. Which way the
others face is not established. bottle and can are symmetric as in the paper's other data sets, and
glass as in that code's IoU. Objects that are listed but hidden are left out; to know that, making
the index opens the instance images.
"""

from __future__ import annotations

from pathlib import Path

from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._records import Record, RecordTree
from pytest_cpas.datasets._tree import find_root
from pytest_cpas.datasets._values import integers, intrinsics
from pytest_cpas.datasets.nocs import symmetry_of
from pytest_cpas.reading.numbers import numbers, whole
from pytest_cpas.reading.paths import natural
from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.types import ContractError, DataError, Derived, SampleRef, Symmetry

CATEGORIES = (
    "box",
    "bottle",
    "can",
    "cup",
    "remote",
    "teapot",
    "cutlery",
    "glass",
    "shoe",
    "tube",
)

_MODELS = "obj_models_small_size_final"


class HouseCat6D(RecordTree):
    """The test scenes of HouseCat6D."""

    class_names = CATEGORIES
    all_derived = (
        Derived(
            part="symmetry",
            made_of=frozenset({"category"}),
            how="by category: bottle, can and glass about y, others none",
        ),
    )

    def __init__(self, data_dir: Path | None) -> None:
        """Find the tree in ``data_dir`` or ``data_dir/housecat6d``; FileNotFoundError says how."""
        super().__init__("housecat6d", find_root("housecat6d", data_dir, _MODELS))

    def scan(self, scan: Scan) -> None:
        """List the labelled objects that are seen."""
        listed: list[tuple[SampleRef, Record]] = []
        for scene in sorted(scan.names(""), key=natural):
            if scene.startswith("test_scene"):
                try:
                    listed += self._scan_scene(scan, scene)
                except ContractError as error:
                    scan.damaged.append(str(error))
        self.add_seen(scan, listed)
        for mesh in sorted({record.mesh for _, record in listed if record.mesh}):
            scan.hash(mesh)

    def _scan_scene(self, scan: Scan, scene: str) -> list[tuple[SampleRef, Record]]:
        where = str(self.root / scene / "intrinsics.txt")
        text = scan.read(f"{scene}/intrinsics.txt").decode("utf-8", "replace")
        camera = intrinsics(text.split(), where)
        names = self._names(scan, scene)
        size: tuple[int, int] | None = None
        listed = []
        for file in sorted(scan.names(f"{scene}/rgb")):
            image = file.removesuffix(".png")
            paths = {
                "depth": f"{scene}/depth/{file}",
                "instance": f"{scene}/instance/{file}",
                "label": f"{scene}/labels/{image}_label.pkl",
            }
            lacks = [kind for kind, path in paths.items() if not scan.has(path)]
            for kind in lacks:
                scan.lacks(f"frames without {kind}", f"{scene}/{image}")
            if lacks:
                continue
            try:
                size = size or scan.image_size(f"{scene}/rgb/{file}")
                shared = Record(f"{scene}/rgb/{file}", paths["depth"], [*size, *camera], [], [])
                shared = shared._replace(mask=paths["instance"])
                listed += self._scan_label(scan, paths["label"], f"{scene}/{image}", shared, names)
            except ContractError as error:
                scan.damaged.append(str(error))
        return listed

    def _names(self, scan: Scan, scene: str) -> dict[int, str]:
        """The model of each instance of a scene."""
        names = {}
        text = scan.read(f"{scene}/meta.txt").decode("utf-8", "replace")
        for line in filter(str.strip, text.split("\n")):
            words = line.split()
            instance = whole(words[0]) if len(words) == 3 and "/" not in words[2] else None
            if instance is None or words[2].split("-")[0] not in CATEGORIES:
                raise DataError(
                    f"{self.root / scene / 'meta.txt'}: line {line!r}, expected"
                    " 'instance_id class_id CATEGORY-NAME'"
                )
            if instance in names:
                raise DataError(f"{self.root / scene / 'meta.txt'}: instance {instance} is twice")
            names[instance] = words[2]
        return names

    def _scan_label(
        self, scan: Scan, file: str, frame: str, shared: Record, names: dict[int, str]
    ) -> list[tuple[SampleRef, Record]]:
        path = self.root / file
        scan.read(file)
        label = load_numpy_pickle(path)
        keys = ("class_ids", "instance_ids", "rotations", "translations", "gt_scales")
        absent = [key for key in keys if key not in label]
        if absent:
            raise DataError(f"{path}: it lacks {', '.join(absent)}")
        instances = integers(label["instance_ids"], None, f"{path}: instance_ids")
        count = len(instances)
        classes = integers(label["class_ids"], count, f"{path}: class_ids")
        rotations = numbers(label["rotations"], (count, 3, 3), f"{path}: rotations")
        translations = numbers(label["translations"], (count, 3), f"{path}: translations")
        scales = numbers(label["gt_scales"], (count, 3), f"{path}: gt_scales")
        listed = []
        for i in range(count):
            instance, class_id = instances[i], classes[i]
            if not 1 <= class_id <= len(CATEGORIES) or instance not in names:
                raise DataError(
                    f"{path}: instance {instance} of class {class_id}, expected one of meta.txt"
                    f" and a class of 1 to {len(CATEGORIES)}"
                )
            category, model = CATEGORIES[class_id - 1], names[instance]
            if model.split("-")[0] != category:
                raise DataError(
                    f"{path}: instance {instance} is a {category}, and in meta.txt a {model}"
                )
            mesh = f"{_MODELS}/{category}/{model}.obj"
            record = shared._replace(
                rotation=rotations[i].ravel().tolist(),
                translation=translations[i].tolist(),
                extents=scales[i].tolist(),
                mesh=mesh if scan.has(mesh) else None,
                mask_id=instance,
            )
            scene = frame.split("/")[0]
            ref_id = f"{frame}/{instance}"
            ref = SampleRef(id=ref_id, category=category, scene=scene, model=model)
            listed.append((ref, record))
            if record.mesh is None:
                scan.lacks_shape(f"{model}.obj")
        return listed

    def _symmetry(self, ref: SampleRef, record: Record) -> Symmetry:
        return symmetry_of("bottle" if ref.category == "glass" else ref.category)
