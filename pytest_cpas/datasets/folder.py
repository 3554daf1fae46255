"""A data set of your own: a folder with a table ``samples.csv``, one object in one image a line.

``docs/datasets.md`` describes the columns, with an example.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pytest_cpas.datasets._derived import BOX_OF_MESH, BY_CATEGORY, RENDERED
from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._records import Record, RecordTree
from pytest_cpas.datasets._symmetries import parse_symmetry
from pytest_cpas.datasets._values import steps_per_metre
from pytest_cpas.datasets.nocs import symmetry_of
from pytest_cpas.reading.files import decoded
from pytest_cpas.reading.meshes import read_mesh
from pytest_cpas.reading.numbers import numbers, quaternion_rotation, whole
from pytest_cpas.reading.paths import below
from pytest_cpas.reading.tables import by_column, csv_table
from pytest_cpas.types import (
    Camera,
    ContractError,
    DataError,
    Mesh,
    SampleRef,
    Symmetry,
    shortened,
)

_TABLE = "samples.csv"

_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")
_QUATERNION = ("qx", "qy", "qz", "qw")
_TRANSLATION = ("tx", "ty", "tz")
_EXTENTS = ("extent_x", "extent_y", "extent_z")
_REQUIRED = ("id", "category", "rgb", "depth", *_CAMERA, *_QUATERNION, *_TRANSLATION)
_OPTIONAL = ("scene", "model", "mask", "mask_id", "depth_unit", *_EXTENTS, "mesh", "symmetry")


class Folder(RecordTree):
    """The data set of a folder, named ``folder-`` and the folder's name."""

    def __init__(self, data_dir: Path | None) -> None:
        """Read the table in ``data_dir``.

        Raises :class:`FileNotFoundError` if there is none, :class:`DataError` if it is not
        such a table; a line that is wrong is in ``damaged``, and the others are listed.
        """
        if data_dir is None or not (data_dir / _TABLE).is_file():
            where = "no folder was given" if data_dir is None else f"{data_dir} has no {_TABLE}"
            raise FileNotFoundError(
                f"{where}. Name the folder: --cpas-dataset folder:DIR, with a table DIR/{_TABLE}"
                f" of the columns {', '.join(_REQUIRED)} (docs/datasets.md)"
            )
        name = re.sub(r"[^A-Za-z0-9._-]", "-", data_dir.resolve().name)
        super().__init__(f"folder-{name}", data_dir)

    def scan(self, scan: Scan) -> None:
        """List the lines of the table whose files are there."""
        path = self.root / _TABLE
        text = decoded(path, scan.read(_TABLE)).removeprefix("\ufeff")
        columns, lines = csv_table(f"{path}", text)
        absent = [column for column in _REQUIRED if column not in columns]
        unknown = [column for column in columns if column not in _REQUIRED + _OPTIONAL]
        if absent or unknown:
            raise DataError(
                f"{path}: columns lacking: {', '.join(absent) or 'none'}; unknown:"
                f" {shortened(', '.join(unknown), 100) or 'none'}. Expected {', '.join(_REQUIRED)}"
                f" and, where wanted, {', '.join(_OPTIONAL)}, separated by commas"
            )
        ids: set[str] = set()
        meshes: set[str] = set()
        for number, values in lines:
            where = f"{path}, line {number}"
            try:
                line = by_column(where, columns, values)
                meshes.add(line.get("mesh", ""))
                self._list(scan, line, where, ids)
            except ContractError as error:
                text = str(error)
                scan.damaged.append(text if text.startswith(where) else f"{where}: {text}")
        for mesh in sorted(meshes - {""}):
            if scan.has(mesh):
                scan.hash(mesh)

    def _list(self, scan: Scan, line: dict[str, str], where: str, ids: set[str]) -> None:
        text = {column: value.strip() for column, value in line.items()}
        if not text["id"] or not text["category"] or text["id"] in ids:
            raise DataError(f"{where}: id {text['id']!r} is empty or occurs twice, or no category")
        ref = SampleRef(
            id=text["id"],
            category=text["category"],
            scene=text.get("scene", ""),
            model=text.get("model", ""),
        )
        ids.add(ref.id)
        record = self._record(text, where)
        for kind in ("rgb", "depth", "mask", "mesh"):
            file = getattr(record, kind)
            if file is not None and not scan.has(below(Path(), file, where).as_posix()):
                scan.lacks(f"samples without their {kind} file", f"{ref.id} ({file})")
                return
        scan.add(ref, record)
        for derived, given in (
            (RENDERED, record.mask),
            (BOX_OF_MESH, record.extents),
            (BY_CATEGORY, record.symmetry),
        ):
            if given is None:
                scan.derives(derived, ref.id)

    def _record(self, text: dict[str, str], where: str) -> Record:
        def values(columns: tuple[str, ...]) -> list[float]:
            seen = [text.get(column, "") for column in columns]
            array = numbers(seen, (len(columns),), f"{where}: {', '.join(columns)}")
            found: list[float] = array.tolist()
            return found

        camera = values(_CAMERA)
        if camera[0] != int(camera[0]) or camera[1] != int(camera[1]):
            raise DataError(f"{where}: the image size is {camera[0]:g} x {camera[1]:g}")
        Camera(int(camera[0]), int(camera[1]), *camera[2:])
        unit = values(("depth_unit",))[0] if text.get("depth_unit") else 0.001
        steps_per_metre(unit, f"{where}: depth_unit, metres of one step", 1.0)
        extents = values(_EXTENTS) if any(text.get(column) for column in _EXTENTS) else None
        mesh, mask = text.get("mesh") or None, text.get("mask") or None
        if extents is None and mesh is None:
            raise DataError(f"{where}: neither extents nor a mesh")
        if mask is None and mesh is None:
            raise DataError(f"{where}: neither a mask nor a mesh to render one from")
        mask_id = text.get("mask_id") or None
        number = whole(mask_id)
        if mask_id is not None and (number is None or number > 255):
            raise DataError(f"{where}: mask_id {mask_id!r}, expected 0 to 255")
        symmetry = text.get("symmetry") or None
        if symmetry is not None:
            parse_symmetry(symmetry)
        return Record(
            rgb=text["rgb"],
            depth=text["depth"],
            camera=camera,
            rotation=quaternion_rotation(values(_QUATERNION), f"{where}: qx, qy, qz, qw")
            .ravel()
            .tolist(),
            translation=values(_TRANSLATION),
            extents=extents,
            mesh=mesh,
            mask=mask,
            mask_id=number,
            depth_per_metre=1 / unit,
            symmetry=symmetry,
        )

    def image_of(self, ref: SampleRef) -> str:
        """The colour image that a sample is in."""
        return Record(*self._details[ref.id]).rgb

    def _symmetry(self, ref: SampleRef, record: Record) -> Symmetry:
        if record.symmetry is None:
            return symmetry_of(ref.category)
        return parse_symmetry(record.symmetry)

    def _read_mesh(self, name: str) -> Mesh:
        mesh = read_mesh(self.root / name)
        low, high = mesh.bounds
        offset, diagonal = np.linalg.norm(low + high) / 2, np.linalg.norm(high - low)
        if offset > 0.01 * diagonal:
            raise DataError(
                f"{self.root / name}: the box's centre is at {(low + high) / 2}, {offset:.3g} m"
                " off the origin; expected a mesh centred on its box, and poses of that centre"
            )
        return mesh
