"""Trials that nobody trained: their configurations, records and folders, and whole experiments.

The results of an experiment have known effects and known noise.
"""

import csv
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256

import numpy as np

from gsbench.analysis.cells import with_variants
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.questions import Asked, ask
from gsbench.analysis.results import read_experiment
from gsbench.config.compose import Trial
from gsbench.runs.commands import Command, PlannedTrial, append
from gsbench.runs.keys import INIT
from gsbench.runs.trial_record import TrialRecord
from tests.helpers import read_json, write, write_lines
from tests.pictures import write_pictures, write_point_cloud

METRICS = ("psnr", "ssim", "lpips_vgg_raw", "flip")
BASE = {"psnr": 26.0, "ssim": 0.80, "lpips_vgg_raw": 0.25, "flip": 0.10}
# a noise of 1 in units of the metric
SPREAD = {"psnr": 1.0, "ssim": 0.03, "lpips_vgg_raw": 0.03, "flip": 0.01}
HASH = "c0ffee00"
STEPS = 150  # of a training by `trial_values`
LOCAL = {"name": "local", "parallel": 2, "timeout_min": None}
BUDGET = {"max_gaussians": 50_000, "cap": "soft"}
GAUSSIANS = {"adc": 20_000, "volumetric": 26_000}

# ---- configurations


def trial_values(runs, seed=0, name="tracked", **groups):
    """The configuration of a trial, which is not composed; ``groups`` are names of choices."""
    named = {group: f"a_{group}" for group in ("scene", "init", "densify")} | groups
    return {
        "name": name,
        "seed": seed,
        "runs": str(runs),
        "train": {"iterations": STEPS},
        **{group: {"name": choice} for group, choice in named.items()},
    }


def bare_trial(runs, seed=0, launch=LOCAL, words=(), **settings):
    """A trial that is not composed, with the words that ask for it."""
    more = {"launch": launch, "tracking": {"sink": f"of {seed}"}, "device": "auto", "threads": 3}
    values = trial_values(runs, seed, "x") | more | {"eval": {"primary": None}} | settings
    return Trial(values, tuple(words))


# ---- records


def results_of(values, **changes):
    """What ``results.json`` of a finished trial says; ``changes`` are fields."""
    return {
        "status": "complete",
        "experiment": values["name"],
        **{group: values[group]["name"] for group in ("scene", "init", "densify")},
        "seed": values["seed"],
        "raster": "cpu",
        "protocol": "paper-1",
        "iterations": values.get("train", {}).get("iterations", 10),
        "metrics": {"psnr": 20.5},
        "unavailable": {},
        "seconds": {"train": 1.0},
        "num_init_points": 5,
        "num_gaussians": 10,
        "peak_memory_mb": 1.5,
        "hashes": {},
        "versions": {},
    } | changes


def record_of(values, **changes):
    """The record of a finished trial with the configuration ``values``."""
    return TrialRecord(**results_of(values, **changes))


def write_results(folder, values, **changes):
    """Write ``results.json`` without a record of the trial's inputs (``made_of``)."""
    record = record_of(values, **changes)
    write(folder / "results.json", record.to_json())
    return record


def search_record(points):
    """The content of ``tuning.json`` for a search with these points, for the arm ``volumetric``."""
    return {
        "sweep": "vth",
        "arm": "sfm-volumetric",
        "metric": "psnr",
        "direction": 1,
        "wanted": 2,
        "seeds": [100],
        "scenes": ["courtyard"],
        "ranges": {},
        "log": [],
        "points": points,
    }


# ---- folders


