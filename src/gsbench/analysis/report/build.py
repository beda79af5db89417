"""The report as one HTML file, readable without network, other files and JavaScript."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

from gsbench.analysis import sentences
from gsbench.analysis.cells import select_trials, where_words
from gsbench.analysis.comparison import Answer, chosen, compare
from gsbench.analysis.differences import between_scenes_notes
from gsbench.analysis.fairness import caveats, counts_notes, fairness_table
from gsbench.analysis.images import choose_views
from gsbench.analysis.notes import texts
from gsbench.analysis.pairs import pair_trials
from gsbench.analysis.paper import layout_of, load_published, paper_tables
from gsbench.analysis.planning import seeds_needed
from gsbench.analysis.quantities import COSTS, relative_change
from gsbench.analysis.report.charts import forest_plot, line_chart
from gsbench.analysis.report.curves import (
    event_charts,
    event_table,
    quality_charts,
    sweep_charts,
    training_charts,
)
from gsbench.analysis.report.where import region_maps
from gsbench.analysis.results import Experiment, TrialResult, group_by, trials_of
from gsbench.analysis.table_formats import Table, fill, text_table
from gsbench.analysis.tables import build_table
from gsbench.analysis.verdicts import Verdict
from gsbench.eval.facts import find_metric
from gsbench.parsing import read_if_sound
from gsbench.runs import layout
from gsbench.runs.experiments import TuningRecord
from gsbench.words import command, counted, signed

COSTS_COMPARED = ("gaussians", "train_time")


def build_report(
    experiment: Experiment,
    baseline: str | None = None,
    where: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """The report as HTML, from files alone.

    With ``baseline``, a densifier, all others are shown against it, without a test.

    With ``where`` (`select_trials`) it shows only these trials. Verdicts that lose trials by it are
    intervals: the choice may have been made after seeing results. Raises InputError if no trial is
    left.
    """
    comparison = compare(experiment, baseline)
    trials = select_trials(comparison.trials, where)
    if where:
        comparison = chosen(comparison, trials, where_words(where))
    arms = sorted({trial.arm for trial in trials})
    paper_table = layout_of(experiment.name)
    if paper_table is None:
        tables = [build_table(experiment, trials, comparison=comparison)]
    else:
        tables = paper_tables(experiment, paper_table, trials, comparison=comparison)
    maps = region_maps(trials, comparison.answers)
    return fill(
        "report.html.j2",
        script=files("gsbench.analysis.report").joinpath("script.js").read_text(encoding="utf-8"),
        name=experiment.name,
        explained=command("explain", f"{experiment.name}:SCENE:METRIC:ARM"),
        arms=arms,
        scenes=sorted({trial.scene for trial in trials}),
        trials=trials,
        versus=[
            compare_arms(trials, own) | {"maps": maps.get((own.baseline, own.arm), [])}
            for own in comparison.answers
        ],
        ledger=experiment.history.ledger and command("ledger", "show", experiment.name),
        experiment=experiment,
        risk=comparison.risk,
        sweeps=sweep_charts(comparison),
        unused=texts(comparison.remarks),
        # the top of the page has the verdicts
        tables=[replace(table, verdicts=()) for table in tables],
        contradictions=[] if paper_table is None else load_published().contradictions,
        search=search_summary(experiment.folder),
        say=sentences,
        seeds_to_resolve=seeds_to_resolve,
        signed=lambda value, decimals: "–" if value is None else signed(value, f".{decimals}f"),
        training=[
            *quality_charts(
                trials, dict.fromkeys(one.verdict.quantity for one in comparison.answers)
            ),
            *training_charts(trials, arms),
        ],
        event_table=event_table(trials, arms),
        events=event_charts(trials, arms),
        provenance=provenance(trials),
    )


def compare_arms(trials: Sequence[TrialResult], judged: Answer) -> dict[str, Any]:
    """Everything that the page shows of two arms; notes say what could not be compared or read."""
    first, second = judged.baseline, judged.arm
    verdicts = [judged.verdict, *judged.metrics]
    views, faults = choose_views(pair_trials(trials, first, second))
    baseline, other = trials_of(trials, first), trials_of(trials, second)
    both: dict[str, Any] = {"caveats": "", "fairness": None, "facts": []}
    if baseline and other:  # neither is awaited
        unlike = [*counts_notes(trials, [(first, second)]), *caveats(trials, first, second)]
        both = {
            "caveats": " ".join(texts(unlike)),
            "fairness": fairness_table(trials, first, second),
            "facts": [*_costs(baseline, other), *between_scenes_notes(baseline, other)],
        }
    return both | {
        "judged": judged,
        "title": f"{second} against {first}",
        "verdicts": verdicts,
        "has_like_these": judged.verdict.like_these is not None,
        "forests": [_forest(verdict) for verdict in verdicts],
        "views": views,
        "notes": texts([*judged.verdict.notes, *faults]),
    }


def seeds_to_resolve(verdict: Verdict) -> int | None:
    """The number of seeds that would resolve the worthwhile difference.

    None if that is unknown, or if there would be too many to run.
    """
    if verdict.deviation is None or verdict.quantity.worthwhile is None:
        return None
    return seeds_needed(verdict.deviation, len(verdict.scenes), verdict.quantity.worthwhile)


def _costs(baseline: Sequence[TrialResult], other: Sequence[TrialResult]) -> list[str]:
    """Say how counts and training times changed over the scenes that both arms have."""
    lines = []
    for key in COSTS_COMPARED:
        name, read = COSTS[key]
        change = relative_change(baseline, other, read)
        if change is not None:
            spread = _spread_of_times([*baseline, *other]) if key == "train_time" else ""
            lines.append(f"{name[0].upper()}{name[1:]} {change}{spread}")
    return lines


def _spread_of_times(trials: Sequence[TrialResult]) -> str:
    """Say how far training times of equal trials differ: smaller changes mean nothing."""
    spread = 0.0
    for cell in group_by(trials, "arm", "scene").values():
        times = [seconds for trial in cell if (seconds := COSTS["train_time"][1](trial))]
        spread = max(spread, max(times, default=1.0) / min(times, default=1.0) - 1)
    return f"; times of equal trials differ by up to {spread:.0%}" if spread else ""


def _forest(verdict: Verdict) -> str:
    rows = [*verdict.scenes]
    if len(rows) > 1:
        mean, seeds = verdict.mean or 0.0, verdict.pairs.seeds
        rows.append(("mean of scenes", mean, seeds, verdict.interval))
    better = (
        "right of zero is better" if verdict.quantity.direction == 1 else "left of zero is better"
    )
    return forest_plot(
        f"{verdict.quantity.name}: {better}", rows, "difference", verdict.quantity.direction
    )


def provenance(trials: Sequence[TrialResult]) -> Table:
    """One row per trial: its folder, conditions, hashes, code, machine and versions."""
    facts_by_trial = {}
    for trial in trials:
        record = trial.record
        versions = (f"{name} {version}" for name, version in record.versions.items())
        facts_by_trial[trial.label] = {
            "raster": record.raster,
            "protocol": record.protocol,
            "iterations": str(record.iterations),
            **{f"{key} hash": value[:12] for key, value in record.hashes.items()},
            "code": ", ".join(trial.code_texts),
            "machine": trial.machine or "",
            "versions": ", ".join(versions),
        }
    names = dict.fromkeys(itertools.chain(*facts_by_trial.values()))
    rows = {
        label: [facts.get(name, "") for name in names] for label, facts in facts_by_trial.items()
    }
    return text_table("Trials", "trial", names, rows, wrapped=True)


def search_summary(home: Path) -> tuple[str, str] | None:
    """A line on the experiment's search, and its chart as SVG; None without a readable one."""
    record = read_if_sound(home / layout.TUNING, TuningRecord)
    if record is None:
        return None
    done = {
        number: point for number, point in enumerate(record.points, 1) if point.value is not None
    }
    failed = len(record.points) - len(done)
    count = (
        f"{len(record.points)} of {counted(record.wanted, 'point')}, each "
        f"{counted(len(record.seeds), 'seed')}{f'; {failed} failed' if failed else ''}"
    )
    if record.best is None:
        return f"{count}; none has a result yet.", ""
    facts = find_metric(record.metric)
    name, decimals = (facts.name, facts.decimals + 1) if facts else (record.metric, 4)
    number = next(number for number, point in done.items() if point is record.best)
    settings = ", ".join(f"{key} = {value}" for key, value in record.best.settings.items())
    line = (
        f"Best {name}: {record.best.value:.{decimals}f} at {settings} (point {number}). {count}. "
    )
    line += "Judged by validation views; no test view was looked at."
    values = [(float(number), point.value or 0.0) for number, point in done.items()]
    return line, line_chart("The search", [("each point", values)], "point", name)
