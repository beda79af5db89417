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
# # Writing your own densifier
#
# A densifier decides when Gaussians are added and removed. Yours is a Python class in your own file; gsbench itself
# stays as it is. The idea of this notebook: late in training, gradients are small and noisy. So *raise the gradient
# threshold during training*.

# %%
import json
import logging
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

from gsbench.cli import run

os.chdir(tempfile.mkdtemp(prefix="gsbench-"))  # the class and the results go here
os.environ["GSBENCH_RUNS"] = "runs"
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
    settings += ["train.densify_interval=25"]
else:
    settings = [
        "scene.views=24",
        "scene.width=240",
        "scene.height=180",
        "init=sfm",
        "train.iterations=1500",
    ]
settings += ["eval.lpips=[]", "eval.flip=false", "tracking=none"]

# %% [markdown]
# ## The class
#
# It extends `ADC`, the baseline, and is a dataclass: its fields are its settings. For each Gaussian, `ADC` gathers the
# sum of its screen gradients and the number of iterations that saw it. Gaussians with a large mean are cloned or split.
# A round is a list of rules, each a method: `grow_by_gradient`, `prune`, `reset_statistics`. So it is enough to scale
# the sums before the first rule reads them; the last rule resets them after each round.

# %%
# %%writefile tightening.py
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge

from gsbench.densify import ADC


@dataclass
class Tightening(ADC):
    """ADC whose gradient threshold rises linearly, to ``final_factor`` times its value at ``stop``."""

    final_factor: Annotated[float, Ge(1)] = 3.0

    def grow_by_gradient(self, refinement):
        progress = (refinement.step - self.start) / (self.stop - self.start)
        self.statistics["gradient_sum"] /= 1 + (self.final_factor - 1) * progress
        super().grow_by_gradient(refinement)


# %% [markdown]
# ## Run it beside the baseline
#
# `densify=adc` starts from the settings of ADC, `_target_` names our class, and `+` adds a setting that ADC does not
# have. `allow_targets` says that we trust this module: otherwise gsbench does not run it. The same words work in a
# terminal.

# %%
own = [
    "densify=adc",
    "densify._target_=tightening.Tightening",
    "densify.name=tightening",
    "+densify.final_factor=3",
]
common = ["scene=courtyard", "seed=0", "name=own", "allow_targets=[tightening]", *settings]
run(["densify=adc", *common])
run([*own, *common])

# %% [markdown]
# Settings are checked against their annotations. A wrong value is one line that names the key, and exit code 2:

# %%
run([*own[:-1], "+densify.final_factor=0.5", *common, "name=wrong"])

# %% [markdown]
# ## What it did
#
# Every refinement writes an event: how many Gaussians were cloned, split and pruned. The counts always add up: `after =
# before + cloned + split − pruned`.

# %%
folders = {
    path.parent.parent.name.split("-")[1]: path.parent
    for path in Path("runs/own").glob("*/*/*/results.json")
}
events = {}
for name, folder in sorted(folders.items()):
    events[name] = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    total = {
        key: sum(event[key] for event in events[name])
        for key in ("cloned", "split_gradient", "pruned_opacity")
    }
    print(f"{name:>10}: {total}")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.4))
for name in events:
    steps = [event["step"] for event in events[name]]
    left.plot(steps, [event["after"] for event in events[name]], label=name)
    right.plot(
        steps, [event["cloned"] + event["split_gradient"] for event in events[name]], label=name
    )
left.set(xlabel="iteration", ylabel="Gaussians")
right.set(xlabel="iteration", ylabel="added in one refinement")
left.legend()
figure.tight_layout()

# %% [markdown]
# ## Compare

# %%
# !gsbench tables own

# %% [markdown]
# Fewer Gaussians for a similar picture, or a worse picture because there are fewer? One trial cannot tell. Give each
# arm `seed=0,1,2` with `-m`, and equal counts with `densify.max_gaussians=… densify.cap=governor`. Then read the result
# as in [Reading a result](03_reading_a_result.ipynb). `docs/densifier.md` has the whole contract, also for densifiers
# that do not extend ADC.
