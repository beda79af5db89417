"""One trial: its steps in order, from its parts; and its way from configuration to ``results.json``."""

import logging
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pycolmap  # noqa: F401 - here, so that what its import does to signals can be undone
import torch

from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError, TrainingError
from gsbench.files import link_or_copy, remove_temporaries, require_own, storage_errors, write_json, write_text
from gsbench.init import Sfm
from gsbench.init.base import PICTURE_FILE, REPORT_FILE
from gsbench.logs import log_to
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.results import results_of
from gsbench.pipeline.steps.evaluate import evaluate_step
from gsbench.pipeline.steps.external import external_step
from gsbench.pipeline.steps.init import init_step
from gsbench.pipeline.steps.scene import CaptureSource, Views, ground_truth_step, masked, masked_step
from gsbench.pipeline.steps.train import train_step
from gsbench.runs import layout
from gsbench.runs.keys import EVALUATE, GROUND_TRUTH, INIT, TRAIN, Stage, Step
from gsbench.runs.layout import BUILDING, CONFIG, FAILED, LOG
from gsbench.runs.store import Entry, Store
from gsbench.runs.trial_folder import Failure, TrialFolder
from gsbench.runs.trial_record import TrialRecord
from gsbench.scene.colmap_files import model_files
from gsbench.scene.types import Capture
from gsbench.system.locks import hold
from gsbench.system.stopping import take_signals_back

log = logging.getLogger(__name__)

PUBLISHED_TRAINING = (
    layout.POINT_CLOUD, layout.LINEAGE, layout.CURVES, layout.EVENTS, layout.HISTOGRAMS, layout.TRAINER_LOG
)  # fmt: skip


class TrialSteps:
    """A trial before, while and after its steps are built; each step's result is found in ``store`` under its key."""

    photographs: Capture  # the user's photographs; known, as the next, once `steps` is past the making of photographs
    capture: Capture  # what the steps look at: without what masks ignore
    views: Views

    def __init__(self, parts: Parts, store: Store) -> None:
        self.parts, self.store = parts, store

    def steps(self) -> Iterator[Step]:
        """The steps in order. A caller that wants results builds each before it asks for the next.

        Keys chain without building, with one exception: the courtyard's photographs must be rendered before their
        fingerprint is known, so where they are not in the store, theirs is the last step.
        """
        parts, store = self.parts, self.store
        source = CaptureSource(parts.scene)
        made = source.step
        if made is not None:
            yield made
            if store.find(made) is None:
                return
        self.capture = self.photographs = source.read(None if made is None else store.path(made))
        replaced = masked_step(self.photographs, parts.scene.transparent)
        if replaced is not None:
            yield replaced
            self.capture = masked(self.photographs, store.path(replaced))
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
    """Run the trial, or find it done; returns what ``results.json`` holds.

    On failure ``failed.json`` and ``log.txt`` in the trial's folder say why, and the error is raised again. Where
    another process runs this trial, waits for it, or raises BusyError if ``wait`` is False.
    """
    take_signals_back()
    folder = trial.files
    with storage_errors(folder.runs):
        folder.require_own()
        require_own(folder.runs, folder.runs / layout.STORE / layout.VIEWS)
        folder.path.mkdir(parents=True, exist_ok=True)
        with hold(folder.lock, folder.label, wait), log_to(folder.path / LOG):
            if not folder.why_not_done(trial.values):
                log.info("%s: was done", folder.label)
                return folder.record()
            remove_temporaries(folder.path)
            return _run(trial, folder)


@contextmanager
def _recorded_failures(values: dict[str, Any], folder: TrialFolder) -> Iterator[None]:
    """Write down why the block failed; code of the trial that ends the process has failed, whatever its exit code."""
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
        with suppress(OSError):  # on a full disk the error itself has to do
            write_json(folder.path / FAILED, {"status": "failed"} | failure.to_json())
        raise


def _run(trial: Trial, folder: TrialFolder) -> TrialRecord:
    """Build every step, show its files in the trial's folder, write the results."""
    values = trial.values
    with _recorded_failures(values, folder):
        parts = Parts(values)
        parts.check(here=True)
        _ = parts.rasterizer  # which may refuse this machine, before hours of work
        torch.set_num_threads(parts.threads)

        def announce(stage: Stage, place: Path) -> None:
            write_json(folder.path / BUILDING, {"stage": stage.name, "folder": str(place)})

        store = Store(folder.runs / layout.STORE, announce)
        write_text(folder.path / CONFIG, trial.yaml)
        (folder.path / FAILED).unlink(missing_ok=True)
        pipeline = TrialSteps(parts, store)
        entries: dict[str, Entry] = {}
        code: dict[str, str] = {}
        for step in pipeline.steps():
            if step.stage.name == TRAIN.name:
                scene = pipeline.views.scene
                log.info("%s: %d training and %d test views", folder.label, len(scene.train), len(scene.test))
            entries[step.stage.name] = entry = store.get(step)
            code |= step.code
            if step.stage is INIT:
                link_or_copy(entry.path / REPORT_FILE, folder.path / layout.INIT_REPORT)
        results = results_of(values, pipeline.capture, pipeline.views.scene, parts.rasterizer.name, entries, code)
        published = _publish(folder.path, entries)
        made_of = {stage.name: entries[stage.name].path for stage in (INIT, TRAIN, GROUND_TRUTH, EVALUATE)}
        again = folder.write_finished(values, results, source_files(pipeline.photographs, store), made_of, published)
        (folder.path / BUILDING).unlink(missing_ok=True)
    metrics = "  ".join(f"{key} {value:.4g}" for key, value in results.metrics.items())
    size = "" if results.num_gaussians is None else f"  {results.num_gaussians} Gaussians"
    log.info("%s: %s%s%s", folder.label, metrics, size, "  (was done)" if again else "")
    return results


def source_files(capture: Capture, store: Store) -> list[Path]:
    """The user's files that a capture was read from; none for a scene that was made in the store."""
    if capture.images.resolve().is_relative_to(store.root.resolve()):
        return []
    images = [(capture.images / name).resolve() for name in capture.image_names]
    images += [file.resolve() for file in (*capture.masks.values(), *capture.read_from)]
    return images + ([] if capture.model is None else [path.resolve() for path in model_files(capture.model)])


def _publish(folder: Path, entries: Mapping[str, Entry]) -> list[Path]:
    """Show the steps' files in the trial's folder; returns what is shown."""
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
