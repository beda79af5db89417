"""One trial: its steps in order, and how it gets from a configuration to ``results.json``."""

import logging
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pycolmap  # noqa: F401 - its import replaces signal handlers, which `reinstall_handlers` then restores
import torch

from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError, TrainingError
from gsbench.files import link_or_copy, remove_temporaries, require_no_links, storage_errors, write_json, write_text
from gsbench.init import Sfm
from gsbench.init.base import PICTURE_FILE, REPORT_FILE
from gsbench.logs import log_to
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.results import results_of
from gsbench.pipeline.steps.evaluate import evaluate_step
from gsbench.pipeline.steps.external import external_step
from gsbench.pipeline.steps.init import init_step
from gsbench.pipeline.steps.scene import CaptureSource, Views, ground_truth_step, masked_capture, masking_step
from gsbench.pipeline.steps.train import train_step
from gsbench.runs import layout
from gsbench.runs.keys import EVALUATE, GROUND_TRUTH, INIT, TRAIN, Stage, Step
from gsbench.runs.layout import BUILDING, CONFIG, FAILED, LOG
from gsbench.runs.store import Store, StoredResult
from gsbench.runs.trial_folder import Failure, TrialFolder
from gsbench.runs.trial_record import TrialRecord
from gsbench.scene.colmap_files import model_files
from gsbench.scene.types import Capture
from gsbench.system.locks import hold
from gsbench.system.stopping import reinstall_handlers

log = logging.getLogger(__name__)

PUBLISHED_TRAINING = (
    layout.POINT_CLOUD, layout.LINEAGE, layout.CURVES, layout.EVENTS, layout.HISTOGRAMS, layout.TRAINER_LOG
)  # fmt: skip


class TrialSteps:
    """The steps of a trial. The result of each is kept in ``store`` under the step's key."""

    # `steps` sets these three as it goes.
    photographs: Capture  # the photographs as the user gave them
    capture: Capture  # the photographs as the steps see them: masked and transparent pixels are replaced
    views: Views

    def __init__(self, parts: Parts, store: Store) -> None:
        self.parts, self.store = parts, store

    def steps(self) -> Iterator[Step]:
        """The steps in order. A caller that wants results builds each step before it asks for the next.

        Keys are known without building, with one exception: the courtyard's photographs must be rendered before their
        fingerprint is known. While they are missing from the store, the step that renders them is the last.
        """
        parts, store = self.parts, self.store
        source = CaptureSource(parts.scene)
        capture_step = source.step
        if capture_step is not None:
            yield capture_step
            if store.find(capture_step) is None:
                return
        self.capture = self.photographs = source.read(None if capture_step is None else store.path(capture_step))
        masking = masking_step(self.photographs, parts.scene.transparent)
        if masking is not None:
            yield masking
            self.capture = masked_capture(self.photographs, store.path(masking))
        reference = None
        if parts.initializer.needs_reference(self.capture):
            reference = init_step(store, self.capture, Sfm(threads=parts.threads))
            yield reference
        init = init_step(store, self.capture, parts.initializer, reference, parts.user_code)
        yield init
        self.views = Views(store, self.capture, init, parts.scene)
        program = parts.program
        trained = train_step(self.views, parts) if program is None else external_step(self.views, program, parts)
        yield trained
        yield ground_truth_step(self.views)
        yield evaluate_step(self.views, trained, parts)


def run_trial(trial: Trial, wait: bool = True) -> TrialRecord:
    """Run the trial unless it is done; returns what ``results.json`` holds.

    On failure, ``failed.json`` and ``log.txt`` in the trial's folder say why, and the error is raised again. If another
    process runs this trial, this waits for it, or raises BusyError if ``wait`` is False.
    """
    reinstall_handlers()
    folder = trial.files
    with storage_errors(folder.runs):
        folder.require_no_links()
        require_no_links(folder.runs, folder.runs / layout.STORE / layout.VIEWS)
        folder.path.mkdir(parents=True, exist_ok=True)
        with hold(folder.lock, folder.label, wait), log_to(folder.path / LOG):
            if not folder.why_not_done(trial.values):
                log.info("%s: was done", folder.label)
                return folder.record()
            remove_temporaries(folder.path)
            return _run(trial, folder)


