"""``gsbench status``, ``retry`` and ``sync``, without a training."""

import json
import os
import time
from pathlib import Path
from shlex import split
from types import SimpleNamespace

import pandas as pd
import pytest

from gsbench.config.compose import compose_one
from gsbench.errors import GsbenchError
from gsbench.launch import states
from gsbench.launch.record import record
from gsbench.launch.states import TrialState
from gsbench.runs.commands import read_history
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.programs import allowed_modules
from gsbench.tracking.sync import MirrorError
from gsbench.verbs import servers, trials
from tests.composed import composed
from tests.helpers import refusal, write
from tests.trials import record_of, write_results

pytestmark = pytest.mark.usefixtures("runs")


def begin(trial):
    """Write the configuration of a trial that has begun; returns its folder."""
    write(trial.folder / "config.yaml", trial.yaml)
    return trial.folder


@pytest.fixture
def folders(runs):
    """Three planned trials: the first is done, the second failed, the third never started."""
    planned = composed(split("name=x densify=adc seed=0,1,2"))
    record(planned, asks=False)
    write_results(begin(planned[0]), planned[0].values)
    write(begin(planned[1]) / "failed.json", {"message": "the loss became nan"})
    return [trial.folder for trial in planned]


# ---- status


def test_verify_finds_a_large_file_that_changed_and_kept_its_time(capsys):
    (trial,) = composed(split("name=x densify=adc seed=0"))
    folder = begin(trial)
    model = write(folder / "point_cloud.ply", b"0" * 2_000_000)
    trial.files.write_finished(trial.values, record_of(trial.values), published=[model])
    assert trials.status(["x", "--verify"], trial.files.runs) == 0
    before = model.stat()
    write(model, b"0" * 1_999_999 + b"1")
    os.utime(model, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert trials.status(["x"], trial.files.runs) == 0
    capsys.readouterr()
    assert trials.status(["x", "--verify"], trial.files.runs) == 1
    assert "point_cloud.ply was changed after results.json was written" in capsys.readouterr().out


def test_status_lists_unfinished_trials(folders, runs, capsys, said, refused):
    assert trials.status(["x"], runs) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:2]] == ["failed", "missing"]
    assert "the loss became nan" in lines[0]
    assert lines[2] == "3 trials: 1 done, 1 missing, 1 failed"
    assert trials.status(["x", "--json"], runs) == 1
    found = json.loads(capsys.readouterr().out)
    assert [Path(trial["folder"]) for trial in found] == folders
    assert [trial["state"] for trial in found] == ["done", "failed", "missing"]
    assert " ".join(said("status").split()) == "x 3 trials: 1 done, 1 missing, 1 failed"
    assert said("status x --forget") == "1 trial removed from the plan\n"
    assert trials.status(["x"], runs) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "2 trials: 1 done, 1 failed"
    assert "no experiment 'y'" in refused("status y")


def test_status_of_an_empty_runs_folder_says_so(runs, said):
    assert said("status") == f"no experiment in {runs} yet\n"


def test_finished_trials_are_listed_with_all_or_with_a_note():
    def state(name, kind, note=""):
        return TrialState(Path("runs/x/courtyard/sfm-adc", f"{name}-seed0"), kind, None, note)

    listed = [state("a", "done"), state("b", "done", "in doubt"), state("c", "missing")]
    first, second, summary = trials.lines_of(listed, with_done=False)
    assert first.startswith("missing  courtyard/sfm-adc seed 0 (c)")
    assert second.startswith("done     courtyard/sfm-adc seed 0 (b)")
    assert second.endswith("in doubt")
    assert summary == "3 trials: 2 done, 1 missing"
    assert len(trials.lines_of(listed, with_done=True)) == 4


@pytest.mark.parametrize(
    "state, words", [("running", "for 2 min"), ("queued", "for 2 min"), ("failed", "2 min ago")]
)
def test_a_lasting_state_has_a_duration_and_a_final_one_an_age(state, words):
    assert trials._age(TrialState(Path("x"), state, time.time() - 120, "")) == words


def test_a_state_without_a_time_has_no_age_and_one_in_the_future_is_new():
    assert trials._age(TrialState(Path("x"), "running", None, "")) == ""
    assert trials._age(TrialState(Path("x"), "done", time.time() + 500, "")) == "0 s ago"


def test_superseded_trials_are_shown_and_deleted_on_demand(folders, monkeypatch, said):
    done = folders[0]
    older = SimpleNamespace(older=[SimpleNamespace(path=done)])
    monkeypatch.setattr(states, "newest_code", lambda experiment: older)
    assert said("status").endswith(" 3 trials: 1 superseded, 1 missing, 1 failed\n")
    lines = said("status x --forget-superseded").splitlines()
    assert lines == [f"removed {done}: made by earlier code", "1 superseded trial removed"]
    assert not done.exists()
    assert [*read_history(done.parents[2]).planned] == folders[1:]


def test_watching_looks_again_until_all_trials_have_ended(runs, monkeypatch, capsys):
    looks = []
    for state in ("running", "waiting", "done"):
        columns = {key: [0] for key in ("done", "running", "failed", "waiting")}
        looks.append(pd.DataFrame(columns | {state: [1234]}, index=["adc[lr=1]"]))
    waited = []
    monkeypatch.setattr(trials, "progress_frame", lambda *_: looks.pop(0))
    monkeypatch.setattr(time, "sleep", waited.append)
    trials._watch(runs, "x")
    assert waited == [trials.SECONDS_BETWEEN_LOOKS] * 2
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "adc[lr=1] 1234 0 0 0" in said


