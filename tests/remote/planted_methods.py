"""Methods with a fault each, for Python 3.6 and newer: what a worker may be made to run.

The fault is in the second sample of tests/tiny.py, whose first pixel tells it.
"""

# ruff: noqa: NPY002, RUF012, SIM105 - as such methods are written
import importlib
import json
import os
import re
import signal
import struct
import subprocess
import sys
import threading
import time
import traceback

import numpy as np


class Good:
    info = {
        "name": "good",
        "categories": ["bowl", "mug"],
        "needs": ["rgb"],
        "gives": ["extents", "shape"],
        "licence": "MIT",
    }
    calls = 0

    def load(self, assets, device):
        pass

    def predict(self, batch, seed):
        return [self.answer(round(float(seen["rgb"][0, 0, 0]) * 255)) for seen in batch]

    def answer(self, index):
        if index == 1:
            type(self).calls += 1
            fault = self.fault()
            if fault is not None:
                return fault
        return self.right()

    def fault(self):
        return None

    def right(self):
        points = np.random.RandomState(0).uniform(-0.05, 0.05, (50, 3))
        return {
            "rotation": np.eye(3),
            "translation": [0, 0, 0.8],
            "extents": [0.1, 0.08, 0.12],
            "points": points,
        }


class NoInfo:
    pass


class LoadRaises(Good):
    def load(self, assets, device):
        raise ValueError("w.pt is truncated")


class LoadDies(Good):
    def load(self, assets, device):
        os.kill(os.getpid(), signal.SIGKILL)


class LoadSleeps(Good):
    def load(self, assets, device):
        time.sleep(60)


class Raises(Good):
    def fault(self):
        raise RuntimeError("the network exploded")


class Exits(Good):
    def fault(self):
        sys.exit(5)


class Interrupts(Good):
    def fault(self):
        raise KeyboardInterrupt


class Dies(Good):
    def fault(self):
        os._exit(9)


class Crashes(Good):
    def fault(self):
        sys.stderr.write("CUDA error: an illegal memory access\n")
        sys.stderr.flush()
        os.kill(os.getpid(), signal.SIGSEGV)
        time.sleep(60)


class DiesAlways(Good):
    def answer(self, index):
        os._exit(9)


class Sleeps(Good):
    def fault(self):
        if "ASLEEP" in os.environ:
            open(os.environ["ASLEEP"], "w").close()
        time.sleep(60)


class HoldsTheLock(Good):
    def fault(self):
        re.match("(a+)+$", "a" * 64 + "b")


class IgnoresSignals(Good):
    def fault(self):
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        while True:
            time.sleep(1)


class Prints(Good):
    def fault(self):
        print("on the standard output")
        os.system("echo from a program")


class Floods(Good):
    def fault(self):
        for stream in (sys.stdout, sys.stderr):
            for _ in range(200):
                stream.write("x" * 10000 + "\n")


class WritesEverywhere(Good):
    def fault(self):
        for number in range(1, 30):
            try:
                os.write(number, b"noise")
            except OSError:
                pass


class ClosesEverything(Good):
    def fault(self):
        os.closerange(0, 2**16)


class ClosesAll(Good):
    """That a program of few files has open."""

    def fault(self):
        os.closerange(0, 256)


class ClosesOutput(Good):
    def fault(self):
        sys.stdout.close()


class PutsOutputAway(Good):
    def fault(self):
        sys.stdout = sys.stderr = None


class ClosesStreams(Good):
    def fault(self):
        os.close(1)
        os.close(2)


class LooksAtStreams(ClosesStreams):
    """Whose numbers are those of no other file afterwards."""

    def answer(self, index):
        os.fstat(1)
        os.fstat(2)
        return super().answer(index)


class Patches(Good):
    def fault(self):
        json.dumps = json.loads = struct.pack = struct.unpack = None
        os.read = os.write = None
        time.monotonic = time.perf_counter = time.time = lambda: 0
        traceback.format_exception = None


class ForgetsNumpy(Good):
    def fault(self):
        sys.modules.pop("numpy")
        sys.path[:] = []


class ManyHypotheses(Good):
    def fault(self):
        return [self.right()] * 10000


