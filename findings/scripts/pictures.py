"""Write ``findings/pictures``: held-out views side by side, the photograph first, then the first
seed of each arm.

    python findings/scripts/pictures.py RUNS

``RUNS`` is the runs folder that holds the trials with their renders; the archives have no pixels.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from operator import attrgetter
from pathlib import Path

from PIL import Image

from gsbench.analysis.results import TrialResult, read_experiment, read_views

PICTURES = Path(__file__).parents[1] / "pictures"
DENSIFIERS = (
    "opensplat",
    "adc",
    "fastgs",
    "volumetric",
    "volumetric-1",
    "volumetric_once",
    "volumetric_once-1",
    "no_shrink",
    "longaxis",
)
CLOUDS = ("sfm", "sfm_dense", "dim", "random")
LPIPS = "lpips_squeeze"  # less is better
GAP = 4  # px between pictures

KindOf = Callable[[TrialResult], str]
_split: KindOf = attrgetter("question")


def _cap(trial: TrialResult) -> str:
    return str(trial.config["densify.cap"])


# By the name of the picture, of the experiment findings_NAME: arm, control, and which trials make a
# pair of rows each.
SHOWN: dict[str, tuple[str, str, KindOf, Sequence[str]]] = {
    "plants": ("volumetric", "adc", _split, ("interpolation", "extrapolation")),
    "parts": ("no_shrink", "adc", _split, ("interpolation",)),
    "schedule": ("volumetric", "adc", _split, ("interpolation",)),
    "volume": ("volumetric", "adc", _split, ("interpolation", "extrapolation")),
    "dimension": ("volumetric-1", "adc", _split, ("interpolation", "extrapolation")),
    "full": ("volumetric", "adc", _cap, ("governor", "soft")),
    "initialisers": ("dim", "sfm", _split, ("interpolation",)),
    "opensplat": ("opensplat", "adc", _split, ("interpolation",)),
}


def for_and_against(
    trials: Sequence[TrialResult], rule: str, control: str, kind_of: KindOf, kinds: Sequence[str]
) -> Image.Image:
    """Draw, of all scenes, the view at which ``rule`` gains most over ``control`` and that at which
    it loses most.

    A pair of rows for each of the ``kinds`` of trials, which ``kind_of`` says of a trial.
    """
    rows = []
    for kind in kinds:
        found: list[tuple[float, str, Sequence[TrialResult]]] = []
        for scene in dict.fromkeys(trial.scene for trial in trials):
            own = _first_seeds(
                [trial for trial in trials if (trial.scene, kind_of(trial)) == (scene, kind)]
            )
            if not own:  # a scene that was not split so
                continue
            one, other = read_views(own[control]), read_views(own[rule])
            found += [
                (other[view][LPIPS] - one[view][LPIPS], view, list(own.values())) for view in other
            ]
        found.sort(key=lambda entry: entry[:2])
        rows += [_pictures(own, view) for _, view, own in (found[0], found[-1])]
    return _joined(rows)


def _first_seeds(trials: Sequence[TrialResult]) -> dict[str, TrialResult]:
    """The trials of seed 0 by arm: by densifier, or by initialiser where only that differs."""
    own = [trial for trial in trials if trial.seed == 0]
    by_densifier = len({trial.densify for trial in own}) > 1
    found = {trial.densify if by_densifier else trial.init: trial for trial in own}
    return {name: found[name] for name in (DENSIFIERS if by_densifier else CLOUDS) if name in found}


def _pictures(trials: Sequence[TrialResult], view: str) -> list[Image.Image]:
    files = [trials[0].path / "ground_truth", *(trial.path / "renders" for trial in trials)]
    return [Image.open(folder / f"{Path(view).stem}.png").convert("RGB") for folder in files]


def _joined(rows: Sequence[Sequence[Image.Image]]) -> Image.Image:
    """Join the rows below each other, each picture in a column as wide as the widest."""
    width = max(picture.width for row in rows for picture in row)
    heights = [max(picture.height for picture in row) for row in rows]
    joined = Image.new(
        "RGB", (len(rows[0]) * (width + GAP) - GAP, sum(heights) + GAP * (len(rows) - 1)), "white"
    )
    for index, pictures in enumerate(rows):
        for column, picture in enumerate(pictures):
            joined.paste(picture, (column * (width + GAP), sum(heights[:index]) + GAP * index))
    return joined


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    for name, (rule, control, kind_of, kinds) in SHOWN.items():
        folder = Path(sys.argv[1]) / f"findings_{name}"
        if folder.is_dir():
            picture = for_and_against(read_experiment(folder).trials, rule, control, kind_of, kinds)
            picture.save(PICTURES / f"{name}.jpg", quality=85)
