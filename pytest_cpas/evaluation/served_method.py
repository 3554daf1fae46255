"""What a script does that serves a method in a process of its own, by lines of JSON.

Such a script can be made to import another revision of the adapter, and of this package with it. So
neither it nor this file, which it loads by its path, imports anything of the package at the top,
and what is needed of it has to be old. The other end is
:class:`pytest_cpas.evaluation.method_process.MethodProcess`.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any


def make(order: dict[str, Any]) -> Any:
    """The loaded method of an order: ``path`` (sys.path), ``module``, ``attribute``, ``inside``
    (where the module has to lie, or None), ``weights``, ``device``."""
    sys.path[:] = order["path"]
    module = importlib.import_module(order["module"])
    inside = order["inside"]
    origin = Path(module.__file__ or "").resolve()
    if inside is not None and not origin.is_relative_to(inside):
        raise ImportError(
            f"{order['module']} was imported from {origin}, not from the revision in {inside}"
        )
    method: Any = module
    for name in order["attribute"].split("."):
        method = getattr(method, name)
    method = method()
    weights = order["weights"]
    method.load(None if weights is None else Path(weights), order["device"])
    return method


def write_observations(path: Path, observations: Sequence[Any]) -> None:
    """Keep observations in a file that any revision can read."""
    import numpy as np

    arrays: dict[str, Any] = {}
    for index, seen in enumerate(observations):
        camera = seen.camera
        arrays[f"{index}.category"] = np.array(seen.category)
        size = (camera.width, camera.height)
        arrays[f"{index}.camera"] = np.array([*size, camera.fx, camera.fy, camera.cx, camera.cy])
        arrays |= {f"{index}.{part}": getattr(seen, part) for part in ("rgb", "depth", "mask")}
    np.savez(path, **arrays)


def read_observations(path: Path) -> list[Any]:
    """What :func:`write_observations` has kept."""
    import numpy as np

    from pytest_cpas.types import Camera, Observation

    observations = []
    with np.load(path) as arrays:
        for index in range(len(arrays) // 5):
            width, height, *intrinsics = arrays[f"{index}.camera"].tolist()
            observations.append(
                Observation(
                    category=str(arrays[f"{index}.category"]),
                    rgb=arrays[f"{index}.rgb"],
                    depth=arrays[f"{index}.depth"],
                    mask=arrays[f"{index}.mask"],
                    camera=Camera(int(width), int(height), *intrinsics),
                )
            )
    return observations


def serve(served: Callable[[Any, dict[str, Any]], object]) -> None:
    """Serve on the standard streams; what the method prints goes to the error stream.

    ``served``: what answers, of the method and its order.
    """
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answers:
        os.dup2(2, 1)
        with contextlib.suppress(KeyboardInterrupt):  # the parent, too, was interrupted
            _serve(served, sys.stdin, answers)


def _serve(
    served: Callable[[Any, dict[str, Any]], object], requests: IO[str], answers: IO[str]
) -> None:
    """One line of JSON per request: first an order, then names of methods with their arguments."""
    answering: object = None
    for line in requests:
        request = json.loads(line)
        try:
            if answering is None:
                answering, value = served(make(request), request), None
            else:
                value = getattr(answering, request["call"])(*request["arguments"])
            answer: dict[str, Any] = {"answer": value}
        except Exception as error:
            answer = {"error": "".join(traceback.format_exception(error))}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()
