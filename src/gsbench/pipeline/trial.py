"""One trial from configuration to ``results.json``."""

from __future__ import annotations

import json
import logging
import os
import shutil
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pycolmap  # noqa: F401 - here, so that what its import does to signals can be undone
import torch

from gsbench.config import EvalConfig, SceneConfig, TrainConfig, config_hash
from gsbench.densify.events import sum_events
from gsbench.errors import GsbenchError
from gsbench.files import remove_temporaries, storage_errors, write_json, write_text
from gsbench.init.base import PICTURE_FILE, REPORT_FILE
from gsbench.pipeline import stages
from gsbench.pipeline.components import build, select_device
from gsbench.pipeline.locks import hold
from gsbench.pipeline.resources import available_threads
from gsbench.pipeline.stage_list import EVALUATE, GROUND_TRUTH, INIT, STAGES, TRAIN
from gsbench.pipeline.stopping import take_signals_back
from gsbench.pipeline.store import Entry, Stage, Store
from gsbench.pipeline.trainer import EVENTS, HISTOGRAMS, METRICS
from gsbench.pipeline.trial_files import (
    BUILDING,
    CONFIG,
    FAILED,
    LOG,
    RESULTS,
    TrialPaths,
    find_finished,
    read_object,
    record_inputs,
)
from gsbench.raster import create_rasterizer, resolve_name
from gsbench.scene.colmap_files import model_files
from gsbench.scene.types import Capture
from gsbench.source import sources_of
from gsbench.tracking import Mirror

log = logging.getLogger(__name__)


def run_trial(values: dict[str, Any], config_yaml: str, wait: bool = True) -> dict[str, Any]:
    """Run the trial with the resolved configuration ``values``, or find it done; returns what ``results.json`` holds.

    On failure ``failed.json`` and ``log.txt`` in the trial's folder say why, and the error is raised again. Where
    another process runs this trial, waits for it, or raises BusyError if ``wait`` is False.
    """
    take_signals_back()
    paths = TrialPaths.of(values)
    with storage_errors(paths.runs):
        paths.folder.mkdir(parents=True, exist_ok=True)
        with hold(paths.lock, paths.label, wait), _log_to(paths.folder / LOG):
            finished = find_finished(values)
            if finished is not None:
                log.info("%s: was done", paths.label)
                return finished
            remove_temporaries(paths.folder)
            try:
                with storage_errors(paths.runs):
                    return _run(values, config_yaml, paths)
            except Exception as error:
                _record_failure(error, values, paths)
                raise


def _record_failure(error: Exception, values: dict[str, Any], paths: TrialPaths) -> None:
    log.debug("the trial failed", exc_info=True)
    kind = type(error).__name__
    message = str(error) if isinstance(error, GsbenchError) else f"{kind}: {error}"
    record = {"status": "failed", "error": kind, "message": message, "traceback": traceback.format_exc()}
    with suppress(OSError):  # on a full disk the error itself has to do
        write_json(paths.folder / FAILED, record | {"time": time.time(), "seed": values["seed"]})


def _run(values: dict[str, Any], config_yaml: str, paths: TrialPaths) -> dict[str, Any]:
    device = select_device(values["device"])
    threads = available_threads(values["launch"]["parallel"]) if values["threads"] == "auto" else values["threads"]
    torch.set_num_threads(threads)
    rasterizer = create_rasterizer(resolve_name(values["raster"]["name"], device), device, threads)
    densifier = build("densify", values["densify"], values["allow_targets"])
    initializer = build("init", values["init"], values["allow_targets"])
    scene_options = SceneConfig(**values["scene"])
    train_options = TrainConfig(**values["train"])
    eval_options = EvalConfig(**values["eval"])
    mirror = Mirror(values["tracking"], paths.runs, paths.folder, values)

    def announce(stage: Stage, folder: Path) -> None:
        write_json(paths.folder / BUILDING, {"stage": stage.name, "folder": str(folder)})
        if stage is TRAIN:
            mirror.follow(folder)

    store = Store(paths.runs / "store", announce)
    write_text(paths.folder / CONFIG, config_yaml)
    (paths.folder / FAILED).unlink(missing_ok=True)
    with mirror:
        capture = stages.read_capture(store, scene_options)
        inputs = stages.scene_inputs(capture, scene_options)
        init = stages.initialize(store, capture, initializer)
        _link(init.path / REPORT_FILE, paths.folder / "init_report.json")
        scene = stages.prepare_scene(store, capture, init, scene_options)
        log.info("%s: %d training and %d test views", paths.label, len(scene.train), len(scene.test))
        trained = stages.train(store, scene, inputs, init, densifier, rasterizer, train_options, values["seed"], device)
        ground_truth = stages.keep_ground_truth(store, scene, inputs, init)
        evaluated = stages.evaluate(store, scene, init, trained, rasterizer, train_options, eval_options, device)
        published = _publish(paths.folder, init, trained, evaluated, ground_truth)
        results = _results(values, capture.fingerprint, scene, init, trained, evaluated, rasterizer.name)
        entries = {INIT.name: init, TRAIN.name: trained, GROUND_TRUTH.name: ground_truth, EVALUATE.name: evaluated}
        where = {name: entry.path for name, entry in entries.items()}
        again = read_object(paths.folder / RESULTS) == results
        record_inputs(paths.folder, values, results, source_files(capture, store), where, published)
        if not again:
            write_json(paths.folder / RESULTS, results)
        (paths.folder / BUILDING).unlink(missing_ok=True)
    metrics = "  ".join(f"{key} {value:.4g}" for key, value in results["metrics"].items())
    log.info("%s: %s  %d Gaussians%s", paths.label, metrics, results["num_gaussians"], "  (was done)" if again else "")
    return results


