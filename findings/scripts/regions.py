"""Where the rule helps, on the five scenes of Table 1 at equal counts, by regions of 32 px.

    python findings/scripts/regions.py DATA

prints a row for each scene: how many regions differ beyond noise, and the change of PSNR in textured
and in green places of the photograph, less that in others, with Student's interval over three
seeds. ``DATA`` has a folder for each scene with its photographs;
without one, the columns about texture are left out. The errors of regions are those of
``findings/archives/paper_table1_regions.npz``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import astuple
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from paper_tables import FINDINGS
from PIL import Image

from gsbench.analysis.images import region_means, texture_energy
from gsbench.analysis.report.where import compare_regions, discoveries, region_psnr
from gsbench.analysis.statistics import t_test

SCENES = ("bonsai", "garden", "train", "treehill", "truck")
SEEDS = (1, 2, 3)
LONGEST = 320  # px, the longer side of the pictures in the trainings
FIFTH = 0.2
Array = NDArray[np.float64]


def errors_of(scene: str, arm: str) -> list[dict[str, Array]]:
    """The mean squared errors of regions by view, for each seed."""
    found: list[dict[str, Array]] = [{} for _ in SEEDS]
    with np.load(FINDINGS / "archives/paper_table1_regions.npz") as stored:
        for name in sorted(stored.files):
            trial, _, view = name.partition("/")
            for seed, own in zip(SEEDS, found, strict=True):
                if trial == f"{scene}-{arm}-{seed}":
                    own[view] = stored[name].astype(float)
    return found


def flat_psnr(errors: dict[str, Array]) -> Array:
    """The PSNR in dB of all regions of a trial's views, [N]."""
    return np.concatenate([region_psnr(error).ravel() for error in errors.values()])


def photograph(folder: Path, view: str) -> NDArray[np.uint8]:
    """A photograph in the size of the trainings."""
    (path,) = (path for path in (folder / "images").iterdir() if path.stem == view)
    with Image.open(path) as opened:
        picture = opened.convert("RGB")
    scale = LONGEST / max(picture.size)
    size = (round(picture.width * scale), round(picture.height * scale))
    return np.asarray(picture.resize(size, Image.Resampling.BOX))


def of_photographs(folder: Path, views: Iterable[str]) -> tuple[Array, Array]:
    """The texture of all regions, and the share of their pixels in which green is largest."""
    texture, green = [], []
    for view in views:
        pixels = photograph(folder, view)
        texture.append(region_means(texture_energy(pixels)).ravel())
        is_green = (pixels[..., 1] > pixels[..., 0]) & (pixels[..., 1] > pixels[..., 2])
        green.append(region_means(is_green.astype(float)).ravel())
    return np.concatenate(texture), np.concatenate(green)


def contrast(changes: Array, inside: NDArray[np.bool_], outside: NDArray[np.bool_]) -> str:
    """The mean change [K, N] of the regions ``inside`` less that of those ``outside``."""
    of_seeds = changes[:, inside].mean(axis=1) - changes[:, outside].mean(axis=1)
    test = t_test(of_seeds[None])
    if test is None:
        return f"{of_seeds.mean():+.2f} dB"
    low, high = astuple(test.interval())
    return f"{of_seeds.mean():+.2f} dB ({low:+.2f} to {high:+.2f})"


if __name__ == "__main__":
    pairs = {scene: [errors_of(scene, arm) for arm in ("volumetric", "adc")] for scene in SCENES}
    compared = {scene: compare_regions(*own) for scene, own in pairs.items()}
    lit = iter(discoveries([view.p for scene in compared.values() for view in scene.values()]))
    for scene, views in compared.items():
        ours, theirs = (np.array([flat_psnr(errors) for errors in arm]) for arm in pairs[scene])
        changes = ours - theirs  # [K, N]
        change = changes.mean(axis=0)
        flags = np.concatenate([next(lit).ravel() for _ in views])
        words = f"{scene}: {(flags & (change > 0)).sum()} better, {(flags & (change < 0)).sum()} "
        words += f"worse of {len(change)}; {change.mean():+.2f} dB"
        folder = Path(sys.argv[1]) / scene if len(sys.argv) > 1 else None
        if folder is not None and folder.is_dir():
            texture, green = of_photographs(folder, views)
            low, high = np.quantile(texture, (FIFTH, 1 - FIFTH))
            words += f"; least textured fifth {change[texture <= low].mean():+.2f} dB, most "
            words += f"{change[texture >= high].mean():+.2f} dB, most minus least "
            words += contrast(changes, texture >= high, texture <= low)
            words += f"; {(green > 0.5).mean():.0%} of regions are green, and gain "
            words += contrast(changes, green > 0.5, green <= 0.5) + " more than others"
        print(words)
