"""Tables of docs/findings.md that come from published archives of checks, docs/findings/NAME.zip.

Verdicts are those that ``gsbench check conf/claims/NAME.yaml --from docs/findings/NAME.zip`` prints. Whatever else is
shown of the same trials was not declared and is one family of tests (Holm) a table.
"""

from __future__ import annotations

import functools
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from findings_pairs import arms_of, difference, facts, pair, row, with_arms
from findings_pictures import cap_of, for_and_against, worst_views
from numpy.typing import NDArray
from PIL import Image

from gsbench.analysis.frame import to_frame
from gsbench.analysis.pairing import Paired
from gsbench.analysis.results import Experiment, TrialResult, read_experiment
from gsbench.analysis.statistics import MIN_SCENES, Comparison, compare_family, t_interval
from gsbench.claims.archive import unpack_archive, write_archive
from gsbench.claims.file import read_claims
from gsbench.claims.recheck import Recheck, recheck
from gsbench.claims.shares import merge
from gsbench.runs.declaration import EXTRAPOLATION, INTERPOLATION
from gsbench.runs.experiments import list_experiments
from gsbench.words import counted, signed

ROOT = Path(__file__).parents[1]
DATA = ROOT / "docs" / "findings"
ARCHIVED = (
    "findings_volume",
    "findings_longaxis",
    "findings_dimension",
    "findings_full",
    "findings_full_count",
    "findings_matched",
    "findings_exponent",
    "scale_bridge",
    "findings_initialisers",
    "check_volumetric",
)
PICTURES: dict[str, Callable[[Experiment], Image.Image]] = {
    "findings_matched": worst_views,
    "findings_volume": for_and_against,
    "findings_dimension": functools.partial(for_and_against, rule="volumetric-1"),
    "findings_full": functools.partial(for_and_against, kinds=("governor", "soft"), kind_of=cap_of),
    "findings_initialisers": functools.partial(for_and_against, rule="dim", control="sfm", kinds=[INTERPOLATION]),
}
QUESTIONS = {INTERPOLATION: "between", EXTRAPOLATION: "sector"}  # as the page calls them
PRIMARY = "lpips_squeeze"
BUDGET = ("densify.max_gaussians", "densify.cap")
GROWTH = ("event_split_volume", "event_split_gradient", "event_cloned")
OTHERS = {"psnr": 2, "ssim": 3, "ms_ssim": 4, "fsim": 4, "flip": 3}  # metrics that were not declared, and their digits


def archive_of(name: str) -> Path:
    """The published archive of the experiment ``name``, which may not be there."""
    return DATA / f"{name}.zip"


def claims_of(name: str) -> Path | None:
    """The file of claims that the experiment ``name`` is the check of; None where it is a sweep."""
    files = sorted((ROOT / "conf" / "claims").glob("*.yaml"))
    return next((file for file in files if f"\nname: {name}\n" in file.read_text(encoding="utf-8")), None)


@functools.cache
def checked(name: str) -> Recheck:
    """The verdicts of the claims file of this name from its archive."""
    file = claims_of(name)
    assert file is not None
    with tempfile.TemporaryDirectory() as folder:
        return recheck(read_claims(file), [archive_of(name)], Path(folder))


@functools.cache
def trials_of(name: str) -> tuple[TrialResult, ...]:
    """The trials of an archive. Their files are gone afterwards; what is measured and set was read."""
    with tempfile.TemporaryDirectory() as folder:
        trials = unpack_archive(archive_of(name), Path(folder)).trials
        assert all(trial.config for trial in trials)
    return trials


@functools.cache
def read_trials(name: str) -> pd.DataFrame:
    """The trials of an archive, one a row, with their ``arm`` and ``question``."""
    frame = with_arms(to_frame(trials_of(name)))
    return frame.assign(question=[trial.question for trial in trials_of(name)])


