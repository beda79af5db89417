"""The notes of a comparison on its arms, from real trials of gsbench's and a user's classes."""

from shlex import split

import pytest

from gsbench.cli import run
from tests.end_to_end.conftest import SMALL

pytestmark = pytest.mark.slow

PATIENT = """
from dataclasses import dataclass
from gsbench.densify import ADC

@dataclass
class Patient(ADC):
    patience: int = 3
"""
TINY = [
    *SMALL,
    *split("train.iterations=2 scene.views=9 scene.width=48 scene.height=36 init.count=200"),
]
TINY += split("raster=reference eval.lpips=[] eval.flip=false tracking=none seed=0,1 name=arms")
OWN = split(
    "densify=adc densify._target_=patient_arm.Patient densify.name=patient +densify.patience=4"
)


def test_differences_of_arms_are_named_and_arms_added_later_are_reported(
    tmp_path, monkeypatch, capsys
):
    (tmp_path / "patient_arm.py").write_text(PATIENT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))

    def tables(*words):
        capsys.readouterr()
        assert run(["tables", "arms", *words]) == 0
        return capsys.readouterr().out

    assert run(["-m", *TINY, "densify=adc,longaxis", "eval.primary=ssim"]) == 0
    notes = tables()
    assert "SSIM was declared beforehand (eval.primary, " in notes
    verdict = next(line for line in notes.splitlines() if "Verdict, random-longaxis" in line)
    assert "random-longaxis differs from random-adc by split, gradient and threshold." in notes

    assert run(["-m", *TINY, *OWN, "densify.interval=40", "allow_targets=[patient_arm]"]) == 0
    notes = tables()
    assert verdict in notes.splitlines()
    # Its command named no metric, so the declared one stays for its trials, with its own time.
    assert "Verdict, random-patient against random-adc" in notes
    assert (
        "random-patient differs from random-adc by rule patient_arm.Patient and schedule" in notes
    )
    sheet = tables("--layout", "fairness", "--format", "latex")
    assert "densify.patience & -- & 4" in sheet
    assert "patient\\_arm.Patient" in sheet
    assert sheet.count("\\caption{Fairness sheet") == 2
