"""The worker of pytest-cpas: runs a method in an interpreter of its own, and answers over a pipe.

One file, of the standard library and numpy alone, for Python 3.6 and newer: the harness sends it
through the standard input of ``python -c exec(input())``, so that nothing of pytest-cpas has to be
there. Where that cannot be, it is copied: ``python worker.py TOKEN``. A method can import it as
``cpas_worker``, for its :func:`stage`, :func:`tap`, :func:`draw` and :class:`TorchTaps`.

A frame, either way, is a token that nobody else knows, the lengths of what follows (4 and 8 bytes,
big-endian), a header in JSON, raw arrays in the order and of the types that it names, and the token
again. What anybody prints goes to the standard error stream; so does, in a line that begins with
the token, how the process of the method died, which is told by the one that watches it.
"""

import contextlib
import errno
import fnmatch
import hashlib
import importlib
import importlib.machinery
import importlib.util
import io
import json
import os
import platform
import random
import re
import select
import signal
import stat
import struct
import sys
import sysconfig
import tempfile
import time
import traceback
import types
from pathlib import Path
from typing import Any, Dict, Iterator, List, Optional, Sequence, Set, Tuple

#: Both sides have to speak the same.
PROTOCOL = 1

#: Bytes of a header at most.
LARGEST_HEADER = 2**22

#: Characters of a message, of a traceback, and of the message in it.
_MESSAGE, _TRACEBACK, _MESSAGE_AGAIN = 1000, 8000, 300

#: Bytes of all arrays of an answer at most: those of a million points, ten times.
LARGEST_BODY = 2**28

#: Arrays of an answer at most.
MOST_ARRAYS = 10_000

#: Values that a prediction may name.
_MOST_TAPS = 8000

#: Files that are told of with one answer; others wait for the next.
_MOST_NEWS = 1000

#: What precedes a header, behind the token.
LENGTHS = struct.Struct(">IQ")

#: Seconds that the process of the method has to end by itself when the line is cut.
_GRACE = 0.5

#: Files that tell of a program, and their bytes up to which all of them count, each and together.
_MOST_FILES, _WHOLE, _ALL = 20000, 2**23, 2**28

#: Seconds that looking at them may take, and that a file has to rest before its digest is kept.
_LONGEST, _REST = 60.0, 2.0

#: Of a larger one so many pieces, of so many bytes, from end to end.
_PIECES, _PIECE = 64, 2**16

#: Variables that differ between machines, users and jobs: each has its own, and answers the same.
_OF_MACHINES = (
    r"(HOME|PATH|USER|LOGNAME|SHELL|PWD|OLDPWD|TMP|TEMP|TMPDIR|LANG|TERM|DISPLAY|HOSTNAME|CI"
    r"|PYTHONPATH|VIRTUAL_ENV|RANK|LOCAL_RANK|WORLD_SIZE|CUDA_VISIBLE_DEVICES"
    r"|(CPAS|PYTEST|SLURM|GITHUB|MASTER|XDG|CONDA)_.*)$"
)

#: What an answer may hold, and what of it is numbers.
_PARTS = ("rotation", "translation", "extents", "points", "vertices", "triangles", "score")

_IS_PYPY = platform.python_implementation() == "PyPy"

#: How the names of modules end, those that are installed with a distribution.
_MODULES = tuple(e for e in importlib.machinery.all_suffixes() if e != ".pyc")

#: Where a distribution is installed, and what of it is there.
_INSTALLED = re.compile(r"(.*[/\\](?:site|dist)-packages[/\\][^/\\]+)")

#: What tools keep for themselves.
_CACHE = re.compile(r"__pycache__$|\.(git|hypothesis|benchmarks|\w+_cache)$")

# whatever the method puts in the place of these
_perf_counter, _monotonic, _sleep, _time = time.perf_counter, time.monotonic, time.sleep, time.time
_dumps, _loads, _format = json.dumps, json.loads, traceback.format_exception

#: What is used of numpy, as it was before the method was imported.
np: Any = types.SimpleNamespace()

#: Whether modules are looked for in the folder that this was started in, as "" says in sys.path.
here: List[str] = []

_SET_PIPE_SIZE, _PIPE_SIZE = 1031, 2**20  # Linux; the system's own size is 64 KiB


class Line:
    """The pipe: frames in, frames out."""

    def __init__(self, token: str, requests: int, answers: int) -> None:
        self._token = token.encode("ascii")
        self._requests = io.FileIO(requests, "rb", closefd=False)
        self._answers = io.FileIO(answers, "wb", closefd=False)

    def receive(self) -> Optional[Tuple[Dict[str, Any], List[Any]]]:
        """The next request and its arrays; None at the end."""
        head = self._read(bytearray(len(self._token) + LENGTHS.size))
        if head is None:
            return None
        header_size, _ = LENGTHS.unpack(head[len(self._token) :])
        header = _loads(bytes(self._read(bytearray(header_size)) or b"null").decode("utf-8"))
        arrays = []
        for dtype, shape in header["arrays"]:
            array = np.empty(shape, dtype)
            if array.size and _IS_PYPY:  # which cannot read into the memory of an array
                content = self._read(bytearray(array.nbytes))
                array = np.frombuffer(content, dtype).reshape(shape)
            elif array.size:
                self._read(array.reshape(-1).view(np.uint8).data)
            arrays.append(array)
        self._read(bytearray(len(self._token)))
        return header, arrays

    def _read(self, into: Any) -> Any:
        rest = memoryview(into)
        while len(rest):
            count = self._requests.readinto(rest)
            if not count:
                return None
            rest = rest[count:]
        return into

    def send(self, header: Dict[str, Any], arrays: Sequence[Any] = ()) -> None:
        """An answer and its arrays, which are C-contiguous and little-endian."""
        header["arrays"] = [[array.dtype.str, list(array.shape)] for array in arrays]
        text = _dumps(header).encode("ascii")
        size = sum(array.nbytes for array in arrays)
        for what, seen, most in (
            ("{} bytes", size, LARGEST_BODY),
            ("{} arrays", len(arrays), MOST_ARRAYS),
            ("{} bytes of names, texts and places of arrays", len(text), LARGEST_HEADER),
        ):
            if seen > most:
                message = f"an answer of {what.format(seen)}, at most {most} are read"
                return self.send(_told(AnswerError(message)))
        parts = [self._token + LENGTHS.pack(len(text), size) + text]
        parts += [array.tobytes() for array in arrays] + [self._token]
        rest = memoryview(b"".join(parts))
        while len(rest):
            rest = rest[self._answers.write(rest) :]


