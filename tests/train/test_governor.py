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


def rounds_of(lab, densifier):
    lab.train(densifier, iterations=260)
    return [event for event in lab.records(EVENTS) if event["step"] % 20 == 0]


def test_if_the_strictest_growth_is_too_much_faint_gaussians_are_culled(lab):
    """The threshold is in other units than the scene's.

    The strictness is between 0.001 and 1000; at both ends, the threshold selects all Gaussians.
    """
    own = {
        "volume_threshold": 1e-24,
        "prune_opacity": 0.03,
        "opacity_reset_interval": 1000,
        "max_gaussians": 120,
    }
    rounds = rounds_of(lab, Volumetric(**(WINDOW | own)))
    culled = [event for event in rounds if event["cull"] > 1]
    assert culled
    for event in culled:
        assert event["strictness"] == pytest.approx(1e3)
        assert event["cull"] <= 10
        assert event["pruned_opacity"] > 0
        grown = event["split_volume"] + event["split_gradient"] + event["cloned"]
        pruned = event["pruned_opacity"] + event["pruned_size"]
        assert event["after"] == event["before"] + grown - pruned


def test_a_frozen_training_changes_no_gaussian_after_the_limit(lab):
    """Only the first round beyond the limit acts; later rounds record what they would add."""
    own = {
        "cap": "freeze",
        "max_gaussians": 100,
        "gradient_threshold": 1e-6,
        "opacity_reset_interval": 1000,
    }
    rounds = rounds_of(lab, ADC(**(WINDOW | own)))
    beyond = [event for event in rounds if event["before"] > 100]
    assert len(beyond) > 3
    assert {event[when] for event in beyond for when in ("before", "after")} == {rounds[0]["after"]}
    assert all(event["blocked_by_cap"] > 0 for event in beyond)
    assert not any(
        event["pruned_opacity"] + event["cloned"] + event["split_gradient"] for event in beyond
    )
