"""Failures that other trials would repeat, with stand-ins for trainings."""

from types import SimpleNamespace

import pytest

from gsbench.errors import InputError
from gsbench.launch import jobs
from gsbench.launch.jobs import run_serial, setting_in
from gsbench.runs.layout import BUILDING, CURVES, FAILED
from tests.helpers import write, write_lines
from tests.trials import bare_trial

SERIAL = {"name": "serial", "parallel": 1, "wait": True}


def fails(trial, error, stage, step):
    """Raise as a training does whose ``stage`` fails after iteration ``step``."""
    write(trial.folder / FAILED, {"status": "failed", "message": str(error)})
    write(trial.folder / BUILDING, {"stage": stage, "folder": str(trial.folder)})
    write_lines(trial.folder / CURVES, [{"step": step}] if step else [])
    raise error


def started(monkeypatch, trials, error, stage="train", step=0, bad=lambda trial: True):
    """The trials that run of a sweep in which the ``bad`` ones fail, and all outcomes."""
    began = []

    def run_trial(trial, wait):
        began.append(trial)
        if bad(trial):
            fails(trial, error, stage, step)
        return SimpleNamespace(metrics_line="psnr 1")

    monkeypatch.setattr("gsbench.pipeline.trial.run_trial", run_trial)
    outcomes = jobs.run_serial(trials)
    assert [one.folder for one in outcomes] == [one.folder for one in trials]
    return began, outcomes


@pytest.mark.parametrize(
    "error, stage, step, count, change",
    [
        (InputError("densify.size=3: too large"), "train", 0, 3, "densify.size"),
        (InputError("photographs are dark"), "init", 0, 1, "a setting of scene or init"),
        (RuntimeError("boom"), "train", 0, 3, "a setting of densify or raster or train or eval"),
        (RuntimeError("boom"), "train", 7, 6, ""),  # another seed may end well
        (InputError("scene.path=/x: no folder"), "", 0, 1, "scene.path"),
    ],
)
def test_a_failure_that_no_other_seed_averts_is_not_repeated(
    tmp_path, monkeypatch, error, stage, step, count, change
):
    groups = {"scene": {"name": "a", "path": "/x"}, "init": {"name": "sfm"}}
    trials = [
        bare_trial(tmp_path, seed, SERIAL, densify={"name": "d", "size": size}, **groups)
        for size in (3, 4, 5)
        for seed in (0, 1)
    ]
    began, outcomes = started(monkeypatch, trials, error, stage, step)
    assert len(began) == count
    assert {one.change for one in outcomes if one.change} == ({change} if change else set())
    assert all(one.status == "failed" for one in outcomes)


def test_arms_without_the_wrong_setting_go_on(tmp_path, monkeypatch):
    trials = [
        bare_trial(tmp_path, seed, SERIAL, densify={"name": "d", "size": size})
        for size in (3, 4)
        for seed in (0, 1)
    ]
    error = InputError("densify.size=3: too large")
    bad = lambda trial: trial.values["densify"]["size"] == 3  # noqa: E731
    began, outcomes = started(monkeypatch, trials, error, bad=bad)
    assert [one.values["densify"]["size"] for one in began] == [3, 4, 4]
    assert [one.status for one in outcomes] == ["failed", "failed", "done", "done"]


def test_the_longest_setting_that_a_message_names_is_meant():
    values = {"densify": {"split": 1, "split_size": 2}, "scene": {"path": "x"}}
    assert setting_in("densify.split_size=2 and scene.path", values) == "densify.split_size"
    assert setting_in("densify.nothing", values) == ""
    assert run_serial([]) == []
