"""Workers for tests, of which none is to stay."""

import os
import secrets
import sys
import time
from pathlib import Path

from pytest_cpas.remote import Spec

HERE = Path(__file__).parent

#: The variable by which all processes of a worker are found, whoever their parent is.
MARK = "CPAS_TEST_WORKER"


def spec(cls: str = "planted_methods:Good", **changes: object) -> Spec:
    """A worker of this interpreter, without what a site brings beside numpy."""
    values = {
        "command": (sys.executable,),
        "cls": cls,
        "path": (str(HERE),),
        "seconds_to_start": 20.0,
        "seconds_to_load": 20.0,
        **changes,
    }
    mark = {MARK: secrets.token_hex(8), "OPENBLAS_NUM_THREADS": "1"}
    return Spec(**{**values, "env": {**mark, **values.get("env", {})}})


def left_of(asked: Spec) -> list[str]:
    """The processes that a worker has left, as their commands; after a moment to end."""
    wanted = f"{MARK}={asked.env[MARK]}".encode()
    for _ in range(100):
        found = [told for pid in os.listdir("/proc") if (told := _told(pid, wanted))]
        if not found:
            break
        time.sleep(0.02)
    return found


def _told(pid: str, wanted: bytes) -> str:
    try:
        if wanted not in Path("/proc", pid, "environ").read_bytes().split(b"\0"):
            return ""
        state = Path("/proc", pid, "stat").read_text().rpartition(")")[2].split()[0]
        command = Path("/proc", pid, "cmdline").read_bytes().replace(b"\0", b" ")
    except OSError:
        return ""
    return "" if state == "Z" else f"{pid} {command[:100]!r}"
