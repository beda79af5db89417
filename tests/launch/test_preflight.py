"""Checks of trials before any of them runs."""

import pytest

from gsbench.config.compose import compose_one
from gsbench.launch.batch import borrowed_names

OWN = "densify._target_=mine.Patient"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["densify=adc", OWN], ["densify.name=patient"]),
        # the name of another class of gsbench
        (["densify=adc", OWN, "densify.name=volumetric"], ["densify.name=patient"]),
        (["densify=adc", OWN, "densify.name=mine"], []),
        (["init=random", "init._target_=mine.Shell"], ["init.name=shell"]),
        # another class of gsbench
        (["densify=adc", "densify._target_=gsbench.densify.AbsGS"], []),
        (["densify=adc"], []),
    ],
)
def test_a_users_class_under_a_name_of_gsbench_gets_a_warning(words, said):
    trials = [compose_one([*words, "allow_targets=[mine]", f"seed={seed}"]) for seed in (0, 1)]
    lines = borrowed_names(trials)
    assert len(lines) == len(said)
    for line, word in zip(lines, said, strict=True):
        assert line.endswith(word)
