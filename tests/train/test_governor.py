"""Trainings under the governor end at one count, with equal rounds and recorded thresholds."""

import pytest

from gsbench.densify import ADC, MCMC, PixelGS, Volumetric
from tests.train.lab import EVENTS

LIMIT = 400
WINDOW = {"start": 20, "stop": 240, "interval": 20, "max_gaussians": LIMIT, "cap": "governor"}
ARMS = {
    "adc": (ADC, {}),
    "adc, a loose threshold": (ADC, {"gradient_threshold": 2e-5}),
    "absgrad": (ADC, {"gradient": "absolute", "gradient_threshold": 8e-4}),
    "volumetric": (Volumetric, {"volume_threshold": 0.003}),
    "volumetric, not the round": (
        Volumetric,
        {"volume_threshold": 0.003, "split_isotropic": False},
    ),
    "volumetric, its tail": (Volumetric, {"threshold_mode": "quantile", "volume_quantile": 0.9}),
    "pixelgs": (PixelGS, {}),
    "mcmc": (MCMC, {}),
}


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.slow
def test_trainings_end_within_two_percent_of_one_count(arm, lab):
    kind, own = ARMS[arm]
    if kind is not MCMC:
        own = own | {"opacity_reset_interval": 120}  # in the middle of the window
    assert len(lab.train(kind(**(WINDOW | own)), iterations=260)) == pytest.approx(LIMIT, rel=0.02)
    rounds = [event for event in lab.records(EVENTS) if "target" in event]
    assert [event["step"] for event in rounds] == list(range(40, 240, 20))
    assert rounds[-1]["target"] == LIMIT
    strictness = [event["strictness"] for event in rounds]
    assert len(set(strictness)) > 3  # the governor changed it
    assert all(1e-3 <= factor <= 1e3 for factor in strictness)
