"""Tables of docs/findings.md that come from published archives of checks, docs/findings/NAME.zip.

Verdicts are those that ``gsbench check conf/claims/NAME.yaml --from docs/findings/NAME.zip`` prints. Whatever else is
shown of the same trials was not declared and is one family of tests (Holm) a table.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd
from findings_pairs import difference, facts, pair, row
from findings_pictures import for_and_against, worst_views
from PIL import Image

from gsbench.analysis.frame import to_frame
from gsbench.analysis.pairing import Paired
from gsbench.analysis.results import Experiment, TrialResult, read_experiment
from gsbench.analysis.statistics import Comparison, compare_family
from gsbench.claims.archive import unpack_archive, write_archive
from gsbench.claims.file import read_claims
from gsbench.claims.recheck import Recheck, recheck
from gsbench.claims.shares import merge
from gsbench.runs.declaration import EXTRAPOLATION, INTERPOLATION
from gsbench.runs.experiments import list_experiments
from gsbench.words import signed

ROOT = Path(__file__).parents[1]
DATA = ROOT / "docs" / "findings"
ARCHIVED = (
    "findings_volume",
    "findings_longaxis",
    "findings_dimension",
    "findings_full",
    "findings_matched",
    "findings_exponent",
    "scale_bridge",
    "check_volumetric",
)
PICTURES: dict[str, Callable[[Experiment], Image.Image]] = {
    "findings_matched": worst_views,
    "findings_volume": for_and_against,
    "findings_dimension": functools.partial(for_and_against, rule="volumetric-1"),
}
QUESTIONS = (INTERPOLATION, EXTRAPOLATION)
PRIMARY = "lpips_squeeze"
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
    """The trials of an archive, one a row, with their ``arm`` (the densifier) and ``question``."""
    frame = to_frame(trials_of(name))
    return frame.assign(arm=frame.densify, question=[trial.question for trial in trials_of(name)])


def verdicts_table(name: str) -> list[str]:
    """A claim a row: what was asked, the difference with the interval over all looks, the verdict, on what."""
    lines = [row(["claim", "difference", "verdict", "on"]), row(["---"] * 4)]
    for verdict in checked(name).verdicts:
        claim, decision = verdict.claim, verdict.decision
        shown, on = "", ""
        if decision is not None and decision.mean is not None and decision.interval is not None:
            shown = f"{verdict.shown(decision.mean)} ({verdict.shown_interval(decision.interval)})"
            on = f"{len(verdict.by_scene)} scenes, {decision.seeds} seeds"
        lines.append(row([f"`{claim.id}`: {claim.arm} − {claim.baseline}", shown, f"**{verdict.word}**", on]))
    return lines


def gaps_table(name: str) -> list[str]:
    """An arm a row: its means over scenes at both questions, and the fall from one to the other."""
    frame = read_trials(name)
    cells = {"psnr": ("PSNR, dB", 2), PRIMARY: ("LPIPS (squeeze)", 3)}
    titles = [f"{title}, {word}" for title, _ in cells.values() for word in ("between", "where none went", "change")]
    lines = [row(["arm", *titles]), row(["---"] + ["--:"] * len(titles))]
    for arm in _arms(frame):
        means = [arm]
        for metric, (_, digits) in cells.items():
            one, other = (_mean(frame, arm, question, metric) for question in QUESTIONS)
            means += [f"{one:.{digits}f}", f"{other:.{digits}f}", signed(other - one, f".{digits}f")]
        lines.append(row(means))
    return lines


def scenes_table(name: str, arms: Sequence[str], against: str) -> list[str]:
    """A scene a row: differences in the declared metric by question and arm, the mean over seeds."""
    frame = read_trials(name)
    columns = [(question, arm) for question in asked(frame) for arm in arms]
    titles = [f"{arm}, {question}" for question, arm in columns]
    lines = [row(["scene", *titles]), row(["---"] + ["--:"] * len(columns))]
    found = {column: paired(frame, column[1], PRIMARY, against, column[0]) for column in columns}
    for scene in dict.fromkeys(frame.scene):
        cells = [scene]
        for column in columns:
            by_scene = dict(zip(found[column].scenes, found[column].differences, strict=True))
            cells.append(signed(float(by_scene[scene].mean()), ".3f") if scene in by_scene else "")
        lines.append(row(cells))
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
    counts = frame.groupby(["scene", "arm"])[list(GROWTH)].sum()
    return counts[GROWTH[0]] / counts.sum(axis=1)


def gains_between(frame: pd.DataFrame, arm: str, metric: str, against: str) -> pd.Series:
    """Return by scene the difference of two arms between the cameras, the mean over seeds."""
    found = paired(frame, arm, metric, against, INTERPOLATION)
    return pd.Series({scene: float(own.mean()) for scene, own in zip(found.scenes, found.differences, strict=True)})


def metrics_table(name: str, arms: Sequence[str], against: str) -> list[str]:
    """Differences with p of one family, in all metrics where none was declared; bold where p is below 5 %."""
    found, shown = compared(name, arms, against), metrics_of(name)
    lines = [row(["", *(facts(metric).label for metric in shown)]), row(["---"] * (1 + len(shown)))]
    for question in asked(read_trials(name)):
        for arm in arms:
            cells = [difference(found[question, arm, metric], digits) for metric, digits in shown.items()]
            lines.append(row([f"{arm} − {against}, {question}", *cells]))
    return lines


def metrics_of(name: str) -> dict[str, int]:
    """The metrics of an experiment about which no claim was declared, with their digits."""
    return {PRIMARY: 3} | OTHERS if claims_of(name) is None else OTHERS


def compared(name: str, arms: Sequence[str], against: str) -> dict[tuple[str, str, str], Comparison]:
    """Compare arms in `metrics_of` the experiment, by question, arm and metric: one family of tests."""
    frame = read_trials(name)
    keys = [(question, arm, metric) for question in asked(frame) for arm in arms for metric in metrics_of(name)]
    members = [
        (paired(frame, arm, metric, against, question), facts(metric).direction) for question, arm, metric in keys
    ]
    return dict(zip(keys, compare_family(members), strict=True))


def paired(frame: pd.DataFrame, arm: str, metric: str, against: str, question: str) -> Paired:
    """``arm`` minus ``against`` at a question, by scene and seed."""
    return pair(frame[frame.question == question], arm, metric, against)


def asked(frame: pd.DataFrame) -> list[str]:
    """The questions that trials of the table ask of a model."""
    return [question for question in QUESTIONS if question in set(frame.question)]


def _mean(frame: pd.DataFrame, arm: str, question: str, metric: str) -> float:
    own = frame[(frame.arm == arm) & (frame.question == question)]
    return float(own.groupby("scene")[metric].mean().mean())


def _arms(frame: pd.DataFrame) -> list[str]:
    """The baseline first."""
    return sorted(dict.fromkeys(frame.arm), key=lambda arm: arm not in ("adc", "absgrad"))


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


TABLES = {"verdicts": verdicts_table, "gaps": gaps_table}
TABLES_OF_ARMS = {"scenes": scenes_table, "metrics": metrics_table, "shares": shares_table}
