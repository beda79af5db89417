"""What ``results.json`` of a finished trial holds, from the results of its steps."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from gsbench import __version__
from gsbench.events import sum_events
from gsbench.init.base import GAUSSIANS_FILE, MODEL_FOLDER, REPORT_FILE
from gsbench.runs.declaration import read_declarations
from gsbench.runs.hashing import config_hash, sha256_of
from gsbench.runs.layout import EVENTS, MANIFEST, METRICS, TRAINING
from gsbench.runs.origin import FROM_MODEL, FROM_RENDERS, MADE_ELSEWHERE, RENDERS_ALONE
from gsbench.runs.source import sources_of
from gsbench.runs.stages import EVALUATE, INIT, STAGES, TRAIN
from gsbench.runs.store import Entry
from gsbench.runs.trial_files import TrialPaths
from gsbench.scene.types import Scene

# What an evaluation has beside metrics, and its name in results: of the unavailable metrics those that may still come;
# how a user's own metrics are to be read; metrics at earlier iterations.
EVALUATED = {"awaited": "awaited", "facts": "metric_facts", "at": "metrics_at"}
PACKAGES = ("torch", "numpy", "numba", "pycolmap", "kornia", "gsplat")  # on whose versions a result depends


def results_of(
    values: dict[str, Any],
    fingerprint: str,
    scene: Scene,
    raster: str,
    entries: Mapping[str, Entry],
    code: Mapping[str, str],
) -> dict[str, Any]:
    """The results of the trial with the configuration ``values``; ``entries`` are those of its steps, by stage.

    ``fingerprint`` is that of the photographs, ``raster`` the executor that rendered, ``code`` the files of gsbench
    that had a part, with their states.
    """
    init, trained, evaluated = entries[INIT.name], entries[TRAIN.name], entries[EVALUATE.name]
    training = _read(trained.path / TRAINING)
    metrics = _read(evaluated.path / METRICS)
    events = [json.loads(line) for line in (trained.path / EVENTS).read_text().splitlines()]
    sizes = sorted({(view.camera.width, view.camera.height) for view in [*scene.train, *scene.test]}, reverse=True)
    results = {
        "status": "complete",
        "experiment": values["name"],
        "scene": values["scene"]["name"],
        "init": values["init"]["name"],
        "densify": values["densify"]["name"],
        "seed": values["seed"],
        "raster": raster,
        "protocol": _read(evaluated.path / MANIFEST)["inputs"]["protocol"],
        "iterations": training["iterations"],
        "metrics": metrics["metrics"],
        "unavailable": metrics["unavailable"],
        "measured": _read(evaluated.path / MANIFEST)["created"],  # of what came from the store: when it came there
        **_declared(values),
        **{key: metrics[name] for name, key in EVALUATED.items() if name in metrics},
        "num_init_points": training["num_init_points"],
        "num_gaussians": training["num_gaussians"],
        "causes": training["causes"],
        "scene_extent": training["scene_extent"],
        "seconds": {"init": init.seconds, "train": training["seconds"], "evaluate": evaluated.seconds},
        "peak_memory_mb": training["peak_memory_mb"],
        "budget": {
            "max_gaussians": values["densify"].get("max_gaussians"),
            "cap": values["densify"].get("cap"),
            "seconds": values["train"]["max_seconds"],
        },
        "train_views": len(scene.train),
        "test_views": len(scene.test),
        "resolution": list(sizes[0]),
        "events": sum_events(events),
        "init_report": _read(init.path / REPORT_FILE),
        "hashes": {
            "config": config_hash(values),
            "data": fingerprint,
            "init": init.key,
            "cloud": cloud_hash(init.path),
            "train": trained.key,
            "evaluate": evaluated.key,
        },
        "code": {
            "sources": sources_of(values),
            "stages": {stage.name: stage.version for stage in STAGES},
            "files": dict(sorted(code.items())),
            **training["checkout"],
        },
        "machine": training["machine"],
        "versions": versions(),
    }
    if "trained_by" in training:
        return _by_program(results, training)
    return results if training["iterations"] else _without_training(results)


def _by_program(results: dict[str, Any], training: Mapping[str, Any]) -> dict[str, Any]:
    """The results of a training by another program, which may have left renders alone."""
    origin = training["evaluated_from"]
    unknown = {}
    if origin == FROM_RENDERS:
        unknown["gaussians"] = RENDERS_ALONE
    if training["peak_memory_mb"] is None:
        unknown["peak_memory_mb"] = "another program's memory of a GPU is not measured"
    return results | {
        "evaluated_from": origin,
        "trained_by": training["trained_by"],
        "raster": "unknown" if origin == FROM_RENDERS else results["raster"],
        "unavailable": results["unavailable"] | unknown,
    }


def _declared(values: dict[str, Any]) -> dict[str, Any]:
    """The metric that the verdict was declared to be about when the trial was run, and since when; else nothing."""
    home = TrialPaths.of(values).home
    metric = values["eval"].get("primary")
    said = [declaration for declaration in read_declarations(home) if declaration.metric == metric]
    return {"declared": said[-1].to_record()} if said else {}


def _without_training(results: dict[str, Any]) -> dict[str, Any]:
    """The results of a model that came as it is: what its training took is not known, rather than nothing."""
    unknown = dict.fromkeys(("train_time", "total_time"), f"{MADE_ELSEWHERE}: not trained here")
    seconds = {stage: taken for stage, taken in results["seconds"].items() if stage != TRAIN.name}
    return results | {
        "evaluated_from": FROM_MODEL,
        "seconds": seconds,
        "unavailable": results["unavailable"] | unknown,
    }


def cloud_hash(init: Path) -> str:
    """The hash of what an initialiser made: cameras, poses and points, or Gaussians. Its key is only of its inputs."""
    files = _read(init / MANIFEST)["outputs"]
    model = (f"{MODEL_FOLDER.as_posix()}/", GAUSSIANS_FILE)
    kept = {name: file["sha256"] for name, file in files.items() if name.startswith(model)}
    return sha256_of(kept)


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    found = {"python": sys.version.split()[0], "gsbench": __version__}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def _read(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content
