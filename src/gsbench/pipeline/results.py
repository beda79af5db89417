"""Content of a finished trial's ``results.json``, put together from the results of its steps."""

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsbench import __version__
from gsbench.events import sum_events
from gsbench.init.base import GAUSSIANS_FILE, MODEL_FOLDER, REPORT_FILE
from gsbench.parsing import read_json
from gsbench.runs.code import user_modules
from gsbench.runs.declaration import read_declarations
from gsbench.runs.keys import EVALUATE, INIT, STAGES, TRAIN, config_hash, flatten, sha256_of
from gsbench.runs.layout import EVENTS
from gsbench.runs.made_of import version_of
from gsbench.runs.store import StoredResult, read_manifest
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import (
    FROM_MODEL,
    FROM_RENDERS,
    MADE_ELSEWHERE,
    RENDERS_ALONE,
    Budget,
    Code,
    Declared,
    ExternalTrainer,
    Training,
    TrialRecord,
    read_evaluation,
    read_rows,
    read_training,
    split_text,
)
from gsbench.scene.types import Capture, Scene

PACKAGES = ("torch", "numpy", "numba", "pycolmap", "kornia", "gsplat")  # on whose versions a result depends


def results_of(
    values: dict[str, Any],
    capture: Capture,
    scene: Scene,
    raster: str,
    entries: Mapping[str, StoredResult],
    code: Mapping[str, str],
) -> TrialRecord:
    """The results of the trial with the configuration ``values``.

    ``capture`` are the photographs, ``raster`` names the executor that rendered, ``entries`` are the steps' store
    entries by stage. ``code`` maps the parts of gsbench's source that the steps used to their states.
    """
    init, trained, evaluated = entries[INIT.name], entries[TRAIN.name], entries[EVALUATE.name]
    training, evaluation = read_training(trained.path), read_evaluation(evaluated.path)
    manifest = read_manifest(evaluated.path)
    events = read_rows(trained.path / EVENTS)
    sizes = sorted({(view.camera.width, view.camera.height) for view in [*scene.train, *scene.test]}, reverse=True)
    results = TrialRecord(
        status="complete",
        experiment=values["name"],
        scene=values["scene"]["name"],
        init=values["init"]["name"],
        densify=values["densify"]["name"],
        seed=values["seed"],
        raster=raster,
        protocol=manifest.inputs["protocol"],
        iterations=training.iterations,
        metrics=evaluation.metrics,
        unavailable=evaluation.unavailable,
        measured=manifest.created,  # of an evaluation found in the store: when it was put there
        declared=_declared(values),
        awaited=evaluation.awaited,
        metric_facts=evaluation.facts,
        metrics_at=evaluation.at,
        num_init_points=training.num_init_points,
        num_gaussians=training.num_gaussians,
        causes=training.causes,
        scene_extent=training.scene_extent,
        seconds={"init": init.seconds, "train": training.seconds, "evaluate": evaluated.seconds},
        peak_memory_mb=training.peak_memory_mb,
        budget=Budget(
            max_gaussians=values["densify"].get("max_gaussians"),
            cap=values["densify"].get("cap"),
            seconds=values["train"]["max_seconds"],
        ),
        train_views=len(scene.train),
        test_views=len(scene.test),
        split=split_text(flatten(values)),
        held_out=capture.held_out,
        resolution=sizes[0],
        events=sum_events(events),
        init_report=read_json(init.path / REPORT_FILE),
        hashes={
            "config": config_hash(values),
            "data": capture.fingerprint,
            "init": init.key,
            "cloud": cloud_hash(init.path),
            "train": trained.key,
            "evaluate": evaluated.key,
        },
        code=Code(
            sources=user_modules(values),
            stages={stage.name: stage.version for stage in STAGES},
            rooms=dict(sorted(code.items())),
            **training.checkout,
        ),
        machine=training.machine,
        versions=versions(),
        evaluated_from=training.evaluated_from,
    )
    if training.trained_by is not None:
        return _trained_by_program(results, training, training.trained_by)
    return results if training.iterations else _without_training(results)


def _trained_by_program(results: TrialRecord, training: Training, trainer: ExternalTrainer) -> TrialRecord:
    """The results of a training by another program, which may have left only renders and no model."""
    unknown = {}
    if training.evaluated_from == FROM_RENDERS:
        unknown["gaussians"] = RENDERS_ALONE
    if training.peak_memory_mb is None:
        unknown["peak_memory_mb"] = "another program's memory of a GPU is not measured"
    return replace(
        results,
        trained_by=trainer,
        raster="unknown" if training.evaluated_from == FROM_RENDERS else results.raster,
        unavailable=results.unavailable | unknown,
    )


def _declared(values: dict[str, Any]) -> Declared | None:
    """The newest declaration of the trial's primary metric, which its verdict is about; None if there is none."""
    home = TrialFolder.of(values).home
    metric = values["eval"].get("primary")
    declarations = [
        declaration
        for declaration in read_declarations(home)
        if not declaration.of_claims and declaration.primary == metric
    ]
    return declarations[-1].summary() if declarations else None


def _without_training(results: TrialRecord) -> TrialRecord:
    """The results of a model that came ready-made: its training time is unknown, not 0."""
    unknown = dict.fromkeys(("train_time", "total_time"), f"{MADE_ELSEWHERE}: not trained here")
    return replace(
        results,
        evaluated_from=FROM_MODEL,
        seconds={stage: seconds for stage, seconds in results.seconds.items() if stage != TRAIN.name},
        unavailable=results.unavailable | unknown,
    )


def cloud_hash(init: Path) -> str:
    """The hash of what an initialiser made: cameras, poses and points, or Gaussians.

    The step's key cannot stand for it: that is a hash of the inputs only.
    """
    files = read_manifest(init).outputs
    model = (f"{MODEL_FOLDER.as_posix()}/", GAUSSIANS_FILE)
    kept = {name: file.sha256 for name, file in files.items() if name.startswith(model)}
    return sha256_of(kept)


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    own = {"python": sys.version.split()[0], "gsbench": __version__}
    return own | {package: version for package in PACKAGES if (version := version_of(package)) is not None}
