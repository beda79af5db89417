"""One trial from configuration to ``results.json``."""

from __future__ import annotations

import logging
import os
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

import pycolmap  # noqa: F401 - here, so that what its import does to signals can be undone
import torch

from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, TrainingError
from gsbench.files import link_or_copy, remove_temporaries, require_own, storage_errors, write_json, write_text
from gsbench.init.base import PICTURE_FILE, REPORT_FILE
from gsbench.logs import log_to
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.results import results_of
from gsbench.pipeline.wiring import TrialSteps
from gsbench.runs import layout
from gsbench.runs.layout import BUILDING, CONFIG, FAILED, LOG
from gsbench.runs.stages import EVALUATE, GROUND_TRUTH, INIT, TRAIN, Stage
from gsbench.runs.store import Entry, Store
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import TrialRecord
from gsbench.scene.colmap_files import model_files
from gsbench.scene.types import Capture
from gsbench.system.locks import hold
from gsbench.system.stopping import take_signals_back
from gsbench.tracking import Mirror

log = logging.getLogger(__name__)

PUBLISHED_TRAINING = (
    layout.POINT_CLOUD, layout.LINEAGE, layout.CURVES, layout.EVENTS, layout.HISTOGRAMS, layout.TRAINER_LOG
)  # fmt: skip


def run_trial(trial: Trial, mirror: Mirror, wait: bool = True) -> TrialRecord:
    """Run the trial, or find it done; returns what ``results.json`` holds. The ``mirror`` is told of its begin.

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
            return _run(trial, folder, mirror)


@contextmanager
def _recorded_failures(values: dict[str, Any], folder: TrialFolder) -> Iterator[None]:
    """Write down why the block failed, before anyone beside the trial is told that it did."""
    try:
        with storage_errors(folder.runs), _exits_as_errors():
            yield
    except Exception as error:
        _record_failure(error, values, folder)
        raise


@contextmanager
def _exits_as_errors() -> Iterator[None]:
    """Raise TrainingError where code of the trial ends the process, whose exit code might be that of a success.

    ``os._exit`` in this process counts, too; a process that was forked from it may end so.
    """
    owner, end_at_once = os.getpid(), os._exit

    def end(status: int) -> NoReturn:
        if os.getpid() == owner:
            raise SystemExit(status)
        end_at_once(status)

    os._exit = end
    try:
        yield
    except SystemExit as ended:
        text = f"code of the trial ended the process (exit code {ended.code}) instead of returning"
        raise TrainingError(text) from ended
    finally:
        os._exit = end_at_once


def _record_failure(error: Exception, values: dict[str, Any], folder: TrialFolder) -> None:
    log.debug("the trial failed", exc_info=True)
    kind = type(error).__name__
    message = str(error) if isinstance(error, GsbenchError) else f"{kind}: {error}"
    record = {"status": "failed", "error": kind, "message": message, "traceback": traceback.format_exc()}
    with suppress(OSError):  # on a full disk the error itself has to do
        write_json(folder.path / FAILED, record | {"time": time.time(), "seed": values["seed"]})


def _run(trial: Trial, folder: TrialFolder, mirror: Mirror) -> TrialRecord:
    """Build every step, show its files in the trial's folder, write the results."""
    values = trial.values
    with _recorded_failures(values, folder):
        parts = Parts(values)
        parts.complete()
        torch.set_num_threads(parts.threads)

        def announce(stage: Stage, place: Path) -> None:
            write_json(folder.path / BUILDING, {"stage": stage.name, "folder": str(place)})

        store = Store(folder.runs / layout.STORE, announce)
        write_text(folder.path / CONFIG, trial.yaml)
        (folder.path / FAILED).unlink(missing_ok=True)
        pipeline = TrialSteps(parts, store)
    entries: dict[str, Entry] = {}
    code: dict[str, str] = {}
    mirror.follow(folder.path, values["tracking"])
    with _recorded_failures(values, folder):
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
    pictures = {name: evaluated / name for name in (layout.RENDERS, layout.MAPS, layout.FIGURES)}
    truth = entries[GROUND_TRUTH.name].path
    for name, source in (pictures | {layout.GROUND_TRUTH: truth, layout.MASKS: truth / layout.MASKS}).items():
        files = sorted([*source.glob("*.png"), *source.glob("*.npz")])
        links |= {folder / name / file.name: file for file in files}
    if (init / PICTURE_FILE).exists():
        links[folder / layout.FIGURES / layout.INITIAL_CLOUD] = init / PICTURE_FILE
    for link, file in links.items():
        link.parent.mkdir(exist_ok=True)
        link_or_copy(file, link)
    return list(links)
