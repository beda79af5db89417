"""The settings of a training: iterations, learning rates, densification window, checkpoints."""

from dataclasses import dataclass, field
from typing import Literal

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from gsbench.gaussians.paper_values import LearningRates
from gsbench.settings import MISSING, Fraction, check_settings

WITHOUT_EFFECT_ON_MODEL = (
    "name",
    "log_every",
    "checkpoint_every",
    "checkpoint_minutes",
    "volume_histogram",
)


@dataclass
class TrainConfig(LearningRates):
    name: str = MISSING
    iterations: NonNegativeInt = 30_000  # 0: evaluate the initial Gaussians without training
    sh_interval: PositiveInt = 1000  # iterations after which spherical harmonics gain a degree
    ssim_weight: Fraction = 0.2  # loss = 0.8 L1 + 0.2 (1 - SSIM)
    background: tuple[Fraction, Fraction, Fraction] = (0.0, 0.0, 0.0)
    densify_start: NonNegativeInt = 500  # the densification window; densifiers read it from here
    densify_stop: NonNegativeInt = 15_000
    densify_interval: PositiveInt = 100
    opacity_reset_interval: PositiveInt = 3000
    mcmc_stop: NonNegativeInt = 25_000  # end of the longer window of 3DGS-MCMC
    # True: the optimiser steps before a refinement, as in gsplat, so no step is lost
    step_after_refine: bool = False
    # DashGaussian (train/resolution.py): training starts on small images
    resolution_schedule: Literal["none", "pictures", "pictures_and_count"] = "none"
    visible_adam: bool = False  # the optimiser updates visible Gaussians only; not in the baseline
    # time budget; training ends with the iteration that reaches it
    max_seconds: PositiveFloat | None = None
    # iterations after which a histogram of volumes is written (Fig. 5 of arXiv 2508.05187)
    volume_histogram: list[NonNegativeInt] = field(default_factory=lambda: [4000, 8000, 12_000])
    log_every: PositiveInt = 10
    # iterations; a killed trial resumes from its last checkpoint
    checkpoint_every: PositiveInt = 1000
    checkpoint_minutes: PositiveFloat = 10.0  # also if the last checkpoint is older than this

    def __post_init__(self) -> None:
        check_settings(self, "train")
