"""Train the paper's tables in small over several days and machines, in a clone of one commit.

    python findings/scripts/paper_tables.py train CLONE EXPERIMENT [SCENE ...]
    python findings/scripts/paper_tables.py save CLONE EXPERIMENT

``CLONE`` is a checkout of the commit that the page names, with its own environment in ``.venv``.
``train`` first unpacks ``findings/archives/EXPERIMENT.zip`` into ``$GSBENCH_RUNS``, if nothing of
the experiment is there. It then trains scene by scene and seed by seed what has no result yet: all
arms of a scene and seed by one command. It can be killed and started again at any time, and two
processes can train different scenes. ``save`` writes the archive, with all trials so far, and
beside it ``EXPERIMENT.csv`` with what archives lack: the share of volumes below V_th. (The CPU time
is that of trainings one by one, by an earlier form of ``train``.)
"""

from __future__ import annotations

import csv
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from gsbench.claims.archive import unpack_archive

FINDINGS = Path(__file__).resolve().parents[1]
LINE = re.compile(r"^(\w+) +(?P<scene>\S+?)/\S+ seed (?P<seed>\d+) \(\w+\)")
THRESHOLD = 0.03  # V_th of the paper
GIVEN = "dataset-"  # in the names of arms that start from the scene's own cloud
CURVE = "paper_curve"  # the experiment that sweeps the number of Gaussians
PAGE = FINDINGS / "paper_tables.md"
STATE, END = "<!-- state {} -->", "<!-- end -->"  # around the table of an experiment
FIELDS = ("trial", "cpu_seconds", "gaussians", "share_below_threshold")


def gsbench(clone: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the clone's gsbench; its output is returned only if it is not written to a log."""
    return subprocess.run(
        [clone / ".venv/bin/gsbench", *words], cwd=clone, check=False, text=True, stdout=-1
    )


def words_of(clone: Path, experiment: str) -> list[str]:
    return [f"hydra.searchpath=['file://{clone}/findings']", f"+experiment={experiment}"]


def missing(clone: Path, experiment: str, scenes: list[str]) -> list[tuple[str, str]]:
    """The scenes and seeds that lack a result of some arm, scene by scene."""
    listed = gsbench(clone, *words_of(clone, experiment), "--dry-run").stdout.splitlines()
    lines = [found for line in listed if (found := LINE.match(line))]
    todo = {(found["scene"], found["seed"]) for found in lines if found[1] != "done"}
    order = list(dict.fromkeys(found["scene"] for found in lines))
    return sorted(
        (one for one in todo if not scenes or one[0] in scenes),
        key=lambda one: (order.index(one[0]), int(one[1])),
    )


def train(clone: Path, experiment: str, *scenes: str) -> None:
    home = Path(os.environ["GSBENCH_RUNS"]) / experiment
    archive = FINDINGS / "archives" / f"{experiment}.zip"
    if archive.exists() and not home.exists():
        code = "import sys, pathlib; from gsbench.claims.archive import unpack_archive;"
        code += "unpack_archive(*map(pathlib.Path, sys.argv[1:]))"
        python = clone / ".venv/bin/python"
        subprocess.run([python, "-c", code, archive, home.parent], check=True)
    while todo := missing(clone, experiment, list(scenes)):
        scene, seed = todo[0]
        print(f"{len(todo)} seeds to go: {scene}, seed {seed}", flush=True)
        one = [f"scene.path={os.environ['GSBENCH_DATA']}/{scene}", f"seed={seed}"]
        done = gsbench(clone, *words_of(clone, experiment), *one)
        print(done.stdout[-2000:], flush=True)
        if done.returncode:
            sys.exit(done.returncode)


def share_below(model: Path) -> tuple[int, float]:
    """How many Gaussians a PLY of 3DGS has, and the share with a volume of at most V_th.

    The volume is that of eq. 5 of the paper: 4/3 π times the three scales.
    """
    from plyfile import PlyData

    vertex = PlyData.read(model)["vertex"]
    volumes = (
        4 / 3 * np.pi * np.exp(sum(vertex[f"scale_{axis}"].astype(float) for axis in range(3)))
    )
    return len(volumes), float((volumes <= THRESHOLD).mean())


def save(clone: Path, experiment: str) -> None:
    home = Path(os.environ["GSBENCH_RUNS"]) / experiment
    archives = FINDINGS / "archives"
    exported = gsbench(
        clone, "export", "--results", experiment, "--out", str(archives / f"{experiment}.zip")
    )
    print(exported.stdout, end="")
    table = archives / f"{experiment}.csv"
    rows = dict[str, dict[str, str]]()
    if table.exists():
        with table.open() as stream:
            rows = {row["trial"]: row for row in csv.DictReader(stream)}
    for results in sorted(home.glob("*/*/*-seed*/results.json")):
        name = name_of(json.loads(results.read_text(encoding="utf-8")))
        model = results.parent / "point_cloud.ply"
        if model.exists():  # else it was trained elsewhere, and is in the files already
            count, share = share_below(model)
            values = (name, "", str(count), f"{share:.6f}")
            rows[name] = dict(zip(FIELDS, values, strict=True))
    with table.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, FIELDS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows.values())
    PAGE.write_text(with_state(PAGE.read_text(encoding="utf-8"), experiment), encoding="utf-8")


