"""The tables and curves of docs/findings.md and docs/first_findings.md, from the files that are kept in docs/findings/.

    python scripts/findings.py collect RUNS   copy what the page needs out of a runs folder
    python scripts/findings.py                write the tables into both pages and draw the curves

A table of differences is one family of tests (Holm). It stands in the page as ``differences of EXPERIMENT`` (every arm
minus the baseline) or as ``differences of EXPERIMENT: ARM, ARM against ARM``. The page's own test makes the tables anew
and compares.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import findings_archives as archives
import findings_trends as trends
import pandas as pd
from findings_pairs import arms_of, baseline, difference, facts, pair, row, with_arms
from PIL import Image

from gsbench.analysis.frame import to_frame
from gsbench.analysis.per_view import read_views
from gsbench.analysis.results import Experiment, read_experiment
from gsbench.analysis.statistics import Comparison, compare_family
from gsbench.runs.experiments import list_experiments

DOCS = Path(__file__).parents[1] / "docs"
PAGES = (DOCS / "findings.md", DOCS / "first_findings.md")
DATA = DOCS / "findings"
EXPERIMENTS = ("bonsai_growth", "fair_governor", "fair_hard", "initialisers")
METRICS = {"lpips_squeeze": ("LPIPS (squeeze)", 3), "psnr": ("PSNR, dB", 2), "ssim": ("SSIM", 3), "flip": ("FLIP", 3)}
WHICH = ["scene", "init", "densify", "seed", "iterations", "width", "height"]
CAUSES = ["cloned", "split_gradient", "split_volume", "isotropic_resplit", "blocked_by_cap", "pruned_opacity"]
SECTION = re.compile(
    r"(<!-- (?P<table>\w+) of (?P<experiment>\w+)(?:: (?P<arms>[\w., -]+) against (?P<against>[\w.-]+))? -->\n)"
    r".*?<!-- end -->",
    re.DOTALL,
)


def collect(runs: Path) -> None:
    """Write archives, one row a trial, and the count after every round, into the files beside the pages."""
    DATA.mkdir(exist_ok=True)
    archives.collect(runs)
    kept = [*WHICH, "num_init_points", "num_gaussians", "seconds_train", *METRICS, *(f"event_{c}" for c in CAUSES)]
    for name in EXPERIMENTS:
        if name in list_experiments(runs):
            experiment = read_experiment(runs / name)
            to_frame(experiment).reindex(columns=kept).to_csv(DATA / f"{name}.csv", index=False, float_format="%.9g")
            _rounds(experiment).to_csv(DATA / f"{name}_rounds.csv", index=False, float_format="%.5g")
            if name == "bonsai_growth":
                _picture(experiment).save(DATA / f"{name}.png")


def _rounds(experiment: Experiment) -> pd.DataFrame:
    """The count after every round of the first seed, and what the governor did to the thresholds."""
    rows = []
    for trial in experiment.trials:
        if trial.seed == min(t.seed for t in experiment.trials):
            for line in (trial.path / "events.jsonl").read_text().splitlines():
                event = json.loads(line)
                row = {"scene": trial.scene, "init": trial.init, "densify": trial.densify, "step": event["step"]}
                rows.append(
                    row | {"count": event["after"], "strictness": event.get("strictness"), "cull": event.get("cull")}
                )
    return pd.DataFrame(rows).dropna(axis=1, how="all")


def _picture(experiment: Experiment, zoom: int = 2) -> Image.Image:
    """A held-out view as photograph, by adc, by the best and the worst seed of volumetric, and by volumetric_once.

    It is the view in whose PSNR the seeds of volumetric differ the most; the other arms are of its worst seed.
    """
    trials = [trial for trial in experiment.trials if trial.densify == "volumetric"]
    trials.sort(key=lambda trial: -trial.metrics["psnr"])
    best, worst = read_views(trials[0]), read_views(trials[-1])
    name = max(best, key=lambda view: abs(best[view]["psnr"] - worst[view]["psnr"]))
    beside = {trial.densify: trial for trial in experiment.trials if trial.seed == trials[-1].seed}
    shown = (beside["adc"], trials[0], trials[-1], beside["volumetric_once"])
    folders = [shown[0].path / "ground_truth", *(trial.path / "renders" for trial in shown)]
    pictures = [Image.open(folder / f"{Path(name).stem}.png") for folder in folders]
    width, height = pictures[0].width * zoom, pictures[0].height * zoom
    joined = Image.new("RGB", (len(pictures) * (width + 4) - 4, height), "white")
    for index, picture in enumerate(pictures):
        joined.paste(picture.resize((width, height), Image.Resampling.NEAREST), (index * (width + 4), 0))
    return joined


def arms_table(frame: pd.DataFrame) -> list[str]:
    """An arm a row: mean over scenes of the mean over seeds, and the deviation of that mean's trials over seeds."""
    columns = {"num_gaussians": ("Gaussians", 0), **METRICS, "seconds_train": ("training, s", 0)}
    lines = [row(["arm", *(title for title, _ in columns.values())]), row(["---"] + ["--:"] * len(columns))]
    for arm in arms_of(frame):
        own = frame[frame.arm == arm]
        by_seed = own.groupby("seed")[list(columns)].mean()
        cells = [f"{by_seed[k].mean():,.{d}f} ± {by_seed[k].std():,.{d}f}" for k, (_, d) in columns.items()]
        lines.append(row([arm, *cells]))
    return lines


