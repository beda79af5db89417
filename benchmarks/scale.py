"""Time how long verbs take to read an experiment of thousands of finished, made-up trials.

    python -m benchmarks.scale FOLDER [SCENES ARMS SEEDS]

prints a line for each verb, and one for the dry run of a sweep of as many further trials: its name,
CPU seconds and wall seconds of the whole command.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from gsbench.runs.code import config_hash
from gsbench.runs.configuration import sha256_of
from gsbench.runs.trial_folder import TrialFolder
from tests.trials import record_of

NAME = "scale"
VERBS = (["tables", NAME], ["status", NAME], ["report", NAME])
DENSIFIERS = "adc absgrad absgs edgeaware longaxis mcmc pixelgs revised taming volumetric".split()  # noqa: SIM905


def values_of(runs: Path, scene: int, arm: int, seed: int) -> dict[str, Any]:
    """As many settings as a real trial has; every second arm is a variant of the one before."""
    groups = {
        group: {f"setting_{k}": k / 7 for k in range(20)}
        for group in ("scene", "init", "train", "eval")
    }
    densify = {f"setting_{k}": k / 7 for k in range(20)} | {
        "name": "adc" if arm < 2 else f"arm{arm // 2}",
        "volume_threshold": 0.03 if arm % 2 else 0.3,
    }
    names: dict[str, Any] = {
        "name": NAME,
        "seed": seed,
        "runs": str(runs),
        "tracking": {"name": "none"},
        "launch": {},
    }
    return (
        names
        | groups
        | {
            "scene": groups["scene"] | {"name": f"scene{scene:02d}"},
            "init": groups["init"] | {"name": "sfm"},
            "densify": densify,
        }
    )


def write_trial(values: dict[str, Any], psnr: float) -> None:
    """Write the files of a finished trial, as `gsbench.runs.trial_folder` leaves them."""
    folder = TrialFolder.of(values).path
    folder.mkdir(parents=True)
    views = [psnr + k / 10 for k in range(-3, 4)]
    per_view = "view,psnr\n" + "".join(f"v{k},{value!r}\n" for k, value in enumerate(views))
    steps = range(100, 2001, 100)
    curve = "".join(
        json.dumps({"step": k, "loss": 1 / k, "num_gaussians": k, "seconds": k / 10}) + "\n"
        for k in steps
    )
    record = record_of(
        values,
        metrics={"psnr": sum(views) / len(views)},
        hashes={
            "config": config_hash(values),
            "data": values["scene"]["name"],
            "init": "i",
            "cloud": "c",
        },
        resolution=(400, 300),
        init_report={f"number_{k}": k / 3 for k in range(40)},
        machine={"cpu": "c", "architecture": "a", "kernels": "k", "torch": "t", "device": "cpu"},
    )
    published = {f"renders/{k:04d}.png": (18000 + k, 1795342870763741765 + k) for k in range(30)}
    files = {"per_view.csv": per_view, "metrics.jsonl": curve}
    made_of = {
        "config": config_hash(values),
        "results": sha256_of(record.to_json()),
        "digests": {
            name: hashlib.sha256(content.encode()).hexdigest() for name, content in files.items()
        },
        "stages": {},
        "pycolmap": None,
        "sources": {},
        "folders": {},
        "entries": {},
        "published": published,
        "settings": values,
    }
    results = json.dumps(record.to_json() | {"made_of": made_of}, indent=1)
    for name, content in (files | {"results.json": results}).items():
        (folder / name).write_text(content)


def write_all(runs: Path, scenes: int, arms: int, seeds: int) -> int:
    """Write the trials of every scene, arm and seed; returns their number."""
    for scene in range(scenes):
        for arm in range(arms):
            for seed in range(seeds):
                write_trial(
                    values_of(runs, scene, arm, seed),
                    25 + scene / 10 + arm / 20 + (seed * 7 % 5) / 30,
                )
    return scenes * arms * seeds


def dry_run(runs: Path, scenes: int, arms: int, seeds: int) -> list[str]:
    """The words of a sweep that is only listed; its captures are empty folders."""
    captures = [runs / ".captures" / f"scene{k:02d}" for k in range(scenes)]
    for capture in captures:
        (capture / "images").mkdir(parents=True, exist_ok=True)
    limits = [100_000 * (k + 1) for k in range(-(-arms // len(DENSIFIERS)))]
    lists = {
        "scene.path": captures,
        "densify": DENSIFIERS[: -(-arms // len(limits))],
        "densify.max_gaussians": limits,
        "seed": range(seeds),
    }
    words = [f"{key}={','.join(map(str, values))}" for key, values in lists.items()]
    return ["-m", "name=further", "scene=colmap", *words, "--dry-run"]


def timed(runs: Path, argv: list[str]) -> tuple[float, float]:
    """CPU and wall seconds of a command of gsbench."""
    started, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"GSBENCH_RUNS": str(runs)}
    command = [sys.executable, "-m", "gsbench.cli", *argv]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, time.perf_counter() - started


if __name__ == "__main__":
    place = Path(sys.argv[1]).resolve()
    shape = tuple(map(int, sys.argv[2:5])) or (50, 20, 10)
    if not (place / NAME).exists():
        write_all(place, *shape)
    for name, argv in [
        *((words[0], words) for words in VERBS),
        ("dry run", dry_run(place, *shape)),
    ]:
        cpu, wall = timed(place, argv)
        print(f"{name:<8} {cpu:6.1f} s CPU {wall:6.1f} s", flush=True)