def source_files(capture: Capture, store: Store) -> list[Path]:
    """The user's files that a capture was read from; none for a scene that was made in the store."""
    if capture.images.resolve().is_relative_to(store.root.resolve()):
        return []
    images = [(capture.images / name).resolve() for name in capture.image_names]
    return images + ([] if capture.model is None else [path.resolve() for path in model_files(capture.model)])


def _results(
    values: dict[str, Any],
    fingerprint: str,
    scene: Any,
    init: Entry,
    trained: Entry,
    evaluated: Entry,
    raster: str,
) -> dict[str, Any]:
    training = json.loads((trained.path / stages.TRAINING_FILE).read_text())
    metrics = json.loads((evaluated.path / stages.METRICS_FILE).read_text())
    events = [json.loads(line) for line in (trained.path / EVENTS).read_text().splitlines()]
    views = [*scene.train, *scene.test]
    sizes = sorted({(view.camera.width, view.camera.height) for view in views}, reverse=True)
    return {
        "status": "complete",
        "experiment": values["name"],
        "scene": values["scene"]["name"],
        "init": values["init"]["name"],
        "densify": values["densify"]["name"],
        "seed": values["seed"],
        "raster": raster,
        "protocol": evaluated_protocol(evaluated),
        "iterations": training["iterations"],
        "metrics": metrics["metrics"],
        "unavailable": metrics["unavailable"],
        "num_init_points": training["num_init_points"],
        "num_gaussians": training["num_gaussians"],
        "causes": training["causes"],
        "scene_extent": training["scene_extent"],
        "seconds": {"init": init.seconds, "train": training["seconds"], "evaluate": evaluated.seconds},
        "peak_memory_mb": training["peak_memory_mb"],
        "budget": {key: values["densify"].get(key) for key in ("max_gaussians", "cap")}
        | {"seconds": values["train"]["max_seconds"]},
        "train_views": len(scene.train),
        "test_views": len(scene.test),
        "resolution": list(sizes[0]),
        "events": sum_events(events),
        "init_report": json.loads((init.path / REPORT_FILE).read_text()),
        "hashes": {
            "config": config_hash(values),
            "data": fingerprint,
            "init": init.key,
            "train": trained.key,
            "evaluate": evaluated.key,
        },
        "code": {"sources": sources_of(values), "stages": {stage.name: stage.version for stage in STAGES}},
        "versions": stages.versions(),
    }


def evaluated_protocol(evaluated: Entry) -> str:
    """The protocol's id, from the manifest of an evaluation."""
    return str(json.loads((evaluated.path / "manifest.json").read_text())["inputs"]["protocol"])


def _publish(folder: Path, init: Entry, trained: Entry, evaluated: Entry, ground_truth: Entry) -> list[Path]:
    """Show the stages' files in the trial's folder, as hard links where the file system has them; returns the links."""
    names = (stages.PLY_FILE, stages.LINEAGE_FILE, METRICS, EVENTS, HISTOGRAMS)
    links = {folder / name: trained.path / name for name in names if (trained.path / name).exists()}
    links[folder / stages.PER_VIEW_FILE] = evaluated.path / stages.PER_VIEW_FILE
    sources = {
        "renders": evaluated.path / "renders",
        "ground_truth": ground_truth.path,
        "maps": evaluated.path / "maps",
        "figures": evaluated.path / "figures",
    }
    for target, source in sources.items():
        files = sorted([*source.glob("*.png"), *source.glob("*.npz")])
        links |= {folder / target / file.name: file for file in files}
    if (init.path / PICTURE_FILE).exists():
        links[folder / "figures" / "initial_cloud.png"] = init.path / PICTURE_FILE
    for link, file in links.items():
        link.parent.mkdir(exist_ok=True)
        _link(file, link)
    return list(links)


def _link(source: Path, target: Path) -> None:
    temporary = target.with_name(f".{target.name}.tmp-{os.getpid()}")
    temporary.unlink(missing_ok=True)
    try:
        os.link(source, temporary)
    except OSError:
        shutil.copyfile(source, temporary)
    os.replace(temporary, target)
    temporary.unlink(missing_ok=True)  # os.replace leaves it where both are links to one file


class _QuietFileHandler(logging.FileHandler):
    """Keeps silent where it cannot write: on a full disk the trial's own error says so."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        return


@contextmanager
def _log_to(path: Path) -> Iterator[None]:
    """Write everything that gsbench logs, tracebacks included, to ``path`` as well."""
    handler = _QuietFileHandler(path, encoding="utf-8")
    handler.setLevel(logging.DEBUG)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logger = logging.getLogger("gsbench")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        with suppress(OSError):
            handler.close()
