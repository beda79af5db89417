# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Choosing the volume threshold
#
# The volumetric rule splits every Gaussian with a volume $V = \frac{4}{3}\pi s_1 s_2 s_3$ above a threshold $V_{th}$.
# The paper uses $V_{th} = 0.03$ for all its scenes. But a volume has a unit: the cube of the unit of length of the
# camera poses. Structure from motion chooses that unit arbitrarily. So the first question about your own scene is:
# *what does 0.03 mean here?*

# %%
import json
import logging
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from gsbench.cli import run
from gsbench.densify import DensifyContext, Volumetric
from gsbench.densify.volumetric import log_volume
from gsbench.gaussians.initial import gaussians_from_cloud
from gsbench.gaussians.ply import read_ply
from gsbench.init import read_cloud

os.environ["GSBENCH_RUNS"] = tempfile.mkdtemp(prefix="gsbench-")
runs = Path(os.environ["GSBENCH_RUNS"])
logging.disable(logging.INFO)  # only what went wrong

# %% tags=["parameters"]
small = bool(
    os.environ.get("GSBENCH_SMALL")
)  # gsbench's own tests take a smaller scene and fewer iterations
if small:
    settings = ["scene.views=10", "scene.width=96", "scene.height=72"]
    settings += ["init=random", "init.count=2000", "init.size=1.2"]
    settings += [
        "train.iterations=200",
        "train.position_steps=200",
        "train.densify_start=50",
        "train.densify_stop=180",
    ]
    settings += ["train.densify_interval=25", "train.volume_histogram=[50,100,190]"]
else:
    settings = [
        "scene.views=24",
        "scene.width=240",
        "scene.height=180",
        "init=sfm",
        "train.iterations=1000",
    ]
    settings += ["train.volume_histogram=[300,600,950]"]
settings += ["eval.lpips=[]", "eval.flip=false", "tracking=none"]


def trial(name: str, *words: str) -> Path:
    """Run a trial and give its folder."""
    assert run(["scene=courtyard", f"name={name}", *settings, *words]) == 0
    (results,) = runs.glob(f"{name}/*/*/*/results.json")
    return results.parent


# %% [markdown]
# ## The gauge report
#
# Every initialiser writes a report. Its `gauge` says what 0.03 is in this model's unit of length. *Extent* is the
# radius of the cameras' positions, 3DGS's own measure of a scene's size.

# %%
baseline = trial("threshold-adc", "densify=adc")
gauge = json.loads((baseline / "init_report.json").read_text())["gauge"]
extent = gauge["scene_extent"]
print(f"scene extent                           {extent:.3f} units")
print(f"a sphere of volume 0.03 has the radius {gauge['threshold_radius']:.3f} units")
print(
    f"which is                               {gauge['threshold_radius_over_extent']:.1%} of the extent"
)
print(f"V_th / extent³                         {gauge['threshold_over_extent_cubed']:.2e}")

# %% [markdown]
# The courtyard is modelled in metres, so here 0.03 is a ball of 19 cm radius in a yard of some ten metres. If the
# same model is scaled, the number means something else:

# %%
for scale in (0.2, 1, 5):
    share = gauge["threshold_radius"] / (extent * scale)
    print(f"model {scale:3} times as large: the ball's radius is {share:6.1%} of the extent")

# %% [markdown]
# ## The volumes of a trained baseline
#
# Volumes spread over many decades. Almost all are tiny; the rule splits the few large ones.

# %%
gaussians = read_ply(baseline / "point_cloud.ply")
log_volumes = log_volume(gaussians.log_scales)  # [N] natural logarithm
volumes = log_volumes.exp().numpy()
for q in (0.5, 0.9, 0.99, 0.9978, 0.999):
    print(f"{q:7.2%} of the volumes lie below {np.quantile(volumes, q):.2g}")
print(
    f"{(volumes > 0.03).mean():7.2%} lie above 0.03, that is {(volumes > 0.03).sum()} of {len(volumes):,} Gaussians"
)

# %% [markdown]
# The paper reports that 99.78 % of the volumes of Mip-NeRF 360 lie below 0.03. So one way to choose is to use the same
# quantile here.
#
# ## Four ways to set it
#
# | `densify.threshold_mode` | the threshold |
# |---|---|
# | `absolute` | `volume_threshold`, as in the paper |
# | `extent_relative` | `volume_threshold` times the extent cubed: the same in any unit of length |
# | `quantile` | the quantile `volume_quantile` of all volumes, computed at each refinement |
# | `auto` | the upper Tukey fence of log V, third quartile + 1.5 interquartile ranges |