def verdicts_table(name: str) -> list[str]:
    """A claim a row: what was asked, the difference with the interval over all looks, the verdict, on what."""
    lines = [row(["claim", "difference", "verdict", "on"]), row(["---"] * 4)]
    for verdict in checked(name).verdicts:
        claim, decision = verdict.claim, verdict.decision
        shown, on = "", ""
        if decision is not None and decision.mean is not None and decision.interval is not None:
            shown = f"{verdict.shown(decision.mean)} ({verdict.shown_interval(decision.interval)})"
            on = f"{counted(len(verdict.by_scene), 'scene')}, {counted(decision.seeds, 'seed')}"
        lines.append(row([f"`{claim.id}`: {claim.arm} − {claim.baseline}", shown, f"**{verdict.word}**", on]))
    return lines


def gaps_table(name: str) -> list[str]:
    """An arm a row: its means over scenes at both questions, and the fall from one to the other."""
    frame = read_trials(name)
    cells = {"psnr": ("PSNR, dB", 2), PRIMARY: ("LPIPS (squeeze)", 3)}
    titles = [f"{title}, {word}" for title, _ in cells.values() for word in (*QUESTIONS.values(), "change")]
    lines = [row(["arm", *titles]), row(["---"] + ["--:"] * len(titles))]
    for arm in arms_of(frame):
        means = [arm]
        for metric, (_, digits) in cells.items():
            one, other = (_mean(frame, arm, question, metric) for question in QUESTIONS)
            means += [f"{one:.{digits}f}", f"{other:.{digits}f}", signed(other - one, f".{digits}f")]
        lines.append(row(means))
    return lines


def scenes_table(name: str, arms: Sequence[str], against: str) -> list[str]:
    """A scene a row: differences in the declared metric by question and arm, with 95 % over the seeds of this scene.

    From `MIN_SCENES` scenes on their mean stands below, with 95 % over the scenes. No interval is adjusted.
    """
    frame = read_trials(name)
    columns = [(question, arm) for question in asked(frame) for arm in arms]
    titles = [f"{arm}, {QUESTIONS[question]}" for question, arm in columns]
    lines = [row(["scene", *titles]), row(["---"] + ["--:"] * len(columns))]
    found = {column: by_scene(frame, column[1], PRIMARY, against, column[0]) for column in columns}
    for scene in dict.fromkeys(frame.scene):
        lines.append(row([scene, *(_plain(found[column][scene]) for column in columns)]))
    if len(found[columns[0]]) >= MIN_SCENES:
        means = [np.array([own.mean() for own in found[column].values()]) for column in columns]
        lines.append(row(["*mean*", *map(_plain, means)]))
    return lines


def _plain(values: NDArray[np.float64]) -> str:
    """Write a mean with Student's interval of 95 %."""
    interval = t_interval(values)
    assert interval is not None
    mean, low, high = (signed(value, ".3f") for value in (float(values.mean()), interval.low, interval.high))
    return f"{mean} ({low} to {high})"


def views_table(name: str) -> list[str]:
    """A scene a row: its held-out views under both splits, how far the nearest training view is, and adc's PSNR."""
    with zipfile.ZipFile(archive_of(name)) as archive, archive.open("per_view.csv") as file:
        views = pd.read_csv(file)
    labels = [trial.label.partition("/")[2] for trial in trials_of(name)]  # below the experiment
    frame = read_trials(name).assign(trial=labels)
    frame = frame[frame.arm == "adc"].merge(views, on="trial", suffixes=("", "_of_view"))
    titles = [
        f"{title}, {word}" for title in ("views", "angle", "distance", "adc's PSNR") for word in QUESTIONS.values()
    ]
    lines = [row(["scene", *titles]), row(["---"] + ["--:"] * len(titles))]
    for scene, own in frame.groupby("scene"):
        groups = [own[own.question == question] for question in QUESTIONS]
        cells = [str(group.view.nunique()) for group in groups]
        cells += [f"{group.angle_to_nearest.median():.1f}°" for group in groups]
        cells += [f"{group.distance_to_nearest.median():.2f}" for group in groups]
        cells += [f"{group.groupby('seed').psnr.first().mean():.2f}" for group in groups]
        lines.append(row([str(scene), *cells]))
    return lines


