"""What an evaluation depends on, and what it measures."""

import csv
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from PIL import Image

from gsbench.config.compose import compose_one
from gsbench.eval.evaluator import Evaluator
from gsbench.eval.protocol import PAPER
from gsbench.gaussians.ply import write_ply
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps.evaluate import evaluate_step, one_color_psnr
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.runs import keys
from gsbench.runs.code import UserCode
from gsbench.runs.keys import INIT, TRAIN, Step
from gsbench.runs.store import Store
from gsbench.scene.types import ANGLE, COUNTED, DISTANCE
from gsbench.train.trainer import snapshot_file
from tests.helpers import read_json

TRAINED = Step(TRAIN, {}, lambda folder: None)
FOUR_LPIPS = ["lpips_alex", "lpips_squeeze", "lpips_vgg", "lpips_vgg_raw"]


def parts_of(evaluator=None, **changes):
    """The parts of a trial that is evaluated without LPIPS."""
    parts = {
        "evaluator": evaluator or Evaluator(PAPER, lpips=[], flip=False),
        "rasterizer": ReferenceRasterizer(),
        "device": torch.device("cpu"),
        "train": SimpleNamespace(background=(0.1, 0.2, 0.3)),
        "eval": SimpleNamespace(regions=None),
        "measured_earlier": [],
        "user_code": UserCode(),
        "program": None,
    }
    return SimpleNamespace(**parts | changes)


def built(folder, step):
    """The folder of a built step, and the rows of its table by view."""
    folder.mkdir()
    step.build(folder)
    with (folder / "per_view.csv").open() as stream:
        return folder, {row["view"]: row for row in csv.DictReader(stream)}


def inputs(**options):
    """The inputs of an evaluation without LPIPS; a key needs no views."""
    parts = parts_of(Evaluator(PAPER, lpips=[], **options))
    return dict(evaluate_step(None, TRAINED, parts).inputs)


def test_an_evaluation_without_newer_settings_keeps_its_key(monkeypatch):
    monkeypatch.setattr(keys, "edited", lambda files: {})  # as in a release
    old = {"train": TRAINED.key, "protocol": "paper-1", "unavailable": FOUR_LPIPS}
    assert inputs() == old
    for more in (["gmsd", "fsim"], ["fsim", "gmsd"]):
        assert inputs(more=more)["more"] == ["fsim", "gmsd"]


def test_an_evaluation_measures_the_pixels_of_its_png_files(tmp_path, truth, tiny_scene, told):
    """Metrics, nearest training views and means of an earlier model are computed here again."""
    store, init = Store(tmp_path), Step(INIT, {}, lambda folder: None)
    masked = replace(tiny_scene.test[1], mask=np.arange(32 * 40).reshape(32, 40) % 4 > 0)
    scene = replace(tiny_scene, test=(tiny_scene.test[0], masked))
    training = store.path(TRAINED)
    (training / snapshot_file(7)).parent.mkdir(parents=True)
    faint = truth.map(lambda tensor: tensor.clone())
    faint.opacity_logits -= 3
    write_ply(truth, training / "point_cloud.ply")
    earlier = faint.select(torch.arange(50))
    write_ply(earlier, training / snapshot_file(7))
    # a time limit ended the training before iteration 9
    parts = parts_of(measured_earlier=[7, 9])
    views = SimpleNamespace(store=store, scene=scene, init=init)
    folder, rows = built(tmp_path / "built", evaluate_step(views, TRAINED, parts))

    def rendered(model, view):
        background = torch.tensor([0.1, 0.2, 0.3])
        image = ReferenceRasterizer().render(model, view.camera, 3, background).image
        return np.floor(255 * image.detach().clamp(0, 1).numpy() + 0.5)

    means = {"last": 0.0, "earlier": 0.0}
    for view in scene.test:
        picture = np.asarray(Image.open(folder / f"renders/{view.name}")).astype(float)
        assert_array_equal(picture, rendered(truth, view))
        counted = np.ones((32, 40), dtype=bool) if view.mask is None else view.mask
        row = rows[view.name]
        for name, image in (("earlier", rendered(earlier, view)), ("last", picture)):
            psnr = 10 * np.log10(255**2 / ((image - view.image)[counted] ** 2).mean())
            means[name] += 0.5 * psnr
        assert float(row["psnr"]) == pytest.approx(psnr, abs=1e-5)
        assert float(row[COUNTED]) == pytest.approx(counted.mean())
        angles = [
            np.arccos(min(1.0, view.camera.rotation[2] @ other.camera.rotation[2]))
            for other in scene.train
        ]
        assert float(row[ANGLE]) == pytest.approx(np.degrees(min(angles)), abs=1e-5)
        places = [np.linalg.norm(view.camera.center - other.camera.center) for other in scene.train]
        assert float(row[DISTANCE]) == pytest.approx(min(places) / scene.extent)
    metrics = read_json(folder / "metrics.json")
    assert metrics["metrics"]["psnr"] == pytest.approx(means["last"], abs=1e-5)
    assert metrics["at"].keys() == {"7"}
    assert metrics["at"]["7"]["num_gaussians"] == 50
    assert metrics["at"]["7"]["metrics"]["psnr"] == pytest.approx(means["earlier"], abs=1e-3)
    assert len(list((folder / "renders").iterdir())) == 2
    assert told == [("views", 1, 2), ("views", 2, 2), ("iteration 7", 1, 2), ("iteration 7", 2, 2)]


def test_the_mean_colour_of_counted_training_pixels_is_measured_against_the_test_views(tiny_scene):
    def plain(view, color):
        return replace(view, image=np.broadcast_to(np.uint8(color), view.image.shape).copy())

    black, light, dark = map(plain, tiny_scene.train, [(0, 0, 0), (80, 0, 40), (40, 200, 0)])
    half = np.zeros(light.image.shape[:2], dtype=bool)
    half[: len(half) // 2] = True
    # half of the second and all of the third: (160, 400, 40) / 3, rounded
    train = (replace(black, mask=np.zeros_like(half)), replace(light, mask=half), dark)
    test = (plain(tiny_scene.test[0], (43, 133, 13)), plain(tiny_scene.test[1], (63, 133, 13)))
    scene = replace(tiny_scene, train=train, test=test)
    expected = 10 * np.log10(255**2 / (10**2 / 3))  # of 53, 133, 13, in one channel
    assert one_color_psnr(scene, PAPER) == pytest.approx(expected, abs=1e-4)
    assert one_color_psnr(replace(scene, test=()), PAPER) is None


def test_a_trial_is_measured_on_its_own_device():
    """Torch's device "meta" stands in for a GPU: its tensors have no values, but a place."""
    seen = set()

    def spy(*images):
        seen.update(image.device.type for image in images)
        return 0.0

    parts = Parts(compose_one(["scene=courtyard", "eval.lpips=[]", "eval.flip=false"]).values)
    parts.device = torch.device("meta")
    evaluator = parts.evaluator
    evaluator._metrics = {"spy": spy}
    image = np.zeros((4, 5, 3), np.uint8)
    assert evaluator.evaluate_view(image, image, np.ones((4, 5), bool)) == {"spy": 0.0}
    assert seen == {"meta"}
