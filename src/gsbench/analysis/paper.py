"""The paper's printed results as data, and what can be computed from them alone."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import yaml

from gsbench.analysis.choices import PaperChoice, read_setup

TABLE1_QUANTITIES = ("ssim", "psnr", "lpips_vgg_raw", "gaussians_millions", "train_minutes")
TABLE1_ARMS = (("dim", "adc"), ("dim", "volumetric"))
TABLE2_ARMS = (("sfm", "adc"), ("dim", "adc"), ("sfm", "volumetric"), ("dim", "volumetric"))
ARM_NAMES = {"adc": "3DGS", "volumetric": "Ours"}
INIT_NAMES = {"sfm": "SfM", "dim": "DIM"}
OUTLIER_RATIO = 2.0  # two initialisers of one scene and method that differ by more are named


@dataclass(frozen=True)
class Printed:
    """A printed number; it stands for anything within half a step of its last digit."""

    text: str

    @property
    def value(self) -> float:
        return float(self.text)

    @property
    def half_step(self) -> float:
        _, _, digits = self.text.partition(".")
        return 0.5 * 10.0 ** -len(digits)

    @property
    def range(self) -> tuple[float, float]:
        return self.value - self.half_step, self.value + self.half_step


Key = tuple[str, str, str, str]  # scene, init, densify, quantity


@dataclass(frozen=True)
class Paper:
    """Both tables: ``table1`` and ``table2`` map (scene, init, densify, quantity) to the printed number."""

    table1: Mapping[Key, Printed]
    table2: Mapping[Key, Printed]
    datasets: Mapping[str, str]  # scene -> data set, as in Table 1
    claims: Mapping[str, Any]
    setup: Mapping[str, PaperChoice]

    def table(self, name: str) -> Mapping[Key, Printed]:
        return {"table1": self.table1, "table2": self.table2}[name]

    def scenes(self, name: str) -> list[str]:
        """The scenes of a table in the printed order."""
        return list(dict.fromkeys(key[0] for key in self.table(name)))


@cache
def load_paper() -> Paper:
    """The paper's tables from the file that ships with the package."""
    content = yaml.safe_load(files("gsbench.analysis").joinpath("paper.yaml").read_text(encoding="utf-8"))
    table1: dict[Key, Printed] = {}
    datasets = {}
    for scene, (dataset, *pairs) in content["table1"]["scenes"].items():
        datasets[scene] = dataset
        for quantity, pair in zip(TABLE1_QUANTITIES, pairs, strict=True):
            for (init, densify), text in zip(TABLE1_ARMS, pair, strict=True):
                table1[scene, init, densify, quantity] = Printed(text)
    table2 = {
        (scene, init, densify, "lpips_vgg_raw"): Printed(text)
        for scene, texts in content["table2"]["scenes"].items()
        for (init, densify), text in zip(TABLE2_ARMS, texts, strict=True)
    }
    return Paper(table1, table2, datasets, content["claims"], read_setup(content["setup"]))


def inconsistencies(paper: Paper) -> list[str]:
    """List the places where the paper contradicts itself, one line each, computed from its own numbers."""
    return [
        *_cost_averages(paper),
        *_means(paper),
        *_lpips_claim(paper),
        *_swapped_datasets(paper),
        *_tables_that_disagree(paper),
        *_outliers(paper),
    ]


def pairs_of(paper: Paper, quantity: str) -> dict[str, tuple[float, float]]:
    """Table 1's (3DGS, ours) of a quantity, by scene."""
    return {
        scene: (
            paper.table1[scene, "dim", "adc", quantity].value,
            paper.table1[scene, "dim", "volumetric", quantity].value,
        )
        for scene in paper.scenes("table1")
    }