# -- the method ---------------------------------------------------------------------------------


class Stages:
    """Adds up the seconds of stages while it listens, as ``pytest_cpas.stages`` does."""

    def __init__(self) -> None:
        self.listens, self.inside = False, False
        self.names: List[str] = []
        self.seconds: Dict[str, float] = {}
        self.synchronise: Any = lambda: None

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add this block to a stage; a stage within one is a part of that."""
        self.names.append(name)
        try:
            with self._timed(name):
                yield
        finally:
            self.names.pop()

    @contextlib.contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        if self.inside or not self.listens:
            yield
            return
        self.inside = True
        self.synchronise()
        start = now()
        try:
            yield
        finally:
            self.synchronise()
            self.seconds[name] = self.seconds.get(name, 0.0) + now() - start
            self.inside = False


_stages = Stages()


def stage(name: str) -> Any:
    """``with stage("network"):`` names a stage of a prediction, for ``--cpas-benchmark``."""
    return _stages.timed(name)


class Taps:
    """Keeps what is named while it listens, as ``pytest_cpas.stages`` does; what is drawn is
    replaced by what is to be replayed."""

    wide = False

    def __init__(self) -> None:
        self.begin(False, {})

    def begin(self, listens: bool, replay: Dict[Tuple[str, int], Any]) -> None:
        """Forget what was heard; ``replay``: what is drawn from now on, by name and call."""
        self.listens, self.replay = listens, replay
        self.names: List[List[str]] = []
        self.arrays: List[Any] = []
        self._calls: Dict[str, int] = {}
        self._size = 0

    def tapped(self, name: str, value: Any) -> None:
        """Keep copies."""
        self._keep("tap", name, value)

    def drawn(self, name: str, value: Any) -> Any:
        """Keep copies; what is to be replayed, as the same kind of thing."""
        other = self.replay.get((name, self._calls.get(name, 0) + 1))
        self._keep("draw", name, value)
        if other is None:
            return value
        if tuple(getattr(value, "shape", ())) != other.shape:
            raise AnswerError(
                "draw {!r}: the reference drew {}, expected {}".format(
                    name, other.shape, getattr(value, "shape", ())
                )
            )
        if hasattr(value, "new_tensor"):
            return value.new_tensor(other.tolist())
        return other.astype(value.dtype) if hasattr(value, "dtype") else type(value)(other)

    def widened(self, name: str, problem: str) -> None:
        """It is not asked for."""

    def _keep(self, kind: str, name: str, value: Any) -> None:
        stage_name = _stages.names[-1] if _stages.names else ""
        for part_name, array in _arrays_in(name, value):
            self._calls[part_name] = self._calls.get(part_name, 0) + 1
            self._size += array.nbytes
            if self._size > LARGEST_BODY // 2 or len(self.names) >= _MOST_TAPS:
                raise AnswerError(
                    f"tap {part_name!r}: more than {_MOST_TAPS} values, or {LARGEST_BODY // 2}"
                    " bytes of them; name fewer"
                )
            self.names.append([part_name, kind, stage_name])
            self.arrays.append(array)


def _arrays_in(name: str, value: Any) -> Iterator[Tuple[str, Any]]:
    """Copies of the arrays in a value, each with a name."""
    if value is None:
        return
    fields = getattr(value, "_fields", None)
    if isinstance(value, dict):
        parts = [(str(key), part) for key, part in value.items()]
    elif isinstance(value, (tuple, list)) and not all(
        isinstance(part, (bool, int, float)) for part in value
    ):
        parts = list(zip(fields or map(str, range(len(value))), value))
    else:
        if hasattr(value, "detach"):  # a tensor
            value = value.detach()
            value = value.float() if str(value.dtype) == "torch.bfloat16" else value
            value = value.cpu().numpy()
        array = np.array(value, order="C")
        if array.dtype.kind == "c":
            array = np.stack([array.real, array.imag], axis=-1)
        if array.dtype.kind not in "biuf":
            raise AnswerError(f"tap {name!r}: of type {array.dtype}, expected numbers")
        if array.dtype.kind == "b":
            array = array.astype(np.uint8)
        if array.dtype.itemsize > 8:
            array = array.astype(float)
        yield name, np.array(array, array.dtype.newbyteorder("<"), order="C")
        return
    for part_name, part in parts:
        yield from _arrays_in(f"{name}.{part_name}", part)


_taps = Taps()


def tap(name: str, value: Any) -> Any:
    """Names an array, tensor, or a tuple, list or dict of such, for ``--cpas-trace`` and
    ``--cpas-parity``; it is returned."""
    if _taps.listens:
        _taps.tapped(name, value)
    return value


def draw(name: str, value: Any) -> Any:
    """The same for what was drawn at random; what is returned is to be used."""
    return _taps.drawn(name, value) if _taps.listens else value


class TorchTaps:
    """``with TorchTaps(network):`` names what every submodule returns, by its dotted path."""

    def __init__(
        self,
        module: Any,
        name: str = "network",
        include: Sequence[str] = ("*",),
        exclude: Sequence[str] = (),
    ) -> None:
        """``include`` and ``exclude``: patterns of paths; the module itself has the path ""."""
        self._module, self._name = module, name
        self._include, self._exclude = include, exclude
        self._hooks: List[Any] = []

    def __enter__(self) -> "TorchTaps":
        for path, part in self._module.named_modules() if _taps.listens else ():
            named = any(fnmatch.fnmatchcase(path, pattern) for pattern in self._include)
            if named and not any(fnmatch.fnmatchcase(path, p) for p in self._exclude):
                name = self._name + ("." + path if path else "")
                self._hooks.append(part.register_forward_hook(_hook(name)))
        return self

    def __exit__(self, *_: Any) -> None:
        while self._hooks:
            self._hooks.pop().remove()


def _hook(name: str) -> Any:
    def hear(module: Any, inputs: Any, output: Any) -> None:
        _taps.tapped(name, output)

    return hear


def now() -> float:
    """Seconds of a clock that stands still while this thread waits for a core, on Linux."""
    while True:
        waited = _waited()
        instant = _perf_counter()
        if _waited() == waited:
            return instant - waited


def _waited() -> float:
    try:
        with open("/proc/thread-self/schedstat", "rb") as file:
            return int(file.read().split()[1]) / 1e9
    except (OSError, IndexError):
        return 0.0


class Served:
    """The class of a method, and the instances of it that the harness uses."""

    def __init__(self) -> None:
        self._class: Any = None
        self._methods: Dict[int, Any] = {}
        self._device = "cpu"
        self._anew = False

    def answer(
        self, request: Dict[str, Any], arrays: List[Any]
    ) -> Tuple[Dict[str, Any], List[Any]]:
        """What a request asks for; raises whatever the method raises."""
        if request["call"] == "predict":
            return self._predict(request, arrays)
        return {"value": getattr(self, "_" + request["call"])(request)}, []

    def _open(self, request: Dict[str, Any]) -> Any:
        """Import the class; what it declares."""
        os.environ.update(request["env"])
        _check_folders(request["path"], request["places"])
        sys.dont_write_bytecode = True
        rest = [folder for folder in sys.path if folder]
        # modules of the method that are called as one of Python's do not stand in their way
        sys.path[:] = rest + request["path"]
        _take_numpy()
        # nothing else that lies about is imported by chance
        sys.path[:] = (request["path"] or here) + rest
        module, _, name = request["class"].partition(":")
        made = importlib.import_module(module)
        for part in name.split("."):
            if not hasattr(made, part):
                file = getattr(made, "__file__", None)
                kind = f"module {module}" + (f" is {file}, and" if file else "")
                raise AnswerError(f"{kind if made is sys.modules[module] else made} has no {part}")
            made = getattr(made, part)
        lacking = [part for part in ("info", "load", "predict") if not hasattr(made, part)]
        info: Any = getattr(made, "info", None)
        if not lacking and not isinstance(info, dict) and not hasattr(info, "categories"):
            lacking = ["dictionary info"]
        if lacking:
            raise AnswerError(
                "{} has no {}; a method is a class with a dictionary info, load(assets, device)"
                " and predict(batch, seed)".format(request["class"], ", no ".join(lacking))
            )
        self._class = made
        if isinstance(info, dict):
            told = {str(key): _plain(value) for key, value in info.items()}
        else:
            told = {key: _plain(value) for key, value in vars(info).items()}
            told["assets"] = [_plain(vars(asset)) for asset in info.assets]
        _sources.begin()
        return {
            "info": told,
            "is_plain": isinstance(info, dict),
            "has_assets_in": hasattr(made, "assets_in"),
            "doc": made.__doc__,
        }

    def _assets_in(self, request: Dict[str, Any]) -> Any:
        assets = self._class.assets_in(Path(request["folder"]))
        return [_plain(a if isinstance(a, dict) else vars(a)) for a in assets]

    def _load(self, request: Dict[str, Any]) -> Any:
        """Another instance, loaded."""
        method = self._class()
        folder, self._device = request["assets"], request["device"]
        method.load(None if folder is None else Path(folder), self._device)
        self._methods[request["instance"]] = method

    def _drop(self, request: Dict[str, Any]) -> Any:
        self._methods.pop(request["instance"], None)

    def _sources(self, request: Dict[str, Any]) -> Any:
        return _sources.told(request["path"], request["leave_out"])

    def _digests(self, request: Dict[str, Any]) -> Any:
        return {path: _digest_of(path) for path in request["files"]}

    def _facts(self, request: Dict[str, Any]) -> Any:
        return facts(self._device)

    def _memory(self, request: Dict[str, Any]) -> Any:
        told = memory(self._device)
        if request["anew"]:
            self._anew = _begin_anew(self._device)
        return dict(told, anew=self._anew)

    def _predict(
        self, request: Dict[str, Any], arrays: List[Any]
    ) -> Tuple[Dict[str, Any], List[Any]]:
        method = self._methods[request["instance"]]
        plain = isinstance(getattr(method, "info", None), dict)
        count = 3 * len(request["batch"])
        arrays, replayed = arrays[:count], arrays[count:]
        keys = [(name, call) for name, call in request.get("replay", [])]
        _taps.begin(request.get("traced", False), dict(zip(keys, replayed)))
        batch = [
            _observation(told, arrays[3 * index : 3 * index + 3], plain)
            for index, told in enumerate(request["batch"])
        ]
        before = [array.copy() for array in arrays] if request["checked"] else []
        drawn = _RandomStates(request["random"])
        _stages.synchronise = _synchroniser(self._device)
        _stages.listens, _stages.seconds = request["timed"], {}
        with _also_listening(_stages):
            _stages.synchronise()
            start, wall = now(), _perf_counter()
            predictions = method.predict(batch, request["seed"])
            _stages.synchronise()
            seconds, wall = now() - start, _perf_counter() - wall
        _taps.listens = False
        made: List[Any] = []
        listed = _listed(predictions, len(batch))
        answers = [_answer(index, answer, made) for index, answer in enumerate(listed)]
        changed = [
            index for index, old in enumerate(before) if old.tobytes() != arrays[index].tobytes()
        ]
        tapped = len(made)
        made += _taps.arrays
        return {
            "answers": answers,
            "values": _taps.names,
            "values_from": tapped,
            "seconds": seconds,
            "wall": wall,
            "stages": _stages.seconds,
            "drawn": drawn.changed(),
            "changed": changed,
        }, made + [arrays[index] for index in changed]


@contextlib.contextmanager
def _also_listening(stages: Stages) -> Iterator[None]:
    """Where an adapter has imported ``pytest_cpas.stages``, its stages are timed by that."""
    theirs: Any = sys.modules.get("pytest_cpas.stages")
    if theirs is None or not (stages.listens or _taps.listens):
        yield
        return
    if _taps.listens and hasattr(theirs, "hearing"):
        with theirs.listening(stages), theirs.hearing(_taps):
            yield
        return
    clock = theirs.StageClock(now, stages.synchronise)
    with clock.listening():
        yield
    for name, seconds in clock.seconds.items():
        stages.seconds[name] = stages.seconds.get(name, 0.0) + seconds


def _synchroniser(device: str) -> Any:
    torch: Any = sys.modules.get("torch")
    if torch is None or not device.startswith("cuda"):
        return lambda: None
    return lambda: torch.cuda.synchronize(device)


def _observation(told: Dict[str, Any], arrays: List[Any], plain: bool) -> Any:
    """What a method sees: a dictionary, or what an adapter for pytest-cpas expects."""
    parts = dict(zip(("rgb", "depth", "mask"), arrays))
    if plain:
        return dict(parts, category=told["category"], camera=dict(told["camera"]))
    types: Any = sys.modules["pytest_cpas.types"]
    parts["camera"] = types.Camera(**told["camera"])
    made = object.__new__(types.Observation)  # the harness has looked at it
    vars(made).update(parts, category=told["category"])
    return made


def _listed(predictions: Any, count: int) -> List[Any]:
    if isinstance(predictions, dict) or not isinstance(predictions, (list, tuple)):
        raise AnswerError(
            f"predict gave a {type(predictions).__name__}, expected a list with an answer for each"
            " observation"
        )
    if len(predictions) != count:
        raise AnswerError(
            f"predict: {len(predictions)} answers to a batch of {count}, expected one for each"
            " observation, in order"
        )
    return list(predictions)


class AnswerError(ValueError):
    """What is to be changed over here, and is told without a traceback."""


def _check_folders(path: List[str], places: List[str]) -> None:
    for what, names in (("path", path), ("paths", places)):
        for name in names:
            if not os.path.exists(name):
                raise AnswerError(f"{what}: there is no {name} on the other side")
    for name in path:
        if not os.path.isdir(name) and not name.endswith((".zip", ".egg", ".whl")):
            raise AnswerError(f"path: {name} is no folder")


def _take_numpy() -> None:
    try:
        import numpy
    except ImportError as error:
        raise AnswerError(
            f"{type(error).__name__}: {error}; the worker needs numpy in {sys.executable} (of"
            f" {sys.prefix})"
        ) from None
    for name in ("array", "asarray", "empty", "frombuffer", "random", "stack", "uint8"):
        setattr(np, name, getattr(numpy, name))


def _answer(index: int, answer: Any, made: List[Any]) -> Dict[str, Any]:
    """An answer in JSON, its arrays appended to ``made``."""
    where = f"answer {index}"
    if hasattr(answer, "hypotheses"):
        reason, hypotheses = answer.reason, [_of_object(each) for each in answer.hypotheses]
    elif isinstance(answer, dict) and "failed" in answer:
        reason, hypotheses = answer["failed"], []
    else:
        reason, hypotheses = None, [answer] if isinstance(answer, dict) else answer
    if not isinstance(hypotheses, (list, tuple)):
        raise AnswerError(
            f"{where} is a {type(answer).__name__}, expected a dictionary such as"
            ' {"rotation": R, "translation": t}, a list of such, the best first, or'
            ' {"failed": "why"}'
        )
    if not hypotheses and not reason:
        raise AnswerError(
            f'{where} has no hypothesis and no reason; say why with {{"failed": "why"}}'
        )
    told = [
        _hypothesis(f"{where}, hypothesis {n}", each, made) for n, each in enumerate(hypotheses)
    ]
    return {"reason": None if reason is None else str(reason)[:4000], "hypotheses": told}


def _of_object(hypothesis: Any) -> Dict[str, Any]:
    told = {name: getattr(hypothesis, name, None) for name in _PARTS}
    if hypothesis.mesh is not None:
        told.update(vertices=hypothesis.mesh.vertices, triangles=hypothesis.mesh.triangles)
    return told


def _hypothesis(where: str, hypothesis: Any, made: List[Any]) -> Dict[str, int]:
    """Which of the arrays is which part."""
    if not isinstance(hypothesis, dict):
        raise AnswerError(f"{where} is a {type(hypothesis).__name__}, expected a dictionary")
    unknown = sorted(str(name) for name in set(hypothesis) - set(_PARTS))
    if unknown:
        raise AnswerError(
            "{} has {}, expected some of {}".format(where, ", ".join(unknown), ", ".join(_PARTS))
        )
    places = {}
    for name in _PARTS:
        value = hypothesis.get(name)
        if value is None:
            continue
        for unwrap in ("detach", "cpu", "numpy"):  # a tensor
            if hasattr(value, unwrap):
                value = getattr(value, unwrap)()
        array = np.asarray(value)
        if array.nbytes > LARGEST_BODY:
            raise AnswerError(f"{where}: {name} take {array.nbytes} bytes, at most {LARGEST_BODY}")
        if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
            raise AnswerError(f"{where}: {name} is of type {array.dtype}, expected numbers")
        places[name] = len(made)
        made.append(np.array(array, array.dtype.newbyteorder("<"), order="C"))
    return places


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, (set, frozenset)):
        return sorted(str(each) for each in value)
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if hasattr(value, "tolist"):  # numpy's
        return _plain(value.tolist())
    return value if isinstance(value, (bool, int, float, type(None))) else str(value)


class _RandomStates:
    """The global random states, seeded as the harness has its own; who drew from them."""

    def __init__(self, seed: int) -> None:
        self._numpy = np.random
        self._torch: Any = sys.modules.get("torch")
        random.seed(seed)
        np.random.seed(seed)
        if self._torch is not None:
            self._torch.random.default_generator.manual_seed(seed)
        self._before = self._states()

    def _states(self) -> Dict[str, Any]:
        state: Any = self._numpy.get_state()
        states = {"random": random.getstate(), "numpy.random": (bytes(state[1]), state[2])}
        if self._torch is not None:
            states["torch"] = self._torch.random.get_rng_state().numpy().tobytes()
        return states

    def changed(self) -> List[str]:
        return [name for name, state in self._states().items() if self._before.get(name) != state]


# -- what is known of this side -----------------------------------------------------------------


def facts(device: str) -> Dict[str, Any]:
    """Interpreter, versions and threads, as far as they are known now."""
    versions: Dict[str, str] = {}
    for name in ("numpy", "torch"):
        if name in sys.modules:
            versions[name] = str(getattr(sys.modules[name], "__version__", "unknown"))
    threads = {}
    torch: Any = sys.modules.get("torch")
    if torch is not None:
        threads["torch"] = int(torch.get_num_threads())
        if device.startswith("cuda"):
            device = str(torch.cuda.get_device_name(device))
            versions["cuda"] = str(torch.version.cuda)
    waits = os.path.exists("/proc/thread-self/schedstat")
    return {
        "clock": "wall clock without waiting for a core" if waits else "wall clock",
        "device": device,
        "threads": threads,
        "versions": versions,
    }


def _begin_anew(device: str) -> bool:
    """Have the peak of memory begin here; whether the system does that."""
    torch: Any = sys.modules.get("torch") if device.startswith("cuda") else None
    if torch is not None:
        torch.cuda.reset_peak_memory_stats(device)
    try:
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
    except OSError:
        return False
    return True


def memory(device: str) -> Dict[str, Any]:
    """The peak of what this process and torch hold."""
    torch: Any = sys.modules.get("torch") if device.startswith("cuda") else None
    host = on_device = None
    if torch is not None:
        on_device = int(torch.cuda.max_memory_allocated(device))
    try:
        with open("/proc/self/status") as status:
            peak = [line.split()[1] for line in status if line.startswith("VmHWM:")]
        host = int(peak[0]) * 1024
    except (OSError, IndexError):
        pass
    return {"host_bytes": host, "device_bytes": on_device}


class TooMuchError(Exception):
    """Why files are not looked at."""


class Sources:
    """The files that the method is made of, as far as they can be seen.

    Those below the folders where modules are looked for, and modules from elsewhere that were
    imported with the class: of what is installed, whole packages. Modules that are imported since
    are told one by one, and so is what else is read, of which Python tells from 3.8 on. What was
    written by this process, or made since it began in the folder of temporary files, is its own
    output.
    """

    def __init__(self) -> None:
        self._folders: List[str] = []
        self._left_out: Set[str] = set()
        self._began = time.time()
        self._names: Set[str] = set()
        self._first: Set[str] = set()
        self._below: Optional[Set[str]] = None
        self._imported: Set[str] = set()
        self._read: Set[str] = set()
        self._written: Set[str] = set()
        self._told: Set[str] = set()

    def listen(self) -> None:
        """Hear of files that are read from now on."""
        if hasattr(sys, "addaudithook"):
            sys.addaudithook(self._hear)  # novermin

    def _hear(self, event: str, arguments: Tuple[Any, ...]) -> None:
        if event not in ("open", "ctypes.dlopen") or not isinstance(arguments[0], (str, bytes)):
            return
        with contextlib.suppress(Exception):  # whoever opens the file is not disturbed
            path = os.path.abspath(os.fsdecode(arguments[0]))
            if path.endswith(".pyc"):
                path = importlib.util.source_from_cache(path)
            writes = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR)
            (self._written if writes else self._read).add(path)

    def begin(self) -> None:
        """The class is imported: what is there now is the same in every process."""
        places = [os.path.realpath(folder) for folder in sys.path if folder]
        self._folders = [p for p in dict.fromkeys(places) if not _is_standard(p)]
        self._first = self._new_modules()

    def _new_modules(self) -> Set[str]:
        """The files of modules that were not there before; packages of those that are installed."""
        names = {*list(sys.modules)} - self._names - {"__main__", "cpas_worker"}
        self._names |= names
        found = set()
        for name in names:
            with contextlib.suppress(Exception):  # it may be anything
                file: Any = getattr(sys.modules[name], "__file__", None)
                found.add(_counted(file) if isinstance(file, str) else "")
        return found - {""}

    def news(self) -> List[List[str]]:
        """Path and digest of each file that was read, or imported, since it was asked what there
        is."""
        if self._below is None:
            return []
        self._imported |= self._new_modules() - self._first
        while self._read:
            path = self._read.pop()
            if self._is_part(path):
                self._imported.add(_counted(path) if path.endswith(_MODULES) else path)
        paths = sorted(self._imported - self._told - self._first - self._written)[:_MOST_NEWS]
        self._imported -= {*paths, *self._told, *self._first}
        self._told.update(paths)
        new = [path for path in paths if self._is_new(path)]
        return [[path, _digest_of(path)] for path in new]

    def _is_part(self, path: str) -> bool:
        """Whether a file that was read is none of Python, of the system or of a cache, and is not
        known otherwise."""
        if re.match(r"/(proc|sys|dev)/", path) or re.search(r"[-.](dist|egg)-info[/\\]", path):
            return False
        if _is_standard(path) and not _INSTALLED.match(path):
            return False
        if any(_CACHE.match(part) for part in path.split(os.sep)):
            return False
        return not any(_is_below(path, folder) for folder in self._left_out)

    def _is_new(self, path: str) -> bool:
        if not os.path.exists(path) or _place(path) in (self._below or ()):
            return False
        temporary = _is_below(path, tempfile.gettempdir())
        return not (temporary and os.path.getctime(path) >= self._began)

    def told(self, path: List[str], leave_out: List[str]) -> Dict[str, Any]:
        """A digest of each file by name, and the distributions; ``unknown``: why that is not all,
        else empty. ``leave_out``: folders of data, weights, results, which are known otherwise."""
        self._left_out = {os.path.realpath(folder) for folder in leave_out}
        unknown = "" if path else "no path says in which folders its sources are"
        files: Dict[str, str] = {}
        self._below = set()
        try:
            until = _monotonic() + _LONGEST
            listed = self._listed(until)
            packages = sorted(self._first)
            files.update(_digests_of(listed, packages, until))
            files.update(_variables({word for file in listed.values() for word in _words(file)}))
        except TooMuchError as error:
            files, unknown = {}, str(error)
        return {"files": files, "distributions": _distributions(), "unknown": unknown}

    def _listed(self, until: float) -> Dict[str, str]:
        """The files below the folders, by name."""
        found: Dict[str, str] = {}
        bases: Set[str] = set()
        for folder in self._folders:
            base = os.path.basename(folder) or folder
            while base in bases:
                base += "'"
            bases.add(base)
            for file, place in _below(folder, self._left_out, until):
                if len(found) >= _MOST_FILES:
                    raise TooMuchError(f"{folder} has more than {_MOST_FILES} files")
                found[base + "/" + os.path.relpath(file, folder).replace(os.sep, "/")] = file
                if self._below is not None:
                    self._below.add(place)
        return found


_sources = Sources()


def _is_standard(place: str) -> bool:
    """Whether it is Python's, or of distributions, which versions tell of."""
    if re.search(r"[/\\](site|dist)-packages([/\\]|$)|[/\\]python\d+\.zip$", place):
        return True
    return any(_is_below(place, sysconfig.get_path(n)) for n in ("stdlib", "platstdlib"))


