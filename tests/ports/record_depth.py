"""Record depth.npz: the depth filling of DPDN in OpenCV's operators, the truth for ours in scipy's.

Needs opencv-python-headless, which the project itself does not.
"""

from pathlib import Path

import cv2
import numpy as np


def square(size):
    return np.ones((size, size), np.uint8)


def cross(size):
    return cv2.getStructuringElement(cv2.MORPH_CROSS, (size, size))


def below_first(x):
    mask = np.ones(x.shape, bool)
    for column in range(x.shape[1]):
        mask[: np.argmax(x[:, column] > 0.01), column] = False
    return mask


def filled(depth):
    x = depth.copy()
    x[depth > 0.01] = 3.0 - x[depth > 0.01]
    inverted = x.copy()
    for band, size in (
        (depth > 2, 3),
        ((depth > 1) & (depth <= 2), 5),
        ((depth > 0.01) & (depth <= 1), 7),
    ):
        wide = cv2.dilate(inverted * band, cross(size))
        x[wide > 0.01] = wide[wide > 0.01]
    x = cv2.morphologyEx(x, cv2.MORPH_CLOSE, square(5))
    valid = x > 0.01
    x[valid] = cv2.medianBlur(x, 5)[valid]
    empty = (x <= 0.01) & below_first(x)
    x[empty] = cv2.dilate(x, square(9))[empty]
    below = below_first(x)
    for _ in range(6):
        empty = (x < 0.01) & below
        x[empty] = cv2.dilate(x, square(5))[empty]
    valid = (x > 0.01) & below
    x[valid] = cv2.medianBlur(x, 5)[valid]
    valid = (x > 0.01) & below
    x[valid] = cv2.bilateralFilter(x, 5, 0.5, 2.0)[valid]
    x[x > 0.01] = 3.0 - x[x > 0.01]
    return x


if __name__ == "__main__":
    random = np.random.RandomState(0)
    v, u = np.mgrid[:60, :80]
    depth = 0.5 + 0.04 * u + 0.1 * np.sin(v / 7) + 0.01 * random.standard_normal((60, 80))
    depth[20:35, 30:50] = 0.8 + 0.004 * v[20:35, 30:50]  # something in front
    depth[random.random_sample((60, 80)) < 0.3] = 0
    depth[:12, 10:40] = depth[40:58, 5:35] = 0  # a hole at the top, and one too large to fill
    depth[:, 70] = 0
    depth = depth.astype(np.float32)
    path = Path(__file__).with_name("recorded") / "depth.npz"
    np.savez_compressed(path, depth=depth, filled=filled(depth))
