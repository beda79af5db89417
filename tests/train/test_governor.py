"""Arms under the governor, in whole trainings.

One count at the end, equal numbers of rounds, thresholds on record.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from gsbench.densify import ADC, MCMC, PixelGS, Volumetric
from gsbench.densify.budget import Budgeted
from gsbench.gaussians.initial import gaussians_from_cloud
from gsbench.gaussians.model import Gaussians
from gsbench.raster import create_rasterizer
from gsbench.scene.types import Scene
from gsbench.train.trainer import Trainer
from tests.train.test_trainer import options

LIMIT = 400
WINDOW = {"start": 20, "stop": 240, "interval": 20, "max_gaussians": LIMIT, "cap": "governor"}
ARMS: dict[str, tuple[type[Budgeted], dict[str, object]]] = {
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
def test_arms_end_within_two_percent_of_one_count(
    arm: str, tiny_scene: Scene, truth: Gaussians, tmp_path: Path
) -> None:
    kind, own = ARMS[arm]
    if kind is not MCMC:
        own = own | {"opacity_reset_interval": 120}  # in the middle of the window
    densifier = kind(**(WINDOW | own))  # type: ignore[arg-type]
    initial = gaussians_from_cloud(
        truth.means.double().numpy(), torch.full((len(truth), 3), 127).byte().numpy()
    )
    rasterizer = create_rasterizer("cpu", torch.device("cpu"), threads=1)
    trained = Trainer(tiny_scene, initial, densifier, rasterizer, options(iterations=260), 0).run(
        tmp_path
    )
    assert len(trained) == pytest.approx(LIMIT, rel=0.02)
    events = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    rounds = [event for event in events if "target" in event]
    assert [event["step"] for event in rounds] == list(range(40, 240, 20))
    assert rounds[-1]["target"] == LIMIT
    strictness = [event["strictness"] for event in rounds]
    assert len(set(strictness)) > 3  # it moved
    assert all(1e-3 <= factor <= 1e3 for factor in strictness)


def trained(
    densifier: Budgeted, scene: Scene, truth: Gaussians, folder: Path
) -> list[dict[str, float]]:
    """The rounds of a training of 260 iterations."""
    initial = gaussians_from_cloud(
        truth.means.double().numpy(), torch.full((len(truth), 3), 127).byte().numpy()
    )
    rasterizer = create_rasterizer("cpu", torch.device("cpu"), threads=1)
    Trainer(scene, initial, densifier, rasterizer, options(iterations=260), 0).run(folder)
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    return [event for event in events if event["step"] % 20 == 0]


def test_where_the_strictest_growth_is_too_much_the_faint_are_culled(
    tiny_scene: Scene, truth: Gaussians, tmp_path: Path
) -> None:
    """A threshold in other units than the scene's.

    A thousandth of it and a thousand times it select everybody.
    """
    own = {
        "volume_threshold": 1e-24,
        "prune_opacity": 0.03,
        "opacity_reset_interval": 1000,
        "max_gaussians": 120,
    }
    rounds = trained(Volumetric(**(WINDOW | own)), tiny_scene, truth, tmp_path)  # type: ignore[arg-type]
    culled = [event for event in rounds if event["cull"] > 1]
    assert culled
    for event in culled:
        assert event["strictness"] == pytest.approx(1e3)
        assert event["cull"] <= 10
        assert event["pruned_opacity"] > 0
        assert event["after"] == event["before"] + event["split_volume"] + event[
            "split_gradient"
        ] + event["cloned"] - (event["pruned_opacity"] + event["pruned_size"])


def test_a_frozen_training_changes_nothing_more(
    tiny_scene: Scene, truth: Gaussians, tmp_path: Path
) -> None:
    """Only the first round beyond the limit acts; later ones say what they would add."""
    own = {
        "cap": "freeze",
        "max_gaussians": 100,
        "gradient_threshold": 1e-6,
        "opacity_reset_interval": 1000,
    }
    rounds = trained(ADC(**(WINDOW | own)), tiny_scene, truth, tmp_path)  # type: ignore[arg-type]
    beyond = [event for event in rounds if event["before"] > 100]
    assert len(beyond) > 3
    assert (
        {event["before"] for event in beyond}
        == {event["after"] for event in beyond}
        == {rounds[0]["after"]}
    )
    assert all(event["blocked_by_cap"] > 0 for event in beyond)
    assert not any(
        event["pruned_opacity"] + event["cloned"] + event["split_gradient"] for event in beyond
    )
