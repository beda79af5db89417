"""Settings that name the user's loss, terms, schedule and optimiser: keys, and what is refused."""

import re

import pytest

from gsbench.config.compose import Composer, compose_one
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.trial import TrialSteps
from gsbench.runs.store import Store
from tests.helpers import refusal

SMALL = ["scene=courtyard", "scene.width=32", "scene.height=32", "init=random"]
ALLOWED = "allow_targets=[termmodule]"
CODE = """
from dataclasses import dataclass

@dataclass
class Faint:
    power: float = 1.0

    def __call__(self, step):
        return step.gaussians.opacity_logits.mean() ** self.power

class Nothing:
    pass
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "termmodule.py").write_text(CODE)
    monkeypatch.chdir(tmp_path)


def train_key(tmp_path, *words):
    trial = compose_one([*SMALL, ALLOWED, *words])
    store, found = Store(tmp_path / "store"), {}
    for step in TrialSteps(Parts(trial.values), store).steps():
        found[step.stage.name] = step.key
        if step.stage.name == "scene":
            store.get(step)
    return found["train"]


def term(**options):
    inner = ", ".join(f"{key}: {value}" for key, value in options.items())
    return f"train.terms=[{{_target_: termmodule.Faint, {inner}}}]"


def test_terms_are_ingredients_of_the_training(tmp_path, module):
    words = [(), ("train.terms=[]",), (term(weight=0.1),), (term(weight=0.2),)]
    words += [(term(weight=0.1, power=2.0),), ("train.loss._target_=termmodule.Faint",)]
    keys = [train_key(tmp_path, *one) for one in words]
    assert keys[0] == keys[1]
    assert len(set(keys[1:])) == 5


def test_composed_values_name_a_part_only_if_there_is_one(module):
    assert "terms" not in compose_one(SMALL).values["train"]
    assert compose_one([*SMALL, ALLOWED, term(weight=1)]).values["train"]["terms"]


@pytest.mark.parametrize(
    "word,error",
    [
        ("train.terms=[{weight: 1}]", "train.terms.0 names no _target_"),
        (term(weigth=1), "train.terms.0.weigth is not a setting; did you mean weight?"),
        (term(weight="much"), "train.terms.0.weight must be a number, got 'much'"),
        (term(weight=1, powre=2), "did you mean power"),
        (term(weight=1, power="x"), "train.terms.0.power must be"),
        ("train.loss._target_=termmodule.Nothing", "is not a class for train.loss"),
        ("train.optimizer._target_=termmodule.Faint", "it has no init, step()"),
        ("train.schedule={length: 3}", "train.schedule names no _target_"),
    ],
)
def test_a_wrong_part_is_refused_by_its_place(module, word, error):
    with refusal(re.escape(error)):
        Parts(compose_one([*SMALL, ALLOWED, word]).values).check(on_this_machine=False)


def test_a_class_that_is_not_allowed_is_refused_before_it_is_imported(module):
    with refusal("allow_targets"):
        compose_one([*SMALL, term(weight=1)])


def test_another_program_has_its_own_loss():
    words = [*SMALL, "densify=external/brush", "densify.version=1"]
    words += ["train.loss._target_=termmodule.Faint", "allow_targets=[termmodule,brush]"]
    with refusal("train.loss: another program has its own loss"):
        compose_one(words)


def test_all_arms_of_a_command_train_by_autograd_if_one_does(module):
    words = [*SMALL, ALLOWED]
    plain, own = [*words, "seed=0"], [*words, "seed=0", term(weight=1)]
    composer = Composer(words)

    def by_autograd(*jobs):
        return [one.values["train"].get("by_autograd", False) for one in composer.trials(jobs)]

    assert by_autograd(plain, plain) == [False, False]
    assert by_autograd(own, own) == [False, False]
    assert by_autograd(plain, own) == [True, True]
    alone, _ = composer.trials([plain, own])
    assert alone.folder == composer.trials([plain])[0].folder
    assert "train.by_autograd=true" in alone.overrides  # a job of a cluster composes these
