"""Reconstruction of a COLMAP model: features, matches, mapping or triangulation, alignment.

`Sfm` works on COLMAP's SIFT features, `gsbench.init.dim` on those of networks.
"""

from __future__ import annotations

import logging
import shutil
from abc import abstractmethod
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.init.base import (
    REGISTERED_SHARE,
    WORK_FOLDER,
    InitReport,
    Timer,
    TrainingPoints,
    UnplacedError,
)
from gsbench.init.colmap.pairs import ALL_PAIRS_UP_TO, STRONGEST, proposed_pairs
from gsbench.init.options import ColmapOptions, SiftOptions
from gsbench.logs import Progress, no_progress
from gsbench.scene.images import lens_of
from gsbench.scene.types import Capture
from gsbench.system.isolate import run_isolated
from gsbench.words import some_of

if TYPE_CHECKING:
    import pycolmap

    from gsbench.init.colmap.database import DatabaseTask

logger = logging.getLogger(__name__)

LOG_FILE = "colmap.log"
Facts = dict[str, Any]  # arguments of `gsbench.init.report.make_report`


@dataclass(frozen=True)
class Job:
    """Inputs of one reconstruction.

    ``work_dir`` keeps features and matches. ``reference`` is a COLMAP model of the same photographs
    whose cameras replace those of the capture.
    """

    options: Reconstruction
    capture: Capture
    output_dir: Path
    work_dir: Path
    reference: Path | None


class Reconstruction(ColmapOptions):
    """Base of the initialisers that reconstruct; subclasses differ in features and matches."""

    @abstractmethod
    def fill(self, job: Job, task: DatabaseTask, progress: Progress, timer: Timer) -> Facts:
        """Write features, matches and verified geometries into the database.

        Returns ``counts`` and more for the report. It runs in COLMAP's process.
        """

    def check(self, capture: Capture, reference: Path | None) -> None:
        """Raise ``InputError``, before any work, if ``capture`` does not suit these settings."""
        if reference is None and self.needs_reference(capture):
            raise InputError(
                f"init={self.name} takes its cameras from a reference, and scene {capture.name} "
                "came without: make one with init=sfm first, or set init.poses=own"
            )

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """See `Initializer.run`.

        ``work_dir`` keeps features and matches for a later run. Without it, they are kept in
        ``output_dir`` until the run succeeds, so that an interrupted run continues there.
        """
        self.check(capture, reference)
        if self.poses == "shared" and (reference or capture.model) is not None:
            report_unused(self)
        elif self.camera == "exif":
            report_lenses(capture)
        work = output_dir / WORK_FOLDER if work_dir is None else work_dir
        for folder in (output_dir, work):
            folder.mkdir(parents=True, exist_ok=True)
        job, log = Job(self, capture, output_dir, work, reference), output_dir / LOG_FILE
        report = run_isolated(build_model, job, what=self.name, log=log, progress=progress)
        if work_dir is None:
            shutil.rmtree(work)
        for warning in report.warnings:
            logger.warning("%s: %s", self.name, warning)
        return report


def report_unused(options: ColmapOptions) -> None:
    """Write a line on each setting for cameras to be estimated, where cameras are given."""
    for name in ("camera", "camera_model", "focal_length"):
        if (value := getattr(options, name)) != getattr(ColmapOptions, name):
            logger.warning(
                "init.%s=%s is not used, since the cameras are given: init.poses=own "
                "estimates them",
                name,
                value,
            )


def report_lenses(capture: Capture) -> None:
    """Write one line if the photographs have several lenses or zooms, which get cameras each."""
    counts = Counter(lens_of(capture.images / name) for name in capture.image_names)
    if len(counts) > 1:
        logger.warning(
            "%s: by EXIF, the photographs have %d focal lengths or lenses, and get a camera for "
            "each: %s; init.camera=single shares one",
            capture.images,
            len(counts),
            some_of([f"{lens}: {count}" for lens, count in counts.most_common()]),
        )


def build_model(job: Job, progress: Progress) -> InitReport:
    """Make a model from the photographs, write it, and return the report on it.

    Calls native code that can abort the process: run it isolated.
    """
    import pycolmap

    from gsbench.init import report
    from gsbench.init.colmap.models import align
    from gsbench.scene.colmap import read_reference

    # without this, COLMAP logs a line for each image; the log is for warnings
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    capture, timer = job.capture, Timer()
    cameras = job.reference or capture.model
    reference = None if cameras is None else read_reference(replace(capture, model=cameras))
    options, model, facts = _best_attempt(job, reference, timer, progress)
    if facts["poses"] == "own":
        exact = capture.exact_poses and job.reference is None
        compared = align(model, reference, capture, exact, options.align)
        facts["warnings"] += compared.pop("warnings", [])
        facts |= compared
    made = report.make_report(
        options.name,
        capture=capture,
        model=model,
        settings={**asdict(options), **facts.pop("settings", {})},
        seconds=timer.rounded(),
        **facts,
    )
    report.write_result(model, made, job.output_dir)
    return made


