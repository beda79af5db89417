"""A rasterizer from a file outside gsbench: examples/oversampled.py, in the real program."""

import os
import shutil
import sys
from shlex import split

import pytest
import torch

from gsbench.config.compose import compose_one
from gsbench.pipeline.parts import Parts, build_own_rasterizer
from gsbench.raster import create_rasterizer
from gsbench.runs.config_hash import config_hash
from gsbench.runs.keys import rasterizer_inputs
from tests.config.test_schema import composed
from tests.conftest import ROOT
from tests.helpers import read_json, refusal
from tests.processes import completed

CPU = torch.device("cpu")
TINY = split(
    "scene.views=10 scene.width=48 scene.height=36 init=random init.count=150 init.size=1.2"
)
TINY += split(
    "scene=courtyard train.iterations=12 eval.lpips=[] eval.flip=false tracking=none device=cpu"
)
OWN = ["raster._target_=oversampled.Oversampled", "allow_targets=[oversampled]"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a copy of the example, from which modules can be imported."""
    shutil.copy(ROOT / "examples/oversampled.py", tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "oversampled", raising=False)
    return tmp_path


def gsbench(folder, *words):
    environment = os.environ | {"GSBENCH_RUNS": str(folder / "runs")}
    return completed([sys.executable, "-m", "gsbench.cli", *words], cwd=folder, env=environment)


@pytest.mark.slow
def test_the_real_program_trains_with_it_and_records_its_source(folder):
    gsbench(folder, *TINY, *OWN, "+raster.factor=1", "name=own")
    (path,) = (folder / "runs").glob("own/*/*/*/results.json")
    assert read_json(path)["raster"] == "oversampled"
    (manifest,) = (folder / "runs" / "store" / "train").glob("*/manifest.json")
    recorded = read_json(manifest)["inputs"]["raster"]
    assert (recorded["class"], recorded["name"], recorded["factor"]) == (
        "oversampled.Oversampled",
        "oversampled",
        1,
    )
    assert len(recorded["source"]["oversampled"]) == 64

    assert "already done" in gsbench(folder, *TINY, *OWN, "+raster.factor=1", "name=own").stderr
    with (folder / "oversampled.py").open("a") as stream:
        stream.write("# a comment makes no other version\n")
    same = gsbench(folder, *TINY, *OWN, "+raster.factor=1", "name=own", "--dry-run")
    assert "missing" not in same.stdout
    with (folder / "oversampled.py").open("a") as stream:
        stream.write("VERSION = 2\n")
    changed = gsbench(folder, *TINY, *OWN, "+raster.factor=1", "name=own", "--dry-run")
    assert "missing" in changed.stdout


def test_its_options_are_checked_and_are_part_of_the_key(folder):
    values = composed(*OWN, "+raster.factor=7")
    rasterizer = build_own_rasterizer(values["raster"], values["allow_targets"])
    key = rasterizer_inputs(rasterizer)
    assert key["factor"] == 7
    assert rasterizer_inputs(create_rasterizer("reference", CPU)) == "reference"
    for words, message in (
        (["+raster.factor=0"], r"raster\.factor must be a whole number above 0"),
        (["+raster.factor=many"], r"raster\.factor"),
        (["+raster.facto=3"], r"raster\.facto is not a setting; did you mean factor"),
    ):
        values = composed(*OWN, *words)
        with refusal(message):
            build_own_rasterizer(values["raster"], values["allow_targets"])
    with refusal(r"allow_targets=\[oversampled\]"):
        compose_one(OWN[:1])


@pytest.mark.parametrize(
    "arm, output, gives",
    [
        ("pixelgs", "footprints", {"has_footprint": True}),
        ("steepgs", "the extra output splitting_matrix", {"extras": {"splitting_matrix": (3, 3)}}),
    ],
)
def test_without_an_output_it_is_refused_for_a_densifier_that_needs_it(folder, arm, output, gives):
    Parts(composed(*OWN)).check(on_this_machine=False)
    parts = Parts(composed(*OWN, f"densify={arm}"))
    able = "raster=reference or raster=cpu or raster=triton"
    line = f"{output}, which raster=oversampled does not give; take {able}"
    with refusal(f"densify={arm} needs {line}"):
        parts.check(on_this_machine=False)
    vars(parts.own_rasterizer).update(gives)
    parts.check(on_this_machine=False)


def test_a_class_without_a_name_of_its_own_or_without_render_is_refused(folder):
    (folder / "oversampled.py").write_text(
        "from gsbench.raster.reference import ReferenceRasterizer\n"
        "class Same(ReferenceRasterizer):\n    pass\n"
        "class Blind:\n    name = 'blind'\n"
        "class Nameless:\n    def render(self): pass\n"
        "class Options:\n    name = 'own'\n    def __init__(self, size=1): self.size = size\n"
        "    def render(self): pass\n"
    )
    for target, options, message in (
        ("Same", {}, "needs an attribute name.* it has 'reference'"),
        ("Nameless", {}, "needs an attribute name.* it has None"),
        ("Blind", {}, r"no render\(\)"),
        ("Options", {"size": 2}, "not a dataclass"),
        ("Absent", {}, "cannot be imported"),
    ):
        with refusal(message):
            build_own_rasterizer(
                {"name": "auto", "_target_": f"oversampled.{target}", **options}, ["oversampled"]
            )


def test_its_source_is_part_of_the_hash(folder):
    own = config_hash(composed(*OWN))
    assert own != config_hash(composed())
    (folder / "oversampled.py").write_text("changed = True\n")
    assert config_hash(composed(*OWN)) != own
