"""``--cpas-batch``: items stay one per sample, and what is judged does not depend on it."""

import pytest
from harness import unfolded

from pytest_cpas.evaluation import read_results

METHODS = """

class Several(Perfect):
    info = replace(Perfect.info, batch=4)

    def predict(self, batch, seed):
        with open(chr(46) + chr(97), "a") as file:  # a hidden file, which no text names
            file.write(f"{len(batch)}\\n")
        return super().predict(batch, seed)


class Silent(Perfect):
    info = replace(Perfect.info, batch=4)


class TooMany(Several):
    def predict(self, batch, seed):
        if len(batch) > 2:
            raise ValueError("so many?")
        return super().predict(batch, seed)


class Killed(Several):
    def answer(self, index):
        if index == 6:
            os.kill(os.getpid(), 9)
        return super().answer(index)


class Hangs(Several):
    def answer(self, index):
        import time

        time.sleep(60 if index == 6 else 0)
        return super().answer(index)
"""


@pytest.fixture
def judged(cpas, pytester):
    """Judges one of the methods, without its contract; what was told, and how many were asked for
    at once."""
    with (pytester.path / "tiny.py").open("a") as file:
        file.write(METHODS)
    asked = pytester.path / ".a"

    def run(method, *args, golden="MATCHES"):
        asked.write_text("")
        result = cpas(method, "-k", "not contract", *args)
        if golden:
            unfolded(result).fnmatch_lines([f"golden: {golden}*"])
        return result, sorted(int(count) for count in asked.read_text().split())

    assert cpas("Several", "--snapshot-update", "--cpas-batch=1").ret == 0
    return run


def rows_in(folder):
    [path] = folder.glob("*.jsonl")
    return read_results(path).rows


WAYS = [
    ((), [4, 4, 4]),
    (("--cpas-batch=1",), [1] * 12),
    (("--cpas-batch=5",), [2, 5, 5]),
    (("--cpas-batch=100",), [12]),
    (("-n2",), [4, 4, 4]),
    (("-n2", "--cpas-batch=100"), [6, 6]),
    (("-n2", "--dist=loadfile"), [4, 4, 4]),
    (("--cpas-granularity=scene",), [4, 4, 4]),
    (("--cpas-granularity=dataset", "--cpas-batch=5"), [2, 5, 5]),
    (("--cpas-granularity=scene", "--cpas-batch=3", "-n2"), [1, 1, 1, 3, 3, 3]),
    (("-p", "no:randomly", "--cpas-shard=1/2", "--cpas-batch=4"), [2, 4]),
]


@pytest.mark.parametrize(("how", "expected"), WAYS, ids=lambda value: " ".join(map(str, value)))
def test_batches_change_nothing_that_is_judged(judged, pytester, how, expected):
    word = "NOT CHECKED" if "--cpas-shard=1/2" in how else "MATCHES"
    result, asked = judged("Several", *how, golden=word)
    assert asked == expected
    assert result.parseoutcomes().get("failed", 0) == 0


@pytest.mark.parametrize("batch", [1, 3, 16])
def test_rows_are_the_same_and_resumed_half_way(judged, pytester, batch):
    judged("Silent", "--cpas-batch=1", "--cpas-results=alone")
    judged("Silent", f"--cpas-batch={batch}", "--cpas-results=whole")
    alone = rows_in(pytester.path / "alone")
    assert rows_in(pytester.path / "whole") == alone
    [path] = (pytester.path / "alone").glob("*.jsonl")
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[: len(lines) // 2]))
    result, _ = judged("Silent", f"--cpas-batch={batch}", "--cpas-results=alone")
    unfolded(result).fnmatch_lines(["rows: computed *, reused * from*"])
    assert rows_in(pytester.path / "alone") == alone
    judged("Silent", f"--cpas-batch={batch}", "-n2", "--cpas-results=two")
    assert rows_in(pytester.path / "two") == alone


@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
def test_batches_that_raise_are_told_of_and_judged_one_by_one(judged, how):
    result, asked = judged("TooMany", *how)
    assert asked == [1] * 12
    unfolded(result).fnmatch_lines(
        ["*4 samples at once: ValueError: so many?; each was asked for alone then*"]
    )


def test_a_worker_that_dies_in_a_batch_does_not_take_all_of_it_along(judged):
    result, _ = judged("Killed", "-n2", "--cpas-granularity=sample", golden="")
    assert result.ret == 1
    # in each of the first two workers an item is taken for it; then each is asked for alone
    assert 2 <= result.parseoutcomes()["failed"] <= 3
    unfolded(result).fnmatch_lines(["*crashed while running*scene_1/0004*"])
    unfolded(result).fnmatch_lines(["*crashed while running*scene_1/0006*"])


def test_a_limit_of_time_is_about_one_sample(judged):
    result, asked = judged("Hangs", "-n2", "--cpas-timeout=3", golden="")
    assert set(asked) == {1}
    unfolded(result).fnmatch_lines(["*scene_1/0006*"])