def clouds_table(name: str) -> list[str]:
    """An initialiser a row: points of its cloud, LPIPS and PSNR in each scene and on average, means over the seeds."""
    frame = read_trials(name)
    columns = {"num_init_points": ",.0f", PRIMARY: ".3f", "psnr": ".2f"}
    by_scene = frame.groupby(["arm", "scene"])[list(columns)].mean()
    scenes = list(dict.fromkeys(frame.scene))
    lines = [row(["initial points; LPIPS; PSNR, dB", *scenes, "*mean*"]), row(["---"] + ["--:"] * (len(scenes) + 1))]
    for arm in arms_of(frame):
        means = [*(by_scene.loc[arm, scene] for scene in scenes), by_scene.loc[arm].mean()]
        lines.append(row([arm, *("; ".join(f"{own[key]:{form}}" for key, form in columns.items()) for own in means)]))
    return lines


def growth_table(name: str, arms: Sequence[str], against: str) -> list[str]:
    """A scene a row, an arm after the other: LPIPS, how many Gaussians both arms have, and what the cap held back."""
    frame = read_trials(name)
    titles = [f"{arm}: {what}" for arm in arms for what in ("LPIPS", "Gaussians", "held back by the cap")]
    lines = [row(["scene", *titles]), row(["---"] + ["--:"] * len(titles))]
    means = frame.groupby(["scene", "arm"])[["num_gaussians", "event_blocked_by_cap"]].mean()
    found = {arm: by_scene(frame, arm, PRIMARY, against, INTERPOLATION) for arm in arms}
    for scene in dict.fromkeys(frame.scene):
        cells = []
        for arm in arms:
            pairs = zip(means.loc[scene, against], means.loc[scene, arm], strict=True)
            cells += [_plain(found[arm][scene]), *(f"{before:,.0f} → {after:,.0f}" for before, after in pairs)]
        lines.append(row([scene, *cells]))
    return lines


def budgets_table(name: str, arms: Sequence[str], against: str) -> list[str]:
    """A budget of a scene and an arm a row: means over the seeds, and LPIPS minus that of ``against`` as in a scene.

    The share is of all that grows what is split by volume; held back is what the cap did not let grow.
    """
    frame = read_trials(name)
    frame = frame.assign(share=by_volume(frame))
    columns = {"num_gaussians": ("Gaussians", 0), "event_blocked_by_cap": ("held back", 0), "share": ("by volume", 2)}
    columns |= {"psnr": ("PSNR, dB", 2), "ssim": ("SSIM", 3), PRIMARY: ("LPIPS", 3)}
    titles = ["scene", "budget", "arm", *(title for title, _ in columns.values()), f"LPIPS − {against}"]
    lines = [row(titles), row(["---"] * 3 + ["--:"] * (len(titles) - 3))]
    for (scene, most, cap), own in frame.groupby(["scene", *BUDGET]):
        for arm in (against, *arms):
            means = own[own.arm == arm][list(columns)].mean()
            cells = [f"{means[key]:,.{digits}f}" for key, (_, digits) in columns.items()]
            last = "" if arm == against else _plain(by_scene(own, arm, PRIMARY, against, INTERPOLATION)[scene])
            lines.append(row([scene, f"{most:,} ({cap})", arm, *cells, last]))
    return lines


def shares_table(name: str, arms: Sequence[str], against: str) -> list[str]:
    """A scene a row: which share of all that grows each arm splits by volume, and its gain over ``against`` in PSNR."""
    frame = read_trials(name)
    lines = [
        row(["scene", "initial points", *(f"{arm}: {what}" for arm in arms for what in ("share", "PSNR, dB"))]),
        row(["---"] + ["--:"] * (1 + 2 * len(arms))),
    ]
    shares = volume_shares(frame)
    gains = {arm: gains_between(frame, arm, "psnr", against) for arm in arms}
    for scene in sorted(dict.fromkeys(frame.scene), key=lambda scene: -shares[scene, arms[0]]):
        points = frame[frame.scene == scene].num_init_points.mean()
        cells = [cell for arm in arms for cell in (f"{shares[scene, arm]:.2f}", signed(gains[arm][scene], ".2f"))]
        lines.append(row([scene, f"{points:,.0f}", *cells]))
    return lines


def volume_shares(frame: pd.DataFrame) -> pd.Series:
    """Return by scene and arm which share of all that grows is split by volume, over all seeds and questions."""
    return by_volume(frame.groupby(["scene", "arm"])[list(GROWTH)].sum())


