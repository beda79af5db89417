"""The search by Optuna, with trials that take no time: what a point is worth is a known function of its setting."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gsbench import cli
from gsbench.analysis.report.setting_charts import search_part
from gsbench.errors import GsbenchError
from gsbench.launch import serial
from gsbench.launch.outcome import Outcome, outcome_of_error
from gsbench.runs.trial_folder import TrialFolder
from tests.finished import write_results

optuna = pytest.importorskip("optuna", reason="needs Optuna (extra search)")

COMMAND = [
    *("-m", "hydra/sweeper=optuna", "hydra.sweeper.trials=12", "name=x", "seed=0,1", "tracking=none", "init=random"),
    "densify.volume_threshold=tag(log, interval(1e-4, 1))",
]
BEST = 0.01


@pytest.fixture(autouse=True)
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs"


class Trials:
    """Stands in for trials; ``fails`` and ``stops`` count calls from 0."""

    def __init__(self) -> None:
        self.trained: list[tuple[float, int]] = []
        self.fails: set[int] = set()
        self.stops: set[int] = set()

    def run_one(self, trial: Any, wait: bool) -> Outcome:
        folder = TrialFolder.of(trial.values).path
        number = len(self.trained)
        threshold, seed = trial.values["densify"]["volume_threshold"], trial.values["seed"]
        self.trained.append((threshold, seed))
        if number in self.stops:
            raise KeyboardInterrupt
        if number in self.fails:
            return outcome_of_error(folder, GsbenchError("no luck"))
        folder.mkdir(parents=True)
        error = abs(threshold - BEST) / max(threshold, BEST)
        metrics = {"psnr": 30 - 10 * error + seed, "flip": error, "mine": error}
        write_results(folder, trial.values, metrics=metrics)
        return Outcome(folder, "done", "psnr", metrics=metrics)


@pytest.fixture
def trials(monkeypatch: pytest.MonkeyPatch) -> Trials:
    stand_in = Trials()
    monkeypatch.setattr(serial, "run_one", stand_in.run_one)

    # What a stand-in leaves has no record of what it was made of; how finished trials are known is tested elsewhere.
    def why_not_done(self: TrialFolder, *rest: Any) -> str:
        return "" if self.sound_record() else "it is not there"

    monkeypatch.setattr(TrialFolder, "why_not_done", why_not_done)
    return stand_in


def results_of(values: dict[str, Any]) -> Path:
    return TrialFolder.of(values).path / "results.json"


def points(runs: Path) -> list[dict[str, Any]]:
    return list(json.loads((runs / "x" / "search.json").read_text())["points"])


@pytest.mark.slow
def test_search_finds_the_best_judges_points_by_their_mean_and_goes_on_after_a_kill(runs: Path, trials: Trials) -> None:
    trials.stops = {7}  # in the fourth point, after its first seed
    assert cli.run(COMMAND) == 130
    assert [point["state"] for point in points(runs)] == ["done"] * 3
    assert cli.run(COMMAND) == 0
    found = points(runs)
    assert [point["state"] for point in found] == ["done"] * 12
    assert len(trials.trained) == 12 * 2 + 1  # the one that was killed, once more, and nothing else
    assert trials.trained[7] == trials.trained[8]
    for point in found:
        value = point["settings"]["densify.volume_threshold"]
        assert point["value"] == pytest.approx(30.5 - 10 * abs(value - BEST) / max(value, BEST))
    best = max(found, key=lambda point: point["value"])
    assert best["value"] > 25
    assert cli.run([word.replace("trials=12", "trials=13") for word in COMMAND]) == 0  # more of the same study
    assert len(trials.trained) == 12 * 2 + 3

    part = search_part(runs / "x")
    assert part is not None
    assert f"(point {best['number'] + 1})" in part.line
    assert len(part.charts) == 2
    assert all(chart.count("<circle") >= 13 for chart in part.charts)


@pytest.mark.slow
def test_what_is_proposed_does_not_depend_on_when_the_search_was_killed(runs: Path, trials: Trials) -> None:
    assert cli.run([*COMMAND, "hydra.sweeper.trials=4", "name=whole"]) == 0
    whole = list(trials.trained)
    trials.trained.clear()
    trials.stops = {2}
    assert cli.run([*COMMAND, "hydra.sweeper.trials=4"]) == 130
    assert cli.run([*COMMAND, "hydra.sweeper.trials=4"]) == 0
    assert [trials.trained[0], trials.trained[1], *trials.trained[3:]] == whole


def test_a_failed_trial_is_told_and_the_search_goes_on(
    runs: Path, trials: Trials, capsys: pytest.CaptureFixture[str]
) -> None:
    trials.fails = {3}
    assert cli.run([*COMMAND, "hydra.sweeper.trials=3", "hydra.sweeper.metric=flip"]) == 1
    found = points(runs)
    assert [point["state"] for point in found] == ["done", "failed", "done"]
    assert found[1]["value"] is None
    lowest = min(point["value"] for point in found if point["value"] is not None)
    part = search_part(runs / "x")
    assert part is not None
    assert f"{lowest:.4f}" in part.line  # of FLIP, less is better
    assert "1 failed" in part.line
    assert "no luck" in capsys.readouterr().err


OFFICIAL = [
    *("-m", "hydra/sweeper=optuna", "name=x", "seed=0,1", "tracking=none", "init=random"),
    *("hydra.sweeper.n_trials=4", "hydra.sweeper.n_jobs=2", "hydra.sweeper.direction=maximize"),
    "densify.volume_threshold=tag(log, interval(1e-4, 1))",
]


def test_settings_have_the_names_of_hydras_plug_in(runs: Path, trials: Trials) -> None:
    assert cli.run(OFFICIAL) == 0
    official = list(trials.trained)
    assert len(official) == 8
    trials.trained.clear()
    ours = [word.replace("n_trials", "trials").replace("n_jobs", "at_once") for word in OFFICIAL]
    assert cli.run([*(word for word in ours if "direction" not in word), "name=y"]) == 0
    assert trials.trained == official


@pytest.mark.parametrize(("direction", "best"), [("minimize", min), ("maximize", max)])
def test_a_metric_of_ones_own_is_made_best_in_the_direction_that_is_given(
    direction: str, best: Any, runs: Path, trials: Trials
) -> None:
    """``mine`` is in the files alone: a stand-in for a class below ``eval.extra``."""
    words = [word for word in OFFICIAL if "direction" not in word]
    assert cli.run([*words, "hydra.sweeper.metric=mine", f"hydra.sweeper.direction={direction}"]) == 0
    found = json.loads((runs / "x" / "search.json").read_text())
    assert found["direction"] == (1 if direction == "maximize" else -1)
    part = search_part(runs / "x")
    assert part is not None
    number = best(found["points"], key=lambda point: point["value"])["number"]
    assert f"(point {number + 1})" in part.line


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["hydra.sweeper.metric=psnrr"], "did you mean psnr?"),
        (["hydra.sweeper.trials=0"], "above 0, got 0"),
        (["hydra.sweeper.trials=many"], "a whole number above 0, got 'many'"),
        (["hydra.sweeper.n_trials=5"], "hydra.sweeper.trials is n_trials by another name, and both are given"),
        (["hydra.sweeper.n_job=2"], "did you mean n_jobs?"),
        (["hydra.sweeper.direction=minimize"], "PSNR is better the other way"),
        (["hydra.sweeper.direction=up"], "'maximize' or 'minimize' or null"),
        (["hydra.sweeper.metric=mine"], "for a metric of your own give hydra.sweeper.direction, too"),
        (["densify.volume_threshold=0.1"], "nothing is searched"),
        (["densify.volume_threshold=tag(log, interval(0, 1))"], "densify.volume_threshold"),
        (["device=cpu,cuda"], "makes no other trial"),
    ],
)
def test_mistakes_are_one_line(words: list[str], part: str, runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run([*COMMAND, *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert part in line
    assert not (runs / "x").exists()


def test_a_dry_run_trains_nothing(runs: Path, trials: Trials, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run([*COMMAND, "--dry-run"]) == 0
    assert "a search of 12 points with 2 seeds each" in capsys.readouterr().out
    assert not trials.trained


def test_a_search_says_which_views_judge_it(runs: Path, trials: Trials, caplog: pytest.LogCaptureFixture) -> None:
    assert cli.run([*COMMAND, "hydra.sweeper.trials=1"]) == 0
    assert any("scene.validation=true" in record.getMessage() for record in caplog.records)
    part = search_part(runs / "x")
    assert part is not None
    assert "Judged by the test views" in part.line
    caplog.clear()
    assert cli.run([*COMMAND, "hydra.sweeper.trials=1", "name=y", "scene.validation=true"]) == 0
    assert not any("scene.validation=true" in record.getMessage() for record in caplog.records)
    part = search_part(runs / "y")
    assert part is not None
    assert "no test view was looked at" in part.line
