import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="no torch: pip install 'pytest-cpas[torch]'")
pointnet2 = pytest.importorskip("method_adapters._networks.pointnet2")

# as they are before a fault is planted
ball_query, farthest_points = pointnet2.ball_query, pointnet2.farthest_points
three_nearest, tie_order = pointnet2.three_nearest, pointnet2.tie_order
gather, interpolate = pointnet2.gather, pointnet2.interpolate
squared_distances = pointnet2.squared_distances

KERNELS = {
    "sgpa": {"max_threads": 1024},
    "dpdn": {"max_threads": 512, "skip_radius_squared": 1e-3},
}


@pytest.mark.parametrize("cloud", ["small", "tiny", "cam"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_same_indices_as_the_kernels(shared_ports, kernel, cloud):
    with np.load(shared_ports / "parity" / "pointnet2_ops.npz") as file:
        data = dict(file)
    xyz = torch.from_numpy(data[f"input__{kernel}_{cloud}_xyz"])
    chosen = farthest_points(xyz, int(data["input__fps_npoint"]), **KERNELS[kernel])
    centres = gather(xyz.mT, chosen).mT
    radius, count = float(data["input__ball_radius"]), int(data["input__ball_nsample"])
    ball = ball_query(squared_distances(centres, xyz), radius, count)
    squared, nearest = three_nearest(xyz, centres)
    for name, ours in (("fps", chosen), ("ball", ball), ("nn3_idx", nearest), ("nn3_d2", squared)):
        np.testing.assert_array_equal(ours.numpy(), data[f"output__{kernel}_{cloud}_{name}"])


def simulated_farthest_points(xyz, count, max_threads, skip_radius_squared=None):
    """The kernel, thread by thread."""
    n = len(xyz)
    threads = min(2 ** int(np.log2(n)), max_threads)
    running = np.full(n, np.inf, np.float32)
    chosen = [0]
    for _ in range(count - 1):
        best, where = [-1.0] * threads, [0] * threads
        for thread in range(threads):
            for k in range(thread, n, threads):
                point = xyz[k]
                norm = np.float32(point[0] * point[0] + point[1] * point[1]) + point[2] * point[2]
                if skip_radius_squared is not None and float(norm) <= skip_radius_squared:
                    continue
                d = point - xyz[chosen[-1]]
                distance = np.float32(d[0] * d[0] + d[1] * d[1]) + d[2] * d[2]
                running[k] = min(running[k], distance)
                if running[k] > best[thread]:
                    best[thread], where[thread] = running[k], k
        step = threads // 2
        while step:
            for thread in range(step):
                if best[thread + step] > best[thread]:
                    best[thread], where[thread] = best[thread + step], where[thread + step]
            step //= 2
        chosen.append(where[0])
    return chosen


def clouds_with_ties():
    random = np.random.RandomState(0)
    for n, threads in ((32, 32), (33, 16), (50, 8), (77, 512)):
        cloud = random.randint(-2, 3, (n, 3)).astype(np.float32)  # a grid: ties everywhere
        yield cloud * np.float32(0.05), threads
        cloud = random.standard_normal((n, 3)).astype(np.float32) * np.float32(0.03)
        cloud[n // 2 :] = cloud[: n - n // 2]
        yield cloud, threads


def check_farthest_points():
    for cloud, threads in clouds_with_ties():
        for skip in (None, 1e-3, 0.006):
            expected = simulated_farthest_points(cloud, 24, threads, skip)
            ours = pointnet2.farthest_points(
                torch.from_numpy(cloud)[None], 24, max_threads=threads, skip_radius_squared=skip
            )
            assert ours[0].tolist() == expected


def check_neighbours():
    random = np.random.RandomState(1)
    xyz = random.randint(0, 6, (2, 60, 3)).astype(np.float32) * np.float32(0.25)
    centres = np.concatenate([xyz[:, ::7], np.full((2, 1, 3), 9, np.float32)], 1)
    squared = squared_distances(torch.from_numpy(centres), torch.from_numpy(xyz))
    ball = pointnet2.ball_query(squared, 0.5, 8).numpy()
    nearest_squared, nearest = pointnet2.three_nearest(
        torch.from_numpy(xyz), torch.from_numpy(centres)
    )
    for b in range(2):
        for i, centre in enumerate(centres[b]):
            inside = [k for k in range(60) if np.sum((xyz[b, k] - centre) ** 2) < 0.25][:8]
            first = inside[0] if inside else 0
            assert ball[b, i].tolist() == inside + [first] * (8 - len(inside))
        for k, point in enumerate(xyz[b]):
            distance = np.sum((centres[b] - point) ** 2, axis=1)
            expected = np.argsort(distance, kind="stable")[:3]
            assert nearest[b, k].tolist() == expected.tolist()
            assert nearest_squared[b, k].tolist() == distance[expected].tolist()


def test_farthest_points_as_the_kernel_simulated():
    check_farthest_points()


def test_no_point_far_enough_from_the_origin():
    cloud = torch.full((1, 40, 3), 0.01)
    ours = farthest_points(cloud, 8, max_threads=512, skip_radius_squared=1e-3)
    assert ours.tolist() == [[0] * 8]


def test_more_samples_than_points_repeat():
    cloud = torch.rand((1, 10, 3), generator=torch.Generator().manual_seed(0))
    ours = farthest_points(cloud, 16, max_threads=512)[0].tolist()
    assert sorted(ours[:10]) == list(range(10))
    assert ours == simulated_farthest_points(cloud[0].numpy(), 16, 512)


def test_neighbours_by_brute_force():
    check_neighbours()


def test_interpolation_is_exact_at_known_points_and_weighted_between():
    known = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [0, 4, 0]]])
    features = torch.tensor([[[1.0, 10, 100]]])
    unknown = torch.tensor([[[3.0, 0, 0], [0, 0, 0], [1, 0, 0]]])
    ours = interpolate(features, *three_nearest(unknown, known))
    weight = np.array([1, 1 / 2, 1 / np.sqrt(17)])
    between = weight @ [1, 10, 100] / weight.sum()
    np.testing.assert_allclose(ours[0, 0], [10, 1, between], rtol=1e-5)


