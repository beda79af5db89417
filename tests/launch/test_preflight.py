"""Checks of trials before any of them runs."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from gsbench.config.compose import compose_one
from gsbench.launch.preflight import borrowed_names, disk_line

OWN = "densify._target_=mine.Patient"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["densify=adc", OWN], ["densify.name=patient"]),
        (["densify=adc", OWN, "densify.name=volumetric"], ["densify.name=patient"]),  # the name of yet another one
        (["densify=adc", OWN, "densify.name=mine"], []),
        (["init=random", "init._target_=mine.Shell"], ["init.name=shell"]),
        (["densify=adc", "densify._target_=gsbench.densify.AbsGS"], []),  # ours by another class: settings tell
        (["densify=adc"], []),
    ],
)
def test_a_class_of_ones_own_under_a_name_of_ours_is_told(words: list[str], said: list[str]) -> None:
    trials = [compose_one([*words, "allow_targets=[mine]", f"seed={seed}"]) for seed in (0, 1)]
    lines = borrowed_names(trials)
    assert len(lines) == len(said)
    for line, word in zip(lines, said, strict=True):
        assert line.endswith(word)


def test_much_disk_for_a_sweep_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda place: SimpleNamespace(free=100 * 10**9))
    trials = [compose_one(["densify=adc", "densify.max_gaussians=3000000"])]
    assert disk_line(trials * 78).startswith("disk: up to 58 GB for the models of 78 trials, 100 GB are free in ")
    assert disk_line(trials) == ""
    assert disk_line([compose_one(["densify=adc", "densify.max_gaussians=null"])] * 10**4) == ""
