"""The listing of a dry run, with an estimate of its time. Loads no torch."""

import json
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from functools import cache
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.launch.states import ask_queue, labels_of, state_in_queue, summary_of
from gsbench.parsing import DamagedError
from gsbench.runs.configuration import Values, sha256_of
from gsbench.runs.layout import RESULTS, TRIAL_GLOB
from gsbench.runs.trial_folder import TrialFolder
from gsbench.scene.images import image_size
from gsbench.scene.names import IMAGE_SUFFIXES
from gsbench.scene.options import downscaled_size
from gsbench.system.resources import available_threads, installed_gpus
from gsbench.words import counted, readable_time


class FinishedTrials:
    """The finished trials below the folder ``runs``.

    All are read once, to compare ten thousand planned ones with them.
    """

    def __init__(self, runs: Path) -> None:
        self._folders: dict[str, list[Path]] = defaultdict(list)
        # seconds per iteration, by `_similarities`
        self._seconds: dict[str, list[float]] = defaultdict(list)
        for path in runs.glob(f"*/{TRIAL_GLOB}/{RESULTS}"):
            files = TrialFolder(path.parent)
            record = files.sound_record()
            if record is None:
                continue
            self._folders[path.parent.name].append(path.parent)
            if record.iterations:
                seconds = sum(record.seconds.get(step, 0.0) for step in ("train", "evaluate"))
                with suppress(FileNotFoundError, DamagedError, KeyError, TypeError):
                    for similarity in _similarities(files.settings()):
                        self._seconds[similarity].append(seconds / record.iterations)

    def elsewhere(self, trial: TrialFolder) -> str | None:
        """Another experiment that has finished the same trial, whose stages are reused, or None."""
        others = (
            folder for folder in self._folders.get(trial.path.name, ()) if folder != trial.path
        )
        return next((folder.relative_to(trial.runs).parts[0] for folder in others), None)

    def estimate(self, values: Values) -> tuple[float, int]:
        """Seconds for the trial with ``values``, and the number of trials that this rests on.

        These trials have the same scene at the same size, the same rasterizer and, if possible, the
        same densifier. Times are taken per iteration. Returns ``(0, 0)`` without such trials.
        """
        for similarity in _similarities(values):
            if seconds := self._seconds.get(similarity):
                return fmean(seconds) * values["train"]["iterations"], len(seconds)
        return 0.0, 0


def _similarities(settings: Values) -> tuple[str, str]:
    """Hashes of scene, rasterizer and densifier, and of scene and rasterizer.

    Trials that share one of them take similar times.
    """
    shared = [settings["scene"], settings["raster"]["name"]]
    return sha256_of([*shared, settings["densify"]["name"]]), sha256_of(shared)


def describe_plan(trials: Sequence[Trial], parallel: int = 1) -> list[str]:
    """Lines for ``--dry-run``: each trial with its state, and the time for the unfinished ones."""
    lines: list[str] = []
    remaining, without_estimate, learned_from = 0.0, 0, 0
    guess = ""  # for the last trial that no finished one is similar to
    states: list[str] = []
    finished = FinishedTrials(trials[0].files.runs)
    queue = ask_queue(trial.folder for trial in trials)
    labels = labels_of(trials)
    for trial in trials:
        folder = trial.files
        state: str = folder.state()
        if state not in ("done", "running"):
            state = state_in_queue(folder.path, queue) or state
        note = ""
        if state == "done":
            # A run may check it again; whether it would is asked without downloads.
            left = folder.why_not_done(
                trial.values, lambda options: unavailable_now(options | {"download": False})
            )
            note = f"  will be checked: {left}" if left else ""
        elif experiment := finished.elsewhere(folder):
            note = f"  as in {experiment}: nothing to compute"
        else:
            seconds, known_from = finished.estimate(trial.values)
            if not known_from and (found := guess_training(trial.values, parallel)):
                seconds, guess = found
            # a stopped training goes on from its checkpoint
            remaining += seconds * (1 - folder.share_done(trial.values["train"]["iterations"]))
            learned_from = max(learned_from, known_from)
            without_estimate += seconds == 0
        states.append(state)
        lines.append(f"{state:<8} {labels[folder.path]}{note}")
    lines.append(summary_of(states))
    if {*states} == {"done"}:
        return lines
    if without_estimate:
        time = (
            "no estimate: no finished trial of this scene with this rasterizer tells how long "
            "one takes here"
        )
    elif not (learned_from or guess):
        time = "seconds, since other experiments have the results"
    else:
        at_once = f", {parallel} at once" if parallel > 1 else ""
        duration = readable_time(remaining / parallel)
        sources = [f"estimated from {counted(learned_from, 'finished trial')}"] * (learned_from > 0)
        sources += [f"{guess}; without compiling (once) and initial clouds (SfM)"] * bool(guess)
        time = f"about {duration}{at_once}, {'; '.join(sources)}"
    return [*lines, f"time: {time}"]


