"""Other sweepers than gsbench's own, with stand-ins for compositions."""

import logging
from shlex import split
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from gsbench.app import command, plugins
from gsbench.app.plugins import Objective, best_line, prepare_other_sweeper, words_without_sweeper
from gsbench.errors import InputError
from tests.app.stand_ins import trial
from tests.helpers import refusal


def sweep_of(words, name="optuna", **sweeper):
    """A sweep by another sweeper, whose composer notes what it composes."""
    values = {"eval": {"primary": "lpips_vgg", "extra": {}}}
    composed = []
    composer = SimpleNamespace(
        composed=composed,
        settings=composed.append,
        trial=lambda words: SimpleNamespace(values=values),
    )
    config = OmegaConf.create({"name": "x", "hydra": {"sweeper": sweeper}})
    return SimpleNamespace(words=words, other_sweeper=name, composer=composer, config=config)


@pytest.mark.parametrize(
    "sweeper, sign",
    [
        ({"direction": "maximize"}, 1),
        ({"direction": "MAXIMIZE"}, 1),
        ({"direction": "minimize"}, -1),
        ({}, -1),
        ({"optim": {"maximize": True}}, 1),
        ({"optim": {"maximize": False}}, -1),
        ({"ax_config": {"experiment": {"minimize": False}}}, 1),
        ({"ax_config": {"experiment": {"minimize": True}}}, -1),
    ],
)
def test_another_sweeper_gets_all_seeds_of_a_job(caplog, sweeper, sign):
    caplog.set_level(logging.INFO, "gsbench")
    words = split("name=x densify=adc,mcmc densify.start=1,2 seed=3,5 hydra.x=1")
    sweep = sweep_of(words, **sweeper, params={"seed": "1,2", "init": "sfm,dim"})
    assert prepare_other_sweeper(sweep) == (
        [*words[:3], "hydra.x=1", "~hydra.sweeper.params.seed"],
        Objective(sign, ("seed=3", "seed=5")),
    )
    # each combination of choices is composed, and may then run code
    assert sweep.composer.composed == [
        ["name=x", init, densify]
        for init in ("init=sfm", "init=dim")
        for densify in ("densify=adc", "densify=mcmc")
    ]
    said = f"gets {'-' if sign > 0 else ''}lpips_vgg of test views, "
    assert said + ("maximized" if sign > 0 else "minimized") in caplog.text
    words, objective = prepare_other_sweeper(
        sweep_of(["seed=9"], **sweeper, params={"seed": "1,2"})
    )
    assert (words[0], objective) == ("seed=9", Objective(sign, ("seed=1", "seed=2")))
    assert prepare_other_sweeper(sweep_of(["a=1"])) == (["a=1"], Objective(-1))


@pytest.mark.parametrize(
    "primary, sign, decay, best",
    [("psnr", 1, "0.3", "22"), ("psnr", -1, "0.3", "22"), ("lpips_vgg", -1, "0.1", "20")],
)
def test_the_best_values_are_said_with_the_command_that_repeats_them(
    tmp_path, primary, sign, decay, best
):
    def record_of(files):
        number = {"0.1": 20.0, "0.2": None, "0.3": 22.0}[files.decay]
        return None if number is None else SimpleNamespace(metrics={primary: number})

    trials = []
    for value in ("0.1", "0.2", "0.3"):
        for seed in (0, 1):
            words = ["hydra/sweeper=optuna", "name=x y", "densify=m", f"densify.decay={value}"]
            one = trial(tmp_path, seed, [*words, f"seed={seed}"], eval={"primary": primary})
            one.files.decay = value
            one.files.sound_record = lambda files=one.files: record_of(files)
            trials.append(one)
    assert best_line(trials, Objective(sign, ("seed=0", "seed=1"))) == (
        f"best: densify.decay={decay}, {primary} {best} of test views (2 seeds); again: "
        f"gsbench -m 'name=x y' densify=m densify.decay={decay} seed=0,1"
    )
    assert best_line(trials[2:4], Objective(sign)) == ""


def test_hydras_grid_sweeper_asks_for_no_value_and_choices_are_limited(monkeypatch):
    monkeypatch.setattr(plugins, "MAX_CHOICES", 4)
    for words in (["densify=a,b", "seed=1,2"], ["densify=a,b", "init=a,b"]):
        assert prepare_other_sweeper(sweep_of(words, "basic")) == (words, Objective(-1))
    with refusal("more than 4 combinations of choices"):
        prepare_other_sweeper(sweep_of(["densify=a,b", "init=a,b,c"], "basic"))


def test_a_dry_run_of_another_sweeper_lists_a_grid_or_says_that_it_searches(capsys):
    words = split("hydra/sweeper=x hydra.sweeper.n=3 seed=1,2 densify=adc")
    assert words_without_sweeper(sweep_of(words, "basic")) == (
        ["seed=1,2", "densify=adc", "hydra/sweeper=gsbench"],
        True,
    )
    for sweeper, said in (({}, "proposes trials from"), ({"n_trials": 9}, "proposes 9 trials (")):
        found = words_without_sweeper(sweep_of(words, **sweeper))
        assert found == (["densify=adc", "hydra/sweeper=gsbench"], False)
        assert said in capsys.readouterr().out


@pytest.mark.parametrize(
    "error, said",
    [
        (
            RuntimeError("study is\ngone"),
            r"^hydra/sweeper=basic raised RuntimeError: study is gone$",
        ),
        (InputError("the trial's own line"), "^the trial's own line$"),
    ],
)
def test_what_another_sweeper_raises_is_named_as_its_own(monkeypatch, error, said):
    def run_main(*_):
        raise error

    monkeypatch.setattr(plugins, "run_main", run_main)
    with refusal(said):
        command.launch(["-m", "hydra/sweeper=basic", "densify=adc,mcmc"])