def _cost_averages(paper: Paper) -> list[str]:
    lines = []
    for quantity, name in (("gaussians_millions", "Gaussians"), ("train_minutes", "Training time")):
        pairs = pairs_of(paper, quantity).values()
        before, after = (sum(pair[k] for pair in pairs) for k in (0, 1))
        of_totals = after / before - 1
        of_scenes = statistics.fmean(b / a for a, b in pairs) - 1
        claim = ""
        if name == "Gaussians":
            printed = paper.claims["gaussian_increase_percent"]
            claim = f"; the printed “global average of {printed} %” is the ratio of totals"
        lines.append(f"{name}: {of_totals:+.1%} as a ratio of totals, {of_scenes:+.1%} as the mean of scenes{claim}.")
    return lines


def _means(paper: Paper) -> list[str]:
    lines = []
    for quantity, name, sign, decimals in (
        ("ssim", "SSIM", 1, 4),
        ("psnr", "PSNR", 1, 3),
        ("lpips_vgg_raw", "LPIPS", -1, 4),
    ):
        pairs = pairs_of(paper, quantity)
        before, after = (statistics.fmean(pair[k] for pair in pairs.values()) for k in (0, 1))
        better = sum(sign * (b - a) > 0 for a, b in pairs.values())
        equal = sum(a == b for a, b in pairs.values())
        lines.append(
            f"{name}: mean of {len(pairs)} scenes {before:.{decimals}f} (3DGS), {after:.{decimals}f} (ours); ours is "
            f"better in {better}, equal as printed in {equal}, worse in {len(pairs) - better - equal}."
        )
    return lines


def _lpips_claim(paper: Paper) -> list[str]:
    equal = [scene for scene, (a, b) in pairs_of(paper, "lpips_vgg_raw").items() if b >= a]
    worse = []
    for scene in paper.scenes("table2"):
        for init, name in INIT_NAMES.items():
            before, after = (paper.table2[scene, init, densify, "lpips_vgg_raw"] for densify in ARM_NAMES)
            if after.value > before.value:
                worse.append(f"{scene} ({name}, {before.text} → {after.text})")
    claim = f"“{paper.claims['lpips']}”: Table 1 prints no lower value for {', '.join(equal)}; "
    return [claim + f"Table 2 prints a higher one for {', '.join(worse)}."]


def _swapped_datasets(paper: Paper) -> list[str]:
    swapped = [scene for scene, said in paper.claims["datasets_in_text"].items() if paper.datasets[scene] != said]
    return [f"Section 5 assigns {', '.join(swapped)} to another data set than Table 1 does."] if swapped else []


def _tables_that_disagree(paper: Paper) -> list[str]:
    """Scenes for which the ranges that two printed numbers of the same runs stand for do not meet."""
    differing = []
    for key, printed in paper.table2.items():
        if key not in paper.table1:
            continue
        (low, high), (other_low, other_high) = printed.range, paper.table1[key].range
        if low > other_high or high < other_low:
            differing.append(f"{key[0]} {ARM_NAMES[key[2]]} {paper.table1[key].text}/{printed.text}")
    missing = [scene for scene in paper.scenes("table1") if scene not in paper.scenes("table2")]
    return [
        f"Tables 1 and 2 print different LPIPS for the same runs (DIM): {', '.join(differing)}.",
        f"Table 2 omits {', '.join(missing)}.",
    ]


def _outliers(paper: Paper) -> list[str]:
    lines = []
    for densify, name in ARM_NAMES.items():
        for scene in paper.scenes("table2"):
            sfm, dim = (paper.table2[scene, init, densify, "lpips_vgg_raw"].value for init in ("sfm", "dim"))
            if max(sfm, dim) > OUTLIER_RATIO * min(sfm, dim):
                lines.append(
                    f"Table 2, {scene}, {name}: LPIPS {sfm} from SfM and {dim} from DIM, a factor of {sfm / dim:.1f}."
                )
    points = paper.claims["figure3_points"]
    lines.append(
        f"Figure 3, {points['scene']}: {points['sfm']:,} points from SfM and {points['dim']:,} from DIM, a factor of "
        f"{points['dim'] / points['sfm']:.2f}."
    )
    return lines
