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
from tests.helpers import refusal, table

ARMS = "densify=adc,volumetric"
SWEEPS = table(__file__, "sweeps")


@pytest.fixture
def compositions(monkeypatch):
    """The words of each of Hydra's compositions."""
    asked = []
    real = ConfigLoaderImpl.load_configuration

    def counted(self, config_name, overrides, **settings):
        asked.append(overrides)
        return real(self, config_name, overrides, **settings)

    monkeypatch.setattr(ConfigLoaderImpl, "load_configuration", counted)
    compose.composed_once.cache_clear()  # as in a new process
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
    table(__file__, "seeds"),
)
def test_only_a_plain_seed_is_set_apart(words, others, seed):
    assert compose._without_seed(split(words)) == (tuple(others), seed)


@pytest.mark.parametrize(
    "word, found",
    table(__file__, "values"),
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