# the options, the model that they give, and facts for the report
Attempt = tuple[Reconstruction, "pycolmap.Reconstruction", Facts]


def _best_attempt(
    job: Job, reference: pycolmap.Reconstruction | None, timer: Timer, progress: Progress
) -> Attempt:
    """The job's model; if ``pairs=auto`` places few images, that of all pairs if it has more."""
    options, total = job.options, len(job.capture.image_names)
    if options.pairs != "auto" or total <= ALL_PAIRS_UP_TO:
        return _attempt(job, reference, timer, progress)
    made, placed = None, 0
    with suppress(UnplacedError):
        made = _attempt(job, reference, timer, progress)
        placed = made[1].num_reg_images()
    if made and (placed >= REGISTERED_SHARE * total or made[2]["poses"] == "shared"):
        return made
    logger.warning(
        "%s: %d of %d images placed from the pairs of init.pairs=auto: the others are matched, too",
        options.name,
        placed,
        total,
    )
    everything = replace(job, options=replace(options, pairs="exhaustive"))
    try:
        again = _attempt(everything, reference, timer, progress)
    except UnplacedError:
        if made is None:
            raise
        return made
    return made if made and again[1].num_reg_images() <= placed else again


def _attempt(
    job: Job, reference: pycolmap.Reconstruction | None, timer: Timer, progress: Progress
) -> Attempt:
    """Match, then triangulate under the reference's cameras, or map.

    Raises UnplacedError if the matches place no cameras.
    """
    from gsbench.init.colmap import database, mapping
    from gsbench.init.colmap.models import keep_training_points

    options, capture = job.options, job.capture
    task = database.create_task(options, capture, reference, job.work_dir)
    facts = {"warnings": [], **options.fill(job, task, progress, timer)}
    facts["counts"] |= database.database_counts(task.database)
    if facts["counts"]["pairs_verified"] == 0:
        raise UnplacedError(
            f"{options.name}: no pair of images shares enough matches: the photos need more "
            "overlap or texture"
        )
    # an interrupted mapping is not continued but started again
    scratch = job.work_dir / "mapping"
    shutil.rmtree(scratch, ignore_errors=True)
    if options.poses == "shared" and reference is not None:
        with timer.phase("triangulate"):
            model = mapping.triangulate(task, scratch, reference, options, progress)
        if options.ignores_test_photographs(reference):
            kept = model.num_points3D()
            facts["training_points"] = TrainingPoints(options.points_from, kept, None, None)
        return options, model, {**facts, "poses": "shared", "scale_to_reference": 1.0}
    with timer.phase("map"):
        found = mapping.map_images(task, scratch, options, progress)
    facts["counts"]["models"] = found.models
    facts["warnings"] += found.warnings
    if options.points_from == "train":
        facts["training_points"] = keep_training_points(
            found.model, capture.train_names, task.images
        )
    return options, found.model, {**facts, "poses": "own", "mapped_by": found.strategy}


@dataclass(frozen=True, kw_only=True)
class Sfm(Reconstruction, SiftOptions):
    """SIFT, matching and incremental mapping by COLMAP.

    With the same seed and ``mapper_threads=1`` two runs give the same model bit for bit.
    """

    name: ClassVar[str] = "sfm"
    is_own_reference: ClassVar[bool] = True

    def fill(self, job: Job, task: DatabaseTask, progress: Progress, timer: Timer) -> Facts:
        from gsbench.init.colmap.database import database_counts, linked, strongest_descriptors
        from gsbench.init.colmap.matches import extract_sift, match_sift

        masks = {f"{name}.png": file for name, file in job.capture.masks.items()}  # as COLMAP wants
        with timer.phase("extract"):
            folder = linked(masks, job.work_dir / "masks") if masks else None
            extract_sift(task, self, progress, folder)
        if database_counts(task.database)["features"] == 0:
            raise InputError(
                f"{self.name}: no keypoint in any image: lower init.peak_threshold, or check the "
                "photos"
            )
        pairs, counts = task.pairs, {}
        if self.pairs == "auto":
            with timer.phase("preview"):
                pairs = proposed_pairs(
                    task.names, lambda name: strongest_descriptors(task.database, name, STRONGEST)
                )
            counts = {"pairs_selected": len(pairs), "pairs_left_out": len(task.pairs) - len(pairs)}
        with timer.phase("match"):
            match_sift(task.database, pairs, self, progress)
        return {"counts": counts}


@dataclass(frozen=True, kw_only=True)
class SfmDense(Sfm):
    """`Sfm` with loose thresholds, for many more points: a substitute for deep image matching."""

    name: ClassVar[str] = "sfm_dense"
    is_own_reference: ClassVar[bool] = False

    max_num_features: PositiveInt = 16384  # per image
    # Together, these thresholds give 2.9 times the points on low-contrast ground, at a lower error.
    peak_threshold: PositiveFloat = 0.02 / 12
    edge_threshold: PositiveFloat = 20.0  # twice COLMAP's default
