"""``pytest-cpas worker-check``: what is known of a method in another interpreter, step by step."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pytest_cpas.evaluation import check_answers
from pytest_cpas.registry import RegistryError
from pytest_cpas.remote import RemoteMethod, project_folder
from pytest_cpas.session.resolution import make_method
from pytest_cpas.types import Camera, Observation, Prediction, some_of
from pytest_cpas.types.frames import to_standard

__all__ = ["made_up", "worker_check"]


def worker_check(name: str, here: Path, weights: Path | None, device: str) -> Iterator[str]:
    """Lines about a method, each when it is known; the last ones say what to type next.

    Raises what is wrong: :class:`pytest_cpas.registry.RegistryError`,
    :class:`pytest_cpas.remote.WorkerError`, :class:`pytest_cpas.remote.RaisedThereError`,
    :class:`pytest_cpas.types.ContractError`, :class:`FileNotFoundError` for weights.
    """
    start = time.monotonic()
    method = make_method(name, weights, project_folder(_project(here), here))()
    if not isinstance(method, RemoteMethod):
        raise RegistryError(
            f"method {name!r} is one of this interpreter: pytest --cpas-method={name} runs it; one"
            " of another is named in pyproject.toml or cpas-methods.toml, or"
            " exec:COMMAND#module:Class"
        )
    remote, info = method.remote, method.info
    where = "on this machine" if remote.is_here else "on another machine"
    yield f"{info.name}: {' '.join(map(shlex.quote, remote.spec.command))}"
    yield f"  {remote.interpreter} {where}, {remote.spec.cls} in {time.monotonic() - start:.1f} s"
    parts = ", ".join(["pose", *sorted(info.gives)])
    needs = ", ".join(sorted(info.needs)) or "nothing"
    yield f"  {some_of(info.categories)}; needs {needs}; gives {parts}; licence {info.licence}"
    side = remote.other_side()
    yield f"  {side.packages}"
    if side.unknown:
        yield f"  its sources are not known, so that no row of it is reused: {side.unknown}"
    else:
        yield "  its sources are known, so that its rows are reused while they stay the same"
    start = time.monotonic()
    method.load(weights, device)
    yield f"  loaded on {device} in {time.monotonic() - start:.1f} s"
    seen = made_up(info.categories[0])
    answer = check_answers(method.predict([seen], 0), info)
    yield f"  a made-up {seen.category} 0.7 m away: {_told(answer, method)}"
    own, way = 1000 * method.own_seconds, 1000 * method.transfer_seconds
    yield f"  in {own:.0f} ms, and {way:.0f} ms for the way there and back"
    options = f"--cpas-method={shlex.quote(name)} --cpas-dataset=synthetic-handheld"
    yield f"next:\n  pytest {options} --cpas-limit=24"


def _project(here: Path) -> Path:
    """The nearest folder with a pyproject.toml, as pytest finds it."""
    folders = (here, *here.parents)
    return next((path for path in folders if (path / "pyproject.toml").is_file()), here)


def _told(answer: Prediction, method: RemoteMethod) -> str:
    if not answer.hypotheses:
        return f"no answer, for {answer.reason!r}"
    best = to_standard(answer.hypotheses[0], method.info)
    x, y, z = best.translation
    return f"answered at ({x:.2f}, {y:.2f}, {z:.2f}) m of the camera, z forward"


def made_up(category: str) -> Observation:
    """A ball of 10 cm, 0.7 m away in the middle of the image, before a wall; 640 x 480."""
    camera = Camera(640, 480, 577.5, 577.5, 319.5, 239.5)
    rows, columns = np.mgrid[:480, :640]
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    # where the ray (x, y, 1) meets the ball
    square, middle, radius = x**2 + y**2 + 1, 0.7, 0.05
    inner = middle**2 - square * (middle**2 - radius**2)
    mask = inner > 0
    depth = np.where(mask, (middle - np.sqrt(np.where(mask, inner, 0))) / square, 1.2)
    grey = np.clip(1.3 - depth, 0, 1)[..., None].repeat(3, axis=-1)
    return Observation(
        category=category,
        rgb=grey.astype(np.float32),
        depth=depth.astype(np.float32),
        mask=mask,
        camera=camera,
    )