class NoReason(Good):
    def fault(self):
        return {"failed": ""}


class ReadsInput(Good):
    def fault(self):
        assert sys.stdin.read() == ""


class Huge(Good):
    def fault(self):
        return dict(self.right(), points=np.broadcast_to(0.0, (2**30, 3)))


class LongReason(Good):
    def fault(self):
        return {"failed": "x" * 10**8}


class LongMessage(Good):
    def fault(self):
        raise RuntimeError("x" * 10**8)


class WrongShape(Good):
    def fault(self):
        return dict(self.right(), rotation=np.eye(2))


class Skewed(Good):
    def fault(self):
        return dict(self.right(), rotation=2 * np.eye(3))


class NotFinite(Good):
    def fault(self):
        return dict(self.right(), translation=[0, 0, float("nan")])


class Objects(Good):
    def fault(self):
        return dict(self.right(), points=np.array([[None] * 3]))


class UnknownKey(Good):
    def fault(self):
        return dict(self.right(), R=np.eye(3))


class NoRotation(Good):
    def fault(self):
        return {"translation": [0, 0, 1]}


class Text(Good):
    def fault(self):
        return "no answer"


class HalfMesh(Good):
    def fault(self):
        return dict(self.right(), vertices=np.eye(3))


class TwoScores(Good):
    def fault(self):
        return dict(self.right(), score=[0.5, 0.5])


class TooMany(Good):
    pass


class ForkKeepsPipe(Good):
    """The copy has the pipe still, and outlives its parent."""

    def fault(self):
        if os.fork() == 0:
            time.sleep(60)
        os._exit(4)


class Daemon(Good):
    """A process in a session of its own, which nobody waits for."""

    def fault(self):
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                time.sleep(60)
            os._exit(0)
        os.wait()


class LeavesProgram(Good):
    def fault(self):
        subprocess.Popen(["sleep", "60"])


class LeavesThread(Good):
    def fault(self):
        threading.Thread(target=time.sleep, args=(60,)).start()


class ChangesInput(Good):
    def predict(self, batch, seed):
        for seen in batch:
            seen["depth"][0, 0] = 7
        return super().predict(batch, seed)


class Elsewhere(Good):
    """Of another side, where only what is named is to be found."""

    def load(self, assets, device):
        with open(str(assets / "w.bin"), "rb") as file:
            assert file.read() == b"weights"
        assert os.environ["WIDTH"] == "3"
        assert "ONLY_HERE" not in os.environ


class ReadsElsewhere(Good):
    def right(self):
        folder = os.getcwd() + "-" + "more"
        sys.path.append(folder)
        importlib.import_module("late" + "_module")
        with open(os.path.join(folder, "settings" + ".txt")) as file:
            assert file.read().startswith("3")
        return super().right()


class Staged(Good):
    def right(self):
        from cpas_worker import stage

        with stage("network"):
            time.sleep(0.01)
        return super().right()


class DrawsGlobally(Good):
    def right(self):
        np.random.rand()
        return super().right()


class DependsOnGlobal(Good):
    def right(self):
        return dict(super().right(), translation=[np.random.rand(), 0, 0.8])


#: Faults that a worker survives, one after the other.
SURVIVED = (
    Raises,
    Exits,
    Interrupts,
    Huge,
    LongReason,
    LongMessage,
    WrongShape,
    Skewed,
    NotFinite,
    Objects,
    UnknownKey,
    NoRotation,
    Text,
    HalfMesh,
    TwoScores,
    TooMany,
    Prints,
    Floods,
    WritesEverywhere,
    ReadsInput,
    Daemon,
    LeavesProgram,
    ManyHypotheses,
    NoReason,
    ClosesOutput,
    PutsOutputAway,
    ClosesStreams,
    ClosesAll,
    ForgetsNumpy,
    Patches,
)


class OneAfterTheOther(Good):
    """Every other sample has a fault, each another one."""

    def predict(self, batch, seed):
        (seen,) = batch
        index = round(float(seen["rgb"][0, 0, 0]) * 255)
        if index % 2 == 0:
            return [self.right()]
        kind = SURVIVED[index // 2]
        return [kind().fault() or self.right()] * (2 if kind is TooMany else 1)