def _counted(file: str) -> str:
    """What counts for a module: its file; of one that is installed the package, or the file, that
    lies among the others; "" for Python's own."""
    file = os.path.abspath(file)
    match = _INSTALLED.match(file)
    if match:
        return match.group(1)
    while not os.path.exists(file) and file != os.path.dirname(file):  # in an archive
        file = os.path.dirname(file)
    return file if os.path.isfile(file) and not _is_standard(file) else ""


def _is_below(place: str, folder: Optional[str]) -> bool:
    place, folder = os.path.realpath(place), os.path.realpath(folder or ".")
    return place == folder or place.startswith(folder.rstrip(os.sep) + os.sep)


def _place(file: str) -> str:
    """A file in the folder that it really is in."""
    return os.path.join(os.path.realpath(os.path.dirname(file)), os.path.basename(file))


def _words(file: str) -> Set[bytes]:
    """What the text of a module says that may be the name of a variable."""
    if not file.endswith(".py"):
        return set()
    try:
        with open(file, "rb") as opened:
            return set(re.findall(rb"[A-Z][A-Z0-9_]{2,}", opened.read(_WHOLE)))
    except OSError:
        return set()


def _variables(words: Set[bytes]) -> Iterator[Tuple[str, str]]:
    """A digest of each variable that a text names, but for those of a machine, a user or a job."""
    for word in sorted(words):
        name = word.decode("ascii")
        if name in os.environ and not re.match(_OF_MACHINES, name):
            value = os.environ[name].encode("utf-8", "surrogateescape")
            yield "$" + name, hashlib.sha256(value).hexdigest()[:16]


