"""Listing for a dry run: the state of each trial, what was done elsewhere, and the time that the others take.

All finished trials are read once, so that ten thousand planned ones can be held against ten thousand. Loads no torch.
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
# Of scene, init and densify, which must be the same: most alike first.
ALIKE = ((True, True, True), (True, False, True), (True, False, False), (False, False, True), (False, False, False))
OF_SIZE = ("name", "path", "width", "height", "downscale", "max_size")  # settings of a scene that set its pixels


@dataclass(frozen=True)
class Estimate:
    """Expected seconds of work, and of how many finished trials that is learned (0: nothing is known)."""

    seconds: float
    learned_from: int


@dataclass
class _Times:
    """Sums over finished trials."""

    count: int = 0
    train: float = 0.0  # s for each iteration and pixel
    evaluate: float = 0.0  # s for each pixel


class FinishedTrials:
    """The finished trials below the folder ``runs``."""

    def __init__(self, runs: Path) -> None:
        self._folders: dict[str, list[Path]] = defaultdict(list)
        self._times: dict[tuple[object, ...], _Times] = defaultdict(_Times)  # by rasterizer, and what is alike
        self._pixels: dict[str, int] = {}  # of a view, by the settings of its scene
        for path in runs.glob(f"*/{TRIAL_GLOB}/{RESULTS}"):
            files = TrialFolder(path.parent)
            record = files.sound_record()
            if record is None:
                continue
            self._folders[path.parent.name].append(path.parent)
            try:
                settings = files.settings()
                asked = settings["raster"]["name"]
                size = _size_of(settings["scene"])
            except (FileNotFoundError, DamagedError, KeyError, TypeError):
                continue
            if not record.iterations or record.resolution is None:
                continue
            self._pixels[size] = pixels = max(1, record.resolution[0] * record.resolution[1])
            for same in ALIKE:
                times = self._times[asked, same, *compress((record.scene, record.init, record.densify), same)]
                times.count += 1
                times.train += record.seconds.get("train", 0.0) / record.iterations / pixels
                times.evaluate += record.seconds.get("evaluate", 0.0) / pixels

    def elsewhere(self, trial: TrialFolder) -> str | None:
        """The other experiment, if any, that has finished the same trial: its stages are reused, not computed again."""
        others = (folder for folder in self._folders.get(trial.path.name, ()) if folder != trial.path)
        return next((folder.relative_to(trial.runs).parts[0] for folder in others), None)

    def estimate(self, values: Mapping[str, Any]) -> Estimate:
        """Seconds for the whole trial with ``values``, as finished ones took with the same rasterizer.

        By iteration and pixel, of the most alike. The pixels of photographs that no trial has read are not known. A
        damaged configuration, which ``gsbench status`` reads too, has no estimate.
        """
        try:
            return self._estimate(values)
        except (KeyError, TypeError, AttributeError, ArithmeticError):
            return Estimate(0.0, 0)

    def _estimate(self, values: Mapping[str, Any]) -> Estimate:
        names = tuple(values[group]["name"] for group in ("scene", "init", "densify"))
        scene = values["scene"]
        pixels = self._pixels.get(_size_of(scene))
        if pixels is None and scene["kind"] == "courtyard":
            longest = max(scene["width"], scene["height"])
            shrunk = min(1.0, (scene["max_size"] or longest) / longest)
            pixels = int(scene["width"] * scene["height"] * (shrunk / scene["downscale"]) ** 2)
        for same in ALIKE:
            times = self._times.get((values["raster"]["name"], same, *compress(names, same)))
            if times is not None and pixels is not None:
                seconds = pixels * (times.train * values["train"]["iterations"] + times.evaluate)
                return Estimate(seconds / times.count, times.count)
        return Estimate(0.0, 0)


def _size_of(scene: Mapping[str, Any]) -> str:
    return json.dumps({name: scene.get(name) for name in OF_SIZE})


def describe_plan(trials: Sequence[Trial], parallel: int = 1) -> list[str]:
    """Lines for ``--dry-run``: each trial with its state, and the time that the unfinished ones will take."""
    lines: list[str] = []
    remaining, unknown, learned = 0.0, 0, 0
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
        elif shared := finished.elsewhere(folder):
            note = f"  as in {shared}: nothing to compute"
        else:
            estimate = finished.estimate(trial.values)
            done = folder.stage_and_step()[1] / max(1, trial.values["train"]["iterations"])
            remaining += estimate.seconds * (1 - min(1.0, done))
            learned = max(learned, estimate.learned_from)
            unknown += estimate.learned_from == 0
        counts[state] += 1
        lines.append(f"{state:<8} {folder.label}{note}")
    summary = ", ".join(f"{counts[state]} {state}" for state in STATES if counts[state])
    lines.append(f"{counted(len(trials), 'trial')}: {summary}")
    if counts["done"] == len(trials):
        return lines
    if unknown:
        time = "no estimate: no finished trial with this rasterizer and picture size tells how long one takes here"
    elif learned == 0:
        time = "seconds, since other experiments have the results"
    else:
        at_once = f", {parallel} at once" if parallel > 1 else ""
        took = readable_time(remaining / parallel)
        time = f"about {took}{at_once}, estimated from {counted(learned, 'finished trial')}"
    return [*lines, f"time: {time}"]
