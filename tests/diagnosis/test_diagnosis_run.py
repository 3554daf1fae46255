"""The diagnosis at the end of a run: when it runs, what it prints, where it stands."""

import numpy as np
import pytest
import tiny
from harness import RUN
from tables import a_row, a_run

from pytest_cpas.diagnosis.running import diagnose_run, is_far_below
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.golden import RunTable

#: Judge the samples of an adapter that the contract would stop.
ALL = ("-k", "not test_contract")

CAUSE = "your camera frame is OpenGL's, not OpenCV's, and your object frame is NOCS's"


def rows(correct, total, iou=1.0):
    """``correct`` of ``total`` mugs within 1 cm."""
    return [
        a_row(
            sample=f"{i}",
            category="mug",
            position_m=0.01 if i < correct else 0.1,
            rotation_deg=1,
            iou=iou,
            fscore_1cm=None,
        )
        for i in range(total)
    ]


def far_below(rows, expected):
    return is_far_below(RunTable.of(a_run(), rows), expected)


@pytest.mark.parametrize(
    ("correct", "expected", "far"),
    [(4, 0.8, False), (3, 0.8, True), (0, 0.0, False), (3, None, False), (2, None, True)],
)
def test_far_below(correct, expected, far):
    table = {} if expected is None else {("mug", "cpas.10deg_2cm"): expected}
    assert far_below(rows(correct, 10), table) is far


def test_far_below_in_one_category_alone():
    bowls = [
        a_row(
            sample=f"b{i}",
            category="bowl",
            position_m=0.01,
            rotation_deg=1,
            iou=None,
            fscore_1cm=None,
        )
        for i in range(90)
    ]
    assert far_below([*rows(2, 10), *bowls], {})
    assert not far_below([*rows(3, 10), *bowls], {})


@pytest.mark.parametrize(("iou", "far"), [(0.9, False), (0.4, True), (None, False)])
def test_wrong_boxes_are_far_below_too(iou, far):
    assert far_below(rows(10, 10, iou), {}) is far


def test_no_rows_are_not_far_below():
    assert not far_below([], {("mug", "cpas.10deg_2cm"): 1.0})


def test_regression_is_explained_in_terminal_and_junit(recorded, pytester):
    # its contract already says that the camera is another one, and stops there
    judged = ("-k", "not test_contract", "--cpas-require-golden")
    result = recorded("Undeclared", "--junitxml=out.xml", *judged)
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        [
            f"{CAUSE}, not ShapeNet's: with both 100 % of the samples are correct"
            " (12 of 12, before 0; at 10 deg, 2 cm)",
            '  change: camera_frame="opengl" in MethodInfo',
            '  change: object_frame="nocs" in MethodInfo',
        ]
    )
    assert CAUSE in (pytester.path / "out.xml").read_text().replace("&apos;", "'")


def test_missing_table_is_explained_as_well(cpas):
    result = cpas("Undeclared", "-k", "not test_contract", "--cpas-require-golden")
    assert result.ret == 1
    result.stdout.fnmatch_lines([f"*{CAUSE}*"])


def test_the_contract_is_stopped_with_an_explanation(cpas, pytester):
    result = cpas("Undeclared", "--junitxml=out.xml")
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        [
            "the adapter is wrong: perfect on tiny, in_front_of_camera: *",
            "demanded: the object is in front of the camera",
            f"{CAUSE}, not ShapeNet's: with both 100 % of the samples are correct"
            " (12 of 12, before 0; at 10 deg, 2 cm)",
            '  change: camera_frame="opengl" in MethodInfo',
            "0 of 12 samples judged",
        ]
    )
    assert CAUSE in (pytester.path / "out.xml").read_text().replace("&apos;", "'")


@pytest.mark.parametrize("method", ["Perfect", "Biased", "Refuses", "OnlyPose", "OtherFrames"])
def test_sound_methods_are_not_explained(cpas, method):
    result = cpas(method)
    assert result.ret == 0
    result.stdout.no_fnmatch_line("*  change: *")


def test_truth_of_the_data_set_or_of_its_samples():
    class Quick(tiny.Tiny):
        def truth(self, ref):
            return tiny.truth(int(ref.id.split("/")[1]))

    found = []
    for dataset in (tiny.Tiny(None), Quick(None)):
        run = MethodRun(tiny.Undeclared(), dataset)
        judged = [run.judge(ref) for ref in run.samples]
        (finding,) = diagnose_run(run, judged, RunTable.of(run, judged), {})
        found.append(finding.lines())
    assert found[0] == found[1]


@pytest.fixture
def rewritten(test_data, pytester):
    """Judge the stored predictions of 100 frames after a change of poses and extents."""

    def run(change):
        with np.load(test_data / "predictions" / "dualposenet_real275.npz") as archive:
            arrays = dict(archive)
        frames = np.arange(0, len(arrays["frame"]), len(arrays["frame"]) // 100)
        part = {"frame": arrays["frame"][frames]}
        for side in ("gt", "pred"):
            offset = arrays[f"{side}_offset"]
            chosen = [np.arange(offset[i], offset[i + 1]) for i in frames]
            part[f"{side}_offset"] = np.cumsum([0, *map(len, chosen)])
            kept = np.concatenate(chosen)
            for key, array in arrays.items():
                if key.startswith(side) and not key.endswith("offset"):
                    part[key] = array[kept]
        change(part)
        np.savez(pytester.path / "rewritten.npz", **part)
        return pytester.runpytest_inprocess(*RUN, "--cpas-predictions=rewritten.npz")

    return run


def test_stored_predictions_in_another_object_frame(rewritten):
    def change(arrays):
        x, y, z = np.moveaxis(arrays["pred_RTs"][:, :3, :3], 2, 0)  # NOCS's axes in the camera
        arrays["pred_RTs"][:, :3, :3] = np.stack([z, y, -x], axis=2)  # ShapeNet's
        arrays["pred_scales"] = arrays["pred_scales"][:, [2, 1, 0]]

    sound = rewritten(lambda arrays: None)
    sound.stdout.no_fnmatch_line("*  change: *")
    line = next(line for line in sound.outlines if line.startswith("all "))
    correct, total = line.split()[1].split("/")
    result = rewritten(change)
    result.stdout.fnmatch_lines(
        [
            "your object frame is ShapeNet's, not NOCS's: with that one rotation *"
            f"({correct} of {total}, before *; at 10 deg, 2 cm)",
            "  change where the file is written: rotation = rotation @ np.array(*;"
            " extents = extents[[][[]2, 1, 0]]",
        ]
    )


def test_stored_predictions_in_millimetres(rewritten):
    def change(arrays):
        arrays["pred_RTs"][:, :3, 3] *= 1000

    rewritten(change).stdout.fnmatch_lines(
        [
            "your translation is in millimetres, not in metres*",
            "  change where the file is written: translation = translation / 1000",
        ]
    )


def test_stored_sizes_in_metres_beside_a_scale(rewritten):
    """The commonest mistake of the form, whose sizes are relative to the scale of the pose."""

    def change(arrays):
        scales = np.cbrt(np.linalg.det(arrays["pred_RTs"][:, :3, :3]))
        arrays["pred_scales"] = arrays["pred_scales"] * scales[:, None]

    rewritten(change).stdout.fnmatch_lines(
        ["your extents are multiplied by the diagonal of the box once more, as sizes in metres*"]
    )