def _below(folder: str, leave_out: Set[str], until: float) -> Iterator[Tuple[str, str]]:
    """The files of a folder, as they are reached and as :func:`_place` has them; a file alone."""
    if not os.path.isdir(folder):
        yield folder, _place(folder)
        return
    been: Set[str] = set()
    for at, folders, names in os.walk(folder, followlinks=True):
        if _monotonic() > until:
            raise TooMuchError(f"{folder} cannot be looked through in {_LONGEST:g} s")
        if at != folder and ("pyvenv.cfg" in names or "conda-meta" in folders):
            folders[:] = []  # an environment, whose distributions have versions
            continue
        place = os.path.realpath(at)
        been.add(place)
        folders[:] = sorted(
            name
            for name in folders
            if not _CACHE.match(name)
            and os.path.realpath(os.path.join(at, name)) not in leave_out | been
        )
        for name in sorted(names):
            if not name.endswith(".pyc"):
                yield os.path.join(at, name), os.path.join(place, name)


def _digests_of(
    listed: Dict[str, str], others: List[str], until: float
) -> Iterator[Tuple[str, str]]:
    """A digest of each file by name, and of others by path."""
    left = _ALL
    for name, file in listed.items():
        size, digest = _digest(file, left > 0)
        left -= size
        yield name, digest
        if _monotonic() > until:
            raise TooMuchError(f"what is below path cannot be read in {_LONGEST:g} s")
    for path in others:
        name = os.path.join(*path.split(os.sep)[-2:]) if _INSTALLED.match(path) else path
        yield name, _digest_of(path)
        if _monotonic() > until:
            raise TooMuchError(f"what is installed cannot be read in {_LONGEST:g} s")


