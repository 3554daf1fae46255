"""Wild6D (Fu & Wang, NeurIPS 2022), the annotated test set. It has no meshes: shape is n/a.

::

    test_set/CATEGORY/OBJECT/SEQUENCE/images/N.jpg, N-depth.png, N-mask.png
    test_set/CATEGORY/OBJECT/SEQUENCE/metadata        JSON: K, nine numbers column by column
    test_set/pkl_annotations/CATEGORY/CATEGORY-OBJECT-SEQUENCE.pkl
        annotations: a list of name "CATEGORY/OBJECT/SEQUENCE/N", rotation (3, 3),
        translation (3,) and size (3,), metres
    test_set/test_list_CATEGORY.txt       the images to be judged; all without it

Depth is 16 bit, in millimetres; the mask is where its first channel is not 0. From the data set's
own code, ``README.md`` and ``evaluate_pose_ucsd.py`` of OasisYang/Wild6D (2022; 17e0b13, 472e840),
and a converter of CPPF++ (2024). It has not been tried on the real files. The object axes are taken
to be NOCS's: that code compares them with poses of networks trained on NOCS data. In names, ``cup``
stands for mug. Images without a mask or without an annotation are left out, as there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pytest_cpas.datasets._derived import BY_CATEGORY
from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._records import Record, RecordTree
from pytest_cpas.datasets._tree import find_root
from pytest_cpas.datasets._values import intrinsics
from pytest_cpas.reading.numbers import numbers, whole
from pytest_cpas.reading.paths import natural
from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.types import ContractError, DataError, SampleRef
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET, permute_extents

CATEGORIES = ("bottle", "bowl", "camera", "laptop", "mug")

_ANNOTATIONS = "test_set/pkl_annotations"


class Wild6D(RecordTree):
    """The test set of Wild6D."""

    several = False
    all_derived = (BY_CATEGORY,)
    published_axes = NOCS_FROM_SHAPENET

    def __init__(self, data_dir: Path | None) -> None:
        """Find the tree in ``data_dir`` or ``wild6d`` in it; FileNotFoundError says how."""
        root = find_root("wild6d", data_dir, _ANNOTATIONS, "Wild6D")
        super().__init__("wild6d", root)

    def scan(self, scan: Scan) -> None:
        """List the annotated images."""
        for category in CATEGORIES:
            tests = self._test_images(scan, category)
            for file in sorted(scan.names(f"{_ANNOTATIONS}/{category}"), key=natural):
                path = f"{_ANNOTATIONS}/{category}/{file}"
                try:
                    self._scan_sequence(scan, category, path, tests)
                except ContractError as error:
                    scan.damaged.append(str(error))

    def _test_images(self, scan: Scan, category: str) -> set[str] | None:
        """As OBJECT/SEQUENCE/N; None for all."""
        file = f"test_set/test_list_{category}.txt"
        if not scan.has(file):
            return None
        # .../CATEGORY/OBJECT/SEQUENCE/images/N.jpg
        lines = [line.split("/") for line in scan.read(file).decode("utf-8", "replace").split()]
        if any(len(words) < 4 for words in lines):
            raise DataError(f"{self.root / file}: expected .../OBJECT/SEQUENCE/images/N.jpg")
        return {f"{w[-4]}/{w[-3]}/{w[-1].removesuffix('.jpg')}" for w in lines}

    def _scan_sequence(self, scan: Scan, category: str, path: str, tests: set[str] | None) -> None:
        scan.read(path)
        annotations = load_numpy_pickle(self.root / path).get("annotations")
        if not isinstance(annotations, list):
            raise DataError(f"{self.root / path}: annotations is not a list")
        words = path.rsplit("/", 1)[1].removesuffix(".pkl").split("-")
        if len(words) != 3:
            raise DataError(f"{self.root / path}: expected CATEGORY-OBJECT-SEQUENCE.pkl")
        sequence = f"{words[1]}/{words[2]}"
        folder = f"test_set/{category}/{sequence}"
        if not scan.has(f"{folder}/metadata"):
            scan.lacks("sequences without metadata", f"{category}/{sequence}")
            return
        where = f"{self.root / folder / 'metadata'}: K"
        # column by column
        matrix = numbers(scan.read_json(f"{folder}/metadata").get("K"), (3, 3), where).T
        camera = intrinsics(matrix, where)
        size: tuple[int, int] | None = None
        for index, annotation in enumerate(annotations):
            at = f"{self.root / path}: annotation {index}"
            try:
                image = self._image(annotation, sequence)
                if tests is not None and f"{sequence}/{image}" not in tests:
                    continue
                stem = f"{folder}/images/{image}"
                files = (f"{stem}.jpg", f"{stem}-depth.png", f"{stem}-mask.png")
                lacks = [file for file in files if not scan.has(file)]
                if lacks:
                    scan.lacks("annotated images without colour, depth or mask", lacks[0])
                    continue
                size = size or scan.image_size(files[0])
                record = self._record(annotation, files, [*size, *camera])
                ref_id = f"{category}/{sequence}/{image}"
                model = f"{category}/{words[1]}"
                scene = f"{category}/{sequence}"
                ref = SampleRef(id=ref_id, category=category, scene=scene, model=model)
                scan.add(ref, record)
            except ContractError as error:
                scan.damaged.append(f"{at}: {error}")

    def _image(self, annotation: Any, sequence: str) -> int:
        name = annotation.get("name") if isinstance(annotation, dict) else None
        # the category may be called otherwise, such as cup for a mug
        words = name.split("/") if isinstance(name, str) else []
        number = whole(words[-1]) if len(words) == 4 else None
        if number is None or "/".join(words[1:3]) != sequence:
            raise DataError(
                f"name {name!r:.100}, expected CATEGORY/OBJECT/SEQUENCE/N of {sequence}"
            )
        return number

    def _record(
        self, annotation: dict[str, Any], files: tuple[str, str, str], camera: list[float]
    ) -> Record:
        rotation = numbers(annotation.get("rotation"), (3, 3), "rotation")
        size = numbers(annotation.get("size"), (3,), "size")
        rgb, depth, mask = files
        return Record(
            rgb,
            depth,
            camera,
            (rotation @ NOCS_FROM_SHAPENET).ravel().tolist(),
            numbers(annotation.get("translation"), (3,), "translation").tolist(),
            permute_extents(size, NOCS_FROM_SHAPENET.T).tolist(),
            mask=mask,
        )
