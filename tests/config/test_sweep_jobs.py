"""A job of a sweep has the configuration of its own words, whatever it shares with other jobs."""

import pickle
import re
from shlex import split

import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from omegaconf import OmegaConf

from gsbench.app.command import compose_trials
from gsbench.config import compose
from gsbench.config.compose import compose_one
from gsbench.config.explain import explained
from gsbench.config.overrides import parse_word
from gsbench.launch.jobs import TrialJob
from tests.helpers import refusal

ARMS = "densify=adc,volumetric"
SWEEPS = {  # words, and how often Hydra composes for them
    "seeds": ([ARMS, "seed=0,1,2"], 3),
    "values": (
        [ARMS, "densify.max_gaussians=1000,2000", "train.iterations=100,1e3", "seed=0,1"],
        3,
    ),
    "texts": (["scene=colmap", "scene.path=/a,/b,'/c d'", "seed=3,4"], 1),
    "values for a name alike": (["scene.views=10,20", "scene.width=40,80"], 1),
    "a value made of the seed": (["scene=colmap", "scene.path='/x/${seed}'", "seed=0,1,2"], 1),
    "a value made of another": (
        ["scene.width='${scene.height}','1${scene.height}'", "scene.height=30,40"],
        1,
    ),
    "a name that is made": (
        ["scene=colmap", "scene.path='/${${name}}'", "name=seed,device", "seed=1,2"],
        1,
    ),
    "added": ([ARMS, "+densify.growth_cap=3,4", "seed=0,1"], 3),
    "null": (["densify.max_gaussians=null,5", "seed=0,1"], 1),
    "lists": (["eval.at=[],[3]", "train.iterations=10,20"], 1),
    "a choice after its values": (["densify.max_gaussians=7,8", ARMS], 3),
    "quotes": (['name="1"', "train.iterations=8,'9'", "seed=0,1"], 1),
}


@pytest.fixture
def compositions(monkeypatch):
    """The words of each of Hydra's compositions."""
    asked = []
    real = ConfigLoaderImpl.load_configuration

    def counted(self, config_name, overrides, **settings):
        asked.append(overrides)
        return real(self, config_name, overrides, **settings)

    monkeypatch.setattr(ConfigLoaderImpl, "load_configuration", counted)
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
    "words", ["seed=0,-1", "train.iterations=5,-5", "seed=0,1 scene.views=9,no"]
)
def test_a_bad_value_is_refused_in_a_shared_composition(words):
    with refusal(f"{split(words)[-1].partition('=')[0]} must be"):
        compose_trials(split(words), multirun=True)


@pytest.mark.parametrize(
    "words, others, seed",
    [
        ("a.b=1 seed=2", ("a.b=1",), 2),
        ("a.b=1", ("a.b=1",), None),
        ("seed=1 ++seed=2", ("seed=1", "++seed=2"), None),  # the later one counts
        ("++seed=2", ("++seed=2",), None),
        ("'seed='\"'\"'${x}'\"'\"''", ("seed='${x}'",), None),
        ("'seed='\"'\"'1'\"'\"''", ("seed='1'",), None),
    ],
)
def test_only_a_plain_seed_is_set_apart(words, others, seed):
    assert compose._without_seed(split(words)) == (others, seed)


@pytest.mark.parametrize(
    "word, found",
    [
        ("a.b=2", {"a": {"b": 2, "c": [1]}}),
        ("+a.d=2", {"a": {"b": 1, "c": [1], "d": 2}}),
        ("++a.b=2", {"a": {"b": 2, "c": [1]}}),
        ("++a.d={e: 2}", {"a": {"b": 1, "c": [1], "d": {"e": 2}}}),
        ("+a.c=[2]", {"a": {"b": 1, "c": [2]}}),
        ("a.c.0=2", {"a": {"b": 1, "c": [2]}}),
        ("a={b: 2}", {"a": {"b": 2, "c": [1]}}),
        ("~a.b", {"a": {"c": [1]}}),
        ("~a.b=1", {"a": {"c": [1]}}),
        ("~a.b=2", "there is no a.b=2"),
        ("~a.d", "there is no a.d"),
        ("+a.b=2", "a.b has a value already: leave out the plus"),
        ("a.d=2", "a.d is not a setting"),
        ("a={d: 2}", "a.d is not a setting"),
        ("e=2", "e is not a setting"),
    ],
)
def test_a_value_is_set_added_or_removed_as_by_hydra(word, found):
    config, hydras = (OmegaConf.create({"a": {"b": 1, "c": [1]}}) for _ in range(2))
    OmegaConf.set_struct(config, True)
    OmegaConf.set_struct(hydras, True)
    if isinstance(found, dict):
        compose.set_value(config, parse_word(word))
        assert OmegaConf.to_container(config) == found
        ConfigLoaderImpl._apply_overrides_to_config([parse_word(word)], hydras)
        assert hydras == config
    else:
        with refusal(re.escape(found)), explained([word]):
            compose.set_value(config, parse_word(word))


def test_a_pickled_job_is_small():
    trials = compose_trials(["densify=adc,volumetric", "seed=0,1"], multirun=True)
    assert all(len(pickle.dumps(TrialJob(trial))) < 20_000 for trial in trials)
