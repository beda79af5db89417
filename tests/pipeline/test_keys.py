"""Keys of trials: those of a known one, and of trials with the user's classes."""

import re
import sys
from pathlib import Path
from shlex import split

import pytest

from gsbench.config.compose import Composer, compose_one
from gsbench.pipeline import trial as pipeline_trial
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps import scene as scene_module
from gsbench.pipeline.steps.scene import CaptureSource
from gsbench.pipeline.trial import TrialSteps
from gsbench.runs import keys
from gsbench.runs.code import config_hash
from gsbench.runs.store import Store
from gsbench.scene.types import Capture
from gsbench.system.programs import allowed_modules
from tests.helpers import refusal

WORDS = split(
    "scene=garden scene.path=photos init=random densify=volumetric "
    "densify.volume_threshold=0.05 eval.lpips=[] eval.flip=false raster=cpu device=cpu "
    "threads=1 seed=3"
)
BARE = Capture(
    "garden", Path("photos"), ("a.jpg", "b.jpg", "c.jpg"), ("a.jpg",), None, False, "0" * 64
)
KEYS = [
    ("config", "2926acc1205ccb82f5292c60e86ffe4f4f0bb477ae5a7586d4145c516a32a29a"),
    # of the reference cameras
    ("init", "b92ef1cdec8634bd52daa8afeaec7fce0b13d00d70d0f715b5eb9a1c73fd5759"),
    ("init", "a3a44618398e68c025836e1031642269da49e069c9d615c9de8217baab805301"),
    ("train", "905a9e3749af71c6bab5b6e430d16dee07270ef47347d1cfbb96b2703408eb9b"),
    ("ground_truth", "2713e948ccf37750ea64717542d37c5a6697a184fe9c108264563c57a4b1b66d"),
    ("evaluate", "5007653c9b10de39c2e268855a6efe5ce0853abbeec6f49ce21e0f2e202ba631"),
]


class BareSource(CaptureSource):
    step = None

    def read(self, made):
        return BARE


def test_the_keys_of_a_known_trial_do_not_change(tmp_path, monkeypatch):
    """The photographs come without cameras, so the step of the reference cameras has a key too."""
    monkeypatch.setattr(scene_module, "version_of", lambda package: "4.0.0")
    monkeypatch.setattr(keys, "edited", lambda files: {})  # as in a release
    values = compose_one(WORDS).values
    monkeypatch.setattr(pipeline_trial, "CaptureSource", BareSource)
    trial = TrialSteps(Parts(values), Store(tmp_path / "store"))
    found = [
        ("config", config_hash(values)),
        *((step.stage.name, step.key) for step in trial.steps()),
    ]
    assert found == KEYS


MODULES = ("mine", "variant")
METRIC = (
    "class M:\n    direction = 1\n    value = {}\n    def measure(self, image, truth):\n     "
    "   return self.value\n"
)
FROM_A_FUNCTION = "def metric_of(x):\n{}    return M\nM = metric_of({{}})\n".format(
    "".join(f"    {line}\n" for line in METRIC.format("x").splitlines())
)
WITHIN = "class Outer:\n{}M = Outer.M\n".format(
    "".join(f"    {line}\n" for line in METRIC.splitlines())
)
WRAPPED = (
    "import functools\ndef same(cls):\n    return type(cls.__name__, (cls,), "
    f"{{{{}}}})\n@same\n{METRIC}"
)


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """The user's current folder."""
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    _forget()
    for name in MODULES:
        allowed_modules().pop(name, None)


def _forget():
    """Forget the user's modules, as a new process would."""
    for name in MODULES:
        sys.modules.pop(name, None)


@pytest.fixture(autouse=True)
def bare_capture(monkeypatch):
    monkeypatch.setattr(pipeline_trial, "CaptureSource", BareSource)


def keys_of(home, *words):
    """The keys of a trial by stage in a new process, and the hash of its configuration."""
    _forget()
    values = compose_one([*WORDS, f"allow_targets=[{','.join(MODULES)}]", *words]).values
    steps = list(TrialSteps(Parts(values), Store(home / "store")).steps())
    return {"config": config_hash(values)} | {step.stage.name: step.key for step in steps}


def moved(one, other):
    return {name for name in one if one[name] != other[name]}


@pytest.mark.parametrize(
    "text",
    [METRIC, FROM_A_FUNCTION, WITHIN, WRAPPED],
    ids=["plain", "made by a function", "in a class", "wrapped"],
)
def test_an_edit_of_a_metric_changes_its_key_however_its_class_is_made(home, text):
    words = ["+eval.extra.m._target_=mine.M"]
    found = []
    for value in ("1.0", "2.0", "1.0"):
        (home / "mine.py").write_text(text.format(value))
        found.append(keys_of(home, *words))
    assert moved(found[0], found[1]) == {"config", "evaluate"}
    assert found[0] == found[2]


def test_a_module_that_passes_a_class_on_is_in_the_key(home):
    (home / "mine.py").write_text(METRIC.format("1.0"))
    found = []
    for value in ("3.0", "4.0"):
        (home / "variant.py").write_text(f"from mine import M\nM.value = {value}\n")
        found.append(keys_of(home, "+eval.extra.m._target_=variant.M"))
    assert moved(*found) == {"config", "evaluate"}
    found = []
    for value in ("3.0", "4.0"):  # one of gsbench's own classes
        (home / "variant.py").write_text(
            f"from gsbench.densify import Volumetric\nVolumetric.extra = {value}\n"
        )
        found.append(keys_of(home, "densify._target_=variant.Volumetric"))
    from gsbench.densify import Volumetric

    del Volumetric.extra
    assert moved(*found) == {"config", "train", "evaluate"}


def test_options_of_a_users_class_are_in_the_key_whatever_their_names(home):
    text = (
        "from dataclasses import dataclass\nfrom gsbench.densify import Volumetric\n"
        "@dataclass(kw_only=True)\nclass Mine(Volumetric):\n    weights: float = 1.0\n    "
        "threads: int = 1\n"
    )
    (home / "mine.py").write_text(text)
    own = ["densify._target_=mine.Mine", "+densify.weights=1.0"]
    for change in ("densify.weights=9.0", "+densify.threads=2"):
        assert moved(keys_of(home, *own), keys_of(home, *own, change)) == {
            "config",
            "train",
            "evaluate",
        }
    (home / "mine.py").write_text(
        f"from dataclasses import dataclass\n@dataclass\n{METRIC.format(1)}    weights: int = 1\n"
    )
    words = ["+eval.extra.m._target_=mine.M", "+eval.extra.m.weights=1"]
    assert moved(keys_of(home, *words), keys_of(home, *words, "eval.extra.m.weights=3")) == {
        "config",
        "evaluate",
    }


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
