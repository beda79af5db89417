"""What each tracker shows of the same files; the packages of some are optional."""

import sys

import numpy as np
import pytest

from gsbench.config.compose import compose_one
from gsbench.launch.batch import check_trackers
from gsbench.runs.trial_folder import TrialFolder
from gsbench.tracking import connect, ensure_experiment
from gsbench.tracking.trial import TrackedTrial
from tests.helpers import refusal, write_lines
from tests.tracking.helpers import mirror_trial, options, run_of
from tests.tracking.test_contract import finished
from tests.trials import STEPS


def test_mlflow_shows_a_grid_of_test_pictures(runs):
    folder, values = finished(runs)
    mirror_trial(options(), folder, values)
    client = connect(None, runs)
    run = run_of(client, 1)
    assert run.info.run_name == "a_densify · a_scene · s1"
    # MLflow's page shows a grid of pictures if it finds this tag
    assert run.data.tags["mlflow.loggedImages"] == "True"


def test_the_summary_of_a_trial(tmp_path):
    folder, values = finished(tmp_path)
    words = ["densify=a_densify", "scene.path=/my photos"]
    planned = {folder.relative_to(folder.parents[2]).as_posix(): {"words": words}}
    command = {"words": words, "cwd": "/", "time": 1.0, "trials": planned}
    write_lines(folder.parents[2] / "commands.jsonl", [command])
    trial = TrackedTrial(TrialFolder(folder), values)
    results = trial.folder.sound_record()
    assert results is not None
    summary = trial.summary(results, images=1, with_model=False)
    found = {(scalar.key, scalar.step): scalar for scalar in summary.scalars}
    assert found["eval/psnr_dB", 50].seconds == pytest.approx(2.0 * 50 / STEPS)
    assert found["eval/psnr_dB", STEPS].seconds == 2.0
    assert {key: scalar.value for (key, step), scalar in found.items() if step == STEPS} == {
        "eval/psnr_dB": 20.0,
        "eval/gaussians": 11.0,
        "eval/init_points": 5.0,
        "eval/peak_memory_MB": 1.5,
        "eval/minutes": pytest.approx(2 / 60),
    }
    assert summary.tags["hash_config"] == "abc"
    names = ["view 1_/1 render", "view 1_/2 photograph", "view 1_/3 error"]
    assert [one.key for one in summary.pictures] == names
    assert (summary.pictures[2].pixels == np.full((4, 6, 3), 150)).all()
    assert {(one.step, one.seconds) for one in summary.pictures} == {(STEPS, 2.0)}
    assert summary.tags["command"] == "gsbench densify=a_densify 'scene.path=/my photos'"
    assert trial.summary(results, images=0, with_model=False).pictures == []
    assert set(summary.files) == {"config.yaml", "results.json", "events.jsonl"}


def test_experiments_have_the_kind_of_model_development(runs):
    client = connect(None, runs)
    tag = "mlflow.experimentKind"
    plain = client.create_experiment("plain")
    client.create_experiment("chosen", tags={tag: "regression"})
    ours = "custom_model_development"
    # a user's choice is kept
    for name, kind in (("kind", ours), ("plain", ours), ("chosen", "regression")):
        made = ensure_experiment(client, name, runs)
        assert client.get_experiment(made).tags[tag] == kind
        assert name != "plain" or made == plain


def test_a_tracker_whose_package_is_missing_is_refused_before_any_work(monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with refusal(r"tracking=wandb needs the package wandb: pip install .*\[wandb\]"):
        check_trackers([compose_one(["tracking=wandb"])])
    check_trackers([compose_one(["tracking=none"])])


def test_weights_and_biases_takes_a_trial_without_a_network(tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="needs wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    folder, values = finished(tmp_path)
    sink = options() | {"_target_": "gsbench.tracking.WandB"}
    assert mirror_trial(sink, folder, values)
    assert not mirror_trial(sink, folder, values)
    (file,) = (tmp_path / "wandb").rglob("*.wandb")
    said = file.read_bytes()
    for word in (b"train/loss", b"eval/psnr_dB", "a_densify · a_scene · s1".encode()):
        assert word in said