def results_in(archive: Path) -> list[dict[str, Any]]:
    """The results of an archive's trials."""
    with tempfile.TemporaryDirectory() as folder:
        unpack_archive(archive, Path(folder))
        files = sorted(Path(folder).glob("*/*/*/*/results.json"))
        return [json.loads(file.read_text(encoding="utf-8")) for file in files]


def state_table(experiment: str) -> str:
    """The page's table of all trials in the archive."""
    archives = FINDINGS / "archives"
    with (archives / f"{experiment}.csv").open() as stream:
        beside = {row["trial"]: row for row in csv.DictReader(stream)}
    table = ["| trial | PSNR | SSIM | LPIPS VGG raw | Gaussians | volumes ≤ V_th | CPU-s |"]
    table += ["|---|--:|--:|--:|--:|--:|--:|"]
    for trial in sorted(results_in(archives / f"{experiment}.zip"), key=_order):
        own = beside[name_of(trial)]
        psnr, ssim, lpips = (trial["metrics"][key] for key in ("psnr", "ssim", "lpips_vgg_raw"))
        share = 100 * float(own["share_below_threshold"])
        table.append(
            f"| {trial['scene']}, {arm_of(trial)}, seed {trial['seed']} | {psnr:.2f} | "
            f"{ssim:.3f} | {lpips:.4f} | {trial['num_gaussians']:,} | {share:.2f} % | "
            f"{own['cpu_seconds'] or '–'} |"
        )
    return "\n".join(table) + "\n"


def arm_of(trial: dict[str, Any]) -> str:
    """The arm of a result, such as sfm-adc; without the initialiser if that is ``dataset``.

    In `CURVE`, arms of one name differ in their number of Gaussians, which comes last.
    """
    count = f"-{trial['budget']['max_gaussians']}" if trial["experiment"] == CURVE else ""
    return f"{trial['init']}-{trial['densify']}{count}".removeprefix(GIVEN)


def name_of(trial: dict[str, Any]) -> str:
    return f"{trial['scene']}-{arm_of(trial)}-{trial['seed']}"


def _order(trial: dict[str, Any]) -> tuple[str, int, str]:
    return trial["scene"], trial["seed"], arm_of(trial)


def with_state(page: str, experiment: str) -> str:
    """The page with the table of the archive's trials between its marks."""
    mark = STATE.format(experiment)
    before, found, rest = page.partition(mark)
    if not found:
        raise ValueError(f"the page has no {mark}")
    return f"{before}{mark}\n{state_table(experiment)}{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    {"train": train, "save": save}[sys.argv[1]](Path(sys.argv[2]).resolve(), *sys.argv[3:])
