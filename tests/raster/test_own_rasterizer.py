"""A rasterizer from a file outside gsbench: examples/oversampled.py.

tests/docs/test_examples.py runs it in the real program.
"""

import shutil
import sys

import pytest
import torch

from gsbench.config.compose import compose_one
from gsbench.pipeline.parts import Parts, build_own_rasterizer
from gsbench.raster import create_rasterizer
from gsbench.runs.keys import rasterizer_inputs
from tests.config.test_schema import composed
from tests.conftest import ROOT
from tests.helpers import refusal

CPU = torch.device("cpu")
OWN = ["raster._target_=oversampled.Oversampled", "allow_targets=[oversampled]"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a copy of the example, from which modules can be imported."""
    shutil.copy(ROOT / "examples/oversampled.py", tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "oversampled", raising=False)
    return tmp_path


def test_its_options_are_checked_and_are_part_of_the_key(folder):
    values = composed(*OWN, "+raster.factor=7")
    rasterizer = build_own_rasterizer(values["raster"], values["allow_targets"])
    key = rasterizer_inputs(rasterizer)
    assert (key["class"], key["name"], key["factor"]) == (OWN[0].split("=")[1], "oversampled", 7)
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
