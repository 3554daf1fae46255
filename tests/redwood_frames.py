"""Frames of REDWOOD75 in their published layout, rendered from its own meshes.

``python tests/redwood_frames.py SOURCE TARGET`` takes the published annotations and meshes in the
folder SOURCE and makes TARGET a folder for ``--cpas-data`` with all 75 frames: exact depth,
rounded to millimetres, a wall at 2.5 m, nothing in front of the object. TARGET's files besides the
frames are links.
"""

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from pytest_cpas.datasets.redwood import REDWOOD_CAMERA, Redwood75
from pytest_cpas.datasets.rendering import render

WALL_MM = 2500


def write_images(
    root: Path, category: str, sequence: str, pose: dict, instance: np.ndarray, depth_mm: np.ndarray
) -> None:
    """Write an annotated pose's images; ``instance`` (H, W): 0 = the object, else not."""
    folder = root / category / "rgbd" / sequence
    colour = np.where(instance[..., None] == 0, [200, 40, 40], [30, 90, 30]).astype(np.uint8)
    images = {
        folder / "rgb" / pose["rgb_file"]: Image.fromarray(colour),
        folder / "depth" / pose["depth_file"]: Image.fromarray(depth_mm.astype(np.uint16)),
    }
    for path, image in images.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        image.save(path, quality=95)


def write_all(source: Path, target: Path) -> None:
    """As the module's docstring says."""
    root = target / "redwood75"
    root.mkdir(parents=True, exist_ok=True)
    for file in source.resolve().iterdir():
        (root / file.name).symlink_to(file)
    annotations = json.loads((source / "annotations.json").read_text())
    data = Redwood75(source)
    for ref in data.samples:
        truth = data.truth(ref)
        seen = render([(truth.surface, truth.pose)], REDWOOD_CAMERA)
        depth_mm = np.where(seen.instance < 0, WALL_MM, np.round(1000 * seen.depth))
        sequence, index = ref.id.split("/")
        pose = annotations[sequence]["pose_anns"][int(index)]
        write_images(root, ref.category, sequence, pose, seen.instance, depth_mm)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    write_all(Path(sys.argv[1]), Path(sys.argv[2]))