def clouds_table(frame: pd.DataFrame) -> list[str]:
    """Points of the initial cloud by arm and scene."""
    return _by_scene(frame, "initial points", lambda own: f"{own.num_init_points.iloc[0]:,.0f}")


def scenes_table(frame: pd.DataFrame) -> list[str]:
    """LPIPS by arm and scene: mean over seeds and its trials' deviation."""
    return _by_scene(frame, "arm", lambda own: f"{own.lpips_squeeze.mean():.3f} ± {own.lpips_squeeze.std():.3f}")


def _by_scene(frame: pd.DataFrame, title: str, cell: Callable[[pd.DataFrame], str]) -> list[str]:
    scenes = list(dict.fromkeys(frame.scene))
    lines = [row([title, *scenes]), row(["---"] + ["--:"] * len(scenes))]
    for arm in arms_of(frame):
        groups = [frame[(frame.arm == arm) & (frame.scene == scene)] for scene in scenes]
        lines.append(row([arm, *("" if own.empty else cell(own) for own in groups)]))
    return lines


def differences_table(frame: pd.DataFrame, against: str | None = None, arms: Sequence[str] | None = None) -> list[str]:
    """Table of each arm minus ``against`` in each metric: mean, 95 % interval, p adjusted over the whole table (Holm).

    Bold is what the program would decide. Nothing is called better or worse, since no metric was declared.
    """
    against = against or baseline(frame)
    found = compared(frame, against, arms)
    lines = [
        row([f"minus {against}", *(title for title, _ in METRICS.values())]),
        row(["---"] * (1 + len(METRICS))),
    ]
    for arm in dict.fromkeys(arm for arm, _ in found):
        lines.append(row([arm, *(difference(found[arm, metric], METRICS[metric][1]) for metric in METRICS)]))
    return lines


def compared(
    frame: pd.DataFrame, against: str | None = None, arms: Sequence[str] | None = None
) -> dict[tuple[str, str], Comparison]:
    """Compare each of ``arms`` (default: all others) with ``against`` in each metric, as one family of tests."""
    against = against or baseline(frame)
    keys = [(arm, metric) for arm in arms or arms_of(frame) if arm != against for metric in METRICS]
    members = [(pair(frame, arm, metric, against), facts(metric).direction) for arm, metric in keys]
    return dict(zip(keys, compare_family(members), strict=True))


def events_table(frame: pd.DataFrame) -> list[str]:
    """Table of what the refinements did, by cause, in thousands of Gaussians, as the mean of the trials."""
    causes = [c for c in frame.columns if c.startswith("event_")]
    lines = [row(["arm", *(c.removeprefix("event_").replace("_", " ") for c in causes)])]
    lines.append(row(["---"] + ["--:"] * len(causes)))
    for arm in arms_of(frame):
        means = frame[frame.arm == arm][causes].mean()
        lines.append(row([arm, *(f"{value / 1000:,.1f}" for value in means)]))
    return lines


def read(name: str) -> pd.DataFrame:
    """The trials of an experiment, with their arms."""
    return with_arms(pd.read_csv(DATA / f"{name}.csv"))


TABLES = {
    "arms": arms_table,
    "clouds": clouds_table,
    "scenes": scenes_table,
    "differences": differences_table,
    "events": events_table,
}


def with_tables(page: str) -> str:
    """The page with every table made anew."""
    return SECTION.sub(lambda found: found[1] + "\n".join(_table(found)) + "\n<!-- end -->", page)


def _table(found: re.Match[str]) -> list[str]:
    name, arms = found["experiment"], found["arms"].split(", ") if found["arms"] else []
    if archives.archive_of(name).is_file():
        if arms and name == trends.BRIDGE:
            return trends.trends_table(name, arms, found["against"])
        if arms:
            return archives.TABLES_OF_ARMS[found["table"]](name, arms, found["against"])
        return archives.TABLES[found["table"]](name)
    frame = read(name)
    if not arms:
        return TABLES[found["table"]](frame)
    return differences_table(frame, found["against"], arms)


def draw() -> None:
    """Counts over the iterations, an arm a line, a scene a panel; below, how far a governor moved thresholds."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    for file in sorted(DATA.glob("*_rounds.csv")):
        rounds = with_arms(pd.read_csv(file)).assign(thousands=lambda frame: frame["count"] / 1000)
        drawn = {"thousands": "Gaussians (thousands)"}
        if "strictness" in rounds:
            drawn["strictness"] = "thresholds, times their own"
        scenes = list(dict.fromkeys(rounds.scene))
        size = (1 + 3.2 * len(scenes), 3 * len(drawn))
        figure, axes = plt.subplots(len(drawn), len(scenes), figsize=size, squeeze=False, sharex="col")
        for (column, label), panels in zip(drawn.items(), axes, strict=True):
            for axis, scene in zip(panels, scenes, strict=True):
                for arm, own in rounds[rounds.scene == scene].groupby("arm", sort=False):
                    axis.plot(own.step, own[column], label=arm)
                axis.set(title=scene, xlabel="iteration", yscale="log" if column == "strictness" else "linear")
            panels[0].set_ylabel(label)
        axes[0][0].legend(fontsize=7)
        figure.tight_layout()
        figure.savefig(file.with_suffix(".png"), dpi=80)
        plt.close(figure)


if __name__ == "__main__":
    if sys.argv[1:2] == ["collect"]:
        collect(Path(sys.argv[2]))
    else:
        for page in PAGES:
            page.write_text(with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")
        draw()
        if archives.archive_of(trends.BRIDGE).is_file():
            trends.draw()