def unavailable_now(options: Mapping[str, Any]) -> Collection[str]:
    """The metrics that cannot be computed now, by the ``eval`` settings.

    Weights are searched for, and downloaded, once per sweep.
    """
    return _unavailable_now(json.dumps(options, sort_keys=True))


@cache
def _unavailable_now(options: str) -> Collection[str]:
    from gsbench.eval.options import EvalConfig
    from gsbench.pipeline.parts import make_evaluator

    return make_evaluator(EvalConfig(**json.loads(options))).awaited


# ---- a first guess from the size of pictures, as long as no finished trial tells more

# Seconds of a step, measured (docs/measurements.md). On one thread of a CPU: projecting, sorting,
# their gradients and Adam for each Gaussian, compositing, its gradient and the loss for each pixel.
# On an H100: 100,000 and 1 million Gaussians took 1.3 and 3.0 ms.
CPU_OF_GAUSSIAN, CPU_OF_PIXEL = 0.0241 / 100_000, 0.0294 / (500 * 375)
GPU_OF_STEP, GPU_OF_GAUSSIAN = 0.0011, 1.9e-9
THREADS, SPEED_UP = (1, 2, 4, 8, 16), (1, 1.9, 3.4, 5.5, 6.3)
# A trained courtyard has 0.46 Gaussians for each pixel of a picture.
GAUSSIANS_OF_PIXEL = 0.46
MAX_ENTRIES = 10_000  # of a folder that are looked at for a picture


def guess_training(values: Values, parallel: int = 1) -> tuple[float, str] | None:
    """The seconds of a training, and what they rest on; None without a picture."""
    size = picture_size(values["scene"])
    if size is None:
        return None
    pixels = size[0] * size[1]
    gaussians = round(GAUSSIANS_OF_PIXEL * pixels)
    gaussians = min(gaussians, values["densify"].get("max_gaussians") or gaussians)
    on_gpu = values["device"] != "cpu" and has_gpu()
    if on_gpu:
        step = GPU_OF_STEP + GPU_OF_GAUSSIAN * gaussians
    else:
        given = values["threads"]
        threads = available_threads(parallel) if given == "auto" else given
        step = CPU_OF_GAUSSIAN * gaussians + CPU_OF_PIXEL * pixels
        step /= float(np.interp(threads, THREADS, SPEED_UP))
    text = (
        f"a first guess for trainings on {'an H100' if on_gpu else 'this CPU'}, from pictures of "
        f"{size[0]}×{size[1]} px and {gaussians:,} Gaussians"
    )
    return step * values["train"]["iterations"], text


def picture_size(scene: Mapping[str, Any]) -> tuple[int, int] | None:
    """The size, in px, to which the first picture of a scene is brought for the training."""
    size = _first_size(scene.get("path") or "", scene.get("images") or "images")
    if scene.get("kind") == "courtyard":
        size = scene["width"], scene["height"]
    if size is None:
        return None
    return downscaled_size(*size, scene.get("max_size"))


@cache
def has_gpu() -> bool:
    return bool(installed_gpus())


@cache
def _first_size(path: str, images: str) -> tuple[int, int] | None:
    folder = Path(path).expanduser()
    for place in (folder / images, folder) if path else ():
        for file in islice(place.iterdir(), MAX_ENTRIES) if place.is_dir() else ():
            if file.suffix.lower() in IMAGE_SUFFIXES and file.is_file():
                with suppress(InputError):
                    return image_size(file)
    return None