def test_ctrl_c_ends_only_the_watching(folders, runs, monkeypatch):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(time, "sleep", interrupted)
    trials._watch(runs, "x")


# ---- retry


def test_retry_runs_the_unfinished_with_their_own_settings(folders, runs, ran, said):
    assert "2 trials: 1 missing, 1 failed" in said("retry x --dry-run")
    assert ran == []
    said("retry x launch=local launch.parallel=3")
    assert [one.folder for one in ran] == folders[1:]
    assert {one.values["launch"]["parallel"] for one in ran} == {3}


def test_retry_with_everything_done_runs_nothing(folders, ran, said):
    for folder in folders[1:]:
        write_results(folder, composed(["name=x", "densify=adc"])[0].values)
    line = "nothing to retry: all trials of x are done, running or queued\n"
    assert (said("retry x"), ran) == (line, [])


def test_retry_refuses_a_setting_that_makes_other_trials(folders, ran, refused):
    line = refused("retry x launch.parallel=2 densify.stop=5")
    assert "densify.stop=5 would make other trials than those of the plan" in line
    assert ran == []


def test_planned_settings_of_a_launcher_go_with_it_unless_it_stays(runs, ran, said):
    words = split("name=x densify=adc launch=local launch.parallel=2")
    record(composed(words), asks=False)
    said("retry x launch=local")
    said("retry x launch=serial")
    assert [(one.values["launch"]["name"], one.values["launch"]["parallel"]) for one in ran] == [
        ("local", 2),
        ("serial", 1),
    ]


def test_a_trial_whose_configuration_has_changed_takes_the_place_of_the_old_one(
    folders, monkeypatch, ran, said, caplog
):
    def changed(folder, *_):
        seed = f"seed={folder.name[-1]}"
        return composed(["name=x", "densify=adc", seed, "train.sh_interval=2"])[0]

    monkeypatch.setattr(trials, "recompose", changed)
    said("retry x")
    assert {one.values["train"]["sh_interval"] for one in ran} == {2}
    assert caplog.text.count("its configuration has changed since; the new one is run") == 2
    assert [*read_history(folders[0].parents[2]).planned] == folders[:1]


def test_retry_of_a_trial_without_a_plan_uses_its_configuration(folders, runs):
    (runs / "x/commands.jsonl").unlink()
    again = trials.recompose(folders[1], None, runs, [], str(runs.parent))
    assert TrialFolder.of(again.values).path == folders[1]
    assert again.values == compose_one(split("name=x densify=adc seed=1")).values
    own = trials.recompose(folders[1], None, runs, ["allow_targets=[mine.Arm]"], "theirs")
    assert own.values["allow_targets"] == ["mine.Arm"]
    assert allowed_modules()["mine"] == "theirs"
    with refusal("is in no plan, so no setting of it can be changed"):
        trials.recompose(folders[1], None, runs, ["launch=local"], "theirs")


def test_a_setting_of_an_earlier_version_is_refused(folders, runs):
    values = compose_one(split("name=x densify=adc seed=1")).values
    values["scene"]["downscale"] = 4
    write(folders[1] / "config.yaml", values)
    with refusal("scene.downscale is not a setting"):
        trials.recompose(folders[1], None, runs, [], str(runs.parent))


def test_a_trial_from_renders_is_entered_by_its_own_command(folders, runs):
    values = compose_one(split("name=x densify=adc seed=1")).values
    values["densify"]["evaluated_from"] = "renders"
    write(folders[1] / "config.yaml", values)
    with refusal("give the command of `gsbench evaluate` again"):
        trials.recompose(folders[1], None, runs, [], str(runs.parent))


def test_a_second_retry_without_a_plan_runs_the_same_trial(folders, runs, monkeypatch):
    (runs / "x/commands.jsonl").unlink()
    ran = []

    def killed(given):
        record(given, asks=False)
        ran.extend(trial.folder for trial in given)
        return 1

    monkeypatch.setattr("gsbench.app.command.run_trials", killed)
    assert [trials.retry(["x"], runs), trials.retry(["x"], runs)] == [1, 1]
    assert ran == [folders[1], folders[1]]


# ---- sync


def test_sync_sends_the_begun_trials_of_one_or_all_experiments(folders, runs, monkeypatch, said):
    begin(composed(["name=y", "densify=adc"])[0])
    sent = []

    def send(given, uri, allowed):
        sent.extend((one.path.parents[2].name, uri) for one in given)
        return [f"sent {len(given)}"]

    monkeypatch.setattr(servers, "send_missing", send)
    assert said("sync x --uri http://here") == "sent 2\n"
    assert sent == [("x", "http://here")] * 2
    assert said("sync") == "sent 3\n"
    assert sent[2:] == [("x", None), ("x", None), ("y", None)]


@pytest.mark.parametrize("error", [MirrorError("no answer"), ConnectionError("no answer")])
def test_a_failed_sync_says_that_nothing_is_lost(folders, runs, monkeypatch, error):
    def send(*_):
        raise error

    monkeypatch.setattr(servers, "send_missing", send)
    with pytest.raises(GsbenchError, match="no answer; the files are complete: try again"):
        servers.sync(["x"], runs)
