"""Files of predictions in the forms that can be written, out of any that can be read."""

from __future__ import annotations

import os
import pickle
import re
import secrets
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas._files import replaced, write_file, write_through
from pytest_cpas.datasets.bop import object_number
from pytest_cpas.submissions import bop_csv, nocs
from pytest_cpas.submissions.answers import (
    box_at,
    failures,
    hypothesis,
    in_half_precision,
    order,
    score_at,
)
from pytest_cpas.submissions.frames import Answers, Image, Submission
from pytest_cpas.submissions.jsonl import Given, Header, answer_line
from pytest_cpas.submissions.pairing import Pairing
from pytest_cpas.types import (
    CATEGORIES,
    AnswerError,
    Array,
    DataError,
    Dataset,
    Hypothesis,
    MethodInfo,
    Prediction,
)
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET, to_standard

__all__ = ["UNWRITTEN", "write_submission"]

#: What files are called that somebody might ask for.
UNWRITTEN = {".json", ".pkl", ".pickle", ".npy", ".txt", ".zip", ".gz", ".yaml", ".h5"}


def write_submission(
    submission: Submission, target: Path, *, dataset: Dataset | None = None, force: bool = False
) -> list[str]:
    """Write a submission, as a whole or not at all; returns what is lost, a line each.

    Its form is that of the name: JSON lines (``.jsonl``), NOCS's arrays (``.npz``), BOP's table
    (``.csv``), else a folder of NOCS's pickles. ``dataset``: in whose axes NOCS's and BOP's forms
    are, None for NOCS's. ``force``: also over what is there. Raises :class:`DataError` for what the
    form cannot say, or what is in the way.
    """
    there = os.path.lexists(target)
    if there and not force:
        raise DataError(f"{target}: it is there already; name another, or pass --force")
    if target.suffix in UNWRITTEN:
        raise DataError(
            f"{target}: this form is not written; name a .jsonl, an .npz, a .csv, or a folder"
        )
    if target.is_dir() is not (target.suffix not in (".jsonl", ".npz", ".csv")) and there:
        raise DataError(f"{target}: a file would take the place of a folder, or a folder of a file")
    lost: Counter[str] = Counter()
    submission = _named(submission, dataset)
    if dataset is None and any(name.startswith("class_") for name in submission.classes):
        lost["what classes are called, which --dataset NAME knows"] = 1
    if target.suffix == ".jsonl":
        with replaced(target) as file:
            for line in _json_lines(submission, lost):
                file.write(line.encode() + b"\n")
    elif target.suffix == ".csv":
        write_file(target, "\n".join([bop_csv.HEADER, *_bop(submission, dataset, lost)]) + "\n")
    elif target.suffix == ".npz":
        content = BytesIO()
        arrays: dict[str, Any] = _one_after_the_other(_nocs_images(submission, dataset, lost))
        np.savez_compressed(content, **arrays)
        write_file(target, content.getvalue())
    else:
        _write_folder(target, _nocs_images(submission, dataset, lost))
    return [told.format(count) for told, count in lost.items() if count]


def _named(submission: Submission, dataset: Dataset | None) -> Submission:
    """A submission whose images have names: where they have none, those of the data set."""
    images = submission.images
    if all(image.name for image in images):
        return submission
    if dataset is None:
        raise DataError(
            f"{submission.path}: its images have no names, and no form can be without; name the"
            " data set, in whose order they are taken: --cpas-dataset NAME"
        )
    pairing = Pairing(submission, dataset)
    named = [replace(images[number], name=name) for number, name in pairing.images.items()]
    return replace(submission, images=named)


# -- JSON lines -----------------------------------------------------------------------------


