"""Draw the threshold sweep: LPIPS and the Gaussians made by volume against V_th.

    python findings/scripts/threshold.py

writes ``findings/pictures/threshold.png`` from ``findings/archives/paper_threshold.zip``.
"""

from __future__ import annotations

from dataclasses import astuple
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from paper_tables import FINDINGS, THRESHOLD, results_in

from gsbench.analysis.statistics import t_test

METRIC = "lpips_vgg_raw"
SCENES = {"treehill": "C0", "garden": "C1"}
IDEA = "volumetric-"
Values = dict[str, dict[int, Any]]  # by arm and seed


def differences(of_scene: Values) -> tuple[list[float], np.ndarray]:
    """The rising thresholds T, and LPIPS minus that of adc with the same seed, [T, K]."""
    thresholds = sorted(float(arm.removeprefix(IDEA)) for arm in of_scene if arm != "adc")
    baseline = of_scene["adc"]
    rows = [
        [
            trial["metrics"][METRIC] - baseline[seed]["metrics"][METRIC]
            for seed, trial in sorted(of_scene[f"{IDEA}{threshold:g}"].items())
        ]
        for threshold in thresholds
    ]
    return thresholds, np.array(rows)


def draw(panels: tuple[Axes, Axes], by_scene: dict[str, Values]) -> None:
    above, below = panels
    for number, (scene, color) in enumerate(SCENES.items()):
        thresholds, changes = differences(by_scene[scene])
        tests = [t_test(of_threshold[None]) for of_threshold in changes]
        ends = [astuple(test.interval()) if test else (np.nan, np.nan) for test in tests]
        half = [(high - low) / 2 for low, high in ends]
        places = np.array(thresholds) * 1.06**number  # so that bars do not hide one another
        style: dict[str, Any] = {"color": color, "marker": "o", "label": scene}
        above.errorbar(places, changes.mean(axis=1), yerr=half, capsize=3, **style)
        made = [
            np.mean([trial["causes"]["split_volume"] / 1000 for trial in own.values()])
            for own in (by_scene[scene][f"{IDEA}{threshold:g}"] for threshold in thresholds)
        ]
        below.plot(thresholds, made, **style)
    above.axhline(0, color="gray", linewidth=1)
    above.annotate("adc", (0.99, 0), xycoords=("axes fraction", "data"), ha="right", va="bottom")
    above.set_ylabel("LPIPS (VGG, raw) minus adc's")
    above.set_title("Equal counts: 200,000 Gaussians in every training", fontsize=10)
    below.set_ylabel("thousand Gaussians at the end\nthat a split by volume made")
    below.set_xlabel("V_th (cubed units of the scene)")
    below.legend(frameon=False)  # for both
    for axes in (above, below):
        axes.set_xscale("log")
        axes.axvline(THRESHOLD, color="gray", linewidth=1, linestyle=":")


if __name__ == "__main__":
    found: dict[str, Values] = {}
    for trial in results_in(FINDINGS / "archives/paper_threshold.zip"):
        found.setdefault(trial["scene"], {}).setdefault(trial["densify"], {})[trial["seed"]] = trial
    figure, axes = plt.subplots(2, 1, figsize=(6, 6.4), sharex=True, layout="constrained")
    draw((axes[0], axes[1]), found)
    figure.savefig(FINDINGS / "pictures/threshold.png", dpi=110)
