"""Outputs of 300 random commands and 300 random experiments, frozen before the redesign.

``python -m tests.freeze.trials --write`` writes ``trials.json.gz``; without ``--write`` it compares
and prints each difference. A frozen command has the sha256 of each group of its composed values,
and the keys of its steps as gsbench's unedited code gives them. A frozen experiment has, for each
pair of arms and each metric, the paired seeds and scenes, the mean difference, its standard error,
the degrees of freedom, and the p of its test alone, adjusted for nothing.
"""

import gzip
import json
import math
import random
import sys
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

from tests.trials import write_trial

FILE = Path(__file__).with_name("trials.json.gz")
COUNT = 300
DIGITS = 10  # significant digits of frozen numbers

DENSIFIERS = [
    "adc",
    "volumetric",
    "mcmc",
    "absgs",
    "absgrad",
    "pixelgs",
    "quantile",
    "resgs",
    "revised",
    "steepgs",
    "taming",
    "gns",
    "mrnf",
    "fastgs",
    "edgeaware",
    "longaxis",
    "volumetric_once",
    "none",
]
SETTINGS = {
    "train.iterations": (200, 1500, 7000),
    "train.ssim_weight": (0.1, 0.3),
    "densify.max_gaussians": (5000, 100_000),
    "densify.cap": ("soft", "hard", "freeze"),
    "eval.primary": ("psnr", "ssim", "lpips_vgg_raw", "flip"),
    "scene.max_images": (24, 40),
    "scene.split": ("every_nth", "sector"),
    "threads": (1, 2),
    "train.steps_scaler": (0.1, 0.5),
}
SCENE = ("scene=courtyard", "scene.views=48", "scene.width=64", "scene.height=48")


def command(rng):
    """The words of a random command about a small courtyard."""
    densify = rng.sample(DENSIFIERS, rng.choice((1, 1, 2, 3)))
    words = [
        f"densify={','.join(densify)}",
        f"init={rng.choice(('sfm', 'sfm', 'random', 'sfm_preview'))}",
        f"train={rng.choice(('quick', 'paper', '7k'))}",
        f"raster={rng.choice(('auto', 'cpu', 'reference'))}",
        f"eval={rng.choice(('paper', 'standard'))}",
        f"seed={','.join(map(str, sorted(rng.sample(range(9), rng.choice((1, 2, 3))))))}",
        f"name=frozen{rng.randrange(5)}",
    ]
    for key in rng.sample(sorted(SETTINGS), rng.choice((0, 1, 2, 3))):
        if not key.startswith("densify") or "none" not in densify:
            words.append(f"{key}={rng.choice(SETTINGS[key])}")
    if rng.random() < 0.2 and "none" not in densify:
        words.append("densify.gradient_threshold=0.0001,0.0003")
    return words


def composed(words, runs):
    """The trials of a command: the digests of their groups and the keys of their steps."""
    from gsbench.app.command import compose_trials
    from gsbench.errors import GsbenchError
    from gsbench.pipeline.parts import Parts
    from gsbench.pipeline.trial import TrialSteps
    from gsbench.runs.store import Store

    store = Store(runs / "store")
    try:
        trials = compose_trials([*SCENE, *words, f"runs={runs}"], True)
    except GsbenchError as error:
        return {"refused": type(error).__name__}
    made = []
    for trial in trials:
        values = {key: value for key, value in trial.values.items() if key != "runs"}
        keys = {}
        with suppress(GsbenchError), mock.patch("gsbench.runs.keys.edited", return_value={}):
            for step in TrialSteps(Parts(trial.values), store).steps():
                keys[step.stage.name] = step.key[:16]
                if step.stage.name == "scene":
                    store.get(step)
        groups = {key: digest(value) for key, value in values.items()}
        made.append({"values": groups, "keys": keys, "folder": trial.folder.name})
    return {"trials": made}