def test_batches_do_not_mix():
    random = np.random.RandomState(3)
    clouds = torch.from_numpy(random.standard_normal((3, 200, 3)).astype(np.float32))
    together = farthest_points(clouds, 50, max_threads=512)
    for i in range(3):
        alone = farthest_points(clouds[i : i + 1], 50, max_threads=512)
        assert torch.equal(together[i : i + 1], alone)


FAULTS = {
    "first maximum in memory order": (
        check_farthest_points,
        "tie_order",
        lambda n, max_threads, device: torch.arange(n),
    ),
    "tree of twice as many threads": (
        check_farthest_points,
        "tie_order",
        lambda n, max_threads, device: tie_order(n, 2 * max_threads, device),
    ),
    "points near the origin are candidates": (
        check_farthest_points,
        "farthest_points",
        lambda xyz, count, max_threads, skip_radius_squared: farthest_points(
            xyz, count, max_threads=max_threads
        ),
    ),
    "last neighbours, descending": (
        check_neighbours,
        "ball_query",
        lambda distances, radius, count: (
            distances.shape[-1] - 1 - ball_query(distances.flip(-1), radius, count)
        ),
    ),
    "a point on the sphere is inside": (
        check_neighbours,
        "ball_query",
        lambda distances, radius, count: ball_query(distances, radius * 1.0001, count),
    ),
    "of equally near points the last": (
        check_neighbours,
        "three_nearest",
        lambda unknown, known: (
            three_nearest(unknown, known)[0],
            known.shape[1] - 1 - three_nearest(unknown, known.flip(1))[1],
        ),
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_fault_is_found(monkeypatch, fault):
    check, operator, replacement = FAULTS[fault]
    monkeypatch.setattr(pointnet2, operator, replacement)
    with pytest.raises(AssertionError):
        check()
