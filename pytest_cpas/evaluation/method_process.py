"""A method in a process of its own, which may import another revision of it."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from pytest_cpas.evaluation.revisions import Adapter
from pytest_cpas.types import ToldError

__all__ = ["MethodProcess"]


class MethodProcess:
    """A script in another process that serves a loaded method as
    :mod:`pytest_cpas.evaluation.served_method` does."""

    def __init__(
        self,
        name: str,
        script: str,
        adapter: Adapter,
        *,
        weights: Path | None,
        device: str,
        error: type[ToldError],
        **order: object,
    ) -> None:
        """Start it and load the method.

        ``name`` is for people; ``error``: what is raised, here and later, where the process died or
        the method raised; ``order``: what else the script wants to know.
        """
        self.name, self._error = name, error
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 - see close
        self._process = subprocess.Popen(  # noqa: S603 - this Python, a file of ours
            [sys.executable, "-P", script],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            encoding="utf-8",
        )
        try:
            self._send(
                path=[*map(str, adapter.first), *sys.path],
                module=adapter.module,
                attribute=adapter.attribute,
                inside=None if adapter.tree is None else str(adapter.tree),
                weights=None if weights is None else str(weights),
                device=device,
                **order,
            )
        except BaseException:
            self.close()
            raise

    def ask(self, call: str, *arguments: object) -> Any:
        """What a method of what serves returns."""
        return self._send(call=call, arguments=arguments)

    def close(self) -> None:
        """End the process."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._complaints):
            if stream is not None:
                stream.close()

    def _send(self, **request: object) -> Any:
        requests, answers = self._process.stdin, self._process.stdout
        if requests is None or answers is None:
            raise RuntimeError("the worker was started without pipes")
        try:
            requests.write(json.dumps(request) + "\n")
            requests.flush()
            line = answers.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise self._error(
                f"the worker of {self.name} ended with exit status {self._process.wait()}:"
                f" {self._last_words() or 'it printed nothing'}"
            )
        answer = json.loads(line)
        if "error" in answer:
            raise self._error(f"{self.name} in its worker:\n{answer['error'].rstrip()}")
        return answer["answer"]

    def _last_words(self) -> str:
        self._complaints.seek(0)
        return self._complaints.read().decode(errors="replace").strip()[-2000:]
