"""A sweep in planned looks: which trials each look launches, when it stops, how it continues."""

import logging
from shlex import split

import numpy as np
import pytest

from gsbench import cli
from gsbench.analysis.results import read_experiment
from gsbench.analysis.verdicts import judge
from gsbench.runs.commands import read_history
from tests.app.stand_ins import Trainings
from tests.launch.test_record import TINY

BASE = [
    "-m",
    *(word for word in TINY if word != "densify=none"),
    "name=stop",
    "launch.stop_when_decided=true",
]
SWEEP = [*BASE, "densify=adc,volumetric", "seed=0,1,2,3", "eval.primary=psnr"]


def Fake(psnr, fails=None, stops_at=None):  # noqa: N802 - a kind of trainings
    """Trainings with the ``psnr`` of arm and seed; one seed ``fails``, at another comes a Ctrl-C."""
    return Trainings(
        lambda values: psnr(values["densify"]["name"], values["seed"]),
        lambda number, trial: trial.values["seed"] == stops_at,
        lambda number, trial: trial.values["seed"] == fails,
    )


@pytest.fixture
def sweep(runs, monkeypatch):
    def run(fake, *words):
        monkeypatch.setattr("gsbench.app.command.run_batch", fake)
        return cli.run([*SWEEP, *words])

    return run


def noise(arm, seed):
    return float(np.random.default_rng([seed, arm == "adc"]).normal(26, 2))


def clear(arm, seed):
    """Volumetric gains much, other arms nothing; seeds hardly differ."""
    return 26 + 2 * (arm == "volumetric") + 1e-3 * np.sin(seed + len(arm))


def test_a_clear_difference_ends_at_the_first_look_and_the_command_again_runs_nothing(
    sweep, runs, caplog
):
    fake = Fake(clear)
    assert sweep(fake) == 0
    assert fake.batches == [[("adc", 0), ("volumetric", 0), ("adc", 1), ("volumetric", 1)]]
    (verdict,) = verdicts_of(runs)
    assert (verdict.outcome, verdict.pairs.seeds) == ("supported", 2)
    caplog.set_level("INFO")
    assert sweep(again := Fake(clear)) == 0
    assert not again.batches
    assert "4 of 8 trials were not needed" in caplog.text


def verdicts_of(runs):
    """The verdicts on the questions of the sweep."""
    experiment = read_experiment(runs / "stop")
    return [judge(experiment.trials, one) for one in experiment.history.questions]


def test_noise_gets_all_seeds_and_each_trial_is_launched_once(sweep, runs):
    fake = Fake(noise)
    assert sweep(fake) == 0
    assert [len(batch) for batch in fake.batches] == [4, 2, 2]
    assert len({trial for batch in fake.batches for trial in batch}) == 8
    (verdict,) = verdicts_of(runs)
    assert verdict.outcome == "undecided"


def test_a_decided_idea_gets_no_more_seeds(sweep, runs, caplog):
    fake = Fake(lambda arm, seed: clear(arm, seed) if arm != "mcmc" else noise(arm, seed))
    with caplog.at_level(logging.INFO):
        assert sweep(fake, "densify=adc,volumetric,mcmc") == 0
    assert [len(batch) for batch in fake.batches] == [6, 2, 2]
    assert {arm for arm, _ in fake.batches[1]} == {"adc", "mcmc"}
    assert "2 of 12 trials were not needed" in caplog.text


def test_a_stopped_sweep_continues_with_the_same_plan(sweep, runs):
    assert sweep(Fake(noise, stops_at=2)) == cli.INTERRUPTED
    (plan,) = read_history(runs / "stop").questions
    fake = Fake(noise)
    assert sweep(fake) == 0
    # finished trials are handed over, and skipped there
    assert [len(batch) for batch in fake.batches] == [4, 2, 2]
    assert read_history(runs / "stop").questions == (plan,)


def test_a_failed_seed_ends_the_looks_and_repeating_it_decides(sweep, runs):
    assert sweep(Fake(clear, fails=1)) == 1
    (verdict,) = verdicts_of(runs)
    assert not verdict.final
    assert sweep(Fake(clear)) == 0
    (verdict,) = verdicts_of(runs)
    assert verdict.outcome == "supported"


@pytest.mark.slow
def test_another_hydra_launcher_gets_one_look_at_a_time(sweep):
    fake = Fake(noise)
    assert sweep(fake, "hydra/launcher=basic", "launch=serial") == 0
    assert len(fake.batches) == 8  # a call for each trial
    assert [seed for ((_, seed),) in fake.batches] == [0, 0, 1, 1, 2, 2, 3, 3]


def test_settings_make_arms(sweep, runs):
    """Arms that differ in one setting only have names of their own, as in the report."""
    words = ["densify.max_gaussians=1000,2000", "launch.least_difference=0.5"]
    assert sweep(Fake(clear), *words) == 0
    asked = [verdict.question for verdict in verdicts_of(runs)]
    assert [(str(one.baseline), str(one.idea), one.least) for one in asked] == [
        (f"random-adc[max_gaussians={count}]", f"random-volumetric[max_gaussians={count}]", 0.5)
        for count in (1000, 2000)
    ]


@pytest.mark.parametrize(
    "words, message",
    [
        ("seed=3", "at least 2 seeds"),
        ("launch=slurm launch.wait=false", "launch.wait must be true"),
        ("launch.least_difference=0", "launch.least_difference"),
        ("launch.stop_when_decided=maybe", "launch.stop_when_decided"),
    ],
)
def test_a_sweep_that_cannot_stop_early_is_refused_before_any_trial(
    sweep, runs, words, message, capsys
):
    fake = Fake(clear)
    assert sweep(fake, *split(words)) == 2
    (line,) = [
        line for line in capsys.readouterr().err.splitlines() if line.startswith("gsbench: ")
    ]
    assert message in line
    assert not fake.batches
    assert not runs.exists()


def test_stop_when_decided_is_refused_for_a_single_trial(runs, refused):
    assert "adds seeds to a sweep" in refused(*TINY, "launch.stop_when_decided=true")


def test_a_dry_run_says_when_it_looks_and_writes_nothing(runs, said):
    assert "looks at 2, 3, 4 seeds" in said(*SWEEP, "--dry-run")
    assert not runs.exists()