# %%
modes = {
    "absolute, 0.03": Volumetric(volume_threshold=0.03),
    "extent_relative, 0.0002": Volumetric(
        volume_threshold=0.0002, threshold_mode="extent_relative"
    ),
    "quantile, 0.9978": Volumetric(threshold_mode="quantile"),
    "auto": Volumetric(threshold_mode="auto"),
}
thresholds = {}
for name, densifier in modes.items():
    densifier.begin(gaussians, DensifyContext(extent))
    thresholds[name] = np.exp(densifier.log_threshold(log_volumes))
    print(
        f"{name:<24} V_th = {thresholds[name]:.3g}, above it {(volumes > thresholds[name]).mean():.2%}"
    )

# %%
key = json.loads((baseline / "results.json").read_text())["hashes"]["init"]
cloud = read_cloud(runs / "store" / "init" / key / "sparse" / "0")
first = np.log10(
    np.exp(log_volume(gaussians_from_cloud(cloud.points, cloud.colors).log_scales).numpy())
)
plt.figure(figsize=(9, 4))
bins = np.arange(-12, 2, 0.25)
for values, label in ((first, "initial cloud"), (np.log10(volumes), "trained baseline")):
    plt.hist(values, bins, weights=np.full(len(values), 1 / len(values)), alpha=0.5, label=label)
for color, (name, threshold) in zip(("C3", "C4", "C5", "C2"), thresholds.items(), strict=True):
    plt.axvline(np.log10(threshold), color=color, label=name)
plt.xlabel("log10 volume, cubed units of the model")
plt.ylabel("share of the Gaussians")
plt.legend()
plt.tight_layout()

# %% [markdown]
# ## How volumes move during training
#
# `train.volume_histogram` lists iterations at which a trial records the histogram of its volumes.

# %%
plt.figure(figsize=(9, 3.5))
for line in (baseline / "volume_histograms.jsonl").read_text().splitlines():
    record = json.loads(line)
    counts = np.array(record["counts"])
    edges = np.array(record["log10_edges"])
    plt.stairs(counts / counts.sum(), edges, label=f"iteration {record['step']}")
plt.axvline(np.log10(0.03), color="C3", label="0.03")
plt.xlim(-12, 2)
plt.xlabel("log10 volume, cubed units of the model")
plt.ylabel("share of the Gaussians")
plt.legend()
plt.tight_layout()

# %% [markdown]
# ## What the modes do
#
# One trial each. `split_volume` counts the Gaussians that the rule added; the event record of each refinement also
# has the threshold that was used.

# %%
arms = {
    "absolute": ["densify.volume_threshold=0.03"],
    "quantile": ["densify.threshold_mode=quantile"],
    "auto": ["densify.threshold_mode=auto"],
}
folders = {"adc": baseline}
for name, words in arms.items():
    folders[name] = trial(f"threshold-{name}", "densify=volumetric", *words)

# %%
for name, folder in folders.items():
    result = json.loads((folder / "results.json").read_text())
    added, psnr = result["events"]["split_volume"], result["metrics"]["psnr"]
    print(
        f"{name:<9} PSNR {psnr:6.2f} dB  {result['num_gaussians']:>7,} Gaussians  {added:>6,} added by volume"
    )

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.4))
for name, folder in folders.items():
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    steps = [event["step"] for event in events]
    left.plot(steps, [event["after"] for event in events], label=name)
    if name != "adc":
        used = [
            (event["step"], event["volume_threshold"])
            for event in events
            if "volume_threshold" in event
        ]
        right.plot(*zip(*used, strict=True), color=f"C{list(folders).index(name)}", label=name)
left.set(xlabel="iteration", ylabel="Gaussians")
right.set(xlabel="iteration", ylabel="threshold in use", yscale="log")
left.legend()
right.legend()
figure.tight_layout()

# %% [markdown]
# `quantile` always splits the same share, even if no Gaussian stands out. `auto` follows the histogram. Both do not
# depend on the unit of length, so they mean the same in any reconstruction of a scene. We ran each trial once. To learn
# which threshold *helps*, run `gsbench +experiment=threshold` and read its table as in [Reading a
# result](03_reading_a_result.ipynb).
