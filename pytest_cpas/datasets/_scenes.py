"""What stands where in the rendered data sets: objects, scenery and cameras.

A scene composes frames: lists of items posed in the camera frame, all of them drawn from the
generator that is passed in. World and object frames have y up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_cpas.datasets import shapes
from pytest_cpas.datasets.rendering import Cast, camera_rays, render
from pytest_cpas.types import CATEGORIES, Array, Camera, Mesh, Pose

#: Class ids of items beside 1..6, the categories: in the data set's masks, but nobody's task.
DISTRACTOR, SCENERY = 0, -1

_SKIN = np.array([[0.80, 0.60, 0.48], [0.76, 0.56, 0.45]])

INSTANCES = 3  # of each category in an embedded split

#: Diagonal from which on an object is held farther away, metres: laptops have more, and nothing
#: else of the embedded shapes.
_LARGE = 0.33


@dataclass(frozen=True, eq=False)
class Item:
    """A mesh in the camera frame; ``colours`` (2, 3) in 0..1 of its ``pattern``."""

    mesh: Mesh
    pose: Pose
    colours: Array
    pattern: str
    class_id: int = SCENERY
    model: str = ""


@dataclass(frozen=True, eq=False)
class Model:
    """An object that scenes show: its mesh, what files call it, and what its colours follow."""

    mesh: Mesh
    name: str
    class_id: int
    pattern: str


class Stock(Protocol):
    """Where scenes get their objects from; scenes are numbered from 1."""

    def on_table(self, number: int) -> list[Model]:
        """The objects of a tabletop scene."""

    def in_hand(self, number: int) -> Model:
        """The object of a handheld scene."""


class Shapes:
    """The embedded stock: instances of the six categories, of which the splits share none."""

    def __init__(self, seed: int, split: int) -> None:
        self._key = (seed, split)

    def on_table(self, number: int) -> list[Model]:
        """One of each category but one."""
        absent = number % len(CATEGORIES)
        return [
            self._model(index, (number + index) % INSTANCES)
            for index in range(len(CATEGORIES))
            if index != absent
        ]

    def in_hand(self, number: int) -> Model:
        """The categories in turn."""
        number -= 1
        return self._model(number % len(CATEGORIES), number // len(CATEGORIES) % INSTANCES)

    def _model(self, index: int, instance: int) -> Model:
        seed, split = self._key
        category = CATEGORIES[index]
        mesh = shapes.make(category, np.random.default_rng([seed, split, 0, index, instance]))
        return Model(mesh, f"{category}_{instance}", index + 1, category)


class TabletopScene:
    """Upright objects on a table in a room, seen from above, as in REAL275."""

    #: How far the camera is from what it looks at, metres.
    distances = (0.5, 1.3)

    def __init__(self, stock: Stock, seed: int, split: int, number: int, camera: Camera) -> None:
        rng = np.random.default_rng([seed, split, 1, number])
        self._placed: list[tuple[Array, float]] = []
        self._things: list[tuple[Model, Array, Array]] = []
        models: list[Model | None] = [*stock.on_table(number)]
        #: How many objects a frame shows well.
        self.wanted = max(1, len(models) - 1)
        if number % 3 == 0:
            models.append(None)
        for index in rng.permutation(len(models)).tolist():
            model = models[index]
            if model is None:
                model = Model(box(rng.uniform(0.06, 0.14, 3)), "box_0", DISTRACTOR, "box")
            half = model.mesh.bounds[1]
            radius = float(np.sqrt(half[0] ** 2 + half[2] ** 2))
            position = free_place(self._placed, radius, rng)
            self._placed.append((position, radius))
            position = np.array([position[0], half[1], position[1]])
            turn = about_y(rng.uniform(0, 2 * np.pi))
            self._things.append((model, turn, position))
        self._colours = rng.uniform(0.1, 0.95, (len(self._things) + 3, 2, 3))
        self._colours[-3:] = rng.uniform(0.35, 0.75, (3, 1, 1)) + rng.uniform(-0.1, 0.1, (3, 2, 3))

    def compose(self, rng: np.random.Generator) -> list[Item]:
        """The same objects from another side."""
        rotation, translation = _look_at(
            target=self._things[rng.integers(len(self._things))][2] + rng.normal(0, 0.03, 3),
            azimuth=rng.uniform(0, 2 * np.pi),
            elevation=np.deg2rad(rng.uniform(15, 60)),
            distance=rng.uniform(*self.distances),
            roll=np.deg2rad(rng.normal(0, 3)),
        )

        def item(
            mesh: Mesh, turn: Array, at: Array, colours: Array, pattern: str, *what: int | str
        ) -> Item:
            pose = rounded_pose(rotation @ turn, rotation @ at + translation)
            return Item(mesh, pose, colours, pattern, *what)  # type: ignore[arg-type]

        scenery = [
            item(mesh, np.eye(3), np.array(at), colours, "planks")
            for (mesh, at), colours in zip(_ROOM, self._colours[-3:], strict=True)
        ]
        return scenery + [
            item(model.mesh, turn, at, colours, model.pattern, model.class_id, model.name)
            for (model, turn, at), colours in zip(self._things, self._colours, strict=False)
        ]


class HandheldScene:
    """One object, freely turned in a hand in front of a person, as in REDWOOD75."""

    wanted = 1  # object that a frame shows well
    cast: Cast | None = None  # what feels where the fingers touch

    def __init__(self, stock: Stock, seed: int, split: int, number: int, camera: Camera) -> None:
        rng = np.random.default_rng([seed, split, 1, number])
        self._camera = camera
        # enough to feel where the fingers touch: a ray for every 4 x 4 pixels
        self._coarse = Camera(
            camera.width // 4,
            camera.height // 4,
            camera.fx / 4,
            camera.fy / 4,
            (camera.cx - 1.5) / 4,
            (camera.cy - 1.5) / 4,
        )
        self._model = stock.in_hand(number)
        self._colours = rng.uniform(0.1, 0.95, (2, 3))
        self._clothes = rng.uniform(0.1, 0.7, (1, 3)) * np.array([[1.0], [0.8]])
        self._wall = rng.uniform(0.4, 0.8, (1, 3)) * np.array([[1.0], [0.93]])

    def compose(self, rng: np.random.Generator) -> list[Item]:
        """The object in another pose and grip."""
        model = self._model
        low, high = model.mesh.bounds
        # nearer than that what is as large as a laptop fills the image
        nearest = 0.6 if np.sqrt(np.sum((high - low) ** 2)) > _LARGE else 0.4
        width, height = self._camera.width, self._camera.height
        column = int(width * rng.uniform(0.3, 0.7))
        row = int(height * rng.uniform(0.3, 0.6))
        centre = camera_rays(self._camera)[row, column] * rng.uniform(nearest, 1.0)
        held = Item(
            model.mesh,
            rounded_pose(_random_rotation(rng), centre),
            self._colours,
            model.pattern,
            model.class_id,
            model.name,
        )
        behind = float(centre[2]) + rng.uniform(0.35, 0.6)
        person = centre[0] + rng.uniform(-0.2, 0.2)
        neck = rng.uniform(-0.15, 0.1)

        def at(right: float, down: float) -> Array:
            return np.array([person + right, neck + down, behind])

        shoulders = (at(-0.12, 0.2), at(0.12, 0.2), 0.11)
        trunk = (at(0.0, 0.25), at(0.0, 0.9), 0.17)
        head = (at(0.0, -0.1), at(0.0, -0.02), 0.085)
        yaw = about_y(np.deg2rad(rng.uniform(-25, 25)))
        wall = rounded_pose(yaw, np.array([0.0, 0.0, behind + rng.uniform(0.5, 0.9)]))
        return [
            Item(box(np.array([8.0, 6.0, 0.05])), wall, self._wall, "planks"),
            _rods([shoulders, trunk], self._clothes),
            _rods([head, *self._hand(held, rng)], _SKIN),
            held,
        ]

    def _hand(self, held: Item, rng: np.random.Generator) -> list[tuple[Array, Array, float]]:
        """Forearm, palm and the fingers that close over the side that the camera sees."""
        seen = render([(held.mesh, held.pose)], self._coarse, self.cast)
        points = self._coarse.back_project(seen.depth, seen.instance == 0)
        if not len(points):
            return []  # too thin to be felt
        centre = held.pose.translation
        near = -centre / np.sqrt(np.sum(centre**2))
        angle = np.deg2rad(rng.uniform(20, 160))  # the arm comes from the lower half
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        out -= np.sum(out * near) * near
        out /= np.sqrt(np.sum(out**2))
        axes = np.stack([out, np.cross(near, out), near])  # outwards, across, to the camera
        local = (points - centre) @ axes.T

        def place(a: float, b: float, c: float) -> Array:
            at: Array = centre + np.array([a, b, c]) @ axes
            return at

        side = float(np.quantile(local[:, 1], rng.uniform(0.35, 0.65)))
        if np.abs(local[:, 1] - side).min() >= 0.04:  # between two parts
            side = float(local[np.argmin(np.abs(local[:, 1] - side)), 1])
        palm = local[np.abs(local[:, 1] - side) < 0.04]
        edge, depth = float(palm[:, 0].max()), float(np.median(palm[:, 2]))
        reach = min(0.06, rng.uniform(0.35, 0.65) * (edge - float(palm[:, 0].min())))
        rods = [
            (
                place(edge + 0.03, side - 0.03, depth),
                place(edge + 0.03, side + 0.03, depth),
                0.024,
            ),
            (place(edge + 0.06, side, depth), place(edge + 0.9, side, depth - 0.1), 0.03),
        ]
        fingers = rng.choice([1, 4])  # the thumb in front, or the four fingers
        radius = 0.011 if fingers == 1 else 0.0085
        for k in range(fingers):
            b = side + (k - (fingers - 1) / 2) * 0.02
            under = palm[(np.abs(palm[:, 1] - b) < 0.012) & (palm[:, 0] > edge - reach - radius)]
            if len(under) == 0:
                continue  # the finger would touch nothing
            above = float(under[:, 2].max()) + radius + 0.001
            knuckle = place(edge + 0.014, b, above - 0.004)
            rods.append((place(edge + 0.03, b, depth), knuckle, radius))
            rods.append((knuckle, place(edge - reach, b, above), radius))
        return rods


def free_place(placed: list[tuple[Array, float]], radius: float, rng: np.random.Generator) -> Array:
    """A place (x, z) on the table that keeps 1 cm from all others."""
    for attempt in range(10_000):
        spread = 0.1 + 0.0003 * attempt  # a crowded table is used further out
        place: Array = np.round(rng.uniform(-spread, spread, 2) * np.array([1.4, 1.0]), 4)
        if all(np.sum((place - p) ** 2) > (radius + r + 0.01) ** 2 for p, r in placed):
            return place
    raise AssertionError("no free place on a table that grows with every attempt")


def _look_at(
    target: Array, azimuth: float, elevation: float, distance: float, roll: float
) -> tuple[Array, Array]:
    """World-to-camera rotation and translation of a camera that looks at ``target``."""
    direction = np.array(
        [
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
            np.cos(elevation) * np.cos(azimuth),
        ]
    )
    forward = -direction
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.sqrt(np.sum(right**2))
    axes = np.stack([right, np.cross(forward, right), forward])
    rotation: Array = Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix() @ axes
    return rotation, -rotation @ (target + distance * direction)


def _random_rotation(rng: np.random.Generator) -> Array:
    """Uniform over SO(3): a normalised Gaussian quaternion."""
    rotation: Array = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return rotation


def about_y(angle: float) -> Array:
    rotation: Array = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
    return rotation


def rounded_pose(rotation: Array, translation: Array) -> Pose:
    """A pose rounded to what no processor's sines and matrix products change."""
    return Pose(np.round(rotation, 9), np.round(translation, 9))


