"""PhoCaL (Wang et al., CVPR 2022), the test images of its 24 sequences.

::

    class_obj_taxonomy.json          class id -> class_name, objs (instance id -> model), scales
                                     (instance id -> side lengths, metres)
    obj_models_small_size/CATEGORY/MODEL.obj     metres, centred
    sequence_N/rgb/IIIIII.png        8-bit colour
    sequence_N/depth/IIIIII.png      16-bit depth; depth_scale units are a metre
    sequence_N/mask/IIIIII.png       1 + index in the image's list, first channel, 0 = background
    sequence_N/scene_camera.json     rgb: fx, fy, cx, cy, depth_scale
    sequence_N/rgb_scene_gt.json     image -> list of class_id, inst_id, cam_R_m2c and cam_t_m2c,
                                     metres
    sequence_N/train_test_split.npz  test_idxs: the test images

from code of others that reads the release, for lack of a published description: the converter to
REAL275's layout of CPPF++ (qq456cvb/CPPF2, 2024) and two ports of 2022 and 2023. It has not been
tried on the real files.

The models' z axis is up, by that converter for bottle, can and cup; it is taken to be so for all,
and turned into ShapeNet's y. Which way they face is not established. bottle and can are symmetric
about it. Objects that are listed but hidden are left out; to know that, making the index opens the
masks.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from pytest_cpas.datasets._derived import BY_CATEGORY
from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._records import Record, RecordTree
from pytest_cpas.datasets._tree import find_root
from pytest_cpas.datasets._values import integers, list_of, steps_per_metre, text_of
from pytest_cpas.reading.arrays import Wanted, read_npz
from pytest_cpas.reading.numbers import numbers, whole
from pytest_cpas.reading.paths import natural
from pytest_cpas.types import ContractError, DataError, SampleRef
from pytest_cpas.types.frames import SHAPENET_FROM_Z_UP, permute_extents

_TAXONOMY = "class_obj_taxonomy.json"


class PhoCaL(RecordTree):
    """The test images of PhoCaL."""

    all_derived = (BY_CATEGORY,)
    mesh_axes = SHAPENET_FROM_Z_UP
    published_axes = SHAPENET_FROM_Z_UP.T

    def __init__(self, data_dir: Path | None) -> None:
        """Find the tree in ``data_dir`` or ``phocal`` in it; FileNotFoundError says how.

        Raises :class:`DataError` if the taxonomy cannot be read.
        """
        super().__init__("phocal", find_root("phocal", data_dir, _TAXONOMY, "PhoCAL_release"))

    def scan(self, scan: Scan) -> None:
        """List the annotated objects that are seen in test images."""
        taxonomy = scan.read_json(_TAXONOMY)
        listed: list[tuple[SampleRef, Record]] = []
        for sequence in sorted(scan.names(""), key=natural):
            if sequence.startswith("sequence_"):
                try:
                    listed += self._scan_sequence(scan, sequence, taxonomy)
                except ContractError as error:
                    scan.damaged.append(str(error))
        self.add_seen(scan, listed)
        for mesh in sorted({record.mesh for _, record in listed if record.mesh}):
            scan.hash(mesh)

    def _scan_sequence(
        self, scan: Scan, sequence: str, taxonomy: dict[str, Any]
    ) -> list[tuple[SampleRef, Record]]:
        sensors = scan.read_json(f"{sequence}/scene_camera.json")
        keys = ("fx", "fy", "cx", "cy", "depth_scale")
        where = f"{self.root / sequence / 'scene_camera.json'}: rgb {', '.join(keys)}"
        colour = sensors.get("rgb")
        values = [colour.get(key) for key in keys] if isinstance(colour, dict) else colour
        *intrinsics, steps = numbers(values, (5,), where).tolist()
        per_metre = steps_per_metre(steps, where)
        tests = self._test_images(scan, f"{sequence}/train_test_split.npz")
        truths = scan.read_json(f"{sequence}/rgb_scene_gt.json")
        size: tuple[int, int] | None = None
        listed = []
        for key in sorted(truths, key=natural):
            number = whole(key)
            if number is None:
                scan.damaged.append(
                    f"{self.root / sequence / 'rgb_scene_gt.json'}: image {key[:80]!r}, expected a"
                    " number"
                )
            if number is None or number not in tests:
                continue
            image = f"{number:06d}"
            paths = [f"{sequence}/{kind}/{image}.png" for kind in ("rgb", "depth", "mask")]
            lacks = [path for path in paths if not scan.has(path)]
            for path in lacks:
                scan.lacks(f"frames without {path.split('/')[1]}", f"{sequence}/{image}")
            if lacks:
                continue
            try:
                size = size or scan.image_size(paths[0])
                rgb, depth, mask = paths
                shared = Record(rgb, depth, [*size, *intrinsics], [], [], mask=mask)
                shared = shared._replace(depth_per_metre=per_metre)
                listed += [
                    self._object(scan, f"{sequence}/{image}/{index}", truth, shared, taxonomy)
                    for index, truth in enumerate(list_of(truths[key], f"image {key}"), start=1)
                ]
            except ContractError as error:
                scan.damaged.append(f"{self.root / sequence / 'rgb_scene_gt.json'}: {error}")
        return listed

    def _test_images(self, scan: Scan, file: str) -> set[int]:
        path, content = self.root / file, io.BytesIO(scan.read(file))
        indices = read_npz(path, {"test_idxs": Wanted("iuf")}, content)["test_idxs"]
        return set(integers(indices, None, f"{path}: test_idxs"))

    def _object(
        self,
        scan: Scan,
        ref_id: str,
        truth: Any,
        shared: Record,
        taxonomy: dict[str, Any],
    ) -> tuple[SampleRef, Record]:
        try:
            entry, instance = taxonomy[str(truth["class_id"])], str(truth["inst_id"])
            category = text_of(entry["class_name"], f"{_TAXONOMY}: class_name")
            model = text_of(entry["objs"][instance], f"{_TAXONOMY}: objs of {category}")
            rotation = numbers(truth["cam_R_m2c"], (3, 3), f"{ref_id}: cam_R_m2c")
            translation = numbers(truth["cam_t_m2c"], (3,), f"{ref_id}: cam_t_m2c")
            scales = numbers(entry["scales"][instance], (3,), f"{_TAXONOMY}: scales of {model}")
        except (KeyError, TypeError) as error:
            raise DataError(
                f"{ref_id}: {error!r}; expected class_id and inst_id of {_TAXONOMY}, cam_R_m2c and"
                " cam_t_m2c"
            ) from None
        mesh = f"obj_models_small_size/{category}/{model}.obj"
        has_mesh = "/" not in category + model and scan.has(mesh)
        if not has_mesh:
            scan.lacks_shape(f"{model}.obj")
        record = shared._replace(
            rotation=(rotation @ SHAPENET_FROM_Z_UP.T).ravel().tolist(),
            translation=translation.tolist(),
            extents=permute_extents(scales, SHAPENET_FROM_Z_UP).tolist(),
            mesh=mesh if has_mesh else None,
            mask_id=int(ref_id.rsplit("/", 1)[1]),
        )
        scene = ref_id.split("/")[0]
        return SampleRef(id=ref_id, category=category, scene=scene, model=model), record
