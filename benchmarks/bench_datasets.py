"""List and read a tree of REAL275's size: time against plain decoding, and memory.

    OMP_NUM_THREADS=1 python benchmarks/bench_datasets.py [--full] [DIR]

DIR: a copy of REAL275, of which one whole frame is taken; without it, the embedded data set's
first frame. The frame is laid out 3224 times (16118 objects). Listing from a warm index must take
less than 1 s, reading an object, amortised over its frame, less than 15 ms, and a pass over all
objects (--full; else over 40 frames) less than 1 GiB.
"""

from __future__ import annotations

import os
import pickle
import resource
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

import numpy as np
from PIL import Image

from pytest_cpas.datasets import _index
from pytest_cpas.datasets.nocs import NocsTree, Real275
from pytest_cpas.datasets.synthetic import SyntheticTabletop

OBJECTS, MEASURED = 16118, 40
IMAGES = ("color", "depth", "mask")


def whole_frame(source: NocsTree) -> tuple[str, list[str]]:
    """The frame with most objects, as scene/number, and the lines of its objects."""
    frames: dict[str, int] = {}
    for ref in source.samples:
        frame = ref.id.rsplit("/", 1)[0]
        frames[frame] = frames.get(frame, 0) + 1
    best = max(frames, key=lambda frame: frames[frame])
    lines = (source.root / f"real_test/{best}_meta.txt").read_text().splitlines()
    return best, [line for line in lines if line.split()[1] != "0"]


def lay_out(source: NocsTree, root: Path) -> int:
    """Repeat a frame until there are OBJECTS objects; images are linked. How many it has."""
    frame, lines = whole_frame(source)
    for name in ("obj_models", "fixed_real_test_obj_models"):
        if (source.root / name).is_dir():
            shutil.copytree(source.root / name, root / name)
    first = source.root / f"real_test/{frame}"
    scene, number = frame.split("/")
    truth = source.root / f"gts/real_test/results_real_test_{scene}_{number}.pkl"
    poses = truth.read_bytes()
    (root / "gts/real_test").mkdir(parents=True)
    for kind in IMAGES:
        shutil.copy(first.with_name(f"{number}_{kind}.png"), root / f"{kind}.png")
    left, index = OBJECTS, 0
    while left:
        folder = root / f"real_test/scene_{index // 540 + 1}"
        folder.mkdir(parents=True, exist_ok=True)
        stem = f"{index % 540:04d}"
        for kind in IMAGES:
            os.link(root / f"{kind}.png", folder / f"{stem}_{kind}.png")
        chosen = lines[: min(left, len(lines))]
        (folder / f"{stem}_meta.txt").write_text("\n".join(chosen) + "\n")
        name = f"results_real_test_{folder.name}_{stem}.pkl"
        (root / "gts/real_test" / name).write_bytes(poses)
        left -= len(chosen)
        index += 1
    return len(lines)


def seconds(function: Callable[[], object], times: int = 1) -> float:
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        function()
        taken.append(time.perf_counter() - began)
    return statistics.median(taken)


def frames_of(root: Path) -> list[Path]:
    files = islice(sorted((root / "real_test").glob("*/*_color.png")), MEASURED)
    return [file.with_name(file.name.removesuffix("_color.png")) for file in files]


def plain_pillow(root: Path) -> None:
    """Decode the same images and poses once per frame, to the same types, checking nothing."""
    for stem in frames_of(root):
        colour, depth, mask = (
            np.asarray(Image.open(stem.with_name(f"{stem.name}_{kind}.png"))) for kind in IMAGES
        )
        colour.astype(np.float32) / np.float32(255)
        depth.astype(np.float32) / np.float32(1000)
        assert len([mask == mask_id for mask_id in range(1, 6)]) == 5
        name = f"results_real_test_{stem.parent.name}_{stem.name}.pkl"
        pickle.loads((root / "gts/real_test" / name).read_bytes())


def plain_opencv(root: Path) -> None:
    import cv2

    for stem in frames_of(root):
        colour, depth, mask = (
            cv2.imread(str(stem.with_name(f"{stem.name}_{kind}.png")), cv2.IMREAD_UNCHANGED)
            for kind in IMAGES
        )
        colour[:, :, ::-1].astype(np.float32) / np.float32(255)
        depth.astype(np.float32) / np.float32(1000)
        assert len([mask == mask_id for mask_id in range(1, 6)]) == 5


def main() -> None:
    arguments = [a for a in sys.argv[1:] if a != "--full"]
    source = Real275(Path(arguments[0])) if arguments else SyntheticTabletop(None)
    _index.SETTLED = -60.0  # the tree is ours: nobody writes to it any more
    with tempfile.TemporaryDirectory() as folder:
        os.environ["CPAS_CACHE"] = f"{folder}/cache"
        root = Path(folder) / "tree"
        root.mkdir()
        per_frame = lay_out(source, root)
        cold = seconds(lambda: Real275(root))
        warm = seconds(lambda: Real275(root), 5)
        data = Real275(root)
        assert len(data.samples) == OBJECTS
        print(f"list {OBJECTS} samples: cold {cold:.2f} s, warm {warm:.3f} s (must be < 1 s)")

        measured = data.samples[: MEASURED * per_frame]
        for ref in data.samples[:per_frame]:
            data.load(ref)  # meshes are read once, of 36 in the whole data set

        def read() -> None:
            for ref in measured:
                data.load(ref)

        ours = seconds(read, 3) / len(measured)
        print(f"read an object: {1000 * ours:.2f} ms (must be < 15 ms), {per_frame} a frame")
        peers = {"pillow": plain_pillow}
        if find_spec("cv2"):
            peers["opencv"] = plain_opencv
        for name, peer in peers.items():
            plain = seconds(lambda peer=peer: peer(root), 3) / len(measured)
            print(f"  plain {name}: {1000 * plain:.2f} ms, ours {ours / plain:.2f} times as long")
        if "--full" in sys.argv:
            taken = seconds(lambda: [data.load(ref) and None for ref in data.samples])
            print(f"a pass over {OBJECTS} samples: {taken:.0f} s")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"peak memory: {peak:.0f} MiB (must be < 1024)")
        if warm >= 1 or ours >= 0.015 or peak >= 1024:
            sys.exit("a limit is exceeded")


if __name__ == "__main__":
    main()
