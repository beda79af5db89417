"""One trial: its steps in order, its files, and its failures."""

import logging
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

# Its import replaces signal handlers, which `reinstall_handlers` then restores.
import pycolmap  # noqa: F401
import torch

from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError, TrainingError
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
from gsbench.init.base import REPORT_FILE
from gsbench.logs import log_to
from gsbench.normalization import Normalization
from gsbench.parsing import read_if_sound
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.results import results_of
from gsbench.pipeline.steps.evaluate import evaluate_step
from gsbench.pipeline.steps.external import external_step
from gsbench.pipeline.steps.regions import check_capture, files_read
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
from gsbench.runs.store import Store, StoredResult
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import AskedBefore, Failure, TrialRecord
from gsbench.scene.colmap_files import model_files
from gsbench.scene.types import Capture
from gsbench.system.locks import hold
from gsbench.system.resources import lacks_memory
from gsbench.system.stopping import reinstall_handlers
from gsbench.train.kernels import compiled_beside

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
        self.views = Views(store, self.capture, init, parts.scene)
        check_capture(self.views, parts)
        yield init
        program = parts.program
        trained = (
            external_step(self.views, program, parts) if program else train_step(self.views, parts)
        )
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
        sources = source_files(trial_steps.photographs, parts, store)
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


def source_files(capture: Capture, parts: Parts, store: Store) -> list[Path]:
    """The user's files from which a capture was read; none for a scene that gsbench made."""
    if capture.images.resolve().is_relative_to(store.root.resolve()):
        return []
    files = [capture.images / name for name in capture.image_names]
    files += [*capture.masks.values(), *files_read(capture, parts), *capture.read_from]
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
