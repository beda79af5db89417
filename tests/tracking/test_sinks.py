"""What each tracker shows of the same files; the packages of some are optional."""

import json
import os
import sys
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import Image

from gsbench.config.compose import compose_one
from gsbench.errors import InputError
from gsbench.launch.batch import check_trackers
from gsbench.runs.trial_folder import TrialFolder
from gsbench.tracking import connect, ensure_experiment
from gsbench.tracking.mlflow_sink import STATE
from gsbench.tracking.sinks import TrackedTrial
from tests.tracking.helpers import (
    RECORDS,
    begin_trial,
    history,
    mirror_trial,
    options,
    run_of,
    trial_values,
    write_trial,
)

AT = {"50": {"metrics": {"psnr": 15.0}, "num_gaussians": 7}}


def finished_trial(runs, seed):
    """A finished trial with a picture, which was also measured at iteration 50."""
    values = trial_values(runs, seed)
    folder = begin_trial(values)
    write_trial(folder, values)
    results = json.loads((folder / "results.json").read_text()) | {"metrics_at": AT}
    (folder / "results.json").write_text(json.dumps(results))
    for kind, value in (("renders", 200), ("ground_truth", 50)):
        (folder / kind).mkdir()
        Image.fromarray(np.full((4, 6, 3), value, np.uint8)).save(folder / kind / "view 1#.png")
    words = ["densify=a_densify", "scene.path=/my photos"]
    plan = {"trials": {folder.relative_to(folder.parents[2]).as_posix(): {"overrides": words}}}
    (folder.parents[2] / "plan.json").write_text(json.dumps(plan))
    return folder, values


def test_mlflow_shows_curves_of_test_metrics_and_a_grid_of_test_pictures(runs):
    folder, values = finished_trial(runs, seed=1)
    mirror_trial(options(), folder, values)
    client = connect(None, runs)
    run = run_of(client, 1)
    assert run.info.run_name == "a_densify · a_scene · s1"
    assert history(client, run.info.run_id, "eval/psnr_dB") == [(50, 15.0), (RECORDS, 20.0)]
    assert run.data.metrics["eval/psnr_dB"] == 20.0  # tables show the last value
    # MLflow's page shows a grid of pictures if it finds this tag
    assert run.data.tags["mlflow.loggedImages"] == "True"
    names = [Path(item.path).name for item in client.list_artifacts(run.info.run_id, "images")]
    for kind in ("1 render", "2 photograph", "3 error"):
        assert [
            n
            for n in names
            if n.startswith(f"view 1_~{kind}+step+{RECORDS}+") and n.endswith(".png")
        ], names
    assert run.data.tags["mlflow.note.content"].startswith(
        "PSNR (dB) 20, 11 Gaussians after 150 iterations."
    )


def test_the_summary_of_a_trial(tmp_path):
    folder, values = finished_trial(tmp_path, seed=3)
    trial = TrackedTrial(TrialFolder(folder), values)
    results = trial.folder.sound_record()
    assert results is not None
    summary = trial.summary(results, images=1, with_model=False)
    assert (summary.step, summary.seconds) == (RECORDS, 2.0)
    found = {(scalar.key, scalar.step): scalar for scalar in summary.scalars}
    assert found["eval/psnr_dB", 50].seconds == pytest.approx(2.0 * 50 / RECORDS)
    assert found["eval/psnr_dB", RECORDS].seconds == 2.0
    assert {key: scalar.value for (key, step), scalar in found.items() if step == RECORDS} == {
        "eval/psnr_dB": 20.0,
        "eval/gaussians": 13.0,
        "eval/init_points": 5.0,
        "eval/peak_memory_MB": 1.5,
        "eval/minutes": pytest.approx(2 / 60),
    }
    assert summary.tags["hash_config"] == "abc"
    assert list(summary.pictures) == ["view 1_/1 render", "view 1_/2 photograph", "view 1_/3 error"]
    assert (summary.pictures["view 1_/3 error"] == 150).all()
    again = summary.note.splitlines()[-1].removeprefix("Again: ")
    assert again == "`gsbench densify=a_densify 'scene.path=/my photos'`"
    assert trial.summary(results, images=0, with_model=False).pictures == {}
    assert {path.name for _, path in summary.files} == {
        "config.yaml",
        "results.json",
        "events.jsonl",
    }


