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
# # Reading a result
#
# Baseline and idea, several seeds each: is the difference more than chance, and where in the picture is it? This
# notebook runs a small sweep and reads it with the functions behind `gsbench tables` and `gsbench report`.

# %%
import logging
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from IPython.display import HTML, Markdown

from gsbench.analysis import load_experiment, to_frame
from gsbench.analysis.comparison import compare
from gsbench.analysis.images import choose_views
from gsbench.analysis.pairs import pair_trials
from gsbench.analysis.planning import seeds_needed
from gsbench.analysis.table_formats import to_markdown
from gsbench.analysis.tables import build_table
from gsbench.cli import run

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
        "train.iterations=150",
        "train.position_steps=150",
        "train.densify_start=30",
        "train.densify_stop=140",
    ]
    settings += ["train.densify_interval=20"]
    init = "random"
else:
    settings = [
        "scene.views=24",
        "scene.width=240",
        "scene.height=180",
        "init=sfm",
        "train.iterations=1000",
    ]
    init = "sfm"
settings += ["eval.lpips=[]", "eval.flip=false", "tracking=none"]

# %% [markdown]
# ## The sweep
#
# `-m` and commas: every combination is one trial. Two arms, three seeds, six trials.

# %%
run(["-m", "scene=courtyard", "densify=adc,volumetric", "seed=0,1,2", "name=reading", *settings])

# %% [markdown]
# ## The table
#
# A cell is the mean over trials, with their deviation. Bold means: best, and shown to be.

# %%
experiment = load_experiment(runs, "reading")
Markdown(to_markdown(build_table(experiment)))

# %% [markdown]
# Or take everything as a data frame for pandas, one row a trial. `gsbench tables reading --format trials` writes the
# same as CSV.

# %%
frame = to_frame(experiment)
frame[
    [
        "densify",
        "seed",
        "psnr",
        "ssim",
        "num_gaussians",
        "seconds_train",
        "event_cloned",
        "event_split_volume",
    ]
]

# %%
frame.groupby("densify")[["psnr", "num_gaussians"]].agg(["mean", "std", "min", "max"]).round(2)

# %% [markdown]
# ## Seeds are paired
#
# The same seed means the same order of photographs in both arms, and every trial is measured on the same test views.
# So we look at differences: volumetric minus baseline, for each seed. Before it trained anything, the command above
# wrote its question: is volumetric's PSNR other than that of adc? `compare` answers the questions of an experiment.

# %%
(answer,) = compare(experiment).answers
adc, volumetric, verdict = answer.baseline, answer.arm, answer.verdict
(differences,) = verdict.pairs.differences  # [seeds], one row a scene

plt.figure(figsize=(7, 3))
plt.plot(range(len(differences)), differences, "o", color="C0")
plt.axhline(differences.mean(), color="C3", linewidth=2)
plt.axhline(0, color="grey", linewidth=1)
plt.xticks(range(len(differences)))
plt.xlabel("seed")
plt.ylabel("PSNR difference, dB")
plt.title("one dot a pair of trials; their mean in red")
plt.tight_layout()

# %% [markdown]
# The views of one trial share its training, so they are not independent repetitions. A test counts pairs of trials:
# here there are three.
#
# ## The verdict
#
# *Better* or *worse*: the interval of the mean difference lies on one side of zero. *Undecided*: these trials cannot
# tell; that does not mean *no difference*. A question that names the least difference that matters has one more
# outcome, *too small*: the interval lies within ± that difference.

# %%
print(f"mean difference  {verdict.mean:+.3f} dB ({verdict.relative:+.2%})")
print(f"interval         {verdict.interval.low:+.3f} to {verdict.interval.high:+.3f} dB")
print(f"p                {verdict.p:.3f}, at the level {verdict.level:.2g}")
print(answer.line)

# %% [markdown]
# Few trials show only a large difference. How many seeds does a given difference need, to be seen in eight of ten such
# experiments?

# %%
for difference in (0.05, 0.1, 0.2, 0.5):
    print(
        f"{difference:4} dB: {seeds_needed(verdict.deviation, 1, difference) or 'more than 40'} seeds an arm"
    )

# %% [markdown]
# More seeds tell more about *this* scene only. For "scenes like these", gsbench needs at least six scenes; then the
# scenes are the units.
#
# ## Where it helps
#
# These are the views with the largest and the least gain, as in the report. In the last picture, blue means that
# volumetric is nearer to the photograph, red that adc is.

# %%
views, _ = choose_views(pair_trials(experiment.trials, adc, volumetric))
rows = []
for view in (views[-1], views[0]):
    pictures = [
        (view.first, "adc"),
        (view.second, "volumetric"),
        (view.difference, "where they differ"),
    ]
    cells = "".join(
        f'<td><img src="{uri}" width="200"><br>{name or "where they differ"}</td>'
        for uri, name in pictures
    )
    rows.append(f"<tr>{cells}</tr><tr><td colspan=3>{view.which}: {view.view}</td></tr>")
HTML(f"<table>{''.join(rows)}</table>")

# %% [markdown]
# ## Is the comparison fair?
#
# More Gaussians usually mean a better picture. If the arms end with different counts, compare again at equal counts:
# `gsbench +experiment=budget` gives every arm exactly the same number.

# %%
for arm in (adc, volumetric):
    counts = [trial.record.num_gaussians for trial in experiment.trials if trial.arm == arm]
    print(f"{arm.densify:>10}: {', '.join(f'{count:,}' for count in counts)} Gaussians")

# %% [markdown]
# `gsbench report reading` writes all of this into one file, for every metric and with pictures. `gsbench explain
# reading:courtyard:psnr:volumetric` shows the trials behind one cell of the table.
