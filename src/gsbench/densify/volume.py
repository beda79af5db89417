"""The geometry of the paper's rule, in log space: volume, condition number and the scales of the children."""

from __future__ import annotations

import math
from typing import Literal

from torch import Tensor

LOG_SPHERE = math.log(4 * math.pi / 3)
ConditionOf = Literal["eigenvalues", "scales", "nothing"]


def log_volume(log_scales: Tensor) -> Tensor:
    """log V = log(4 pi / 3) + sum of log s_i (eq. 5), [N] from [N, 3]; world units^3, never underflows."""
    return LOG_SPHERE + log_scales.sum(-1)


def log_condition(log_scales: Tensor) -> Tensor:
    """log kappa = 2 (log s_max - log s_min) (eq. 6: the ratio of the eigenvalues s^2), [N] from [N, 3], at least 0."""
    return 2 * (log_scales.amax(-1) - log_scales.amin(-1))


def child_log_scales(
    log_scales: Tensor,
    applied_to: ConditionOf = "eigenvalues",
    max_condition: float | None = None,
    plain_shrink: float = 1.6,
) -> Tensor:
    """Scales of the children (eq. 7), [N, 3].

    ``eigenvalues``: lambda' = lambda / kappa, so log s' = log s - log(kappa) / 2. ``scales``: s' = s / kappa.
    ``nothing``: s' = s / ``plain_shrink``, as ADC splits, in place of eq. 7. ``max_condition`` (at least 1) limits the
    kappa that is divided by.
    """
    if applied_to == "nothing":
        return log_scales - math.log(plain_shrink)
    condition = log_condition(log_scales)  # [N]
    if max_condition is not None:
        condition = condition.clamp_max(math.log(max_condition))
    factor = 0.5 if applied_to == "eigenvalues" else 1.0
    return log_scales - (factor * condition).unsqueeze(-1)
