"""Pictures of docs/findings.md: held-out views side by side, the photograph first, then the first seed of each arm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import attrgetter
from pathlib import Path

from PIL import Image

from gsbench.analysis.per_view import read_views
from gsbench.analysis.results import Experiment, TrialResult
from gsbench.runs.declaration import EXTRAPOLATION, INTERPOLATION

# Arms that are shown, in this order: densifiers, and initialisers where those differ.
ARMS = ("adc", "volumetric", "volumetric-1", "volumetric_once", "volumetric_once-1", "longaxis")
CLOUDS = ("sfm", "sfm_dense", "dim", "random")
CONTROL = "adc"
JUDGED = "lpips_squeeze"  # less is better
GAP = 4  # px between pictures

KindOf = Callable[[TrialResult], str]
_question_of: KindOf = attrgetter("question")


def worst_views(experiment: Experiment) -> Image.Image:
    """Draw, a scene a row, the view of the sector with the least mean PSNR."""
    rows = []
    for scene in dict.fromkeys(trial.scene for trial in experiment.trials):
        own = list(_first_seeds(experiment, scene, EXTRAPOLATION, _question_of).values())
        views = [read_views(trial) for trial in own]
        worst = min(views[0], key=lambda view: sum(found[view]["psnr"] for found in views))
        rows.append(_pictures(own, worst))
    return _joined(rows)


def cap_of(trial: TrialResult) -> str:
    """The trial's setting ``densify.cap``."""
    return str(trial.config["densify.cap"])


def for_and_against(
    experiment: Experiment,
    rule: str = "volumetric",
    control: str = CONTROL,
    kinds: Sequence[str] = (INTERPOLATION, EXTRAPOLATION),
    kind_of: KindOf = _question_of,
) -> Image.Image:
    """Draw, of all scenes, the view at which ``rule`` gains most over ``control`` and that at which it loses most.

    A pair of rows for each of the ``kinds`` of trials: between the cameras and of the sector, or as ``kind_of`` says.
    """
    rows = []
    for kind in kinds:
        found: list[tuple[float, str, Sequence[TrialResult]]] = []
        for scene in dict.fromkeys(trial.scene for trial in experiment.trials):
            own = _first_seeds(experiment, scene, kind, kind_of)
            one, other = read_views(own[control]), read_views(own[rule])
            found += [(other[view][JUDGED] - one[view][JUDGED], view, list(own.values())) for view in other]
        found.sort(key=lambda entry: entry[:2])
        rows += [_pictures(own, view) for _, view, own in (found[0], found[-1])]
    return _joined(rows)


def _first_seeds(experiment: Experiment, scene: str, kind: str, kind_of: KindOf) -> dict[str, TrialResult]:
    """The trials of a scene's first seed that are of this kind, by `ARMS`, or by `CLOUDS` where one densifier is."""
    own = [trial for trial in experiment.trials if (trial.scene, trial.seed, kind_of(trial)) == (scene, 0, kind)]
    if len({trial.densify for trial in own}) > 1:
        found, shown = {trial.densify: trial for trial in own}, ARMS
    else:
        found, shown = {trial.init: trial for trial in own}, CLOUDS
    return {name: found[name] for name in shown if name in found}


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
