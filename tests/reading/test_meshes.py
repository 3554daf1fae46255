"""Meshes as files: what is there is read, whichever way it is written, or the file is refused."""

import re
import struct
import time

import numpy as np
import pytest

from pytest_cpas.reading import mesh_binary, mesh_rows
from pytest_cpas.reading.mesh_rows import MOST_ELEMENTS, Rows
from pytest_cpas.reading.meshes import read_mesh
from pytest_cpas.types import DataError

#: A cube's corners; of its six sides two are triangles, and one vertex is not used.
PLACES = [(x, y, z) for x in (0, 1) for y in (0, 2) for z in (0, 4)] + [(9, 9, 9)]
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6), (6, 4, 0), (1, 5, 7, 3)]
TRIANGLES = [
    (face[0], *face[k : k + 2]) for face in FACES for k in range(1, len(face) - 1)
]  # fmt: skip


def rows(values, head=""):
    return "".join(f"{head}{' '.join(map(str, row))}\n" for row in values)


def obj(corner="{}", more=()):
    faces = [[corner.format(i + 1) for i in face] for face in FACES]
    return rows([(*place, *more) for place in PLACES], "v ") + "vt 0 0\n" + rows(faces, "f ")


def off(kind="OFF", more=(), colour=()):
    head = f"{kind}\n{len(PLACES)} {len(FACES)} 0\n"
    faces = rows([(len(face), *face, *colour) for face in FACES])
    return head + rows([(*place, *more) for place in PLACES]) + faces


def ply_head(form, faces, length="uchar", name="vertex_indices"):
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    return (
        f"ply\nformat {form} 1.0\ncomment made here\nelement vertex {len(PLACES)}\n{axes}property"
        f" uchar red\nelement edge 0\nproperty int a\nelement face {len(faces)}\nproperty float"
        f" quality\nproperty list {length} int {name}\nend_header\n"
    )


def ply(name="vertex_index"):
    faces = rows([(0.5, len(face), *face) for face in FACES])
    return ply_head("ascii", FACES, name=name) + rows([(*p, 7) for p in PLACES]) + faces


def binary_ply(order, faces=FACES, length="uchar"):
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    made = ply_head(form, faces, length).encode()
    made += b"".join(struct.pack(f"{order}3dB", *place, 7) for place in PLACES)
    code = {"uchar": "B", "uint": "I"}[length]
    for face in faces:
        made += struct.pack(f"{order}f{code}{len(face)}i", 0.5, len(face), *face)
    return made


def corners_of(triangles=TRIANGLES):
    return np.array(PLACES, float)[np.array(triangles)]


def stl():
    facets = "".join(
        "facet normal 0 0 1\n outer loop\n" + rows(c, "  vertex ") + " endloop\nendfacet\n"
        for c in corners_of().tolist()
    )
    return f"solid a b\n{facets}endsolid a b\n"


def binary_stl():
    made = b"solid".ljust(80) + struct.pack("<I", len(TRIANGLES))
    for corners in corners_of().reshape(-1, 9).tolist():
        made += struct.pack("<12fH", 0, 0, 1, *corners, 0)
    return made


TEXTS = {
    "obj": obj(),
    "obj texture.obj": obj("{0}/{0}"),
    "obj normals.obj": obj("{0}//{0}"),
    "obj both.obj": obj("{0}/1/{0}", (0.5, 0.5, 1)),
    "obj weight.obj": obj(more=(1,)),
    "off": off(),
    "coff.off": off("COFF", (9, 9, 9, 9)),
    "cnoff.off": off("CNOFF", (0, 0, 1, 9, 9, 9), (9, 9, 9)),
    "one line.off": off().replace("OFF\n", "OFF "),
    "ply": ply(),
    "other name.ply": ply("vertex_indices"),
    "stl": stl(),
}
BYTES = {
    "little.ply": binary_ply("<"),
    "big.ply": binary_ply(">", length="uint"),
    "equal.ply": binary_ply("<", TRIANGLES),
    "binary.stl": binary_stl(),
}
SOUND = {name: text.encode() for name, text in TEXTS.items()} | BYTES


