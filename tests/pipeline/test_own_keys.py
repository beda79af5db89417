"""Keys of trials with the user's classes: they change with everything that changes results."""

import sys

import pytest

from gsbench.config.compose import compose_one
from gsbench.pipeline import trial as pipeline_trial
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.trial import TrialSteps
from gsbench.runs.config_hash import config_hash
from gsbench.runs.store import Store
from gsbench.system.programs import allowed_modules
from tests.pipeline.test_keys import WORDS, BareSource

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