def write_trial(
    runs,
    seed=0,
    config_hash=HASH,
    settings=None,
    *,
    experiment="exp",
    scene="garden",
    init="sfm",
    densify="adc",
    **values,
):
    """Write the folder of a trial: results, metrics of views, events, curves, a configuration.

    ``psnr=…`` gives a metric, in one view or in each, and ``_iterations=…`` a key of
    ``results.json``. ``settings`` are keys with dots, or whole groups. Returns the folder.
    """
    views = {key: np.atleast_1d(value) for key, value in values.items() if key[0] != "_"}
    config = {"name": experiment, "seed": seed, "train": {"iterations": 2000}}
    config |= {"scene": {"name": scene}, "init": {"name": init}}
    config["densify"] = {"name": densify, "volume_threshold": 0.03}
    count = GAUSSIANS.get(densify, 20_000)
    data = results_of(
        config,
        resolution=[400, 300],
        budget=BUDGET,
        train_views=42,
        test_views=len(next(iter(views.values()))),
        metrics={key: float(of_views.mean()) for key, of_views in views.items()},
        unavailable={"lpips_alex": "weights file alexnet.pth not found"},
        num_init_points=3000,
        num_gaussians=count + 10 * seed,
        scene_extent=4.2,
        seconds={"init": 5.0, "train": count / 400 + seed, "evaluate": 2.0},
        peak_memory_mb=900,
        events={
            "cloned": 500,
            "split_gradient": 300,
            "split_volume": 100 * (densify == "volumetric"),
        },
        init_report={"registered": 48, "images": 48},
        hashes={
            "config": HASH,
            "data": f"data-{scene}",
            "train": f"t{seed} of {scene} {densify} {config_hash}",
            "init": INIT.key({"scene": scene, "init": init}),
        },
        versions={"gsbench": "0.1.0", "torch": "2.13.0", "pycolmap": "4.2.1"},
    )
    data |= {key[1:]: value for key, value in values.items() if key[0] == "_"}
    config["train"]["iterations"] = data["iterations"]
    for key, value in (settings or {}).items():
        group, _, name = key.partition(".")
        config[group] = config.get(group, {}) | {name: value} if name else value
    path = runs / experiment / f"{scene}/{init}-{densify}/{config_hash}-seed{seed}"
    path.mkdir(parents=True)
    with (path / "per_view.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["view", *views])
        for k, row in enumerate(zip(*views.values(), strict=True)):
            writer.writerow([f"view{k:03d}", *(repr(float(value)) for value in row)])
    write(path / "config.yaml", config)  # JSON is YAML
    write_lines(path / "events.jsonl", events(data))
    write_lines(path / "metrics.jsonl", curves(data))
    write(path / "results.json", data)
    return path


def write_as(trial, **values):
    """Write the folder of a composed trial, as `write_trial` does, with its configuration."""
    chosen = {group: trial.values[group]["name"] for group in ("scene", "init", "densify")}
    place = trial.files.runs, trial.values["seed"], trial.folder.name.partition("-")[0]
    path = write_trial(*place, experiment=trial.values["name"], **chosen, **values)
    (path / "config.yaml").write_text(trial.yaml)


def events(data):
    """Refinements every 100 iterations; only "volumetric" splits by volume."""
    volume = 4 * (data["densify"] == "volumetric")
    counts = {"cloned": 20, "split_gradient": 12, "split_volume": volume, "pruned_opacity": 7}
    return [{"step": step, **counts} for step in range(600, data["iterations"] + 1, 100)]


def curves(data):
    """A growing scene and a rising PSNR."""
    final, last, rows = data["num_gaussians"] or 3000, data["iterations"], []
    for step in range(100, last + 1, 100):
        part = step / last
        growth = {"step": step, "num_gaussians": int(3000 + (final - 3000) * part)}
        psnr = data["metrics"].get("psnr", 20) - 6 * (1 - part) ** 2
        seconds = data["seconds"].get("train", 1) * part
        rows.append(growth | {"seconds": seconds, "psnr": psnr, "loss": 0.3 * (1.2 - part)})
    return rows


# ---- experiments


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
    gaussians: dict[str, int] = field(default_factory=lambda: GAUSSIANS)
    random_seed: int = 0
    pictures: bool = False  # also renders, ground truth and point clouds


def write_runs(runs, **plan):
    """Write every trial of a plan; returns their folders."""
    plan = Plan(**plan)
    rng = np.random.default_rng(plan.random_seed)
    paths = []
    for scene in plan.scenes:
        scene_level = {m: rng.normal(0, plan.scene_noise) for m in METRICS}
        scene_effect = {m: rng.normal(0, plan.effect_noise) for m in METRICS}
        view_level = {m: rng.normal(0, plan.view_noise, plan.views) for m in METRICS}
        for init, densify, seed in itertools.product(plan.inits, plan.densifiers, plan.seeds):
            treated, views = densify == "volumetric", {}
            for m in METRICS:
                noise = scene_level[m] + treated * scene_effect[m] + view_level[m]
                noise = noise + rng.normal(0, plan.trial_noise)
                noise = noise + rng.normal(0, plan.residual_noise, plan.views)
                views[m] = BASE[m] + treated * plan.effect.get(m, 0.0) + SPREAD[m] * noise
            count = plan.gaussians.get(densify, 20_000)
            path = write_trial(
                runs,
                seed,
                experiment=plan.experiment,
                scene=scene,
                init=init,
                densify=densify,
                _num_gaussians=count + 10 * seed,
                _seconds={"init": 5.0, "train": count / 400 + seed, "evaluate": 2.0},
                **views,
            )
            paths.append(path)
            if plan.pictures:
                write_pictures(path, densify, seed, plan.views)
                write_point_cloud(path, densify, seed)
    return paths


def write_arms(runs, arms, seeds=(0, 1, 2), scenes=("courtyard",), settings=None):
    """Write trials whose results are noise, of arms with these settings of the densifier."""
    rng = np.random.default_rng(0)
    paths = []
    for (name, own), scene, seed in itertools.product(arms.items(), scenes, seeds):
        views = {m: BASE[m] + SPREAD[m] * rng.normal(0, 0.1, 3) for m in METRICS}
        # a hash of its own for each arm, as different settings have
        config_hash = sha256(repr(own).encode()).hexdigest()[:8]
        more = (settings or {}) | {"densify": {"name": name, **own}}
        paths.append(write_trial(runs, seed, config_hash, more, scene=scene, densify=name, **views))
    return paths


def with_record(trial, **values):
    """The trial with these values in its record."""
    return replace(trial, record=replace(trial.record, **values))


def ask_about(
    runs,
    chosen=lambda trial: True,
    experiment="exp",
    metric="psnr",
    seen=None,
    turned=False,
    **asked,
):
    """Write the command that asks about these trials as if before they were trained.

    ``seen`` are the trials measured before; by default those that an earlier command asked about.
    The command lists its trials in the order of their folders, or ``turned`` in the other one.
    Returns the questions.
    """
    home = runs / experiment
    trials = read_experiment(home).trials
    own = with_variants([trial for trial in trials if chosen(trial)])[:: -1 if turned else 1]
    quantity = asked_quantity(metric, own)
    about = {"sign": quantity.direction, "least": quantity.worthwhile} | asked
    known = [trial for trial in trials if (seen or (lambda one: one.record.questions))(trial)]
    planned = {
        trial.path.relative_to(home).as_posix(): PlannedTrial(words=("x",), digest=trial.digest)
        for trial in own
    }

    def make(history):
        found, shown = ask(own, Asked(metric=metric, **about), known, history)
        return Command(
            words=("-m",),
            cwd="/",
            time=1.0,
            trials=planned,
            questions=tuple(found),
            shows=tuple(shown),
        )

    questions = append(home, make).questions
    for trial in own:
        names = [q.id for q in questions if q.has(trial.digest, trial.scene, trial.seed)]
        record = read_json(trial.path / "results.json")
        write(trial.path / "results.json", record | {"questions": trial.record.questions + names})
    return questions