def test_weights_and_biases_gets_a_whole_trial_in_one_run(tmp_path, monkeypatch):
    """A mock stands in for the client."""
    wandb = MagicMock()
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    monkeypatch.setenv("WANDB_BASE_URL", "http://before")
    folder, values = finished_trial(tmp_path, seed=1)
    sink = options("http://wandb.example") | {"sink": "wandb"}
    assert mirror_trial(sink, folder, values)
    assert not mirror_trial(sink, folder, values)
    assert os.environ["WANDB_BASE_URL"] == "http://wandb.example"
    (asked,) = (call.kwargs for call in wandb.init.call_args_list)
    assert (asked["project"], asked["resume"]) == ("tracked", "allow")
    assert asked["name"] == "a_densify · a_scene · s1"
    run = wandb.init.return_value
    logged = [call.args[0] for call in run.log.call_args_list]
    losses = [(row["iteration"], row["train/loss"]) for row in logged if "train/loss" in row]
    assert losses == [(i, 1 / i) for i in range(1, RECORDS + 1)]
    assert {"iteration": 50, "eval/psnr_dB": 15.0} in logged
    assert [row["iteration"] for row in logged if "view 1_/1 render" in row] == [RECORDS]
    assert run.summary.update.call_args.args[0]["eval/psnr_dB"] == 20.0
    assert {Path(call.args[0]).name for call in run.save.call_args_list} >= {
        "config.yaml",
        "results.json",
    }
    run.finish.assert_called_once_with(0)
    write_trial(folder, values, psnr=33.0)
    assert mirror_trial(sink, folder, values)
    # the run with earlier results stays beside it
    assert wandb.init.call_args.kwargs["id"] != asked["id"]
    (folder / "results.json").unlink()
    (folder / "failed.json").write_text(json.dumps({"message": "the loss became nan"}))
    assert mirror_trial(sink, folder, values)
    run.summary.__setitem__.assert_called_once_with("error", "the loss became nan")
    run.finish.assert_called_with(1)


def test_experiments_have_the_kind_of_model_development(runs):
    client = connect(None, runs)
    tag = "mlflow.experimentKind"
    assert (
        client.get_experiment(ensure_experiment(client, "kind", runs)).tags[tag]
        == "custom_model_development"
    )
    plain, chosen = (
        client.create_experiment("plain"),
        client.create_experiment("chosen", tags={tag: "regression"}),
    )
    assert ensure_experiment(client, "plain", runs) == plain
    assert client.get_experiment(plain).tags[tag] == "custom_model_development"
    ensure_experiment(client, "chosen", runs)
    assert client.get_experiment(chosen).tags[tag] == "regression"  # a user's choice is kept


def test_a_tracker_whose_package_is_missing_is_refused_before_any_work(monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r"tracking.sink=wandb needs a package: pip install .*\[wandb\]"
    ):
        check_trackers([compose_one(["tracking=wandb"])])
    check_trackers([compose_one(["tracking=none"])])


def test_tensorboard_shows_the_same_numbers_once(tmp_path):
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator", reason="needs tensorboard"
    )
    folder, values = finished_trial(tmp_path, seed=1)
    there = tmp_path / "tensorboard" / folder.relative_to(tmp_path)
    sink = options() | {"sink": "tensorboard"}

    def shown():
        events = accumulator.EventAccumulator(str(there), size_guidance={"scalars": 0, "images": 0})
        return events.Reload()

    for _ in range(2):  # the second time as after a crash between sending and recording
        assert mirror_trial(sink, folder, values)
        assert not mirror_trial(sink, folder, values)
        assert len(list(there.iterdir())) == 1
        losses = [(event.step, event.value) for event in shown().Scalars("train/loss")]
        assert losses == [(i, pytest.approx(1 / i)) for i in range(1, RECORDS + 1)]
        assert [(event.step, event.value) for event in shown().Scalars("eval/psnr_dB")] == [
            (50, 15.0),
            (RECORDS, 20.0),
        ]
        assert [event.step for event in shown().Images("view 1_/1 render")] == [RECORDS]
        state = json.loads((folder / "tensorboard.json").read_text())
        (folder / "tensorboard.json").write_text(json.dumps(state | {"complete": None}))
    assert not (folder / STATE).exists()


def test_weights_and_biases_takes_a_trial_without_a_network(tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="needs wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    folder, values = finished_trial(tmp_path, seed=1)
    sink = options() | {"sink": "wandb"}
    assert mirror_trial(sink, folder, values)
    assert not mirror_trial(sink, folder, values)
    (file,) = (tmp_path / "wandb").rglob("*.wandb")
    said = file.read_bytes()
    for word in (b"train/loss", b"eval/psnr_dB", "a_densify · a_scene · s1".encode()):
        assert word in said
