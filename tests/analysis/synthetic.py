"""A runs folder with made-up results: known effects, known noise, and nothing trained."""

import csv
import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import sha256

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement
from scipy.ndimage import gaussian_filter

from gsbench.runs.keys import INIT
from tests.helpers import read_json, write

METRICS = ("psnr", "ssim", "lpips_vgg_raw", "flip")
BASE = {"psnr": 26.0, "ssim": 0.80, "lpips_vgg_raw": 0.25, "flip": 0.10}
# a noise of 1 in units of the metric
SPREAD = {"psnr": 1.0, "ssim": 0.03, "lpips_vgg_raw": 0.03, "flip": 0.01}


@dataclass
class Plan:
    """What to make up. ``effect`` is the true difference of "volumetric" from "adc" in each metric.

    Noises are in units of ``SPREAD``: of a scene (shared by the arms), of the effect in a scene, of
    a trial, of a view (shared by the arms) and of a view in a trial.
    """

    experiment: str = "exp"
    scenes: Sequence[str] = ("courtyard", "garden")
    inits: Sequence[str] = ("sfm",)
    densifiers: Sequence[str] = ("adc", "volumetric")
    seeds: Sequence[int] = (0, 1, 2)
    views: int = 6
    effect: dict[str, float] = field(default_factory=dict)
    scene_noise: float = 2.0
    effect_noise: float = 0.0
    trial_noise: float = 0.1
    view_noise: float = 1.0
    residual_noise: float = 0.1
    gaussians: dict[str, int] = field(default_factory=lambda: {"adc": 20_000, "volumetric": 26_000})
    unavailable: dict[str, str] = field(
        default_factory=lambda: {"lpips_alex": "weights file alexnet.pth not found"}
    )
    random_seed: int = 0
    pictures: bool = False  # also renders, ground truth and point clouds


def write_runs(runs, plan):
    """Write every trial of the plan; returns their folders."""
    rng = np.random.default_rng(plan.random_seed)
    paths = []
    for scene in plan.scenes:
        scene_level = {m: rng.normal(0, plan.scene_noise) for m in METRICS}
        scene_effect = {m: rng.normal(0, plan.effect_noise) for m in METRICS}
        view_level = {m: rng.normal(0, plan.view_noise, plan.views) for m in METRICS}
        for init in plan.inits:
            for densify in plan.densifiers:
                for seed in plan.seeds:
                    views = {}
                    for m in METRICS:
                        treated = densify == "volumetric"
                        noise = (
                            scene_level[m]
                            + treated * scene_effect[m]
                            + view_level[m]
                            + rng.normal(0, plan.trial_noise)
                        )
                        noise = noise + rng.normal(0, plan.residual_noise, plan.views)
                        views[m] = BASE[m] + treated * plan.effect.get(m, 0.0) + SPREAD[m] * noise
                    data = trial_data(plan, scene, init, densify, seed, views)
                    paths.append(write_trial(runs, data, views))
                    if plan.pictures:
                        write_pictures(paths[-1], data, plan.views)
                        write_point_cloud(paths[-1], data)
    return paths


def trial_data(plan, scene, init, densify, seed, views):
    """A ``results.json`` as a finished trial writes it."""
    gaussians = plan.gaussians.get(densify, 20_000)
    return {
        "status": "complete",
        "experiment": plan.experiment,
        "scene": scene,
        "init": init,
        "densify": densify,
        "seed": seed,
        "raster": "cpu",
        "protocol": "paper-1",
        "iterations": 2000,
        "resolution": [400, 300],
        "budget": {"max_gaussians": 50_000, "cap": "soft"},
        "train_views": 42,
        "test_views": len(next(iter(views.values()))),
        "metrics": {m: float(values.mean()) for m, values in views.items()},
        "unavailable": plan.unavailable,
        "num_init_points": 3000,
        "num_gaussians": gaussians + 10 * seed,
        "scene_extent": 4.2,
        "seconds": {"init": 5.0, "train": gaussians / 400 + seed, "evaluate": 2.0},
        "peak_memory_mb": 900,
        "events": {
            "cloned": 500,
            "split_gradient": 300,
            "split_volume": 100 if densify == "volumetric" else 0,
        },
        "init_report": {"registered": 48, "images": 48},
        "hashes": {
            "config": "c0ffee00",
            "data": f"data-{scene}",
            "init": INIT.key({"scene": scene, "init": init}),
            "train": f"t{seed}",
        },
        "versions": {"gsbench": "0.1.0", "torch": "2.13.0", "pycolmap": "4.2.1"},
    }


def trial_folder(runs, data, config_hash="c0ffee00"):
    arm = f"{data['init']}-{data['densify']}"
    return runs / data["experiment"] / data["scene"] / arm / f"{config_hash}-seed{data['seed']}"


