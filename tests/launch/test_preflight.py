"""Checks of trials before any of them runs."""

import pytest

from gsbench.config.compose import compose_one
from gsbench.launch.batch import borrowed_names

OWN = "densify._target_=mine.Patient"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["densify=adc", OWN], ["densify.name=patient"]),
        # the name of yet another one
        (["densify=adc", OWN, "densify.name=volumetric"], ["densify.name=patient"]),
        (["densify=adc", OWN, "densify.name=mine"], []),
        (["init=random", "init._target_=mine.Shell"], ["init.name=shell"]),
        # ours by another class: settings tell
        (["densify=adc", "densify._target_=gsbench.densify.AbsGS"], []),
        (["densify=adc"], []),
    ],
)
def test_a_class_of_ones_own_under_a_name_of_ours_is_told(words, said):
    trials = [compose_one([*words, "allow_targets=[mine]", f"seed={seed}"]) for seed in (0, 1)]
    lines = borrowed_names(trials)
    assert len(lines) == len(said)
    for line, word in zip(lines, said, strict=True):
        assert line.endswith(word)
