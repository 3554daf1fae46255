"""Symmetries in words, and those that are found on meshes."""

import numpy as np
import pytest

from pytest_cpas.datasets import _rings, _scenes, shapes
from pytest_cpas.datasets._symmetries import TOLERANCE, find_symmetry, mismatch, parse_symmetry
from pytest_cpas.types import ContractError, Mesh


def box(*sides: float) -> Mesh:
    return _scenes.box(np.array(sides))


def lathe(profile: list[list[float]], sides: int) -> Mesh:
    """A solid about y that has so many sides, a corner of them at -z."""
    return _rings.solid(_rings.revolve(np.array(profile), sides))


def lying(mesh: Mesh, *order: int) -> Mesh:
    """The same with its axes exchanged, in a cycle."""
    return Mesh(mesh.vertices[:, order], mesh.triangles)


STRAIGHT, TAPERED = [[0.04, 0.0], [0.04, 0.1]], [[0.04, 0.0], [0.02, 0.1]]
BALL = [[0.05 * np.cos(a), 0.05 * np.sin(a)] for a in np.deg2rad(np.linspace(-88, 88, 40))]

SHAPES = {
    "cylinder": (lathe(STRAIGHT, 48), "y + x/2"),
    "cylinder along x": (lying(lathe(STRAIGHT, 48), 1, 2, 0), "y/2 + x"),
    "cone": (lathe(TAPERED, 48), "y"),
    "cone along z": (lying(lathe(TAPERED, 48), 2, 0, 1), "z"),
    "ball": (lathe(BALL, 48), "sphere"),
    "box": (box(0.1, 0.2, 0.3), "box"),
    "square box": (box(0.1, 0.2, 0.1), "y/4 + x/2"),
    "cube": (box(0.1, 0.1, 0.1), "y/4 + x/4"),
    "hexagon": (lathe(STRAIGHT, 6), "y/6 + x/2"),
    "pyramid of 8": (lathe(TAPERED, 8), "y/8"),
    # the centre of its box is not on the axis of its turns
    "triangle": (lathe(STRAIGHT, 3), "z/2"),
    "mug": (shapes.mean_shape("mug"), "none"),
    "laptop": (shapes.mean_shape("laptop"), "none"),
    "bowl": (shapes.mean_shape("bowl"), "y"),
}


@pytest.mark.parametrize("name", SHAPES)
def test_symmetry_is_found(name: str) -> None:
    mesh, expected = SHAPES[name]
    found = find_symmetry(mesh)
    assert found.text == expected
    assert found.off <= TOLERANCE
    assert (found.next_best is None) == (name == "ball")
    if found.next_best is not None:
        assert found.next_best[1] > TOLERANCE


def test_how_far_a_surface_is_off_itself() -> None:
    # a box of 0.1 x 0.2 x 0.3 turned by 90 deg about z: its corner (0.1, 0.05, 0.15) is 0.05 out
    mesh = box(0.1, 0.2, 0.3)
    assert mismatch(mesh, "z/4") == pytest.approx(0.05 / np.sqrt(0.14), rel=1e-5)
    assert mismatch(mesh, "box") < 1e-5
    # a mug's handle has no counterpart behind it
    assert mismatch(shapes.mean_shape("mug"), "y") > 0.1


def test_a_dent_is_no_symmetry() -> None:
    """One corner of 8 that is cut off leaves one turn of none."""
    mesh = box(0.1, 0.2, 0.3)
    vertices = mesh.vertices.copy()
    vertices[0] *= 0.85
    assert find_symmetry(Mesh(vertices, mesh.triangles)).text == "none"


def test_a_thin_spike_is_no_symmetry() -> None:
    """Of a surface that is sampled, none of the points need be on it."""
    body, spike = box(0.1, 0.2, 0.3), box(0.0002, 0.0002, 0.04)
    mesh = Mesh(
        np.concatenate([body.vertices, spike.vertices + np.array([0.04, 0.02, 0.17])]),
        np.concatenate([body.triangles, spike.triangles + len(body.vertices)]),
    )
    assert find_symmetry(mesh).text == "none"


@pytest.mark.parametrize(
    ("text", "elements", "axis"),
    [
        ("y + x/2", 2, [0, 1, 0]),
        ("x/2+y", 2, [0, 1, 0]),
        ("y + x/2 + z/2", 2, [0, 1, 0]),
        ("y + y/4", 1, [0, 1, 0]),
        ("y/4 + x/2", 8, None),
        ("y/2 + x/2", 4, None),
        ("y/4 + x/4", 24, None),
        ("y/6 + x/2", 12, None),
    ],
)
def test_words_that_are_joined(text: str, elements: int, axis: list[float] | None) -> None:
    symmetry = parse_symmetry(text)
    assert (len(symmetry.rotations), symmetry.sphere) == (elements, False)
    assert (None if symmetry.axis is None else symmetry.axis.tolist()) == axis


@pytest.mark.parametrize("text", ["x + y", "y + x/4", "z + y/3 + x/2"])
def test_an_axis_that_is_turned_away_makes_a_sphere(text: str) -> None:
    assert parse_symmetry(text).sphere


@pytest.mark.parametrize("text", ["y +", "+ y", "y + none", "box + y", "y/0 + x/2", "y x/2"])
def test_words_that_mean_nothing(text: str) -> None:
    with pytest.raises(ContractError, match="several of these joined by"):
        parse_symmetry(text)


def test_a_group_without_end_is_refused() -> None:
    with pytest.raises(ContractError, match="more than 720 rotations"):
        parse_symmetry("y/7 + x/5")
