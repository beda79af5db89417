"""Training by another program: it gets the training views, and leaves a model."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.densify import Lineage
from gsbench.errors import InputError, TrainingError
from gsbench.external.exchange import collect_model, write_training_views
from gsbench.external.run import ProgramResult, run_program
from gsbench.external.settings import (
    DATA,
    FOLDERS,
    OUTPUT,
    External,
    fill_placeholders,
    split_command,
)
from gsbench.init import read_cloud
from gsbench.init.base import MODEL_FOLDER, PointCloud
from gsbench.pipeline.steps.scene import Views
from gsbench.pipeline.steps.train import check_points, write_training
from gsbench.runs.keys import TRAIN, Step, options_of, step_of
from gsbench.runs.layout import EVENTS, POINT_CLOUD, TRAINER_LOG
from gsbench.runs.trial_record import FROM_MODEL
from gsbench.system.programs import SAFE_PATH
from gsbench.words import readable_time

if TYPE_CHECKING:
    from gsbench.pipeline.parts import Parts

log = logging.getLogger(__name__)

CONTRACT = 1  # raise it when the files that a program gets, or must leave, change
WORK = "work"  # subfolder of the build: the program's inputs and outputs
SECONDS_TO_TELL_VERSION = 120.0
MAX_OUTPUT = 200  # characters of the version command's output that an error quotes
OWN_VARIABLES = "GSBENCH_"  # prefix of gsbench's own settings, which the program does not get


def external_step(views: Views, trainer: External, parts: Parts) -> Step:
    """The step in which ``trainer`` trains on the training views, from the initialiser's cloud.

    Raises InputError for a capture with masks.
    """
    if views.capture.masks:
        raise InputError(
            f"densify={parts.values['densify']['name']}: another program gets no masks, so it "
            "would train on ignored pixels: leave scene.masks out, or train with gsbench"
        )
    iterations, device = parts.train.iterations, parts.device
    repetition = {"iterations": iterations, "seed": parts.seed}
    inputs: dict[str, Any] = {
        "contract": CONTRACT,
        "scene": views.inputs,
        "init": views.init.key,
        "densify": options_of("densify", trainer),
        **repetition,
    }

    def build(folder: Path) -> None:
        cloud = read_cloud(views.store.path(views.init) / MODEL_FOLDER)
        start = check_points(cloud.points, cloud.colors, views, parts)
        here = {"device": str(device), "threads": parts.threads}
        values = {name: str((folder / WORK / name).resolve()) for name in FOLDERS}
        values |= trainer.options | repetition | here
        ended, said = _run(trainer, values, views, cloud, folder / TRAINER_LOG)
        count = _collect(trainer, views, values, folder)
        shutil.rmtree(folder / WORK)
        (folder / EVENTS).write_text("")
        # The record has placeholders instead of the folders in the command, which are deleted.
        nameless = values | {name: f"{{{name}}}" for name in FOLDERS}
        summary = {
            "evaluated_from": FROM_MODEL,
            "num_gaussians": count,
            "iterations": iterations,
            "num_init_points": len(cloud),
            "seconds": ended.seconds,
            # Only the program itself could measure its memory on a GPU.
            "peak_memory_mb": ended.peak_memory_mb if device.type == "cpu" else None,
            "trained_by": {
                "program": trainer.program,
                "version": trainer.version,
                "said": said,
                "command": filled_command(trainer, nameless),
            },
        }
        # without causes: which rule of the program made a Gaussian is unknown here
        write_training(folder, summary, Lineage(count), views, device, start)

    # The stage has its own version, because changes of gsbench's trainer do not affect it. It is
    # not resumable, because a stopped program starts from the beginning.
    stage = replace(TRAIN, version=1, resumable=False)
    return step_of(stage, inputs, build)


def _run(
    trainer: External, values: Mapping[str, Any], views: Views, cloud: PointCloud, log_file: Path
) -> tuple[ProgramResult, str | None]:
    """Run the program on its inputs, which are then removed; returns its end, and `check_version`.

    ``values`` replace the placeholders, among them the folders of inputs and results.
    """
    executable, environment = trainer.executable(), environment_of(trainer, values)
    said = check_version(trainer, values, environment)
    data, output = Path(values[DATA]), Path(values[OUTPUT])
    output.mkdir(parents=True)
    write_training_views(data, views.scene.train, cloud, views.capture.normalization)
    command = [executable, *filled_command(trainer, values)[1:]]
    limit = None if trainer.time_limit_minutes is None else 60 * trainer.time_limit_minutes
    log.info("train: %s runs; its output: %s", trainer.program, log_file)
    try:
        ended = run_program(command, log_file, output, environment, limit)
    finally:
        shutil.rmtree(data, ignore_errors=True)
    log.info("train: %s ended after %s", trainer.program, readable_time(ended.seconds))
    return ended, said


def filled_command(trainer: External, values: Mapping[str, object]) -> list[str]:
    """The words of the program's command with ``values`` in place of the placeholders."""
    return [fill_placeholders(word, values, "densify.command") for word in trainer.words]


def _collect(trainer: External, views: Views, values: Mapping[str, Any], folder: Path) -> int:
    """Move the model from the output to ``folder``; returns the number of its Gaussians.

    Raises TrainingError, with the log's path, if the program left something else.
    """
    pattern, output = fill_placeholders(trainer.result, values, "densify.result"), values[OUTPUT]
    normalization = views.capture.normalization
    try:
        return len(collect_model(Path(output), pattern, folder / POINT_CLOUD, normalization))
    except TrainingError as error:
        raise TrainingError(
            f"{Path(trainer.program).name} ended well, but {error}; log: {folder / TRAINER_LOG}"
        ) from error


def environment_of(trainer: External, values: Mapping[str, object]) -> dict[str, str]:
    """The program's environment: gsbench's without its variables, and ``densify.environment``."""
    # SAFE_PATH is left out too, because a train.py must find the modules beside it.
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(OWN_VARIABLES) and (name, value) != SAFE_PATH
    }
    for name, text in trainer.environment.items():
        environment[name] = fill_placeholders(text, values, f"densify.environment.{name}")
    return environment


def check_version(
    trainer: External, values: Mapping[str, object], environment: Mapping[str, str]
) -> str | None:
    """Run ``densify.version_command``; return its output on one line, None without a command.

    Raises `InputError` unless the output contains ``densify.version``.
    """
    if trainer.version_command is None:
        return None
    key = "densify.version_command"
    command = [
        fill_placeholders(word, values, key) for word in split_command(trainer.version_command, key)
    ]
    try:
        # It runs in an empty folder, because `python -c` imports modules of the current folder.
        with tempfile.TemporaryDirectory(prefix="gsbench-version-") as empty:
            done = subprocess.run(
                command,
                cwd=empty,
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=SECONDS_TO_TELL_VERSION,
                check=False,
            )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(f"{key} cannot be run ({error})") from error
    output = " ".join((done.stdout + done.stderr).split())
    if trainer.version not in output:
        raise InputError(
            f"densify.version is {trainer.version!r}, but `{' '.join(command)}` says "
            f"{output[:MAX_OUTPUT]!r}: results are kept by the version, so set densify.version "
            "to what it is"
        )
    return output