def _digest_of(path: str) -> str:
    """A digest of a file, or of the modules below a folder: beyond some bytes of their sizes."""
    if not os.path.isdir(path):
        return _digest(path, True)[1]
    digest = hashlib.sha256()
    left, until = _ALL, _monotonic() + _LONGEST
    for at, folders, names in os.walk(path):
        folders.sort()
        for name in sorted(names):
            if not name.endswith(_MODULES):
                continue
            file = os.path.join(at, name)
            size, told = _digest(file, True) if left > 0 else (0, str(_size(file)))
            left -= size
            digest.update(f"{os.path.relpath(file, path)} {told}\n".encode("utf-8", "replace"))
        if _monotonic() > until:
            return f"unread: it takes longer than {_LONGEST:g} s"
    return digest.hexdigest()[:16]


def _size(file: str) -> int:
    try:
        return os.path.getsize(file)
    except OSError:
        return -1


#: Digests of files that have rested, by path and how they were looked at.
_digests: Dict[Tuple[str, bool], Tuple[Tuple[int, ...], Tuple[int, str]]] = {}


def _digest(file: str, whole: bool) -> Tuple[int, str]:
    """Bytes that were read of a file, and their digest: all, or of a large one some pieces."""
    try:
        seen = os.stat(file)
        if not stat.S_ISREG(seen.st_mode):
            return 0, "no file"
        stamp = seen.st_dev, seen.st_ino, seen.st_size, seen.st_mtime_ns, seen.st_ctime_ns
        known = _digests.get((file, whole))
        if known is not None and known[0] == stamp:
            return known[1]
        told = _read_digest(file, seen.st_size, whole)
    except OSError as error:
        return 0, f"unread: {error.strerror}"
    if _time() - seen.st_ctime > _REST:
        _digests[file, whole] = stamp, told
    return told


