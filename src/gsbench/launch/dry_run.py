"""The listing of a dry run: the state of each trial, trials that other experiments have finished, and a time estimate.

All finished trials are read once, so that ten thousand planned trials can be compared with ten thousand finished ones.
Loads no torch.
"""

import json
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

from gsbench.config.compose import Trial
from gsbench.launch.states import ask_queue, state_in_queue
from gsbench.parsing import DamagedError
from gsbench.runs.layout import RESULTS, TRIAL_GLOB
from gsbench.runs.trial_folder import TrialFolder
from gsbench.words import counted, readable_time

STATES = ("done", "partial", "missing", "running", "queued", "failed", "damaged")  # in the order of a summary
# The fields (scene, init, densify) that a finished trial must share with the estimated one; the most similar first.
SHARED = ((True, True, True), (True, False, True), (True, False, False), (False, False, True), (False, False, False))
SIZE_SETTINGS = ("name", "path", "width", "height", "downscale", "max_size")  # of a scene: they determine its pixels


@dataclass(frozen=True)
class Estimate:
    """Expected seconds of work, and the number of finished trials that the estimate is from (0: no estimate)."""

    seconds: float
    learned_from: int


@dataclass
class _Times:
    """Sums over finished trials."""

    count: int = 0
    train: float = 0.0  # s per iteration and pixel
    evaluate: float = 0.0  # s per pixel


class FinishedTrials:
    """The finished trials below the folder ``runs``."""

    def __init__(self, runs: Path) -> None:
        self._folders: dict[str, list[Path]] = defaultdict(list)
        self._times: dict[tuple[object, ...], _Times] = defaultdict(_Times)  # by rasterizer, SHARED, and shared names
        self._pixels: dict[str, int] = {}  # pixels of a view by `_size_key`
        for path in runs.glob(f"*/{TRIAL_GLOB}/{RESULTS}"):
            files = TrialFolder(path.parent)
            record = files.sound_record()
            if record is None:
                continue
            self._folders[path.parent.name].append(path.parent)
            try:
                settings = files.settings()
                raster = settings["raster"]["name"]
                size = _size_key(settings["scene"])
            except (FileNotFoundError, DamagedError, KeyError, TypeError):
                continue
            if not record.iterations or record.resolution is None:
                continue
            self._pixels[size] = pixels = max(1, record.resolution[0] * record.resolution[1])
            for shared in SHARED:
                times = self._times[raster, shared, *compress((record.scene, record.init, record.densify), shared)]
                times.count += 1
                times.train += record.seconds.get("train", 0.0) / record.iterations / pixels
                times.evaluate += record.seconds.get("evaluate", 0.0) / pixels

    def elsewhere(self, trial: TrialFolder) -> str | None:
        """Another experiment that has finished the same trial, so that its stages are reused; None if there is none."""
        others = (folder for folder in self._folders.get(trial.path.name, ()) if folder != trial.path)
        return next((folder.relative_to(trial.runs).parts[0] for folder in others), None)

    def estimate(self, values: Mapping[str, Any]) -> Estimate:
        """Seconds for the whole trial with ``values``, from the most similar finished trials with its rasterizer.

        Times are taken per iteration and pixel. There is no estimate for photographs that no trial has read, since
        their size is unknown, and for a damaged configuration, which ``gsbench status`` may pass.
        """
        try:
            return self._estimate(values)
        except (KeyError, TypeError, AttributeError, ArithmeticError):
            return Estimate(0.0, 0)

    def _estimate(self, values: Mapping[str, Any]) -> Estimate:
        names = tuple(values[group]["name"] for group in ("scene", "init", "densify"))
        scene = values["scene"]
        pixels = self._pixels.get(_size_key(scene))
        if pixels is None and scene["kind"] == "courtyard":
            longest = max(scene["width"], scene["height"])
            scale = min(1.0, (scene["max_size"] or longest) / longest)
            pixels = int(scene["width"] * scene["height"] * (scale / scene["downscale"]) ** 2)
        for shared in SHARED:
            times = self._times.get((values["raster"]["name"], shared, *compress(names, shared)))
            if times is not None and pixels is not None:
                seconds = pixels * (times.train * values["train"]["iterations"] + times.evaluate)
                return Estimate(seconds / times.count, times.count)
        return Estimate(0.0, 0)


def _size_key(scene: Mapping[str, Any]) -> str:
    return json.dumps({name: scene.get(name) for name in SIZE_SETTINGS})


def describe_plan(trials: Sequence[Trial], parallel: int = 1) -> list[str]:
    """Lines for ``--dry-run``: each trial with its state, and the time for the unfinished ones."""
    lines: list[str] = []
    remaining, without_estimate, learned_from = 0.0, 0, 0
    counts: Counter[str] = Counter()
    finished = FinishedTrials(trials[0].files.runs)
    queue = ask_queue(trial.folder for trial in trials)
    for trial in trials:
        folder = trial.files
        state: str = folder.state()
        if state not in ("done", "running"):
            state = state_in_queue(folder.path, queue) or state
        note = ""
        if state == "done":
            if reason := folder.why_not_done(trial.values):
                note = f"  will be checked: {reason}"
        elif experiment := finished.elsewhere(folder):
            note = f"  as in {experiment}: nothing to compute"
        else:
            estimate = finished.estimate(trial.values)
            done = folder.stage_and_step()[1] / max(1, trial.values["train"]["iterations"])
            remaining += estimate.seconds * (1 - min(1.0, done))
            learned_from = max(learned_from, estimate.learned_from)
            without_estimate += estimate.learned_from == 0
        counts[state] += 1
        lines.append(f"{state:<8} {folder.label}{note}")
    summary = ", ".join(f"{counts[state]} {state}" for state in STATES if counts[state])
    lines.append(f"{counted(len(trials), 'trial')}: {summary}")
    if counts["done"] == len(trials):
        return lines
    if without_estimate:
        time = "no estimate: no finished trial with this rasterizer and picture size tells how long one takes here"
    elif learned_from == 0:
        time = "seconds, since other experiments have the results"
    else:
        at_once = f", {parallel} at once" if parallel > 1 else ""
        duration = readable_time(remaining / parallel)
        time = f"about {duration}{at_once}, estimated from {counted(learned_from, 'finished trial')}"
    return [*lines, f"time: {time}"]
