"""One trial: its steps in order, and the content of its ``results.json``."""

import logging
import sys
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

# Its import replaces signal handlers, which `reinstall_handlers` then restores.
import pycolmap  # noqa: F401
import torch

from gsbench import __version__
from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError, TrainingError
from gsbench.events import sum_events
from gsbench.files import (
    link_or_copy,
    remove_temporaries,
    require_no_links,
    storage_errors,
    write_json,
    write_text,
)
from gsbench.gaussians.ply import read_ply, write_ply
from gsbench.init import Sfm
from gsbench.init.base import GAUSSIANS_FILE, MODEL_FOLDER, REPORT_FILE
from gsbench.logs import log_to
from gsbench.normalization import Normalization
from gsbench.parsing import read_if_sound, read_json, read_typed
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps.evaluate import evaluate_step
from gsbench.pipeline.steps.external import external_step
from gsbench.pipeline.steps.scene import (
    CaptureSource,
    Views,
    ground_truth_step,
    init_step,
    masked_capture,
    masking_step,
    normalized_capture,
    normalizing_step,
)
from gsbench.pipeline.steps.train import train_step
from gsbench.runs import keys, layout
from gsbench.runs.commands import digest_of, read_history
from gsbench.runs.config_hash import arm_hash, config_hash
from gsbench.runs.nested import flatten, sha256_of
from gsbench.runs.rows import read_rows
from gsbench.runs.store import Store, StoredResult, read_manifest
from gsbench.runs.trial_files import AskedBefore, Failure
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import (
    FROM_MODEL,
    FROM_RENDERS,
    MADE_ELSEWHERE,
    RENDERS_ALONE,
    Budget,
    Code,
    Evaluation,
    Oddity,
    Training,
    TrialRecord,
    TwinViews,
    split_text,
)
from gsbench.runs.user_code import user_modules
from gsbench.scene.colmap_files import model_files
from gsbench.scene.rules import settle
from gsbench.scene.types import Capture, Scene
from gsbench.system.install import version_of
from gsbench.system.locks import hold
from gsbench.system.resources import lacks_memory
from gsbench.system.stopping import reinstall_handlers
from gsbench.train.kernels import compiled_beside
from gsbench.train.proof import Proven

log = logging.getLogger(__name__)

PUBLISHED_TRAINING = (
    layout.POINT_CLOUD,
    layout.LINEAGE,
    layout.CURVES,
    layout.EVENTS,
    layout.HISTOGRAMS,
    layout.TRAINER_LOG,
)


class TrialSteps:
    """The steps of a trial. The result of each is kept in ``store`` under the step's key."""

    # `steps` sets these three attributes while it runs.
    photographs: Capture  # the photographs as the user gave them
    # the photographs as the steps see them: masked and transparent pixels are replaced
    capture: Capture
    views: Views

    def __init__(self, parts: Parts, store: Store) -> None:
        self.parts, self.store = parts, store

    def steps(self) -> Iterator[keys.Step]:
        """The steps in order.

        A caller that wants results builds each step before it asks for the next.

        Keys are known without building, with one exception: the courtyard's photographs must be
        rendered before their fingerprint is known. While they are missing from the store, the step
        that renders them is the last.
        """
        parts, store = self.parts, self.store
        source = CaptureSource(parts.scene, parts.reader, parts.user_code)
        capture_step = source.step
        if capture_step is not None:
            yield capture_step
            if store.find(capture_step) is None:
                return
        self.capture = self.photographs = source.read(
            None if capture_step is None else store.path(capture_step)
        )
        masking = masking_step(self.photographs, parts.scene.transparent)
        if masking is not None:
            yield masking
            self.capture = masked_capture(self.photographs, store.path(masking))
        normalizing = normalizing_step(self.capture)
        if normalizing is not None:
            yield normalizing
            self.capture = normalized_capture(self.capture, normalizing, store.path(normalizing))
        reference = None
        if parts.initializer.needs_reference(self.capture):
            reference = init_step(store, self.capture, Sfm(threads=parts.threads))
            yield reference
        init = init_step(store, self.capture, parts.initializer, reference, parts.user_code)
        yield init
        self.views = Views(store, self.capture, init, parts.scene)
        program = parts.program
        if program is None:
            trained = train_step(self.views, parts)
        else:
            trained = external_step(self.views, program, parts)
        yield trained
        yield ground_truth_step(self.views)
        yield evaluate_step(self.views, trained, parts)


