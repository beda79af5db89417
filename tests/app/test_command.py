"""From a command line to trials and an exit code, with stand-ins for trials."""

from shlex import split

import pytest
from omegaconf import OmegaConf

from gsbench.app import command, sweep
from gsbench.app.command import one_trial_per_scene, summarize
from gsbench.app.sweep import check_sweep_settings
from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError
from gsbench.launch.jobs import Outcome
from gsbench.launch.record import record
from gsbench.runs.commands import read_history
from gsbench.runs.trial_folder import TrialFolder
from tests.app.stand_ins import trial
from tests.helpers import refusal, table, write


@pytest.mark.parametrize(
    "changes, multirun, said",
    table(__file__, "settings"),
)
def test_settings_of_a_sweep_need_a_sweep(changes, multirun, said):
    runtime = {"choices": {"hydra/launcher": "gsbench"}}
    hydra = {"sweeper": {"params": None, "grids": []}, "mode": None, "runtime": runtime}
    launch = {"stop_when_decided": False, "name": "serial"}
    config = OmegaConf.create({"hydra": hydra, "launch": launch})
    for key, value in changes.items():
        OmegaConf.update(config, key, value, merge=False)
    with refusal(said):
        check_sweep_settings(config, multirun)


# ---- the end of a command

CHANGE = "change what the lines above name, then give the command again"


@pytest.mark.parametrize(
    "ends, code, advice",
    table(__file__, "ends"),
)
def test_the_end_of_a_command_tells_what_to_do_next(tmp_path, logged, capsys, ends, code, advice):
    status = {"d": "done", "q": "queued"}
    trials = [trial(tmp_path, seed) for seed in range(len(ends))]
    outcomes = [
        Outcome(
            one.folder,
            status.get(end, "failed"),
            "why",
            end == "b",
            "densify.x" if end == "r" else "",  # repeats another failure, so it was not started
        )
        for one, end in zip(trials, ends, strict=True)
    ]
    first = Trial(trials[0].values | {"name": "tuning"}, ())
    assert summarize(outcomes, [first, *trials]) == code
    (said,) = [one.getMessage() for one in logged.records if one.name == command.__name__]
    assert said == advice + (str(trials[0].folder) if len(ends) == 1 else "")
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("gsbench: ")]
    assert said == [
        f"gsbench: failed: {TrialFolder(one.folder).label}: why"
        for one in outcomes
        if one.status == "failed" and not one.change
    ] + [
        "gsbench: not started: 1 trial would fail in the same way: change densify.x, then give "
        "the command again"
    ] * ends.count("r")


def test_the_failure_of_a_single_trial_is_raised(tmp_path):
    for bad_input, kind in ((True, InputError), (False, GsbenchError)):
        with pytest.raises(GsbenchError, match="why") as error:
            summarize([Outcome(tmp_path, "failed", "why", bad_input)], [trial(tmp_path)])
        assert type(error.value) is kind


def test_a_comparison_of_versions_has_a_trial_of_each_scene(tmp_path, monkeypatch):
    asked = []
    made = [trial(tmp_path, scene={"name": name}) for name in ("a", "b")]

    def compose_trials(words, multirun):
        asked.append((words, multirun))
        return made

    monkeypatch.setattr(command, "compose_trials", compose_trials)
    assert one_trial_per_scene("gate", ["scene=a,b"], "train_time") == {"a": made[0], "b": made[1]}
    one_trial_per_scene("gate", ["+name=y"], "train_time")
    assert asked == [
        (["scene=a,b", "seed=0", "name=gate"], True),
        (["+name=y", "seed=0"], True),
    ]
    for words, said in (
        (["seed=1"], "seed follows from the other words"),
        (["+eval.primary=psnr"], r"eval\.primary follows from"),
    ):
        with refusal(f"gate: {said}"):
            one_trial_per_scene("gate", words, "psnr")
    with refusal("primary=nosuch"):
        one_trial_per_scene("gate", [], "nosuch")
    made.append(trial(tmp_path, 1, scene={"name": "a"}))
    with refusal("gate is about one arm"):
        one_trial_per_scene("gate", [], "train_time")
    made[:] = [trial(tmp_path)]
    made[0].values["launch"]["wait"] = False
    with refusal("gate waits for its trials"):
        one_trial_per_scene("gate", [], "train_time")


def test_a_dry_run_explains_a_reference_to_nothing(runs):
    with refusal(r"^hydra\.run\.dir: Interpolation key 'nope' not found"):
        command.compose_trials(["hydra.run.dir=${nope}"])


def test_a_dry_run_shows_as_many_log_lines_as_the_run_would(runs, monkeypatch):
    asked = []
    monkeypatch.setattr(sweep, "set_up_logging", asked.append)
    command.compose_trials(["hydra.verbose=true"])
    command.compose_trials(["hydra.verbose=[gsbench.scene]", "seed=0,1"], multirun=True)
    assert asked == [True, ["gsbench.scene"]]


def test_nothing_stays_of_a_command_of_which_all_trials_were_refused(runs, monkeypatch):
    """A trial whose training began in an earlier command stays."""
    good = set()

    def run(trials, asks=True):
        record(trials, asks=False)
        for one in trials:
            write(one.folder / "failed.json", {})
        return [
            Outcome(one.folder, "failed", "no", one.values["seed"] not in good) for one in trials
        ]

    def stay():
        found = {path.parent for path in runs.glob("x/*/*/*/failed.json")}
        assert found == set(read_history(runs / "x").planned)
        return sorted(found)

    monkeypatch.setattr(command, "run_batch", run)
    words = split("-m init=random tracking=none name=x seed=0,1")
    assert command.launch(words) == 2
    assert stay() == []
    good.add(1)
    assert command.launch(words) == 1
    first, _ = stay()
    good.clear()
    write(first / "asked.json", {})
    assert command.launch(words) == 2
    assert stay() == [first]
