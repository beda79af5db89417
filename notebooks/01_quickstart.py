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
# # Quickstart
#
# A **trial** is one scene, one initial cloud, one densifier and one seed. It has three stages: initialise, train,
# evaluate. This notebook runs two trials on the built-in courtyard, without any download, and looks at the results.
# It takes some minutes on a CPU. On Colab or any other Jupyter, first install gsbench in a cell (`%pip install …`).

# %%
import json
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from PIL import Image

from gsbench.cli import run

os.environ["GSBENCH_RUNS"] = tempfile.mkdtemp(prefix="gsbench-")  # results go below this folder
runs = Path(os.environ["GSBENCH_RUNS"])

# %% [markdown]
# ## Settings
#
# Every setting is a word `key=value`, the same here and on the command line. gsbench's own tests set `GSBENCH_SMALL`:
# then the scene is smaller, iterations are fewer, and the pictures are worse.

# %% tags=["parameters"]
small = bool(os.environ.get("GSBENCH_SMALL"))
if small:
    settings = ["scene.views=10", "scene.width=96", "scene.height=72"]
    settings += ["init=random", "init.count=2000", "init.size=1.2"]
    settings += [
        "train.iterations=200",
        "train.position_steps=200",
        "train.densify_start=50",
        "train.densify_stop=180",
    ]
    settings += ["train.densify_interval=25"]
else:
    settings = [
        "scene.views=24",
        "scene.width=240",
        "scene.height=180",
        "init=sfm",
        "train.iterations=1500",
    ]
settings += ["eval.lpips=[]", "tracking=none"]

# %% [markdown]
# ## A trial from Python
#
# `run` is the command line as a function. It returns 0 when all went well.

# %%
run(["scene=courtyard", "densify=volumetric", "seed=0", "name=quickstart", *settings])

# %% [markdown]
# ## A trial from the command line
#
# In a terminal, type `gsbench scene=courtyard densify=adc …`. ADC, the adaptive density control of 3D Gaussian
# Splatting, is the baseline. Both trials share the photographs and the initial cloud: gsbench does not make them again.

# %%
words = " ".join(["scene=courtyard", "densify=adc", "seed=0", "name=quickstart", *settings])
# !TERM=dumb gsbench {words}

# %% [markdown]
# ## The results
#
# This table of the experiment comes from the files of its trials:

# %%
# !gsbench tables quickstart

# %% [markdown]
# Each trial has a folder. `results.json` is written last, so a trial that has one is complete.

# %%
finished = sorted(runs.glob("quickstart/*/*/*/results.json"))
folders = {path.parent.parent.name.split("-")[1]: path.parent for path in finished}
for folder in folders.values():
    print(folder.relative_to(runs))
    print("   ", ", ".join(sorted(path.name for path in folder.iterdir())))

# %%
results = {
    name: json.loads((folder / "results.json").read_text()) for name, folder in folders.items()
}
for name, result in results.items():
    metrics = ", ".join(f"{key} {value:.3f}" for key, value in result["metrics"].items())
    print(
        f"{name:>10}: {metrics}; {result['num_init_points']:,} points became {result['num_gaussians']:,} Gaussians"
    )

# %% [markdown]
# ## Renders beside the ground truth
#
# Every eighth photograph is held out for testing. A metric compares exactly these pictures.

# %%
truths = sorted((folders["adc"] / "ground_truth").glob("*.png"))
figure, axes = plt.subplots(len(truths), 3, figsize=(11, 2.8 * len(truths)), squeeze=False)
for row, truth in zip(axes, truths, strict=True):
    pictures = {"ground truth": truth} | {
        name: folder / "renders" / truth.name for name, folder in folders.items()
    }
    for axis, (title, path) in zip(row, pictures.items(), strict=True):
        axis.imshow(Image.open(path))
        axis.set_title(f"{title} {truth.stem}")
        axis.axis("off")
figure.tight_layout()

# %% [markdown]
# ## How the model grew
#
# `metrics.jsonl` has the loss and the number of Gaussians over the iterations. Where the loss jumps up, ADC has reset
# the opacities: Gaussians that the picture needs become opaque again, and the others are removed.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.2))
for name, folder in folders.items():
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    steps = [row["step"] for row in rows]
    left.plot(steps, [row["num_gaussians"] for row in rows], label=name)
    right.plot(steps, [row["loss"] for row in rows], label=name, alpha=0.7)
left.set(xlabel="iteration", ylabel="Gaussians")
right.set(xlabel="iteration", ylabel="loss", yscale="log")
left.legend()
figure.tight_layout()

# %% [markdown]
# Two trials say little: another seed gives another number. [Reading a result](03_reading_a_result.ipynb) repeats them
# and asks whether the difference is more than chance. To look at both models in the browser:
#
#     gsbench view quickstart:courtyard:adc quickstart:courtyard:volumetric