def run_trial(trial: Trial, wait: bool = True) -> TrialRecord:
    """Run the trial unless it is done; returns what ``results.json`` holds.

    On failure, ``failed.json`` and ``log.txt`` in the trial's folder say why, and the error is
    raised again. If another process runs this trial, this waits for it, or raises BusyError if
    ``wait`` is False.
    """
    reinstall_handlers()
    folder = trial.files
    with storage_errors(folder.runs):
        folder.require_no_links()
        require_no_links(folder.runs, folder.runs / layout.STORE / keys.VIEWS.name)
        folder.path.mkdir(parents=True, exist_ok=True)
        with hold(folder.lock, folder.label, wait), log_to(folder.path / layout.LOG):
            if not folder.why_not_done(trial.values):
                log.info("%s: already done", folder.label)
                return folder.record()
            remove_temporaries(folder.path)
            return _run(trial, folder)


@contextmanager
def _recorded_failures(values: dict[str, Any], folder: TrialFolder) -> Iterator[None]:
    """Write ``failed.json`` if the block fails.

    Code that ends the process has failed, even with exit code 0.
    """
    try:
        with storage_errors(folder.runs):
            try:
                yield
            except SystemExit as ended:
                text = (
                    f"code of the trial ended the process (exit code {ended.code}) instead of "
                    "returning"
                )
                raise TrainingError(text) from ended
            except (RuntimeError, MemoryError) as error:
                if not lacks_memory(error):
                    raise
                raise TrainingError(
                    f"device={values['device']} has no memory left: lower scene.max_size, "
                    "densify.max_gaussians or the number of trials at once (launch.parallel), or "
                    "end other programs there"
                ) from error
    except Exception as error:
        log.debug("the trial failed", exc_info=True)
        kind = type(error).__name__
        message = str(error) if isinstance(error, GsbenchError) else f"{kind}: {error}"
        failure = Failure(
            error=kind,
            message=message,
            traceback=traceback.format_exc(),
            time=time.time(),
            seed=values["seed"],
            bad_input=isinstance(error, InputError),
        )
        with suppress(OSError):  # a full disk: the raised error is all that the user gets
            write_json(folder.path / layout.FAILED, {"status": "failed"} | failure.to_json())
        raise


def _run(trial: Trial, folder: TrialFolder) -> TrialRecord:
    """Build every step, link its files into the trial's folder, write the results."""
    values = trial.values
    with _recorded_failures(values, folder):
        parts = Parts(values)
        parts.check(on_this_machine=True)
        # made here, so that one that cannot run on this machine raises before hours of work
        _ = parts.rasterizer
        torch.set_num_threads(parts.threads)

        def announce(stage: keys.Stage, place: Path) -> None:
            write_json(folder.path / layout.BUILDING, {"stage": stage.name, "folder": str(place)})

        store = Store(folder.runs / layout.STORE, announce)
        write_text(folder.path / layout.CONFIG, trial.yaml)
        (folder.path / layout.FAILED).unlink(missing_ok=True)
        trial_steps = TrialSteps(parts, store)
        entries: dict[str, StoredResult] = {}
        code: dict[str, str] = {}
        asked: list[str] = []
        digest = digest_of(values)
        on_cpu = parts.program is None and parts.device.type == "cpu"
        with compiled_beside(parts.rasterizer, on_cpu) as kernels_ready:
            for step in trial_steps.steps():
                if step.stage.name == keys.TRAIN.name:
                    scene = trial_steps.views.scene
                    counts = len(scene.train), len(scene.test)
                    log.info("%s: %d training and %d test views", folder.label, *counts)
                    asked = _questions(folder, digest, values, step, store)
                    kernels_ready()
                entries[step.stage.name] = entry = store.get(step)
                code |= step.code
                if step.stage is keys.INIT:
                    link_or_copy(entry.path / REPORT_FILE, folder.path / layout.INIT_REPORT)
        capture, scene = trial_steps.capture, trial_steps.views.scene
        results = results_of(values, capture, scene, parts.raster, entries, code, asked)
        published = _publish(folder.path, entries, capture.normalization)
        kept = {name: entry.path for name, entry in entries.items() if name != keys.CAPTURE.name}
        sources = source_files(trial_steps.photographs, store)
        was_done = folder.write_finished(values, results, sources, kept, published)
        (folder.path / layout.BUILDING).unlink(missing_ok=True)
    size = "" if results.num_gaussians is None else f"  {results.num_gaussians} Gaussians"
    ending = f"{size}  (already done)" if was_done else size
    log.info("%s: %s%s", folder.label, results.metrics_line, ending)
    if results.learnt_nothing:
        log.warning("%s: %s", folder.label, results.learnt_nothing)
    return results