def read(tmp_path, name, content):
    path = tmp_path / f"x.{name.rpartition('.')[2]}"
    path.write_bytes(content)
    mesh = read_mesh(path)
    return mesh.vertices[mesh.triangles]


def is_refused(tmp_path, name, content):
    with pytest.raises(DataError, match=r"^[^\n]*x\.\w+: not a readable mesh: [^\n]+$"):
        read(tmp_path, name, content)
    return True


@pytest.mark.parametrize("name", SOUND)
def test_sound_meshes(name, tmp_path):
    np.testing.assert_array_equal(read(tmp_path, name, SOUND[name]), corners_of())


@pytest.mark.parametrize("name", [name for name in TEXTS if not name.endswith("ply")])
def test_comments_white_space_and_marks_change_nothing(name, tmp_path):
    text = TEXTS[name]
    first, _, rest = text.partition("\n")
    for same in (
        text.replace("\n", "\r\n"),
        text.replace("\n", " # 1 2 3\n# 4 5 6\n\n"),
        text.replace(" ", " \t ").rstrip(),
        "\ufeff" + text if not name.endswith("stl") else text,
        f"{first}\n \n{rest}",
    ):
        np.testing.assert_array_equal(read(tmp_path, name, same.encode()), corners_of())


@pytest.mark.parametrize("name", TEXTS)
def test_rows_of_another_length_are_refused(name, tmp_path):
    """Each number in turn left out, there twice, or no number."""
    if "obj" in name:
        pattern = r"(?m)(?<=^[vf] ).*"
    elif name == "stl":
        pattern = r"(?m)(?<=vertex ).*"
    else:
        pattern = r"(?m)^[\d. ]+$"
    text = TEXTS[name]
    for match in list(re.finditer(pattern, text))[::3]:
        words = match[0].split()
        for index in {0, len(words) - 1}:
            for other in ([], ["1_0"], ["0x1"], ["\u0663"], ["1d0"]):
                made = " ".join(words[:index] + other + words[index + 1 :])
                # a polygon with a corner less, a colour that is not transparent
                corner = len(words) in (4, 6, 7) if "obj" in name else words[-1] in ("0", "9")
                if not other and "stl" not in name and "ply" not in name and corner:
                    continue
                damaged = text[: match.start()] + made + text[match.end() :]
                assert is_refused(tmp_path, name, damaged.encode()), (match[0], made)


@pytest.mark.parametrize("name", [n for n in SOUND if not n.endswith("obj")])
def test_counts_that_do_not_match_are_refused(name, tmp_path):
    content = SOUND[name]
    if name in BYTES:
        damaged = [content[:cut] for cut in range(1, len(content), 7)] + [content + b"\0"]
    else:
        lines = content.splitlines(keepends=True)
        free = (b"comment", b"edge", b"int a")  # of which nothing hangs
        kept = [i for i, line in enumerate(lines) if not any(word in line for word in free)]
        damaged = [b"".join(lines[:i] + lines[i + 1 :]) for i in kept]
        damaged += [b"".join(lines[: i + 1] + lines[i:]) for i in kept]
    for each in damaged:
        assert is_refused(tmp_path, name, each), each


