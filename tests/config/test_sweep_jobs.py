"""A job of a sweep has the configuration of its own words, whatever it shares with other jobs."""

import pickle

import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl

from gsbench.app.command import compose_trials
from gsbench.config.compose import _plain_values, compose_one
from gsbench.errors import InputError
from gsbench.launch.jobs import job_of

ARMS = "densify=adc,volumetric"
SWEEPS = {  # words, and how often Hydra composes for them
    "seeds": ([ARMS, "seed=0,1,2"], 2),
    "values": (
        [ARMS, "densify.max_gaussians=1000,2000", "train.iterations=100,1e3", "seed=0,1"],
        2,
    ),
    "texts": (["scene=colmap", "scene.path=/a,/b,'/c d'", "seed=3,4"], 1),
    "values for a name alike": (["scene.views=10,20", "scene.width=40,80"], 1),
    "a value made of the seed": (["scene=colmap", "scene.path='/x/${seed}'", "seed=0,1,2"], 1),
    "a value made of another": (
        ["scene.width='${scene.height}','1${scene.height}'", "scene.height=30,40"],
        2,
    ),
    "a name that is made": (
        ["scene=colmap", "scene.path='/${${name}}'", "name=seed,device", "seed=1,2"],
        2,
    ),
    "added": ([ARMS, "+densify.growth_cap=3,4", "seed=0,1"], 4),
    "null": (["densify.max_gaussians=null,5", "seed=0,1"], 2),
    "lists": (["eval.at=[],[3]", "train.iterations=10,20"], 2),
    "a choice after its values": (["densify.max_gaussians=7,8", ARMS], 2),
    "quotes": (['name="1"', "train.iterations=8,'9'", "seed=0,1"], 1),
}


@pytest.fixture
def compositions(monkeypatch):
    """The words of each of Hydra's compositions of a job."""
    asked = []
    compose = ConfigLoaderImpl.load_sweep_config

    def counted(self, master_config, sweep_overrides):
        asked.append(sweep_overrides)
        return compose(self, master_config, sweep_overrides)

    monkeypatch.setattr(ConfigLoaderImpl, "load_sweep_config", counted)
    return asked


@pytest.mark.parametrize("name", list(SWEEPS))
@pytest.mark.slow
def test_every_job_has_the_configuration_of_its_words(name, compositions):
    words, count = SWEEPS[name]
    trials = compose_trials(words, multirun=True)
    assert len(compositions) == count
    assert len({repr(trial.values) for trial in trials}) == len(trials) > 1
    for trial in trials:
        alone = compose_one(trial.overrides)
        assert (trial.values, trial.yaml) == (alone.values, alone.yaml)


@pytest.mark.parametrize(
    "words", [["seed=0,-1"], ["train.iterations=5,-5"], ["seed=0,1", "scene.views=9,no"]]
)
def test_a_bad_value_is_refused_in_a_shared_composition(words):
    with pytest.raises(InputError, match=f"{words[-1].partition('=')[0]} must be"):
        compose_trials(words, multirun=True)


@pytest.mark.parametrize(
    "words, values",
    [
        (["a.b=1", "seed=2", "c=3", "d.e='4'"], {"a.b": 1, "seed": 2, "d.e": "4"}),
        (["a.b={c:1}", "d.e=2"], {}),  # a mapping, whose order matters
        (["+a.b.c=1", "a.b=2"], {}),
        (["a.b=1", "~a.b"], {}),
        (
            [
                "a._target_=x.Y",
                "hydra.job.name=x",
                "a.b=${c}",
                "a.c=[1]",
                "a.d=null",
                "+a.e=1",
                "a/f=g",
            ],
            {},
        ),
    ],
)
def test_plain_values_are_those_that_may_be_set_after_composition(words, values):
    assert _plain_values(words) == values


def test_a_pickled_job_is_small():
    trials = compose_trials(["densify=adc,volumetric", "seed=0,1"], multirun=True)
    assert all(len(pickle.dumps(job_of(trial))) < 20_000 for trial in trials)
