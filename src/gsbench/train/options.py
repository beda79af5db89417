"""The settings of a training: iterations, learning rates, densification window, checkpoints."""

from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from gsbench.gaussians.paper_values import LearningRates
from gsbench.settings import MISSING, Fraction, check_settings

IDEAS = ("loss", "terms", "schedule", "optimizer")  # settings that name classes of the user's
# the steps that ``steps_scaler`` multiplies; densifiers have theirs from these
STEPS = (
    "iterations",
    "sh_interval",
    "position_steps",
    "densify_start",
    "densify_stop",
    "densify_interval",
    "opacity_reset_interval",
    "mcmc_stop",
    "volume_histogram",
)

BY_AUTOGRAD = "by_autograd"


@dataclass
class TrainConfig(LearningRates):
    name: str = MISSING
    # all steps of the schedule (`STEPS`) times this, as in gsplat; recorded as 1
    steps_scaler: PositiveFloat = 1.0
    iterations: NonNegativeInt = 30_000  # 0: evaluate the initial Gaussians without training
    sh_interval: PositiveInt = 1000  # iterations after which spherical harmonics gain a degree
    ssim_weight: Fraction = 0.2  # loss = 0.8 L1 + 0.2 (1 - SSIM)
    # classes of your own (docs/ideas.md): _target_ and options, instead of the loss above
    loss: dict[str, Any] = field(default_factory=dict)
    # terms added to the loss: a list of _target_, weight and options
    terms: list[dict[str, Any]] = field(default_factory=list)
    schedule: dict[str, Any] = field(default_factory=dict)  # of the learning rates
    optimizer: dict[str, Any] = field(default_factory=dict)  # instead of Adam
    background: tuple[Fraction, Fraction, Fraction] = (0.0, 0.0, 0.0)
    densify_start: NonNegativeInt = 500  # the densification window; densifiers read it from here
    densify_stop: NonNegativeInt = 15_000
    densify_interval: PositiveInt = 100
    opacity_reset_interval: PositiveInt = 3000
    mcmc_stop: NonNegativeInt = 25_000  # end of the longer window of 3DGS-MCMC
    # True: the optimiser steps before a refinement, as in gsplat, so no step is lost
    step_after_refine: bool = False
    # DashGaussian (train/views.py): training starts on small images
    # steps of plain autograd, as trainings with a loss, term or optimiser of your own have them:
    # the same bits, in more time; a command with such a training gives it to all
    by_autograd: bool = False
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


def scale_steps(train: MutableMapping[str, Any]) -> None:
    """Multiply the steps of a schedule by its ``steps_scaler``, which becomes 1.

    One that is no number above 0 is left for the check of the settings.
    """
    scale = train.get("steps_scaler", 1.0)
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0 < scale != 1:
        return

    def scaled(step: Any) -> Any:
        if isinstance(step, Sequence) and not isinstance(step, str):
            return [scaled(one) for one in step]
        # an interval of 0 is none; a step given as 0 stays
        return max(1, round(step * scale)) if isinstance(step, int) and step else step

    for key in STEPS:
        train[key] = scaled(train[key])
    train["steps_scaler"] = 1.0