def _questions(
    folder: TrialFolder, digest: str, values: Mapping[str, Any], step: keys.Step, store: Store
) -> list[str]:
    """The ids of the questions that covered a trial when its training began.

    None for a training that is found in the store, unless it began for this experiment: its result
    may have been seen before a question was written.
    """
    file = folder.path / layout.ASKED
    before = read_if_sound(file, AskedBefore)
    if before is not None and before.training == step.key:
        return before.questions
    history, place = read_history(folder.home), (values["scene"]["name"], values["seed"])
    if store.find(step) is not None and (digest, place) not in history.results:
        return []
    asked = [question.id for question in history.covering(digest, *place)]
    write_json(file, AskedBefore(training=step.key, questions=asked).to_json())
    return asked


def source_files(capture: Capture, store: Store) -> list[Path]:
    """The user's files from which a capture was read; none for a scene that gsbench made."""
    if capture.images.resolve().is_relative_to(store.root.resolve()):
        return []
    files = [capture.images / name for name in capture.image_names]
    files += [*capture.masks.values(), *capture.read_from]
    if capture.model is not None:
        files += model_files(capture.model)
    return [file.resolve() for file in files]


def _publish(
    folder: Path, entries: Mapping[str, StoredResult], normalization: Normalization
) -> list[Path]:
    """Link the steps' files into the trial's folder, or copy them; returns the new paths.

    The model gets the coordinates in which the scene was given.
    """
    stages = keys.TRAIN, keys.EVALUATE, keys.GROUND_TRUTH
    trained, evaluated, truth = (entries[stage.name].path for stage in stages)
    links = {
        folder / name: trained / name for name in PUBLISHED_TRAINING if (trained / name).exists()
    }
    links[folder / layout.PER_VIEW] = evaluated / layout.PER_VIEW
    pictures = {
        layout.RENDERS: evaluated / layout.RENDERS,
        layout.FIGURES: evaluated / layout.FIGURES,
        layout.GROUND_TRUTH: truth,
        layout.MASKS: truth / layout.MASKS,
    }
    for name, source in pictures.items():
        links |= {folder / name / file.name: file for file in sorted(source.glob("*.png"))}
    for link, file in links.items():
        link.parent.mkdir(exist_ok=True)
        if file.name == layout.POINT_CLOUD and not normalization.is_identity:
            write_ply(read_ply(file), link, normalization)
        else:
            link_or_copy(file, link)
    return list(links)


# ---- the content of results.json

# packages on whose versions a result depends
PACKAGES = ("torch", "numpy", "numba", "pycolmap", "kornia", "gsplat", "piq")
# fields that results.json copies from the training and from the evaluation without changes
OF_TRAINING = (
    "iterations",
    "num_init_points",
    "num_gaussians",
    "causes",
    "initial_cloud",
    "scene_extent",
    "peak_memory_mb",
    "machine",
    "trained_by",
)
OF_EVALUATION = ("metrics", "awaited", "one_color_psnr")


