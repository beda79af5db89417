"""A trial's parts, their checks before any work, and failures of its code."""

import sys
from shlex import split
from types import ModuleType

import pytest

from gsbench.config.build import build
from gsbench.config.compose import compose_one
from gsbench.densify import ADC
from gsbench.pipeline.parts import Parts, build_own_rasterizer
from gsbench.pipeline.trial import run_trial
from gsbench.runs import layout
from gsbench.runs.keys import VIEWS
from tests.helpers import refusal, table


@pytest.mark.parametrize(
    "words, here, said",
    table(__file__, "rasters"),
)
def test_a_rasterizer_that_cannot_run_or_lacks_a_needed_feature_is_refused_before_any_work(
    words, here, said
):
    parts = Parts(compose_one(["scene=courtyard", "device=cpu", *split(words)]).values)
    with refusal(said):
        parts.check(here)


def test_auto_threads_are_those_that_parallel_trials_leave(monkeypatch):
    monkeypatch.setattr("gsbench.pipeline.parts.available_threads", lambda parallel: 100 + parallel)
    for words, threads in ((["threads=3"], 3), (["threads=auto", "launch.parallel=2"], 102)):
        assert Parts(compose_one(["scene=courtyard", *words]).values).threads == threads


def test_auto_threads_of_the_initialiser_are_those_of_the_trial():
    for word, threads in (("init.threads=auto", 3), ("init.threads=2", 2)):
        words = ["scene=courtyard", "init=sfm", "threads=3", word]
        assert Parts(compose_one(words).values).initializer.threads == threads


def test_iterations_measured_earlier_are_sorted_and_before_the_last():
    words = split("scene=courtyard train.iterations=9 eval.at=[7,3,9]")
    assert Parts(compose_one(words).values).measured_earlier == [3, 7]


def test_a_configuration_that_was_not_composed_is_checked_for_permissions_too():
    values = compose_one(["scene=courtyard"]).values
    Parts(values)
    with refusal("allow_targets"):
        Parts(values | {"densify": values["densify"] | {"_target_": "mine.Mine"}})


def test_a_program_must_exist_only_on_the_machine_where_it_runs():
    command = "densify.command='/nowhere/program {data} {output}'"
    words = split("densify=external/program densify.result=a.ply densify.version=1")
    words += ["scene=courtyard", command, "allow_targets=[/nowhere/program]"]
    parts = Parts(compose_one(words).values)
    parts.check(on_this_machine=False)
    with refusal("program"):
        parts.check(on_this_machine=True)


OWN = """
from dataclasses import dataclass
from gsbench.densify import ADC
from gsbench.raster.reference import ReferenceRasterizer

@dataclass
class Picky(ADC):
    least: float = 1.0
    def __post_init__(self):
        if self.least < 0:
            raise KeyError("least")
        super().__post_init__()

class Bare(ReferenceRasterizer):
    def __init__(self, least=2.0):
        self.least = least

class Ender(ADC):
    def __init__(self):
        raise SystemExit(3)

class Named(ReferenceRasterizer):
    name = "named"

class Nameless(ReferenceRasterizer):
    name = None

class Taken(ReferenceRasterizer):
    name = "cpu"

class Nothing:
    pass

function = len
"""


ADC_PATH = "gsbench.densify.ADC"


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    (tmp_path / "own_classes.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_classes", raising=False)