def write_trial(runs, data, views, config_hash="c0ffee00", **settings):
    """Write a trial's folder: results, per-view metrics, events, curves, and a configuration.

    ``settings`` (``group__key=value``) are added to the configuration.
    """
    path = trial_folder(runs, data, config_hash)
    path.mkdir(parents=True)
    names = [f"view{k:03d}" for k in range(len(next(iter(views.values()))))]
    with (path / "per_view.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["view", *views])
        writer.writerows(
            [name, *(repr(float(values[k])) for values in views.values())]
            for k, name in enumerate(names)
        )
    config = {"name": data["experiment"], "seed": data["seed"], "scene": {"name": data["scene"]}}
    config["init"] = {"name": data["init"]}
    config |= {
        "densify": {"name": data["densify"], "volume_threshold": 0.03},
        "train": {"iterations": data["iterations"]},
    }
    for key, value in settings.items():
        group, _, name = key.partition("__")
        config[group] = {**config.get(group, {}), name: value}
    write(path / "config.yaml", config)  # JSON is YAML
    _write_lines(path / "events.jsonl", events(data))
    _write_lines(path / "metrics.jsonl", curves(data))
    write(path / "results.json", data)
    return path


def write_arms(runs, arms, seeds=(0, 1, 2), scenes=("courtyard",), experiment="exp", **settings):
    """Write trials of arms whose results are noise.

    ``arms`` has the densifier's settings of each arm; ``settings`` (``group__key=value``) are
    for all.
    """
    rng = np.random.default_rng(0)
    paths = []
    for (name, densify), scene, seed in itertools.product(arms.items(), scenes, seeds):
        views = {m: BASE[m] + SPREAD[m] * rng.normal(0, 0.1, 3) for m in METRICS}
        data = trial_data(Plan(experiment=experiment), scene, "sfm", name, seed, views)
        # a hash of its own for each arm, as different settings have
        paths.append(
            write_trial(
                runs, data, views, sha256(repr(densify).encode()).hexdigest()[:8], **settings
            )
        )
        config = read_json(paths[-1] / "config.yaml")
        config["densify"] = {"name": name, **densify}
        write(paths[-1] / "config.yaml", config)
    return paths


PICTURE_SIZE = (120, 160)  # rows, columns
TEXTURED = slice(80, 160)  # columns of the ground truth that hold grass; the others are smooth


def write_pictures(path, data, views):
    """Write ground truth that is smooth on the left and grassy on the right, and renders.

    "adc" blurs the grass more than "volumetric". In the upper left corner "volumetric" is off
    by 20 levels, where "adc" is right.
    """
    noise = np.random.default_rng(data["seed"])
    for folder in ("renders", "ground_truth"):
        (path / folder).mkdir()
    for view in range(views):
        rng = np.random.default_rng(view)
        rows, columns = np.mgrid[0 : PICTURE_SIZE[0], 0 : PICTURE_SIZE[1]]
        truth = np.stack([90 + rows / 3, 120 + columns / 4, 80 + rows / 4], axis=-1)
        grass = gaussian_filter(rng.normal(0, 160, PICTURE_SIZE), (3, 0.8))[:, TEXTURED, None]
        truth[:, TEXTURED] += grass * np.array([0.6, 1.0, 0.4])
        truth = np.clip(truth, 0, 255)
        blur = 3.0 if data["densify"] == "adc" else 1.0
        render = gaussian_filter(truth, (blur, blur, 0)) + noise.normal(0, 1, truth.shape)
        if data["densify"] == "volumetric":
            render[:40, :40] += 20
        for folder, image in (("renders", render), ("ground_truth", truth)):
            pixels = np.clip(image + 0.5, 0, 255).astype(np.uint8)
            Image.fromarray(pixels).save(path / folder / f"view{view:03d}.png")


def write_point_cloud(path, data):
    """Write a PLY with log-normal scales, smaller for "volumetric", and logged histograms."""
    rng = np.random.default_rng(data["seed"])
    fields = ["x", "y", "z", "opacity", *(f"scale_{k}" for k in range(3))]
    vertices = np.zeros(2000, dtype=[(name, "f4") for name in fields])
    for axis in range(3):
        vertices[f"scale_{axis}"] = rng.normal(
            -4.0 if data["densify"] == "adc" else -4.5, 1.0, 2000
        )
    PlyData([PlyElement.describe(vertices, "vertex")]).write(path / "point_cloud.ply")
    edges = np.linspace(-18, 3, 85)
    histograms = []
    for step, center in ((600, -4.0), (1200, -5.0)):
        counts, _ = np.histogram(rng.normal(center, 2, 2000), edges)
        histograms.append({"step": step, "log10_edges": edges.tolist(), "counts": counts.tolist()})
    _write_lines(path / "volume_histograms.jsonl", histograms)


def events(data):
    """Refinements every 100 iterations; only "volumetric" splits by volume."""
    volume = 4 if data["densify"] == "volumetric" else 0
    counts = {"cloned": 20, "split_gradient": 12, "split_volume": volume, "pruned_opacity": 7}
    return [{"step": step, **counts} for step in range(600, data["iterations"] + 1, 100)]


def curves(data):
    """A growing scene and a rising PSNR."""
    final, rows = data["num_gaussians"], []
    for step in range(100, data["iterations"] + 1, 100):
        part = step / data["iterations"]
        row = {
            "step": step,
            "num_gaussians": int(3000 + (final - 3000) * part),
            "seconds": data["seconds"]["train"] * part,
        }
        rows.append(
            row
            | {"psnr": data["metrics"]["psnr"] - 6 * (1 - part) ** 2, "loss": 0.3 * (1.2 - part)}
        )
    return rows


def _write_lines(path, rows):
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