def _json_lines(submission: Submission, lost: Counter[str]) -> Iterator[str]:
    yield Header(
        object_frame=submission.object_frame,
        gives=submission.gives,
        classes=submission.classes,
        method=submission.method,
        dataset=submission.dataset,
        provenance=submission.provenance,
    ).line()
    half = in_half_precision(submission.images)
    for image in submission.images:
        answers = image.answers
        if image.truths is not None:
            lost["the truth about {} objects; judge the file with --cpas-dataset"] += len(
                image.truths
            )
        if answers.scores is not None and "score" not in submission.gives:
            lost["the scores of {} answers, which others do not have"] += len(answers)
        reasons = failures(answers)

        def given(
            rows: Sequence[int], image: Image = image, reasons: Sequence[str | None] = reasons
        ) -> Given:
            return _given(submission, image, rows, reasons, half, lost)

        for rows, beside in _lines_of(answers):
            sample = None if answers.samples is None else answers.samples[rows[0]]
            answer, others = given(rows), [given([row]) for row in beside]
            yield answer_line(image.name, sample, answer, submission.gives, others)


def _given(
    submission: Submission,
    image: Image,
    rows: Sequence[int],
    reasons: Sequence[str | None],
    half: bool,
    lost: Counter[str],
) -> Given:
    """What was answered about one object, the best first; ``reasons``: why an answer is none."""
    answers, best = image.answers, rows[0]
    given, reason = [], None
    for row in rows:
        reason = reason or reasons[row]
        if reasons[row] is None:
            where = f"prediction {row} of {image.name}"
            try:
                made = hypothesis(answers, row, where, half=half)
            except AnswerError as error:
                reason = str(error)
                lost["{} answers that are no pose; they are written as failures"] += 1
            else:
                given.append(_declared(made, submission))
    if given and len(given) < len(rows):
        lost["{} hypotheses that are none, beside others"] += len(rows) - len(given)
    return Given(
        category=submission.category(int(answers.class_ids[best])),
        prediction=Prediction(tuple(given), reason=reason),
        box=box_at(answers, best),
        score=score_at(answers, best) if "score" in submission.gives else None,
    )


def _lines_of(answers: Answers) -> Iterator[tuple[Sequence[int], Sequence[int]]]:
    """The rows of each line: those about a sample, the best first, or else one; and, with the first
    sample, those that are about none."""
    if answers.samples is None:
        yield from (([row], ()) for row in range(len(answers)))
        return
    found: dict[str, list[int]] = defaultdict(list)
    for row in order(answers):
        found[answers.samples[row]].append(row)
    beside = found.pop("", [])
    for rows in found.values():
        yield rows, beside
        beside = []


def _declared(made: Hypothesis, submission: Submission) -> Hypothesis:
    return made if "score" in submission.gives else replace(made, score=None)


# -- forms of detections --------------------------------------------------------------------


def _kept(answers: Answers, lost: Counter[str], form: str) -> list[int]:
    """The rows that a form of detections can say: no failure that the file declares, unless it is a
    detection that can be ranked, and of further hypotheses those that are less sure than the best.
    """
    reasons: Sequence[str | None] = answers.reasons or [None] * len(answers)
    scores = answers.scores
    ranked = np.zeros(len(answers), bool) if scores is None else ~np.isnan(scores)
    gone = [reason is not None and not ranked[row] for row, reason in enumerate(reasons)]
    lost["the reasons of {} failures, which are left out"] += sum(gone)
    kept = sum(reason is not None for reason in reasons) - sum(gone)
    lost["the reasons of {} failures, which have a pose of zeros"] += kept
    rows = [row for row in range(len(answers)) if not gone[row]]
    if answers.samples is not None:
        lost["the names of {} samples: objects are found by class and place in their image"] += len(
            {answers.samples[row] for row in rows} - {""}
        )
    if answers.ranks is not None and answers.samples is not None:
        bests = {answers.samples[r]: r for r in rows if answers.ranks[r] == 0}

        def is_clear(row: int) -> bool:
            sample = answers.samples[row] if answers.samples else ""
            best = bests.get(sample) if sample else None
            return (
                best is None or row == best or (scores is not None and scores[row] < scores[best])
            )

        clear = [row for row in rows if is_clear(row)]
        told = "{} further hypotheses, which " + form + " would take for the best ones"
        lost[told] += len(rows) - len(clear)
        rows = clear
    if answers.shapes is not None:
        lost["the shapes of {} answers"] += len(rows)
    return rows


