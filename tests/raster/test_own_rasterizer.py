"""A rasterizer from a file outside gsbench: the one of docs/rasterizer.md, in the real program."""

import os
import re
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
OWN = ["raster._target_=untiled.Untiled", "allow_targets=[untiled]"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the document's ``untiled.py``, from which modules can be imported."""
    blocks = re.findall(
        r"^```python\n(# untiled\.py\n.*?)^```$",
        (ROOT / "docs/rasterizer.md").read_text(),
        re.S | re.M,
    )
    (tmp_path / "untiled.py").write_text(blocks[0])
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "untiled", raising=False)
    return tmp_path


def gsbench(folder, *words):
    environment = os.environ | {"GSBENCH_RUNS": str(folder / "runs")}
    return completed([sys.executable, "-m", "gsbench.cli", *words], cwd=folder, env=environment)


@pytest.mark.slow
def test_the_real_program_trains_with_it_and_records_its_source(folder):
    def run(*words):
        done = gsbench(folder, *TINY, *OWN, "+raster.rows=36", "name=own", *words)
        return done.stdout + done.stderr

    run()
    (path,) = (folder / "runs").glob("own/*/*/*/results.json")
    assert read_json(path)["raster"] == "untiled"
    (manifest,) = (folder / "runs" / "store" / "train").glob("*/manifest.json")
    recorded = read_json(manifest)["inputs"]["raster"]
    assert recorded["class"] == "untiled.Untiled"
    assert (recorded["name"], recorded["rows"]) == ("untiled", 36)
    assert len(recorded["source"]["untiled"]) == 64

    assert "already done" in run()
    for text, missing in (("# a comment makes no other version\n", False), ("VERSION = 2\n", True)):
        with (folder / "untiled.py").open("a") as stream:
            stream.write(text)
        assert ("missing" in run("--dry-run")) is missing


def test_its_options_are_checked_and_are_part_of_the_key(folder):
    values = composed(*OWN, "+raster.rows=7")
    key = rasterizer_inputs(build_own_rasterizer(values["raster"], values["allow_targets"]))
    assert key["rows"] == 7
    assert rasterizer_inputs(create_rasterizer("reference", CPU)) == "reference"
    for words, message in (
        (["+raster.rows=0"], r"raster\.rows must be a whole number above 0"),
        (["+raster.rows=many"], r"raster\.rows"),
        (["+raster.row=3"], r"raster\.row is not a setting; did you mean rows"),
    ):
        values = composed(*OWN, *words)
        with refusal(message):
            build_own_rasterizer(values["raster"], values["allow_targets"])
    with refusal(r"allow_targets=\[untiled\]"):
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
    line = f"{output}, which raster=untiled does not give; take {able}"
    with refusal(f"densify={arm} needs {line}"):
        parts.check(on_this_machine=False)
    vars(parts.own_rasterizer).update(gives)
    parts.check(on_this_machine=False)


def test_a_class_without_a_name_of_its_own_or_without_render_is_refused(folder):
    (folder / "untiled.py").write_text(
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
                {"name": "auto", "_target_": f"untiled.{target}", **options}, ["untiled"]
            )


def test_its_source_is_part_of_the_hash(folder):
    own = config_hash(composed(*OWN))
    assert own != config_hash(composed())
    (folder / "untiled.py").write_text("changed = True\n")
    assert config_hash(composed(*OWN)) != own
