"""Draw quality against count: LPIPS of each training against its number of Gaussians, by scene.

    python findings/scripts/curve.py

writes ``findings/pictures/curve.png`` from ``findings/archives/paper_curve.zip``.
"""

from __future__ import annotations

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from paper_tables import FINDINGS, results_in
from threshold import METRIC

ARMS = {"adc": "C0", "volumetric": "C1"}
SCENES = ("treehill", "truck", "garden")
Points = dict[int, list[tuple[float, float]]]  # (Gaussians, LPIPS) by the governor's count


def draw(axes: Axes, by_arm: dict[str, Points]) -> None:
    """The trainings as points, and a line through the means of each count."""
    for arm, color in ARMS.items():
        means = np.array([np.mean(of_count, axis=0) for _, of_count in sorted(by_arm[arm].items())])
        axes.plot(*means.T, color=color, label=arm)
        every = np.array([point for of_count in by_arm[arm].values() for point in of_count])
        axes.scatter(every[:, 0], every[:, 1], color=color, s=14)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(sorted(by_arm["adc"])))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda count, _: f"{count / 1000:g}"))


if __name__ == "__main__":
    found: dict[str, dict[str, Points]] = {}
    for trial in results_in(FINDINGS / "archives/paper_curve.zip"):
        of_arm = found.setdefault(trial["scene"], {}).setdefault(trial["densify"], {})
        point = trial["num_gaussians"], trial["metrics"][METRIC]
        of_arm.setdefault(trial["budget"]["max_gaussians"], []).append(point)
    figure, panels = plt.subplots(1, len(SCENES), figsize=(10, 3.6), layout="constrained")
    for axes, scene in zip(panels, SCENES, strict=True):
        draw(axes, found[scene])
        axes.set_title(scene, fontsize=10)
        axes.set_xlabel("thousand Gaussians")
    panels[0].set_ylabel("LPIPS (VGG, raw)")
    panels[-1].legend(frameon=False)
    figure.savefig(FINDINGS / "pictures/curve.png", dpi=110)
