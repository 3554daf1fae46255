"""The compiled operators of PointNet++ that published codes load, which need CUDA, as plain numpy:
what each thread of a kernel does, and nothing of ours."""

import numpy as np
import torch


def squared(a, b):
    """(N,) squared distances of (3,) and (N, 3), float32, summed in the kernels' order."""
    d = a - b
    return (d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1]) + d[:, 2] * d[:, 2]


def farthest(xyz, count, max_threads, skip_radius_squared=None):
    """Of (N, 3), ``count`` indices: every thread keeps its best, then halves of them meet."""
    n = len(xyz)
    threads = min(2 ** int(np.log2(n)), max_threads)
    rounds = -(-n // threads)
    left_out = np.zeros(n, bool)
    if skip_radius_squared is not None:
        left_out = squared(np.zeros(3, np.float32), xyz).astype(float) <= skip_radius_squared
    running, chosen = np.full(n, 1e10, np.float32), [0]
    for _ in range(count - 1):
        running = np.minimum(running, squared(xyz[chosen[-1]], xyz))
        seen = np.full(rounds * threads, -1.0, np.float32)
        seen[:n] = np.where(left_out, -1.0, running)
        seen = seen.reshape(rounds, threads)
        best = seen.max(axis=0)
        # the first of its points, and 0 for a thread that saw none
        where = np.where(best > -1, seen.argmax(axis=0) * threads + np.arange(threads), 0)
        while len(best) > 1:
            half = len(best) // 2
            other = best[half:] > best[:half]
            best = np.where(other, best[half:], best[:half])
            where = np.where(other, where[half:], where[:half])
        chosen.append(int(where[0]))
    return chosen


def ball(centres, xyz, radius, count):
    """(M, ``count``): the first points within a radius, the first of them in places left."""
    limit = np.float32(radius) * np.float32(radius)
    found = np.zeros((len(centres), count), np.int32)
    for row, centre in zip(found, centres, strict=True):
        inside = np.flatnonzero(squared(centre, xyz) < limit)[:count]
        if len(inside):
            row[:] = inside[0]
            row[: len(inside)] = inside
    return found


def three_nearest(unknown, known):
    """(N, 3) squared distances and indices, ascending, the earlier of two that are as near."""
    near = np.empty((len(unknown), 3), np.float32), np.empty((len(unknown), 3), np.int32)
    for row, point in enumerate(unknown):
        distances = squared(point, known)
        order = np.argsort(distances, kind="stable")[:3]
        near[0][row], near[1][row] = distances[order], order
    return near


def stacked(function, *batches):
    """Of each of a batch, as a tensor."""
    made = [function(*each) for each in zip(*(b.numpy() for b in batches), strict=True)]
    return torch.from_numpy(np.stack(made))


class Functions:
    """As the module ``_C`` of DPDN has them."""

    @staticmethod
    def furthest_point_sampling(xyz, count):
        return stacked(lambda x: np.array(farthest(x, count, 512, 1e-3), np.int32), xyz)

    @staticmethod
    def gather_points(features, index):
        return stacked(lambda x, i: x[:, i], features, index)

    group_points = gather_points

    @staticmethod
    def ball_query(centres, xyz, radius, count):
        return stacked(lambda c, x: ball(c, x, radius, count), centres, xyz)

    @staticmethod
    def three_nn(unknown, known):
        return tuple(
            stacked(lambda u, k, part=part: three_nearest(u, k)[part], unknown, known)
            for part in range(2)
        )

    @staticmethod
    def three_interpolate(features, index, weight):
        def one(x, i, w):
            return x[:, i[:, 0]] * w[:, 0] + x[:, i[:, 1]] * w[:, 1] + x[:, i[:, 2]] * w[:, 2]

        return stacked(one, features, index, weight)


class Wrappers:
    """As the extension of SGPA and iCaps has them: sizes first, results into the last argument."""

    @staticmethod
    def furthest_point_sampling_wrapper(b, n, count, xyz, running, chosen):
        chosen.copy_(stacked(lambda x: np.array(farthest(x, count, 1024), np.int32), xyz))

    @staticmethod
    def gather_points_wrapper(b, c, n, count, features, index, out):
        out.copy_(Functions.gather_points(features, index))

    @staticmethod
    def group_points_wrapper(b, c, n, centres, count, features, index, out):
        out.copy_(Functions.gather_points(features, index))

    @staticmethod
    def ball_query_wrapper(b, n, centres_count, radius, count, centres, xyz, out):
        out.copy_(Functions.ball_query(centres, xyz, radius, count))

    @staticmethod
    def three_nn_wrapper(b, n, m, unknown, known, distances, index):
        near = Functions.three_nn(unknown, known)
        distances.copy_(near[0])
        index.copy_(near[1])

    @staticmethod
    def three_interpolate_wrapper(b, c, m, n, features, index, weight, out):
        out.copy_(Functions.three_interpolate(features, index, weight))