def _turn(submission: Submission, dataset: Dataset | None, lost: Counter[str]) -> Array:
    """The change (3, 3) from the axes of a submission to those in which a data set is published."""
    ours = NOCS_FROM_SHAPENET if submission.object_frame == "nocs" else np.eye(3)
    if dataset is None and submission.object_frame != "nocs":
        name = submission.dataset or "the data set"
        lost[f"the object axes, if {name} has others than NOCS's; --dataset NAME writes those"] = 1
    published = NOCS_FROM_SHAPENET if dataset is None else dataset.published_axes
    return ours if published is None else ours @ published.T


def _nocs_images(
    submission: Submission, dataset: Dataset | None, lost: Counter[str]
) -> list[tuple[str, dict[str, NDArray[Any]]]]:
    """Each image's name, and its arrays in NOCS's form."""
    where = f"{submission.path}: NOCS's form needs"
    if "extents" not in submission.gives:
        raise DataError(f"{where} extents, and the answers have none; write a .jsonl")
    if tuple(submission.classes) != CATEGORIES:
        classes = ", ".join(submission.classes)
        lost["what class ids mean ({} images), which is by their order: " + classes] += len(
            submission.images
        )
    made = []
    turn = _turn(submission, dataset, lost)
    for image in submission.images:
        answers = image.answers
        if answers.boxes is None or not image.name or not answers.class_ids.all():
            lacks = "names of images" if not image.name else "2-D boxes and classes"
            raise DataError(f"{where} {lacks}, and {image.name or 'an image'} has none of them")
        rows = _kept(answers, lost, "NOCS's form")
        arrays: dict[str, NDArray[Any]] = {}
        if np.isnan(answers.boxes[rows]).any():
            raise DataError(f"{where} 2-D boxes, and not all answers of {image.name} have one")
        for side, objects, chosen in (
            ("gt", image.truths, None),
            ("pred", answers, rows),
        ):
            if objects is None:
                continue
            at = slice(None) if chosen is None else chosen
            boxes, extents = objects.boxes, objects.extents
            if boxes is None or extents is None:
                raise DataError(f"{where} 2-D boxes and sizes, and {image.name} lacks some")
            poses, sizes = _scaled(objects.poses[at], extents[at], turn)
            arrays |= {
                f"{side}_class_ids": objects.class_ids[at].astype(np.int32),
                f"{side}_bboxes": boxes[at],
                f"{side}_RTs": poses,
                f"{side}_scales": sizes,
            }
        if "score" in submission.gives and answers.scores is not None:
            arrays["pred_scores"] = answers.scores[rows]
        handles = None if image.truths is None else image.truths.visible_handles
        if handles is not None:
            arrays["gt_handle_visibility"] = handles.astype(np.int32)
        made.append((image.name, arrays))
    return made


def _scaled(poses: Array, extents: Array, turn: Array) -> tuple[Array, Array]:
    """Poses (n, 4, 4) with a scale, in other axes, and the sizes (n, 3) relative to it."""
    poses = poses.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ turn
    extents = extents @ np.abs(turn)
    with np.errstate(all="ignore"):
        scales = np.cbrt(np.linalg.det(poses[:, :3, :3]))
        diagonals = np.linalg.norm(extents, axis=1)
        rigid = (np.abs(scales - 1) < 1e-6) & np.isfinite(diagonals) & (diagonals > 0)
        poses[rigid, :3, :3] *= diagonals[rigid, None, None]
        scales = np.where(rigid, scales * diagonals, scales)[:, None]
        sizes: Array = np.where(scales != 0, extents / scales, extents)
    return poses, sizes


