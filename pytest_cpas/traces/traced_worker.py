"""A method in a process of its own that traces its predictions; this file is run as a script.

It may be made to import another revision of the adapter, and of this package with it. So this file
imports nothing of the package at the top, and what it needs of it may not be there: a revision
without taps has its answers alone.
"""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any


class Listener:
    """Keeps what it hears of, as (name, kind, stage, value)."""

    wide = False
    replay: dict[tuple[str, int], Any] = {}  # noqa: RUF012 - nothing is, and nobody writes to it

    def __init__(self, copied: Any) -> None:
        self.heard: list[tuple[str, str, str, Any]] = []
        self._copied = copied
        self._stages: list[str] = []

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Enter a stage, and leave it."""
        self._stages.append(name)
        try:
            yield
        finally:
            self._stages.pop()

    def tapped(self, name: str, value: Any) -> None:
        """Keep copies."""
        self._keep(name, value, "tap")

    def drawn(self, name: str, value: Any) -> Any:
        """Keep copies, and hand out the same."""
        self._keep(name, value, "draw")
        return value

    def widened(self, name: str, problem: str) -> None:
        """It is not asked for."""

    def _keep(self, name: str, value: Any, kind: str) -> None:
        stage = self._stages[-1] if self._stages else ""
        self.heard += [(n, kind, stage, part) for n, part in self._copied(name, value)]


def _copied(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The arrays in a value, each with a name, as :func:`pytest_cpas.traces.values.parts_of`."""
    import numpy as np

    if value is None:
        return
    fields = getattr(value, "_fields", None)
    if isinstance(value, dict):
        parts = [(str(key), part) for key, part in value.items()]
    elif isinstance(value, (tuple, list)) and not all(
        isinstance(part, (bool, int, float)) for part in value
    ):
        parts = list(zip(fields or map(str, range(len(value))), value))  # noqa: B905
    else:
        if hasattr(value, "detach"):
            value = value.detach()
            value = value.float() if str(value.dtype) == "torch.bfloat16" else value
            value = value.cpu().numpy()
        yield name, np.array(value)
        return
    for part_name, part in parts:
        yield from _copied(f"{name}.{part_name}", part)


class Tracer:
    """A loaded method whose predictions are traced; ``read``: reads a file of observations."""

    def __init__(self, method: Any, read: Callable[[Path], list[Any]]) -> None:
        self._method, self._read = method, read

    def trace(self, observation: str, seed: int, target: str) -> dict[str, Any]:
        """Write the arrays of a prediction for the observation in a file into another; what they
        are."""
        import numpy as np

        [seen] = self._read(Path(observation))
        listener = Listener(_copied)
        with contextlib.ExitStack() as stack:
            try:
                stages = importlib.import_module("pytest_cpas.stages")
                stack.enter_context(stages.hearing(listener))
                stack.enter_context(stages.listening(listener))
            except (ImportError, AttributeError):
                pass  # older than taps
            [prediction] = self._method.predict([seen], seed)
        heard = list(listener.heard)
        for index, hypothesis in enumerate(prediction.hypotheses):
            for name in ("rotation", "translation", "extents", "points", "score"):
                part = getattr(hypothesis, name)
                if part is not None:
                    heard.append((f"{index}.{name}", "answer", "", np.array(part)))
            if hypothesis.mesh is not None:
                for name in ("vertices", "triangles"):
                    part = np.array(getattr(hypothesis.mesh, name))
                    heard.append((f"{index}.{name}", "answer", "", part))
        np.savez(target, **{f"{index:06d}": part for index, (*_, part) in enumerate(heard)})
        info = self._method.info
        return {
            "values": [[name, kind, stage] for name, kind, stage, _ in heard],
            "reason": prediction.reason if not prediction.hypotheses else None,
            "frames": [info.camera_frame, info.object_frame],
        }


def main() -> None:
    """Serve a method's traces."""
    file = Path(__file__).parents[1] / "evaluation" / "served_method.py"
    spec = importlib.util.spec_from_file_location(file.stem, file)
    served: Any = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    spec.loader.exec_module(served)  # type: ignore[union-attr]
    served.serve(lambda method, order: Tracer(method, served.read_observations))


if __name__ == "__main__":
    main()