def by_volume(counts: pd.DataFrame) -> pd.Series:
    """Return by row which share of all that grows is split by volume."""
    return counts[GROWTH[0]] / counts[list(GROWTH)].sum(axis=1)


def gains_between(frame: pd.DataFrame, arm: str, metric: str, against: str) -> pd.Series:
    """Return by scene the difference of two arms between the cameras, the mean over seeds."""
    return pd.Series({s: float(own.mean()) for s, own in by_scene(frame, arm, metric, against, INTERPOLATION).items()})


def by_scene(frame: pd.DataFrame, arm: str, metric: str, against: str, question: str) -> dict[str, NDArray[np.float64]]:
    """Return ``arm`` minus ``against`` at a question by scene, a value for each seed."""
    found = paired(frame, arm, metric, against, question)
    return {scene: own.ravel() for scene, own in zip(found.scenes, found.differences, strict=True)}


def metrics_table(name: str, arms: Sequence[str], against: str) -> list[str]:
    """Differences with p of one family, in all metrics where none was declared; bold where p is below 5 %."""
    found, shown = compared(name, arms, against), metrics_of(name)
    lines = [row(["", *(facts(metric).label for metric in shown)]), row(["---"] * (1 + len(shown)))]
    for question in asked(read_trials(name)):
        for arm in arms:
            cells = [difference(found[question, arm, metric], digits) for metric, digits in shown.items()]
            lines.append(row([f"{arm} − {against}, {QUESTIONS[question]}", *cells]))
    return lines


def metrics_of(name: str) -> dict[str, int]:
    """The metrics of an experiment about which no claim was declared, with their digits."""
    return {PRIMARY: 3} | OTHERS if claims_of(name) is None else OTHERS


def compared(name: str, arms: Sequence[str], against: str) -> dict[tuple[str, str, str], Comparison]:
    """Compare arms in `metrics_of` the experiment, by question, arm and metric: one family of tests.

    Units are the pairs of trials, from `MIN_SCENES` scenes on the scenes.
    """
    frame = read_trials(name)
    keys = [(question, arm, metric) for question in asked(frame) for arm in arms for metric in metrics_of(name)]
    members = [
        (_units(paired(frame, arm, metric, against, question)), facts(metric).direction)
        for question, arm, metric in keys
    ]
    return dict(zip(keys, compare_family(members), strict=True))


def paired(frame: pd.DataFrame, arm: str, metric: str, against: str, question: str) -> Paired:
    """``arm`` minus ``against`` at a question, by scene and seed."""
    return pair(frame[frame.question == question], arm, metric, against)


def _units(found: Paired) -> Paired:
    """The pairs, or one value for each scene where there are `MIN_SCENES` of them."""
    if len(found.scenes) < MIN_SCENES:
        return found
    return replace(found, differences=tuple(own.mean(keepdims=True) for own in found.differences))


def asked(frame: pd.DataFrame) -> list[str]:
    """The questions that trials of the table ask of a model."""
    return [question for question in QUESTIONS if question in set(frame.question)]


def _mean(frame: pd.DataFrame, arm: str, question: str, metric: str) -> float:
    own = frame[(frame.arm == arm) & (frame.question == question)]
    return float(own.groupby("scene")[metric].mean().mean())


def collect(runs: Path) -> None:
    """Add the experiments in ``runs`` to their archives, and write their `PICTURES`."""
    for name in ARCHIVED:
        if name in list_experiments(runs):
            experiment, archive = read_experiment(runs / name), archive_of(name)
            with tempfile.TemporaryDirectory() as folder:
                own = Path(folder) / archive.name
                for line in write_archive(experiment, own):
                    print(f"left out: {line}")
                merge([own, archive] if archive.is_file() else [own], name, archive)
            if name in PICTURES:
                PICTURES[name](experiment).save(DATA / f"{name}.jpg", quality=85)


TABLES = {"verdicts": verdicts_table, "gaps": gaps_table, "views": views_table, "clouds": clouds_table}
TABLES_OF_ARMS = {
    "scenes": scenes_table,
    "growth": growth_table,
    "metrics": metrics_table,
    "shares": shares_table,
    "budgets": budgets_table,
}