def _one_after_the_other(
    images: Sequence[tuple[str, Mapping[str, NDArray[Any]]]],
) -> dict[str, NDArray[Any]]:
    """The arrays of an ``.npz``, in which the rows of all images follow each other."""
    if not images:
        raise DataError("there are no images, so there is nothing to write")
    keys = [key for key in images[0][1] if all(key in arrays for _, arrays in images)]
    joined = {key: np.concatenate([arrays[key] for _, arrays in images]) for key in keys}
    for side in ("gt", "pred"):
        if f"{side}_class_ids" in joined:
            counts = [0, *(len(arrays[f"{side}_class_ids"]) for _, arrays in images)]
            joined[f"{side}_offset"] = np.cumsum(counts)
    return {"frame": np.array([name for name, _ in images]), **joined}


def _write_folder(target: Path, images: Sequence[tuple[str, Mapping[str, NDArray[Any]]]]) -> None:
    """A pickle for each image, in a folder that takes the place of one that has nothing else."""
    names = {}
    for name, arrays in images:
        file = f"results_{re.sub(r'[^A-Za-z0-9.-]', '_', name)}.pkl"
        if file in names or _parts(nocs.image_name(Path(file))) != _parts(name):
            raise DataError(f"{target}: no pickle can be called by image {name!r}; write an .npz")
        names[file] = arrays
    if target.is_dir() and (others := [p.name for p in target.iterdir() if p.suffix != ".pkl"]):
        raise DataError(
            f"{target}: it holds {min(others)}, which --force would remove; name another folder"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = target.with_name(f".{secrets.token_hex(8)}.part")
    unfinished.mkdir()
    try:
        for file, arrays in names.items():
            write_through(unfinished / file, pickle.dumps(dict(arrays), protocol=2))
        if target.is_dir():
            old = target.with_name(f".{secrets.token_hex(8)}.old")
            target.rename(old)
            unfinished.rename(target)
            shutil.rmtree(old)
        else:
            unfinished.rename(target)
    except BaseException:
        shutil.rmtree(unfinished, ignore_errors=True)
        raise


def _parts(name: str) -> list[str]:
    return [part for part in re.split(r"[^A-Za-z0-9.-]", name) if part]


def _bop(submission: Submission, dataset: Dataset | None, lost: Counter[str]) -> Iterator[str]:
    """The lines of BOP's table."""
    if dataset is None or not dataset.published_centres:
        raise DataError(
            f"{submission.path}: the poses of BOP's table are those of its models; name the data"
            " set: --dataset bop:DIR"
        )
    half = in_half_precision(submission.images)
    info = MethodInfo(
        name="submission",
        categories=tuple(submission.classes),
        needs=frozenset(),
        gives=submission.gives,
        licence="unknown",
        object_frame=submission.object_frame,
    )
    for image in submission.images:
        answers = image.answers
        place = re.fullmatch(r"(\d{1,9})/(\d{1,9})", image.name)
        if place is None:
            raise DataError(f"{submission.path}: image {image.name!r} is none of BOP's")
        rows = _kept(answers, lost, "BOP's table")
        failed = failures(answers)
        if answers.extents is not None:
            lost["the extents of {} answers"] += len(rows)
        for row in rows:
            if failed[row] is not None:
                lost["{} answers that are none"] += 1
                continue
            where = f"{submission.path}: prediction {row} of {image.name}"
            given = to_standard(hypothesis(answers, row, where, half=half, shaped=False), info)
            category = submission.category(int(answers.class_ids[row]))
            if category not in dataset.published_centres:
                raise DataError(f"{where}: {category or 'no class'} is none of BOP's models")
            yield bop_csv.line(
                (int(place[1]), int(place[2]), object_number(category)),
                given,
                dataset.published_centres[category],
            )
