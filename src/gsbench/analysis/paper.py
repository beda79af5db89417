"""The paper's printed results as data, with the places where they contradict each other or its text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import yaml

from gsbench.analysis.choices import PaperChoice, read_setup

TABLE1_QUANTITIES = ("ssim", "psnr", "lpips_vgg_raw", "gaussians_millions", "train_minutes")
TABLE1_ARMS = (("dim", "adc"), ("dim", "volumetric"))
TABLE2_ARMS = (("sfm", "adc"), ("dim", "adc"), ("sfm", "volumetric"), ("dim", "volumetric"))
ARM_NAMES = {"adc": "3DGS", "volumetric": "Ours"}
INIT_NAMES = {"sfm": "SfM", "dim": "DIM"}


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
    contradictions: tuple[str, ...]  # of the paper with itself, a sentence each
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
    for scene, (_, *pairs) in content["table1"]["scenes"].items():
        for quantity, pair in zip(TABLE1_QUANTITIES, pairs, strict=True):
            for (init, densify), text in zip(TABLE1_ARMS, pair, strict=True):
                table1[scene, init, densify, quantity] = Printed(text)
    table2 = {
        (scene, init, densify, "lpips_vgg_raw"): Printed(text)
        for scene, texts in content["table2"]["scenes"].items()
        for (init, densify), text in zip(TABLE2_ARMS, texts, strict=True)
    }
    return Paper(table1, table2, tuple(content["contradictions"]), read_setup(content["setup"]))
