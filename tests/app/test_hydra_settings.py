"""Hydra's own settings: which ones take effect, and what errors advise."""

from shlex import split

import pytest

from gsbench import cli
from gsbench.app.command import compose_trials
from tests.helpers import table, write

pytestmark = pytest.mark.usefixtures("runs")


SWEEP = split("densify=adc,none seed=0,1 init=random tracking=none")


def test_a_sweep_may_set_what_all_its_choices_have_and_the_default_lacks():
    trials = compose_trials(["densify=absgs,fastgs", "densify.split_threshold=0.5"], multirun=True)
    assert [trial.values["densify"]["split_threshold"] for trial in trials] == [0.5, 0.5]


def test_now_is_the_same_in_all_trials_of_a_sweep():
    """Microseconds never agree by chance; each densifier is composed by itself."""
    words = [*SWEEP, "name=x-${now:%H%M%S%f}", "scene.name=y-${now:%f}"]
    trials = compose_trials(words, multirun=True)
    assert len({(one.values["name"], one.values["scene"]["name"]) for one in trials}) == 1


@pytest.mark.parametrize(
    "words, text",
    table(__file__, "impossible"),
)
def test_impossible_settings_are_refused_in_one_line(words, text, refused):
    if "hydra/launcher=joblib" in words:
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    line = refused(*split(words), "--dry-run")
    assert text in line


@pytest.mark.parametrize(
    "words",
    [
        "hydra.run.dir=elsewhere hydra.output_subdir=x",
        "-m hydra.sweep.dir=elsewhere hydra.sweep.subdir=${hydra:job.num} seed=0,1",
        "hydra.verbose=[gsbench] hydra.job.chdir=true",
        "hydra/job_logging=default hydra.job_logging.root.level=DEBUG",
        "-m hydra/sweeper=basic seed=0,1",
        "-m hydra/sweeper=basic hydra/launcher=basic seed=0,1",
    ],
)
def test_hydras_own_settings_are_accepted_and_a_dry_run_writes_nothing(words, runs, said):
    assert f"{1 + ('-m' in words)} trial" in said(*split(words), "--dry-run")
    assert list(runs.parent.iterdir()) == []


def test_settings_can_read_hydras_node():
    """Each job gets its own number, although trials that differ in the seed share a composition."""

    def names(*words):
        trials = compose_trials(["init=random", *words], multirun=True)
        return [trial.values["name"] for trial in trials]

    choice = "name=x-${hydra:runtime.choices.densify}"
    jobs = names(f"{choice}-${{hydra:job.num}}", "densify=adc,none", "seed=0,1")
    assert jobs == split("x-adc-0 x-adc-1 x-none-2 x-none-3")
    assert names(choice) == ["x-volumetric"]
    without_name = "+hydra.job.config.override_dirname.exclude_keys=[name]"
    found = names(without_name, "seed=0,1", "name='${hydra:job.override_dirname}'")
    assert found == ["init=random,seed=0", "init=random,seed=1"]


@pytest.mark.parametrize("value", ["x-${seed}", "x-${oc.select:seed,5}", "x-${${scene.name}}"])
def test_settings_can_read_the_seed(value):
    words = ["init=random", "scene.name=seed", f"name='{value}'", "seed=3,4"]
    trials = compose_trials(words, multirun=True)
    assert [trial.values["name"] for trial in trials] == ["x-3", "x-4"]


def test_a_dry_run_calls_an_interval_a_search_and_not_a_trial(said):
    out = said("-m", "densify.volume_threshold=interval(.01,1)", "--dry-run")
    assert "search" in out
    assert "20 points" in out
    assert "1 trial" not in out


def test_a_glob_in_the_quotes_that_the_error_advises_works(said):
    assert "sfm-adc" in said("-m", 'densify=glob("[av]*")', "--dry-run")


@pytest.mark.parametrize("words", ["--config-dir own --help", "-h --config-dir=own", "-m --help"])
def test_help_is_printed_wherever_its_option_stands(words, tmp_path, said):
    write(tmp_path / "own/densify/patient.yaml", "defaults: [adc]\n")
    out = said(*split(words))
    assert "Verbs" in out
    # a folder's own choices are listed
    assert ("patient" in out) == ("own" in words)
    assert cli.run(split("--config-dir nowhere --help")) == 2
