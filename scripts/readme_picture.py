"""Draw the README's picture from the trials of ``gsbench +experiment=demo``: ``make picture``.

A strip of one held-out view (photograph, initial cloud, baseline, idea, where the two differ) above
the table of the experiment with its verdict.
"""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pycolmap
from matplotlib.axes import Axes
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter

from gsbench.analysis import load_experiment, to_frame
from gsbench.cli import run

TARGET = Path(__file__).resolve().parents[1] / "docs" / "demo.jpg"
BASELINE, IDEA = "adc", "longaxis"
ARMS = (BASELINE, "volumetric", IDEA)
COLUMNS = {"psnr": "PSNR (dB) ↑", "ssim": "SSIM ↑", "flip": "FLIP ↓", "num_gaussians": "Gaussians"}
FORMATS = {"psnr": "{:.2f}", "ssim": "{:.3f}", "flip": "{:.3f}", "num_gaussians": "{:,.0f}"}


def pixels(path: Path) -> NDArray[np.float64]:
    """A picture [H, W, 3] in [0, 1]."""
    return np.asarray(Image.open(path).convert("RGB"), float) / 255


def initial_cloud(model: Path, view: str, size: tuple[int, int]) -> NDArray[np.float64]:
    """The points of a COLMAP model as the camera of ``view`` sees them, [H, W, 3] in [0, 1]."""
    reconstruction = pycolmap.Reconstruction(model)
    (image,) = (
        entry
        for entry in reconstruction.images.values()
        if Path(entry.name).stem == Path(view).stem
    )
    width, height = size
    points = np.array([point.xyz for point in reconstruction.points3D.values()])
    colors = np.array([point.color for point in reconstruction.points3D.values()]) / 255
    pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
    local = points @ pose.rotation.matrix().T + pose.translation
    front = local[:, 2] > 0.05
    local, colors = local[front], colors[front]
    camera = reconstruction.cameras[image.camera_id]
    at = np.array([camera.img_from_cam(point) for point in local]) * width / camera.width
    picture = np.full((height, width, 3), 0.08)
    for index in np.argsort(-local[:, 2]):
        x, y = at[index].astype(int)
        if 0 <= x < width and 0 <= y < height:
            picture[max(0, y - 1) : y + 1, max(0, x - 1) : x + 1] = colors[index]
    return picture


def verdicts() -> str:
    """The last lines of the sweep, one for each idea, as ``gsbench tables demo`` gives them."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        run(["tables", "demo"])
    lines = [line.removeprefix("- ") for line in printed.getvalue().splitlines()]
    badges = tuple(f"{badge}: " for badge in ("BETTER", "WORSE", "TOO SMALL", "UNDECIDED"))
    return "\n".join(line for line in lines if line.startswith(badges))


def show(axis: Axes, title: str, picture: NDArray[np.float64]) -> None:
    """Draw a picture [H, W, 3], or a map of differences [H, W], below its title."""
    bound = 0.06 if picture.ndim == 2 else None
    axis.imshow(
        picture,
        cmap="RdBu",
        vmin=-bound if bound else None,
        vmax=bound,
        interpolation="lanczos",
    )
    axis.set_title(title, fontsize=11)
    axis.axis("off")


def write_table(axis: Axes, frame: pd.DataFrame) -> None:
    """Write the means and deviations of the arms, and the verdicts below them."""
    axis.axis("off")
    columns = [name for name in COLUMNS if name in frame]
    cells = []
    for arm in ARMS:
        rows = frame[frame["densify"] == arm]
        values = [
            f"{FORMATS[n].format(rows[n].mean())} ± {FORMATS[n].format(rows[n].std())}"
            for n in columns
        ]
        cells.append([arm, *values])
    labels = ["", *(COLUMNS[name] for name in columns)]
    table = axis.table(cells, colLabels=labels, loc="upper center", cellLoc="center")
    table.auto_set_font_size(False)
    table.set_fontsize(11)
    table.scale(0.8, 1.25)
    for cell in table.get_celld().values():
        cell.set_edgecolor("#cccccc")
    axis.text(
        0.5, -0.08, verdicts(), ha="center", va="bottom", fontsize=11, transform=axis.transAxes
    )


def main(runs: Path) -> None:
    """Write the picture from the experiment ``demo`` of a runs folder."""
    experiment = load_experiment(runs, "demo")
    frame = to_frame(experiment)
    arms = {
        arm: min((t for t in experiment.trials if t.densify == arm), key=lambda t: t.seed)
        for arm in (BASELINE, IDEA)
    }
    views = sorted(path.name for path in (arms[IDEA].path / "renders").glob("*.png"))
    view = views[len(views) // 2]
    truth = pixels(arms[IDEA].path / "ground_truth" / view)
    renders = {arm: pixels(trial.path / "renders" / view) for arm, trial in arms.items()}
    errors = {arm: np.abs(picture - truth).mean(-1) for arm, picture in renders.items()}
    gain = gaussian_filter(errors[BASELINE] - errors[IDEA], 2.0)
    key = arms[IDEA].record.hashes["init"]
    cloud = initial_cloud(
        runs / "store" / "init" / key / "sparse" / "0", view, (truth.shape[1], truth.shape[0])
    )

    figure = plt.figure(figsize=(12.5, 3.8), dpi=110)
    grid = figure.add_gridspec(
        2, 5, height_ratios=(2.0, 1.3), left=0.005, right=0.995, top=0.92, bottom=0.04, wspace=0.02
    )
    panels = {
        "photograph": truth,
        "initial cloud": cloud,
        f"baseline: {BASELINE}": renders[BASELINE],
        f"idea: {IDEA}": renders[IDEA],
        "blue: idea nearer; red: baseline": gain,
    }
    for place, (title, picture) in enumerate(panels.items()):
        show(figure.add_subplot(grid[0, place]), title, picture)
    write_table(figure.add_subplot(grid[1, :]), frame)
    figure.savefig(TARGET, pil_kwargs={"quality": 88})
    print(f"{TARGET}: {TARGET.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main(Path(os.environ.get("GSBENCH_RUNS", "runs")))
