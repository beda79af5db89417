"""The walks of docs/architecture.md work: a copy of gsbench gets all of their changes."""

import os
import re
import shutil
import subprocess
import sys

import pytest
import yaml

from gsbench.gaussians.ply import read_ply
from tests.conftest import ROOT
from tests.helpers import read_json

PAGE = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
WALKS = dict(
    re.findall(r"^### (An? \w+|The loss|A column).*?^```diff\n(.*?)^```", PAGE, re.M | re.S)
)
TINY = """scene=courtyard scene.views=10 scene.width=64 scene.height=48 init=random init.count=300
    init.size=1.2 train.iterations=12 raster=reference eval.lpips=[] eval.flip=false tracking=none
    name=walk densify=pruned_first eval.more=[mae] train.opacity_weight=0.5"""


def edits(walk):
    """Yield the parts of a walk: (file, lines before, lines after)."""
    for part in walk.split("+++ ")[1:]:
        name, *lines = part.splitlines()
        before = [line[1:] for line in lines if not line.startswith("+")]
        after = [line[1:] for line in lines if not line.startswith("-")]
        yield name, "\n".join(before), "\n".join(after)


@pytest.mark.parametrize("walk", WALKS.values(), ids=list(WALKS))
def test_a_walk_changes_lines_that_exist(walk):
    assert len(WALKS) == 5
    for name, before, _ in edits(walk):
        file = ROOT / name
        assert file.read_text().count(f"{before}\n") == 1 if before else not file.exists(), name


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """A function that runs Python in a copy of gsbench with the changes of all walks."""
    copy = tmp_path_factory.mktemp("walked")
    for folder in ("src", "conf"):
        shutil.copytree(ROOT / folder, copy / folder)
    for walk in WALKS.values():
        for name, before, after in edits(walk):
            file = copy / name
            if before:
                file.write_text(file.read_text().replace(f"{before}\n", f"{after}\n"))
            else:
                file.write_text(f"{after}\n")
    environment = os.environ | {"PYTHONPATH": str(copy / "src"), "GSBENCH_RUNS": str(copy / "runs")}

    def run(*words):
        return subprocess.run(
            [sys.executable, *words], cwd=copy, env=environment, capture_output=True, text=True
        )

    done = run("-m", "gsbench", *TINY.split())
    assert done.returncode == 0, done.stderr
    (run.trial,) = (copy / "runs").glob("walk/courtyard/random-pruned_first/*")
    run.results = read_json(run.trial / "results.json")
    return run


@pytest.fixture(scope="module")
def answers(walked):
    """What one Python in the copy says of the new code."""
    code = """
from gsbench.densify import ADC, PrunedFirst
from gsbench.train.loss import *
import torch

ADC.rules = lambda self, refinement: [self.grow_by_gradient, self.prune]
one = torch.full((9, 9, 3), 0.5)
print([rule.__name__ for rule in PrunedFirst().rules(None)])
print(float(PhotometricLoss(0.0)(one, one)[0]))
chosen = [PhotometricLoss().implementation(device) for device in ("cpu", "cuda")]
print(["torch_photometric_loss" in str(one) for one in chosen])
"""
    return walked("-c", code).stdout.splitlines()


@pytest.mark.slow
def test_the_new_densifier_prunes_before_it_grows(walked, answers):
    assert answers[0] == "['prune', 'grow_by_gradient']"
    assert walked.results["densify"] == "pruned_first"


@pytest.mark.slow
def test_the_new_metric_and_the_new_column_are_shown_in_tables(walked):
    assert 0 < walked.results["metrics"]["mae"] < 1
    shown = walked("-m", "gsbench", "tables", "walk", "--metrics", "mae,test_views").stdout
    assert "MAE ↓" in shown
    assert "test views (views)" in shown


@pytest.mark.slow
def test_the_new_setting_is_checked_recorded_and_has_its_effect(walked):
    refused = walked("-m", "gsbench", *TINY.split(), "train.opacity_weight=2")
    assert refused.returncode == 2
    assert "train.opacity_weight must be a number" in refused.stderr
    values = yaml.safe_load((walked.trial / "config.yaml").read_text())
    assert values["train"]["opacity_weight"] == 0.5
    assert walked("-m", "gsbench", *TINY.split(), "train.opacity_weight=0").returncode == 0
    trials = walked.trial.parent.iterdir()
    means = {trial: read_ply(trial / "point_cloud.ply").opacities.mean() for trial in trials}
    assert means.pop(walked.trial) < min(means.values())


@pytest.mark.slow
def test_the_new_loss_is_trained_with_on_every_device_under_a_new_version(walked, answers):
    assert float(answers[1]) == pytest.approx(1e-3)
    assert answers[2] == "[True, True]"
    assert walked.results["code"]["stages"]["train"] == 6