def box(extents: Array) -> Mesh:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    return Mesh(np.round(corners * extents / 2, 7), np.array(triangles))


def _rods(rods: list[tuple[Array, Array, float]], colours: Array) -> Item:
    """Rods with round ends, each between two points of the camera frame, with a radius."""
    vertices, triangles = [], []
    count = 0
    for start, end, radius in rods:
        along = end - start
        length = np.sqrt(np.sum(along**2))
        y = along / length
        x = np.cross(y, np.eye(3)[np.argmin(np.abs(y))])
        x /= np.sqrt(np.sum(x**2))
        bend = np.deg2rad(np.linspace(4, 90, 6))
        ball = radius * np.stack([np.sin(bend), -np.cos(bend)], axis=1)
        mesh = shapes.solid_of_revolution(
            np.concatenate([ball, ball[::-1] * [1, -1] + [0, length]])
        )
        axes = np.stack([x, y, np.cross(x, y)])
        vertices.append(np.round(mesh.vertices @ axes + (start + end) / 2, 7))
        triangles.append(mesh.triangles + count)
        count += len(mesh.vertices)
    body = Mesh(np.concatenate(vertices), np.concatenate(triangles))
    return Item(body, Pose(np.eye(3), np.zeros(3)), colours, "planks")


#: Table top, floor and walls: mesh and centre in the world, whose y = 0 is the table's surface.
_ROOM = (
    (box(np.array([1.6, 0.04, 1.2])), (0.0, -0.02, 0.0)),
    (box(np.array([4.0, 0.04, 3.6])), (0.0, -0.45, 0.0)),
    (box(np.array([4.0, 3.0, 3.6])), (0.0, 1.0, 0.0)),
)
