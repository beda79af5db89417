"""The content of a trial's ``results.json``, from the results of its steps."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsbench import __version__
from gsbench.events import sum_events
from gsbench.init.base import GAUSSIANS_FILE, MODEL_FOLDER, REPORT_FILE
from gsbench.parsing import read_json, read_typed
from gsbench.runs import keys, layout
from gsbench.runs.code import config_hash, user_modules
from gsbench.runs.configuration import arm_hash, flatten, sha256_of
from gsbench.runs.store import StoredResult, read_manifest
from gsbench.runs.trial_record import (
    FROM_MODEL,
    MADE_ELSEWHERE,
    Budget,
    Code,
    Evaluation,
    Oddity,
    Training,
    TrialRecord,
    TwinViews,
    read_rows,
    split_text,
)
from gsbench.scene.rules import settle
from gsbench.scene.types import Capture, Scene
from gsbench.system.install import version_of
from gsbench.train.proof import Proven

MEASURED = keys.INIT, keys.TRAIN, keys.EVALUATE  # stages whose time and key are recorded
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
    init, trained, evaluated = (entries[stage.name] for stage in MEASURED)
    training = read_typed(trained.path / layout.TRAINING, Training)
    evaluation = read_typed(evaluated.path / layout.METRICS, Evaluation)
    manifest = read_manifest(evaluated.path)
    init_report = read_json(init.path / REPORT_FILE)
    views = [*scene.train, *scene.test]
    copied = {name: getattr(training, name) for name in OF_TRAINING}
    copied |= {name: getattr(evaluation, name) for name in OF_EVALUATION}
    return TrialRecord(
        status="complete",
        experiment=values["name"],
        **{group: values[group]["name"] for group in ("scene", "init", "densify")},
        seed=values["seed"],
        raster=raster.rasterizer.name,
        raster_proof=raster.proof,
        raster_passed_over=[*raster.passed_over],
        protocol=manifest.inputs["protocol"],
        unavailable=evaluation.unavailable | _unknown_costs(training),
        measured=manifest.created,  # of an evaluation found in the store: when it was put there
        questions=asked,
        metric_facts=evaluation.facts,
        metrics_at=evaluation.at,
        oddities=_oddities(capture, scene, init_report, training),
        twins=TwinViews(
            left_out={**capture.left_out, **scene.twins.left_out}, near=dict(scene.twins.near)
        ),
        seconds=_seconds(init, training, evaluated),
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
        hashes=_hashes(values, capture, entries),
        code=Code(
            sources=user_modules(values),
            stages={stage.name: stage.version for stage in keys.STAGES},
            packages=dict(sorted(code.items())),
            **training.checkout,
        ),
        versions=versions(),
        evaluated_from=FROM_MODEL if training.was_given else training.evaluated_from,
        **copied,
    )


def _oddities(
    capture: Capture, scene: Scene, init_report: Mapping[str, Any], training: Training
) -> list[Oddity]:
    """The oddities of all stages; raises InputError for one whose rule is not accepted here."""
    of_model = [Oddity(**odd) for odd in init_report.get("oddities", ())]
    found = [*capture.oddities, *scene.oddities, *of_model, *training.oddities]
    # A stage of the store may have been made with a rule accepted that is not accepted here.
    refused = [odd for odd in found if odd.refused]
    settle(refused, f"scene {capture.name}", capture.accept)
    return found


def _hashes(
    values: dict[str, Any], capture: Capture, entries: Mapping[str, StoredResult]
) -> dict[str, str]:
    """The hashes of settings, photographs and initial cloud, and the keys of the stages."""
    return {
        "config": config_hash(values),
        "arm": arm_hash(values),
        "data": capture.fingerprint,
        "cloud": cloud_hash(entries[keys.INIT.name].path),
        **{stage.name: entries[stage.name].key for stage in MEASURED},
    }


def _seconds(init: StoredResult, training: Training, evaluated: StoredResult) -> dict[str, float]:
    """The seconds of each stage; without a training, none for it."""
    seconds = {"init": init.seconds, "train": training.seconds, "evaluate": evaluated.seconds}
    if training.was_given:
        del seconds["train"]
    if training.compile_seconds is not None:
        seconds["compile"] = training.compile_seconds
    return seconds


def _unknown_costs(training: Training) -> dict[str, str]:
    """The costs that were not measured, each with the reason, if gsbench did not train."""
    unknown = {}
    if training.peak_memory_mb is None:
        unknown["peak_memory_mb"] = "another program's memory of a GPU is not measured"
    if training.was_given:
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