def _read_digest(file: str, size: int, whole: bool) -> Tuple[int, str]:
    digest = hashlib.sha256(str(size).encode("ascii"))
    with open(file, "rb") as opened:
        if (whole and size <= _WHOLE) or size <= _PIECE:
            digest.update(opened.read())
            return size, digest.hexdigest()[:16]
        for place in range(_PIECES):
            opened.seek(place * (size - _PIECE) // (_PIECES - 1))
            digest.update(opened.read(_PIECE))
    return _PIECES * _PIECE, digest.hexdigest()[:16] + " in part"


def _distributions() -> List[str]:
    """Name and version of each one that is installed."""
    found = set()
    for folder in sys.path:
        with contextlib.suppress(OSError):
            for name in os.listdir(folder or "."):
                match = re.match(r"([^-]+)-([^-]+).*\.(dist|egg)-info$", name)
                if match:
                    found.add(f"{match.group(1).lower()} {match.group(2)}")
    return sorted(found)


def _machine() -> str:
    """What tells a machine from others, also seen from a container on it."""
    try:
        with open("/proc/sys/kernel/random/boot_id") as file:
            return file.read().strip()
    except OSError:
        return platform.node()


# -- the processes ------------------------------------------------------------------------------


def serve(token: str, requests: int, answers: int, errors: int) -> None:
    """Answer requests until there are none; ``errors``: another number of the error stream."""
    line, served = Line(token, requests, answers), Served()
    line.send(
        {
            "protocol": PROTOCOL,
            "python": platform.python_version(),
            "implementation": platform.python_implementation(),
            "executable": sys.executable,
            "prefix": sys.prefix,
            "machine": _machine(),
            "pid": os.getpid(),
        }
    )
    while True:
        received = line.receive()
        if received is None:
            return
        made: List[Any] = []
        try:
            answer, made = served.answer(*received)
        except BaseException as error:  # sys.exit() is no way out either
            answer = _told(error)
        answer["read"] = _sources.news()
        _flush()
        _mend_streams(errors)
        line.send(answer, made)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # the method has closed it, or put it away
            stream.flush()


def _mend_streams(errors: int) -> None:
    """Open the output of this process again where the method has closed it: no file that is opened
    next takes what is meant for it."""
    for number in (1, 2):
        try:
            os.fstat(number)
        except OSError:
            with contextlib.suppress(OSError):
                os.dup2(errors, number)


def _told(error: BaseException) -> Dict[str, Any]:
    """What was raised, as the harness shows it: without the frames that led to the method."""
    kind, frames = type(error), error.__traceback__
    while frames is not None and frames.tb_frame.f_globals.get("__name__") == __name__:
        frames = frames.tb_next
    parts = _format(kind, error, frames or error.__traceback__)
    text = "".join(_shortened(part, _MESSAGE_AGAIN) for part in parts)
    contract = any(base.__name__ == "ContractError" for base in kind.__mro__)
    try:
        message = str(error)
    except Exception:
        message = "its message cannot be told"
    return {
        "raised": kind.__name__,
        "message": _shortened(message, _MESSAGE),
        "traceback": text[-_TRACEBACK:],
        "contract": contract or kind is AnswerError,
    }


def _shortened(text: str, most: int) -> str:
    """``text``, or its beginning and end."""
    if len(text) <= most:
        return text
    return f"{text[: most // 2]} ... [{len(text)} characters] ... {text[-most // 4 :]}"


def main(token: str) -> None:
    """Take the standard streams over, and serve in a process that this one watches."""
    requests, answers, errors = _aside(0), _aside(1), _aside(2)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    with contextlib.suppress(Exception):
        import fcntl

        for each in (requests, answers):
            with contextlib.suppress(OSError):
                fcntl.fcntl(each, _SET_PIPE_SIZE, _PIPE_SIZE)
    if hasattr(os, "fork"):
        _set_process_option(36, 1)  # orphans of the method become children of this process
        wake, woken = os.pipe()
        for each in (wake, woken):
            os.set_blocking(each, False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(woken)
        child = os.fork()
        if child:
            os.close(answers)
            _watch(token, child, requests, wake)
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.close(wake)
        os.close(woken)
        os.setsid()
        _set_process_option(1, signal.SIGKILL)  # should the other one be killed
        _forget_in_copies(requests, answers)
    _sources.listen()
    with contextlib.suppress(Exception):
        import faulthandler

        faulthandler.enable(errors)
        faulthandler.register(signal.SIGUSR1, errors)
    try:
        serve(token, requests, answers, errors)
    except OSError as error:
        if error.errno == errno.EBADF:
            _say_closed(errors)
            os._exit(1)
        if error.errno not in (errno.EPIPE, errno.ECONNRESET):  # nobody listens any more
            raise
    _flush()
    os._exit(0)  # neither threads nor libraries that tidy up for seconds are waited for


def _aside(descriptor: int) -> int:
    """A copy of it with a high number, which code that closes or writes to all that it knows of
    leaves alone."""
    with contextlib.suppress(Exception):
        import fcntl
        import resource

        most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        most = min(most, 4096) if most > 0 else 4096
        return fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, most - 32)
    return os.dup(descriptor)


def _say_closed(errors: int) -> None:
    """Whichever way is left to the error stream."""
    said = (
        b"\nthe method has closed file descriptors that it did not open, and with them the line to"
        b" pytest-cpas\n"
    )
    for number in (errors, 2):
        with contextlib.suppress(OSError):
            os.write(number, said)
            return
    path = f"/proc/{os.getppid()}/fd/2"  # as the process that watches this one has it
    with contextlib.suppress(OSError), open(path, "wb", buffering=0) as stream:
        stream.write(said)


def _forget_in_copies(*descriptors: int) -> None:
    """A copy of this process does not hold the line open."""

    def forget() -> None:
        for each in descriptors:
            with contextlib.suppress(OSError):
                os.close(each)

    if hasattr(os, "register_at_fork"):  # 3.7
        os.register_at_fork(after_in_child=forget)  # novermin


def _set_process_option(number: int, value: int) -> None:
    """``prctl``, where there is one."""
    if sys.platform.startswith("linux"):
        with contextlib.suppress(Exception):
            import ctypes

            ctypes.CDLL(None).prctl(number, value, 0, 0, 0)


def _watch(token: str, child: int, requests: int, wake: int) -> None:
    """Wait for the process of the method, or for the end of the line; then end all that is left."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    poller = select.poll()
    poller.register(requests, getattr(select, "POLLRDHUP", 0))
    poller.register(wake, select.POLLIN)
    status = None
    cut: Optional[float] = None
    while status is None and (cut is None or _monotonic() < cut):
        events = poller.poll(None if cut is None else 50)
        if any(number == requests for number, _ in events):
            poller.unregister(requests)
            cut = _monotonic() + _GRACE
        with contextlib.suppress(OSError):
            os.read(wake, 100)
        status = _reaped(child)
    if status is None and hasattr(signal, "SIGUSR1"):
        with contextlib.suppress(OSError):  # it says where it is
            os.kill(child, signal.SIGUSR1)
            _sleep(0.1)
    for end in (os.killpg, os.kill):
        with contextlib.suppress(OSError):
            end(child, signal.SIGKILL)
    _end_orphans()
    if cut is None and status is not None:
        number = os.WTERMSIG(status)
        told = f"signal {number}" if number else f"status {os.WEXITSTATUS(status)}"
        with contextlib.suppress(OSError):
            os.write(2, (f"\n{token} {told}\n").encode("ascii"))
    os._exit(0)


def _reaped(child: int) -> Optional[int]:
    """Take in all children that have ended; the status of ``child`` if it is one of them."""
    found = None
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except OSError as error:
            return found if error.errno == errno.ECHILD else None
        if pid == 0:
            return found
        found = status if pid == child else found


def _parent_of(pid: int) -> Optional[int]:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return int(file.read().rpartition(")")[2].split()[1])
    except OSError:
        return None


def _end_orphans() -> None:
    """End what the method has started and left behind, where the system says whose it is."""
    for _ in range(20):
        pids = os.listdir("/proc") if os.path.isdir("/proc/self") else []
        left = [int(p) for p in pids if p.isdigit() and _parent_of(int(p)) == os.getpid()]
        for pid in left:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        _reaped(-1)
        if not left:
            return
        _sleep(0.01)


if __name__ == "__main__":
    sys.modules["cpas_worker"] = sys.modules["__main__"]
    main(sys.argv[1])
