"""Finished trials, and what they tell of those to come: which are done elsewhere, and how long others take.

All are read once, so that ten thousand planned trials can be held against ten thousand finished ones. Loads no torch.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

from gsbench.parsing import DamagedError
from gsbench.runs.layout import RESULTS, TRIAL_GLOB
from gsbench.runs.trial_folder import TrialFolder

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