@pytest.mark.parametrize(
    "group, target, options, said",
    [
        ("densify", "own_classes.Picky", {"least": 2.0}, None),
        ("densify", "own_classes.Picky", {"lest": 2.0}, r"densify\.lest"),
        ("densify", "own_classes.Picky", {"least": -1.0}, "Picky cannot be made .KeyError"),
        ("raster", "own_classes.Bare", {"least": 2.0}, "has options but is not a dataclass"),
        ("raster", "own_classes.Bare", {}, None),
        ("densify", "own_classes.Ender", {}, "cannot be made .SystemExit: 3"),
        ("densify", "own_classes.Nothing", {}, "is not a class for densify: it has no "),
        ("densify", "own_classes.function", {}, "is not a class for densify"),
        ("densify", ADC_PATH, {"gradient_treshold": 1}, "did you mean gradient_threshold"),
        ("densify", ADC_PATH, {"stop": 1, "start": 5}, r"densify\.stop must be above"),
        ("init", "gsbench.init.Random", {"count": 0}, "init"),
    ],
)
def test_a_part_that_cannot_be_made_is_refused_with_the_name_of_its_setting(
    own_module, group, target, options, said
):
    with refusal(said):
        made = build(group, {"_target_": target, **options}, ["own_classes"])
        assert type(made).__name__ == target.rpartition(".")[2]
        assert getattr(made, "least", 2.0) == 2.0


@pytest.mark.parametrize("name, sound", [("Named", True), ("Nameless", False), ("Taken", False)])
def test_a_users_rasterizer_needs_a_name_of_its_own(own_module, name, sound):
    values = {"name": "own", "_target_": f"own_classes.{name}"}
    with refusal(None if sound else "needs an attribute name"):
        assert build_own_rasterizer(values, ["own_classes"]).name == "named"
    for densify, given in (("adc", "auto"), ("adc", "own"), ("taming", "auto")):
        words = split(f"scene=courtyard device=cpu densify={densify} allow_targets=[own_classes]")
        parts = Parts(compose_one(words).values | {"raster": values | {"name": given}})
        if sound and densify == "adc":
            parts.check(on_this_machine=True)
        elif sound:
            for use in (lambda: parts.check(on_this_machine=False), lambda: parts.rasterizer):  # noqa: B023
                with refusal("raster=named does not give; take raster=reference"):
                    use()
    assert build_own_rasterizer({"name": "cpu"}, []) is None


def test_code_whose_version_results_cannot_record_is_named(tmp_path, monkeypatch, caplog):
    (tmp_path / "own_helper.py").write_text("x = 1\n")
    lines = "import own_helper\nfrom gsbench.densify import ADC\nclass Mine(ADC): pass\n"
    (tmp_path / "own_importer.py").write_text(lines)
    monkeypatch.syspath_prepend(tmp_path)
    for allowed, said in (
        (["own_importer", "own_helper"], []),
        (["own_importer"], ["own_importer.Mine imports own_helper, and results do not record"]),
    ):
        for name in ("own_importer", "own_helper"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        build("densify", {"_target_": "own_importer.Mine"}, allowed)
        assert [message[: len(said[0])] for message in caplog.messages] == said
    caplog.clear()
    made_up = ModuleType("made_up")
    made_up.Mine = type("Mine", (ADC,), {"__module__": "made_up"})
    monkeypatch.setitem(sys.modules, "made_up", made_up)
    build("densify", {"_target_": "made_up.Mine"}, ["made_up"])
    assert caplog.messages == [
        "no file of made_up.Mine was found: results do not record its version"
    ]


@pytest.mark.parametrize("place", split("scene trial log.txt store/views"))
def test_nothing_is_written_through_a_link_in_the_runs_folder(tmp_path, place):
    """A runs folder from somebody else could have links to any file."""
    trial = compose_one(["scene=courtyard", f"runs={tmp_path / 'runs'}"])
    outside = tmp_path / "outside"
    outside.mkdir()
    own = trial.files
    link = {
        "scene": own.path.parents[1],
        "trial": own.path,
        "log.txt": own.path / "log.txt",
        "store/views": own.runs / layout.STORE / VIEWS.name,
    }[place]
    link.parent.mkdir(parents=True)
    link.symlink_to(outside / "private" if place == "log.txt" else outside)
    with refusal(r"not a regular file|is a link"):
        run_trial(trial)
    assert not list(outside.iterdir())
