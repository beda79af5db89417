"""OpenSplat as an arm, where it is installed: its model lies at the right place, and it grows."""

import shutil
from shlex import split

import numpy as np
import pytest
from PIL import Image

from gsbench.cli import run
from tests.helpers import read_json

PROGRAM = "opensplat"
VERSION = "1.2.0"
ITERATIONS = 300
SHIFT = 3  # px

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which(PROGRAM) is None,
        reason=f"{PROGRAM} is not on the PATH (docs/other_trainers.md)",
    ),
]


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    """The folder of a short trial of OpenSplat on a small courtyard, with a schedule of growth."""
    runs = tmp_path_factory.mktemp("runs")
    scene = split("scene.views=16 scene.width=128 scene.height=96 init=random init.count=3000")
    growth = split(
        "densify_from=50 densify_until=200 refine_every=50 loss_threshold=0.02 "
        "sh_degree_interval=50"
    )
    words = [
        f"densify=external/{PROGRAM}",
        f"densify.version={VERSION}",
        *(f"densify.options.{one}" for one in growth),
    ]
    words += split(
        f"allow_targets=[{PROGRAM}] train.iterations={ITERATIONS} tracking=none eval.lpips=[]"
    )
    assert run([*scene, *words, f"runs={runs}"]) == 0
    return next(runs.glob("default/courtyard/*/*-seed0"))


def error(picture, truth):
    return float(np.square(picture.astype(float) - truth).mean())


def test_renders_of_opensplat_are_neither_mirrored_nor_shifted(trial):
    """Each test photograph is nearer to its render than to a mirrored or shifted copy of it."""
    files = sorted((trial / "renders").glob("*.png"))
    assert len(files) == 2
    for file in files:
        render = np.asarray(Image.open(file).convert("RGB"))
        truth = np.asarray(Image.open(trial / f"ground_truth/{file.name}").convert("RGB"))
        moved = [np.roll(render, shift, axis) for shift in (-SHIFT, SHIFT) for axis in (0, 1)]
        for other in (render[::-1], render[:, ::-1], *moved):
            assert error(render, truth) < error(other, truth), file.name


def test_opensplat_grows_on_the_given_schedule(trial):
    results = read_json(trial / "results.json")
    assert results["num_gaussians"] > results["num_init_points"]
    assert VERSION in results["trained_by"]["said"]
    rounds = [
        line
        for line in (trial / "trainer.log").read_text().splitlines()
        if line.startswith("Densify ")
    ]
    assert [line.split(":")[0] for line in rounds] == ["Densify 100", "Densify 150"]