WRONG = {
    "statement.obj": (b"V 1 1 1\n" + SOUND["obj"], "line 1 begins with 'V', which is no statement"),
    "curved.obj": (SOUND["obj"] + b"surf 0 1 0 1 1 2 3\n", "begins with 'surf'"),
    "weight.obj": (obj(more=(2,)).encode(), "the weight 2, expected none or 1"),
    "two corners.obj": (SOUND["obj"] + b"f 1 2\n", "a face has 2 corners, expected at least 3"),
    "long.obj": (SOUND["obj"] + b"f" + b" 1" * 2**20, "has 2097153 bytes, at most 1048576"),
    "beyond.off": (SOUND["off"].replace(b"3 0 2 6", b"3 0 2 9"), "vertex 9, but there are 9, the"),
    "below.off": (SOUND["off"].replace(b"3 0 2 6", b"3 0 2 -1"), "vertex -1, but there are 9, the"),
    "4off.off": (b"4" + SOUND["off"], "begins with '4OFF', expected OFF, COFF"),
    "twice.ply": (
        SOUND["ply"].replace(b"uchar red", b"uchar z"),
        "gives a name twice",
    ),
    "vertices.ply": (
        SOUND["ply"].replace(b"element vertex 9", b"element vertex 900000000"),
        f"announces 900000000 elements 'vertex' in .* at most {MOST_ELEMENTS} are read",
    ),
    "no z.ply": (SOUND["ply"].replace(b"double z", b"double w"), "no x, y and z"),
    "list.ply": (
        binary_ply("<", length="uint").replace(struct.pack("<I", 4), b"\xff" * 4, 1),
        "a list has 4294967295 numbers, expected 0 to 65536",
    ),
    "header.ply": (
        SOUND["ply"].replace(b"comment", b"comment " + b"x" * 70_000),
        "no end_header in its first 65536 bytes",
    ),
    "floats.ply": (
        SOUND["ply"].replace(b"uchar int vertex", b"uchar float vertex"),
        "vertex_index of a face is a list of floats, expected whole numbers",
    ),
    "floats in bytes.ply": (
        binary_ply("<").replace(b"uchar int vertex", b"uchar float vertex"),
        "is a list of floats, expected whole numbers",
    ),
    "corner.ply": (
        SOUND["ply"].replace(b"list uchar int vertex", b"int vertex"),
        "vertex_index of a face is one number, expected a list",
    ),
    "list of x.ply": (
        SOUND["ply"].replace(b"property double x", b"property list uchar double x"),
        "x of a vertex is a list, expected one number",
    ),
    "line.ply": (SOUND["ply"].replace(b"element face", b"Element face"), "line 'Element face 7'"),
    "count.stl": (
        binary_stl()[:80] + b"\xff" * 4 + binary_stl()[84:],
        "announces 4294967295 triangles",
    ),
    "order.stl": (SOUND["stl"].replace(b"outer loop", b"endloop", 1), "'endloop', expected outer"),
    "empty.ply": (
        (ply_head("ascii", []) + rows([(*p, 7) for p in PLACES])).encode(),
        "it has no triangles",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_wrong_meshes(name, tmp_path):
    content, words = WRONG[name]
    with pytest.raises(DataError, match=rf"x\.\w+: not a readable mesh: .*{words}"):
        read(tmp_path, name, content)


def test_too_many_rows_and_numbers(monkeypatch):
    few = Rows("a vertex", (3,), most=2)
    few.add(1, b"1 2 3")
    few.add(2, b"1 2 3")
    with pytest.raises(DataError, match="more than 2 rows of a vertex, the most read"):
        few.add(3, b"1 2 3")
    monkeypatch.setattr(mesh_rows, "MOST_NUMBERS", 5)
    with pytest.raises(DataError, match="have more than 5 numbers, the most read"):
        few.values()


def test_polygons_of_too_many_triangles(monkeypatch, tmp_path):
    monkeypatch.setattr(mesh_rows, "MOST_ELEMENTS", 11)
    with pytest.raises(DataError, match="it has 12 triangles, at most 11 are read"):
        read(tmp_path, "obj", SOUND["obj"])
    monkeypatch.setattr(mesh_binary, "MOST_ELEMENTS", 11)
    with pytest.raises(DataError, match="it has 12 triangles, at most 11 are read"):
        read(tmp_path, "stl", binary_stl())


def test_faces_with_a_material_each_take_no_longer(tmp_path):
    faces = b"".join(b"usemtl m%d\nf 1 2 3\n" % i for i in range(20_000))
    start = time.process_time()
    assert len(read(tmp_path, "obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + faces)) == 20_000
    assert time.process_time() - start < 1
