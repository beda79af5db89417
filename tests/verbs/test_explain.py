"""`gsbench explain`: every number of a cell leads to its trials."""

from __future__ import annotations

import pytest

from gsbench.errors import InputError
from gsbench.verbs.results import explain, explain_cell
from tests.analysis.synthetic import Plan, write_runs


def test_a_cell_names_its_trials_hashes_and_versions(tmp_path, capsys):
    paths = write_runs(tmp_path, Plan(experiment="table1", inits=("dim",), scenes=("garden",)))
    assert explain(["table1:garden:lpips:volumetric"], tmp_path) == 0
    text = capsys.readouterr().out
    for path in paths:
        assert (str(path) in text) == ("volumetric" in str(path))
    for expected in (
        "LPIPS VGG raw of dim-volumetric on garden",
        "over 3 of 3 trials",
        "data-garden",
        "torch 2.13.0",
        "protocol: paper-1",
        "resolution: 400x300",
        "iterations: 2000",
    ):
        assert expected in text


def test_missing_trials_and_metrics_are_reported(tmp_path):
    paths = write_runs(tmp_path, Plan(scenes=("garden",), densifiers=("adc", "adc_2")))
    (paths[0] / "results.json").unlink()
    (paths[-1] / "results.json").unlink()  # of another arm, whose name has the arm's
    text = explain_cell("exp:garden:psnr:adc", tmp_path)
    assert "over 2 of 3 trials" in text
    assert "Left out\n  exp/garden/sfm-adc/c0ffee00-seed0: unfinished" in text
    assert "adc_2" not in text
    assert "not available: weights file alexnet.pth not found" in explain_cell(
        "exp:garden:lpips_alex:adc", tmp_path
    )


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("exp:garden:psnr", "is not EXPERIMENT:SCENE:METRIC:ARM"),
        ("nope:garden:psnr:adc", "no experiment 'nope'"),
        ("exp:kitchen:psnr:adc", "has no scene 'kitchen'; it has garden"),
        (
            "exp:garden:psnr:mcmc",
            "names 0 arms of garden; choose one of dim-adc, dim-volumetric, sfm-adc",
        ),
        ("exp:garden:psnr:adc", "names 2 arms"),
        ("exp:garden:quality:sfm-adc", "unknown metric 'quality'"),
    ],
)
def test_bad_addresses_are_explained(tmp_path, address, words):
    write_runs(tmp_path, Plan(scenes=("garden",), inits=("sfm", "dim")))
    with pytest.raises(InputError, match=words):
        explain_cell(address, tmp_path)
