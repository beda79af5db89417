"""Small finished trials for the viewer to show."""

import numpy as np
import pytest
import torch
from PIL import Image

from gsbench.gaussians.ply import write_ply
from gsbench.runs.keys import INIT, Step
from gsbench.runs.store import Store
from gsbench.scene.colmap import write_model
from gsbench.scene.types import Camera
from tests.gaussians.helpers import random_gaussians
from tests.trials import write_runs

VIEWS = {"view000.png": (64, 48), "view001.png": (48, 64)}  # width, height of their photographs
POINTS = np.array([[0, 0, z] for z in (-3.0, 0.1, 4, 5, 8)])  # two are not before the cameras


@pytest.fixture(scope="session")
def small_runs(tmp_path_factory):
    """A runs folder with the experiment ``small``: ADC and volumetric with two seeds, made up.

    The cameras look along z, and their model is twice the size of the photographs.
    """
    runs = tmp_path_factory.mktemp("view-runs")
    rng = np.random.default_rng(0)
    cameras = {
        name: Camera(2 * w, 2 * h, 100.0, 110.0, w + 3, h - 2, np.eye(3), np.array([-k, -2, 0]))
        for k, (name, (w, h)) in enumerate({"trained.png": (64, 48), **VIEWS}.items())
    }
    cloud = POINTS, np.full((len(POINTS), 3), 200, np.uint8)
    inputs = {"scene": "courtyard", "init": "random"}
    model = Step(INIT, inputs, lambda folder: write_model(folder / "sparse/0", cameras, cloud))
    Store(runs / "store").get(model)
    plan = {"experiment": "small", "scenes": ["courtyard"], "inits": ["random"], "seeds": [0, 1]}
    for seed, trial in enumerate(write_runs(runs, **plan, views=len(VIEWS))):
        gaussians = random_gaussians(40, seed, torch.float32, log_scale=(-4.0, -2.2))
        write_ply(gaussians, trial / "point_cloud.ply")
        (trial / "ground_truth").mkdir()
        for name, (width, height) in VIEWS.items():
            noise = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
            Image.fromarray(noise).save(trial / "ground_truth" / name)
    more = {"scenes": ["garden"], "inits": ["random", "sfm"], "densifiers": ["adc"], "seeds": [0]}
    write_runs(runs, **plan | more)
    return runs