def digest(value):
    """The first digits of the sha256 of a value's canonical JSON."""
    return sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:12]


def write_experiment(rng, runs):
    """Write the trials of a random experiment: 1 to 4 arms on 1 to 7 scenes with 1 to 5 seeds."""
    scenes = [f"s{k}" for k in range(rng.choice((1, 1, 2, 3, 6, 7)))]
    seeds = range(rng.choice((1, 2, 3, 3, 5)))
    arms = [("adc", {})]
    for _ in range(rng.choice((1, 1, 2, 3))):
        name = rng.choice(("volumetric", "mine", "absgs"))
        settings = {"densify.decay": rng.choice((1, 2))} if rng.random() < 0.4 else {}
        if (name, settings) not in arms:
            arms.append((name, settings))
    lost = 0.1 if rng.random() < 0.3 else 0.0
    for densify, settings in arms:
        effect = rng.choice((0.0, 0.0, 0.3, -0.5))
        for scene in scenes:
            for seed in seeds:
                views = {
                    "psnr": [24 + effect + rng.gauss(0, 0.2) for _ in range(3)],
                    "ssim": [0.8 + effect / 50 + rng.gauss(0, 0.01) for _ in range(3)],
                    "lpips_vgg_raw": [0.25 - effect / 50 + rng.gauss(0, 0.01) for _ in range(3)],
                }
                if rng.random() < lost:
                    continue
                own = digest([densify, settings])[:8]
                where = {"scene": scene, "densify": densify}
                write_trial(runs, seed, own, settings, **where, **views)


def pairs_of(runs):
    """The tests of all pairs of arms in all metrics, by names of arms and metric."""
    from gsbench.analysis.comparison import compare
    from gsbench.analysis.results import load_experiment

    found = {}
    for answer in compare(load_experiment(runs, "exp")).answers:
        for verdict in (answer.verdict, *answer.metrics):
            test = verdict.test
            pairs = verdict.pairs
            name = f"{answer.arm} - {answer.baseline}, {verdict.quantity.name}"
            found[name] = {
                "shape": list(pairs.differences.shape),
                "mean": rounded(verdict.mean),
                "baseline": rounded(pairs.baseline),
                "error": rounded(test.error) if test else None,
                "degrees": test.degrees if test else None,
                "p": rounded(test.p) if test else None,
            }
    return found


def rounded(number):
    """The number with `DIGITS` significant digits; None stays None."""
    if number is None or not math.isfinite(number):
        return None
    return float(f"{number:.{DIGITS - 1}e}")


def outputs():
    """All frozen outputs, made by the present code."""
    commands, experiments = [], []
    with TemporaryDirectory() as folder:
        for number in range(COUNT):
            words = command(random.Random(f"command {number}"))
            commands.append({"words": words, **composed(words, Path(folder))})
    for number in range(COUNT):
        with TemporaryDirectory() as folder:
            write_experiment(random.Random(f"experiment {number}"), Path(folder))
            experiments.append(pairs_of(Path(folder)))
    return {"commands": commands, "experiments": experiments}


def differences(before, after, place=""):
    """A line for each place where two nested values differ."""
    if isinstance(before, dict) and isinstance(after, dict):
        return [
            line
            for key in sorted({*before, *after})
            for line in differences(before.get(key), after.get(key), f"{place}/{key}")
        ]
    if isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        return [
            line
            for k, both in enumerate(zip(before, after, strict=True))
            for line in differences(*both, f"{place}/{k}")
        ]
    return [] if before == after else [f"{place}: {before} -> {after}"]


def main(words):
    found = json.loads(json.dumps(outputs()))
    if words == ["--write"]:
        with gzip.GzipFile(FILE, "wb", mtime=0) as file:
            file.write(json.dumps(found).encode())
        return 0
    with gzip.open(FILE) as file:
        lines = differences(json.load(file), found)
    print("\n".join(lines) or "nothing differs")
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
