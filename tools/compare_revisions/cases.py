"""What is run with both revisions."""

#: Methods of the cases; every one is wrong in a way of its own.
ADAPTERS = '''\
from dataclasses import replace

import numpy as np
from method_adapters.icp import Icp
from pytest_cpas.types import Prediction


class Turned(Icp):
    """Five degrees off, and no answer for laptops."""

    turn = np.array([[1, 0, 0], [0, 0.99619470, -0.08715574], [0, 0.08715574, 0.99619470]])
    unknown = "laptop"

    def predict(self, batch, seed):
        predictions = super().predict(batch, seed)
        return [self.spoil(o.category, p) for o, p in zip(batch, predictions, strict=True)]

    def spoil(self, category, prediction):
        if category == self.unknown:
            return Prediction.failed("no lid")
        turned = [replace(h, rotation=h.rotation @ self.turn) for h in prediction.hypotheses]
        return replace(prediction, hypotheses=tuple(turned))


class OtherAxes(Turned):
    """The object axes of NOCS, undeclared."""

    turn = np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])
    unknown = None


class Raises(Icp):
    def predict(self, batch, seed):
        raise RuntimeError("the network exploded")
'''

ICP = "pytest --cpas-method icp --cpas-dataset synthetic-handheld"
OWN = "pytest --cpas-dataset synthetic-handheld --cpas-method"
MINE = f"{OWN} my_method:MyMethod"
REPORT = "--cpas-report report --junitxml junit.xml"

#: The commands of each case, run one after the other in a folder of its own that holds
#: ``adapters.py``. DATA stands for the folder of ``--data``.
CASES: dict[str, tuple[str, ...]] = {
    "icp": (
        f"{ICP} --cpas-dataset synthetic-tabletop -n 2 --cpas-require-golden --cpas-results out"
        f" {REPORT}",
    ),
    "resume": (
        f"{ICP} --cpas-limit 12 -v --cpas-results out {REPORT}",
        f"{ICP} --cpas-limit 12 -v --cpas-results out --cpas-report again --junitxml again.xml",
        "pytest-cpas report out/icp-synthetic-handheld.jsonl --to stored"
        " --against report/report.json --cpas-dataset synthetic-handheld",
        "pytest-cpas report report/report.json --to anew",
    ),
    "shards": (
        *(f"{ICP} --cpas-limit 6 -q --cpas-results out --cpas-shard {i}/3" for i in (1, 2, 3)),
        "pytest-cpas merge out/icp-synthetic-handheld-1-of-3.jsonl"
        " out/icp-synthetic-handheld-2-of-3.jsonl",
        "pytest-cpas merge out/icp-synthetic-handheld-1-of-3.jsonl"
        " out/icp-synthetic-handheld-2-of-3.jsonl out/icp-synthetic-handheld-3-of-3.jsonl"
        f" --cpas-require-golden {REPORT}",
    ),
    "robustness": (f"{ICP} --cpas-profile robustness --cpas-category mug --cpas-limit 4 {REPORT}",),
    "regressed": (
        f"{OWN} adapters:Turned --cpas-limit 12 --cpas-results out {REPORT}",
        f"{OWN} adapters:OtherAxes --cpas-limit 24 -k 'not test_contract' --cpas-report axes"
        " --junitxml axes.xml",
        f"{OWN} adapters:OtherAxes --cpas-limit 24 --cpas-report stopped --junitxml stopped.xml",
        f"{OWN} adapters:Raises --cpas-limit 2 --cpas-report raises --junitxml raises.xml",
        f"{OWN} adapters:Raises --cpas-limit 2 -k 'not test_contract' --tb line"
        " --cpas-results raised",
    ),
    "new-adapter": (
        "pytest-cpas new-adapter my-method",
        f"{MINE} --cpas-limit 24 {REPORT}",
        "pytest test_my_method.py",
        "sed -i 's|(low + high) / 2|500 * (low + high)|' my_method.py",
        f"{MINE} --cpas-limit 24 --cpas-report broken --junitxml broken.xml",
    ),
    "snapshot": (
        f"{ICP} --cpas-category mug --cpas-golden golden --snapshot-update",
        "pytest-cpas new-adapter my-method",
        f"{MINE} --cpas-golden golden --cpas-limit 24 --snapshot-update",
        f"{MINE} --cpas-golden golden --cpas-category mug --snapshot-update",
        f"{MINE} --cpas-golden golden --cpas-granularity scene --cpas-jitter 2 --snapshot-update",
        f"{MINE} --cpas-golden golden --cpas-granularity scene --cpas-jitter 2"
        f" --cpas-require-golden {REPORT}",
        f"{MINE} --cpas-golden golden --cpas-granularity dataset --cpas-seed 1",
        "sed -i 's/^mug,/bowl,/' golden/recorded/my-method/synthetic-handheld/facts.csv",
        f"{MINE} --cpas-golden golden --cpas-granularity dataset",
    ),
    "metrics": (
        "pytest --cpas-metrics cpas --cpas-metrics trimesh --cpas-metrics-report matrix.json"
        " --cpas-metrics-report matrix.md --junitxml junit.xml",
    ),
    "check-synthetic": (
        "pytest --cpas-check-dataset synthetic-tabletop --cpas-limit 20 --cpas-pictures pictures"
        " --junitxml junit.xml",
    ),
    "list": (
        "pytest --cpas-list",
        "pytest --help",
        "pytest-cpas --help",
        "pytest-cpas merge --help",
        "pytest-cpas report --help",
    ),
    "mistakes": (
        "pytest --cpas-method icq --cpas-dataset synthetic-handheld",
        "pytest --cpas-method adapters:Absent --cpas-dataset synthetic-handheld",
        "pytest --cpas-method sgpa --cpas-dataset synthetic-handheld",
        "pytest --cpas-method icp --cpas-dataset real275",
        "pytest --cpas-method icp --cpas-dataset real275 --cpas-data nowhere",
        "pytest --cpas-method icp",
        f"{ICP} --cpas-shard 5/3",
        f"{ICP} --cpas-limit 0",
        f"{ICP} --cpas-category spoon",
        "pytest --cpas-report report",
        "pytest --cpas-predictions absent.npz",
        "pytest --cpas-metrics absent",
        "pytest --cpas-check-dataset absent",
        "pytest-cpas merge absent.jsonl",
        "pytest-cpas report absent.json --to report",
        "pytest-cpas new-adapter icp",
        "pytest-cpas fetch absent --to there",
    ),
    "predictions": (
        "pytest --cpas-predictions DATA/predictions/dualposenet_real275.npz"
        f" --cpas-granularity dataset {REPORT}",
        "pytest --cpas-predictions DATA/predictions/dualposenet_real275 --cpas-report few"
        " --junitxml few.xml --cpas-results out",
    ),
    "check-real": (
        "pytest --cpas-check-dataset real275 --cpas-check-dataset redwood75 --cpas-data=DATA"
        " --cpas-pictures pictures --junitxml junit.xml",
    ),
    "real": (f"pytest --cpas-method icp --cpas-dataset real275 --cpas-data=DATA {REPORT}",),
    "sdfest": (
        "ln -s DATA/weights/sdfest_v1 sdfest",
        f"{OWN} sdfest --cpas-weights . --cpas-limit 2 -k 'not test_contract' {REPORT}",
    ),
}
