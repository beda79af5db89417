"""Values from papers and their code that several packages share. Does not import torch."""

import math
from dataclasses import dataclass, fields

from pydantic import PositiveFloat, PositiveInt

VOLUME_THRESHOLD = 0.03  # V_th of arXiv 2508.05187, in cubed units of its COLMAP models
ADAM_BETAS = (0.9, 0.999)  # torch's defaults, as in 3DGS
ADAM_EPSILON = 1e-15  # 3DGS
PAPER_CAP = 3_400_000  # Gaussians; the same paper has it for the baseline and for its own rule


@dataclass
class LearningRates:
    """Adam's learning rates, those of 3DGS's code of 2023 (late 2024: 0.025 for opacity)."""

    position_initial: PositiveFloat = 1.6e-4  # times the scene extent
    position_final: PositiveFloat = 1.6e-6  # times the scene extent
    # number of iterations over which the position rate falls log-linearly
    position_steps: PositiveInt = 30_000
    sh_dc: PositiveFloat = 2.5e-3
    sh_rest: PositiveFloat = 2.5e-3 / 20
    opacity: PositiveFloat = 0.05
    scale: PositiveFloat = 5e-3
    rotation: PositiveFloat = 1e-3

    def position(self, step: float) -> float:
        """The learning rate of the means at iteration ``step``, for a scene extent of 1."""
        t = min(max(step / self.position_steps, 0.0), 1.0)
        return math.exp(
            (1 - t) * math.log(self.position_initial) + t * math.log(self.position_final)
        )


# the settings of `LearningRates` that are rates
RATES = tuple(entry.name for entry in fields(LearningRates) if entry.name != "position_steps")
