"""Pictures of docs/findings.md: held-out views side by side, the photograph first, then the first seed of each arm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from gsbench.analysis.per_view import read_views
from gsbench.analysis.results import Experiment, TrialResult
from gsbench.runs.declaration import EXTRAPOLATION, INTERPOLATION

ARMS = ("adc", "volumetric", "volumetric-1", "volumetric_once", "volumetric_once-1", "longaxis")  # in this order
CONTROL = "adc"
JUDGED = "lpips_squeeze"  # less is better
GAP = 4  # px between pictures


def worst_views(experiment: Experiment) -> Image.Image:
    """Draw, a scene a row, the view of the sector with the least mean PSNR."""
    rows = []
    for scene in dict.fromkeys(trial.scene for trial in experiment.trials):
        own = _first_seeds(experiment, scene, EXTRAPOLATION)
        views = [read_views(trial) for trial in own]
        worst = min(views[0], key=lambda view: sum(found[view]["psnr"] for found in views))
        rows.append(_pictures(own, worst))
    return _joined(rows)


def for_and_against(experiment: Experiment, rule: str = "volumetric") -> Image.Image:
    """Draw, of all scenes, the view at which ``rule`` gains most over `CONTROL` and that at which it loses most.

    One pair of rows between the cameras, one of the sector.
    """
    rows = []
    for question in (INTERPOLATION, EXTRAPOLATION):
        found: list[tuple[float, str, list[TrialResult]]] = []
        for scene in dict.fromkeys(trial.scene for trial in experiment.trials):
            own = _first_seeds(experiment, scene, question)
            views = {trial.densify: read_views(trial) for trial in own}
            found += [(views[rule][v][JUDGED] - views[CONTROL][v][JUDGED], v, own) for v in views[rule]]
        found.sort(key=lambda entry: entry[:2])
        rows += [_pictures(own, view) for _, view, own in (found[0], found[-1])]
    return _joined(rows)


def _first_seeds(experiment: Experiment, scene: str, question: str) -> list[TrialResult]:
    """The trials of the first seed of a scene at a question, in the order of `ARMS`."""
    own = [t for t in experiment.trials if (t.scene, t.seed, t.question) == (scene, 0, question)]
    return sorted(own, key=lambda trial: ARMS.index(trial.densify))


def _pictures(trials: Sequence[TrialResult], view: str) -> list[Image.Image]:
    files = [trials[0].path / "ground_truth", *(trial.path / "renders" for trial in trials)]
    return [Image.open(folder / f"{Path(view).stem}.png").convert("RGB") for folder in files]


def _joined(rows: Sequence[Sequence[Image.Image]]) -> Image.Image:
    """Join the rows below each other, each picture in a column as wide as the widest."""
    width = max(picture.width for row in rows for picture in row)
    heights = [max(picture.height for picture in row) for row in rows]
    joined = Image.new("RGB", (len(rows[0]) * (width + GAP) - GAP, sum(heights) + GAP * (len(rows) - 1)), "white")
    for index, pictures in enumerate(rows):
        for column, picture in enumerate(pictures):
            joined.paste(picture, (column * (width + GAP), sum(heights[:index]) + GAP * index))
    return joined