@contextmanager
def _recorded_failures(values: dict[str, Any], folder: TrialFolder) -> Iterator[None]:
    """Write ``failed.json`` if the block fails. Code that ends the process has failed, even with exit code 0."""
    try:
        with storage_errors(folder.runs):
            try:
                yield
            except SystemExit as ended:
                text = f"code of the trial ended the process (exit code {ended.code}) instead of returning"
                raise TrainingError(text) from ended
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
            write_json(folder.path / FAILED, {"status": "failed"} | failure.to_json())
        raise


def _run(trial: Trial, folder: TrialFolder) -> TrialRecord:
    """Build every step, link its files into the trial's folder, write the results."""
    values = trial.values
    with _recorded_failures(values, folder):
        parts = Parts(values)
        parts.check(on_this_machine=True)
        _ = parts.rasterizer  # raises now, not after hours of work, if it cannot run on this machine
        torch.set_num_threads(parts.threads)

        def announce(stage: Stage, place: Path) -> None:
            write_json(folder.path / BUILDING, {"stage": stage.name, "folder": str(place)})

        store = Store(folder.runs / layout.STORE, announce)
        write_text(folder.path / CONFIG, trial.yaml)
        (folder.path / FAILED).unlink(missing_ok=True)
        trial_steps = TrialSteps(parts, store)
        entries: dict[str, StoredResult] = {}
        code: dict[str, str] = {}
        for step in trial_steps.steps():
            if step.stage.name == TRAIN.name:
                scene = trial_steps.views.scene
                log.info("%s: %d training and %d test views", folder.label, len(scene.train), len(scene.test))
            entries[step.stage.name] = entry = store.get(step)
            code |= step.code
            if step.stage is INIT:
                link_or_copy(entry.path / REPORT_FILE, folder.path / layout.INIT_REPORT)
        results = results_of(values, trial_steps.capture, trial_steps.views.scene, parts.rasterizer.name, entries, code)
        published = _publish(folder.path, entries)
        made_of = {stage.name: entries[stage.name].path for stage in (INIT, TRAIN, GROUND_TRUTH, EVALUATE)}
        sources = source_files(trial_steps.photographs, store)
        was_done = folder.write_finished(values, results, sources, made_of, published)
        (folder.path / BUILDING).unlink(missing_ok=True)
    metrics = "  ".join(f"{key} {value:.4g}" for key, value in results.metrics.items())
    size = "" if results.num_gaussians is None else f"  {results.num_gaussians} Gaussians"
    log.info("%s: %s%s%s", folder.label, metrics, size, "  (was done)" if was_done else "")
    return results


def source_files(capture: Capture, store: Store) -> list[Path]:
    """The user's files from which a capture was read; none for a scene that gsbench made in the store."""
    if capture.images.resolve().is_relative_to(store.root.resolve()):
        return []
    images = [(capture.images / name).resolve() for name in capture.image_names]
    images += [file.resolve() for file in (*capture.masks.values(), *capture.read_from)]
    return images + ([] if capture.model is None else [path.resolve() for path in model_files(capture.model)])


def _publish(folder: Path, entries: Mapping[str, StoredResult]) -> list[Path]:
    """Link the steps' files into the trial's folder, or copy them; returns the new paths."""
    init, trained, evaluated = (entries[stage.name].path for stage in (INIT, TRAIN, EVALUATE))
    links = {folder / name: trained / name for name in PUBLISHED_TRAINING if (trained / name).exists()}
    links[folder / layout.PER_VIEW] = evaluated / layout.PER_VIEW
    pictures = {name: evaluated / name for name in (layout.RENDERS, layout.FIGURES)}
    truth = entries[GROUND_TRUTH.name].path
    for name, source in (pictures | {layout.GROUND_TRUTH: truth, layout.MASKS: truth / layout.MASKS}).items():
        links |= {folder / name / file.name: file for file in sorted(source.glob("*.png"))}
    if (init / PICTURE_FILE).exists():
        links[folder / layout.FIGURES / layout.INITIAL_CLOUD] = init / PICTURE_FILE
    for link, file in links.items():
        link.parent.mkdir(exist_ok=True)
        link_or_copy(file, link)
    return list(links)