def results_of(
    values: dict[str, Any],
    capture: Capture,
    scene: Scene,
    raster: Proven,
    entries: Mapping[str, StoredResult],
    code: Mapping[str, str],
    asked: list[str],
) -> TrialRecord:
    """The results of the trial with the configuration ``values``.

    ``capture`` are the photographs, ``raster`` is the rasterizer, ``entries`` are the steps' store
    entries by stage. ``code`` maps the parts of gsbench's source that the steps used to their
    states. ``asked`` are the ids of the questions that covered the trial before its training.
    """
    stages = keys.INIT, keys.TRAIN, keys.EVALUATE
    init, trained, evaluated = (entries[stage.name] for stage in stages)
    training = read_typed(trained.path / layout.TRAINING, Training)
    evaluation = read_typed(evaluated.path / layout.METRICS, Evaluation)
    manifest = read_manifest(evaluated.path)
    init_report = read_json(init.path / REPORT_FILE)
    of_model = [Oddity(**odd) for odd in init_report.get("oddities", ())]
    oddities = [*capture.oddities, *scene.oddities, *of_model, *training.oddities]
    # A stage of the store may have been made with a rule accepted that is not accepted here.
    refused = [odd for odd in oddities if odd.refused]
    settle(refused, f"scene {capture.name}", capture.accept)
    is_ready_made = training.trained_by is None and not training.iterations
    seconds = {"init": init.seconds, "train": training.seconds, "evaluate": evaluated.seconds}
    if is_ready_made:
        del seconds["train"]
    if training.compile_seconds is not None:
        seconds["compile"] = training.compile_seconds
    only_renders = training.evaluated_from == FROM_RENDERS
    views = [*scene.train, *scene.test]
    copied = {name: getattr(training, name) for name in OF_TRAINING}
    copied |= {name: getattr(evaluation, name) for name in OF_EVALUATION}
    return TrialRecord(
        status="complete",
        experiment=values["name"],
        **{group: values[group]["name"] for group in ("scene", "init", "densify")},
        seed=values["seed"],
        raster="unknown" if only_renders else raster.rasterizer.name,
        raster_proof=raster.proof,
        raster_passed_over=[*raster.passed_over],
        protocol=manifest.inputs["protocol"],
        unavailable=evaluation.unavailable | _unknown_costs(training, is_ready_made),
        measured=manifest.created,  # of an evaluation found in the store: when it was put there
        questions=asked,
        metric_facts=evaluation.facts,
        metrics_at=evaluation.at,
        oddities=oddities,
        twins=TwinViews(
            left_out={**capture.left_out, **scene.twins.left_out}, near=dict(scene.twins.near)
        ),
        seconds=seconds,
        budget=Budget(
            max_gaussians=values["densify"].get("max_gaussians"),
            cap=values["densify"].get("cap"),
            seconds=values["train"]["max_seconds"],
        ),
        normalization=None if capture.normalization.is_identity else capture.normalization,
        train_views=len(scene.train),
        test_views=len(scene.test),
        split=split_text(flatten(values)),
        held_out=capture.held_out,
        resolution=max((view.camera.width, view.camera.height) for view in views),
        events=sum_events(read_rows(trained.path / layout.EVENTS)),
        init_report=init_report,
        hashes={
            "config": config_hash(values),
            "arm": arm_hash(values),
            "data": capture.fingerprint,
            "cloud": cloud_hash(init.path),
            **{stage.name: entries[stage.name].key for stage in stages},
        },
        code=Code(
            sources=user_modules(values),
            stages={stage.name: stage.version for stage in keys.STAGES},
            packages=dict(sorted(code.items())),
            **training.checkout,
        ),
        versions=versions(),
        evaluated_from=FROM_MODEL if is_ready_made else training.evaluated_from,
        **copied,
    )


def _unknown_costs(training: Training, is_ready_made: bool) -> dict[str, str]:
    """The costs that were not measured, each with the reason, if gsbench did not train."""
    unknown = {}
    if training.evaluated_from == FROM_RENDERS:
        unknown["gaussians"] = RENDERS_ALONE
    if training.peak_memory_mb is None:
        unknown["peak_memory_mb"] = "another program's memory of a GPU is not measured"
    if is_ready_made:
        reason = f"{MADE_ELSEWHERE}: not trained here"
        unknown |= {"train_time": reason, "total_time": reason}
    return unknown


def cloud_hash(init: Path) -> str:
    """The hash of what an initialiser made: cameras, poses and points, or Gaussians.

    The step's key cannot replace it, because that is a hash of the inputs only.
    """
    files = read_manifest(init).outputs
    model = (f"{MODEL_FOLDER.as_posix()}/", GAUSSIANS_FILE)
    kept = {name: file.sha256 for name, file in files.items() if name.startswith(model)}
    return sha256_of(kept)


def versions() -> dict[str, str]:
    """The versions of Python, gsbench and the packages on which a result depends."""
    found = {"python": sys.version.split()[0], "gsbench": __version__}
    for package in PACKAGES:
        if version := version_of(package):
            found[package] = version
    return found
