"""The way from a densifier's switches to the runs of an ablation and back: settings of each run, and its files.

A switch is declared by the densifier's class (``SWITCHES``), by its YAML (``switches``), or on the command line. It is
on as the densifier is configured; its ``off`` settings take that part out. Runs that differ only in what does nothing
there (the scales of children where nothing is split) are one and the same, and trained once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.quantities import metric_keys, metric_quantity
from gsbench.analysis.report.build import AblationPart
from gsbench.analysis.report.charts import ForestRow, forest_plot
from gsbench.analysis.results import TrialResult, read_experiment
from gsbench.analysis.statistics import Interval, Run
from gsbench.claims.ablation import Ablation, ablate, plan_runs
from gsbench.errors import InputError
from gsbench.files import write_json
from gsbench.parsing import read_json
from gsbench.runs.layout import ABLATION
from gsbench.settings import Switch, checked
from gsbench.words import closest, counted, signed

VERSION = 1  # of the record
_ABSENT = object()  # unlike any value


@dataclass(frozen=True)
class Record:
    """The trials of an ablation: for each run, the folders of its trials within the experiment.

    ``trials`` of all runs are in one order of scenes and seeds.
    """

    densify: str
    switches: Mapping[str, Switch]
    runs: tuple[tuple[Run, tuple[str, ...]], ...]


def declared_switches(own: Mapping[str, Switch], values: Mapping[str, Any]) -> dict[str, Switch]:
    """The switches of a densifier's class, and those of its settings ``values``, that take something out there.

    Raises InputError for a switch that is none.
    """
    listed = values.get("switches") or {}
    if not isinstance(listed, Mapping):
        raise InputError(f"densify.switches must be a mapping NAME: {{off: {{KEY: VALUE}}}}, got {listed!r}")
    found = dict(own)
    for name, entry in listed.items():
        where = f"densify.switches.{name}"
        if not isinstance(entry, Mapping) or "off" not in entry:
            raise InputError(f"{where} must be {{off: {{KEY: VALUE}}}}, got {entry!r}")
        found[str(name)] = Switch(**checked(Switch, dict(entry), where))
    return {
        name: switch
        for name, switch in found.items()
        if any(values.get(key, _ABSENT) != value for key, value in switch.off.items())
    }


def choose_switches(found: Mapping[str, Switch], names: Sequence[str], densify: str) -> dict[str, Switch]:
    """Choose the switches of ``names``, or all; raises InputError for an unknown name, and where there are none."""
    for name in names:
        if name not in found:
            raise InputError(
                f"{name!r} is no switch of densify={densify}{closest(name, found)} (there are "
                f"{', '.join(found) or 'none'})"
            )
    if not found:
        raise InputError(
            f"densify={densify} declares no switch that is on: name one by --switch NAME:KEY=VALUE, the setting that "
            "takes it out (docs/claims.md)"
        )
    return {name: found[name] for name in names or found}


def effective(run: Run, switches: Mapping[str, Switch]) -> Run:
    """The run without the switches that do nothing in it, because that within which they act is off."""
    return frozenset(name for name in run if _acts(name, run, switches))


def _acts(name: str, run: Run, switches: Mapping[str, Switch]) -> bool:
    within = switches[name].within
    return within not in switches or (within in run and _acts(within, run, switches))


def runs_to_train(switches: Mapping[str, Switch]) -> list[Run]:
    """The runs of the design, each once, all switches on first; raises InputError for switches within each other."""
    for name in switches:
        seen, place = [name], switches[name].within
        while place in switches:
            if place in seen:
                raise InputError(f"the switches {', '.join(seen)} stand within each other in a circle")
            seen, place = [*seen, place], switches[place].within
    runs = [effective(run, switches) for run in plan_runs(tuple(switches))]
    return sorted(dict.fromkeys(runs), key=lambda run: (-len(run), sorted(run)))


def words_of(run: Run, switches: Mapping[str, Switch]) -> dict[str, Any]:
    """The settings of ``densify`` that take out what is off in the run."""
    settings: dict[str, Any] = {}
    for name, switch in switches.items():
        if name not in run:
            settings |= switch.off
    return settings


def write_record(home: Path, record: Record) -> None:
    """Write the record beside the experiment's trials, for the report."""
    write_json(
        home / ABLATION,
        {
            "version": VERSION,
            "densify": record.densify,
            "switches": {name: asdict(switch) for name, switch in record.switches.items()},
            "runs": [{"on": sorted(run), "trials": list(trials)} for run, trials in record.runs],
        },
    )


def read_record(home: Path) -> Record | None:
    """The record of the experiment in ``home``; None without one. Raises InputError for one that is damaged."""
    if not (home / ABLATION).exists():
        return None
    content = read_json(home / ABLATION)
    try:
        if content["version"] != VERSION:
            raise InputError(f"{home / ABLATION} is of version {content['version']}: update gsbench")
        runs = tuple((frozenset(run["on"]), tuple(map(str, run["trials"]))) for run in content["runs"])
        switches = {name: Switch(**values) for name, values in content["switches"].items()}
        return Record(str(content["densify"]), switches, runs)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{home / ABLATION} is damaged ({error!r}): give the command of the ablation again") from None


def shares_of(record: Record, home: Path, metric: str) -> Ablation:
    """The shares in a metric; raises InputError where trials are missing or lack it."""
    by_folder = read_experiment(home).by_folder
    trained: dict[Run, NDArray[np.float64]] = {}
    for run, folders in record.runs:
        values = [by_folder[folder].metrics.get(metric) if folder in by_folder else None for folder in folders]
        missing = [folder for folder, value in zip(folders, values, strict=True) if value is None]
        if missing:
            raise InputError(f"{counted(len(missing), 'trial')} of the ablation lack {metric}, such as {missing[0]}")
        trained[run] = _by_scene(folders, [value for value in values if value is not None])
    names = tuple(record.switches)
    return ablate(names, {run: trained[effective(run, record.switches)] for run in plan_runs(names)})


def _by_scene(folders: Sequence[str], values: Sequence[float]) -> NDArray[np.float64]:
    """The values [S, K], a row a scene; a sweep has all seeds of all scenes."""
    scenes: dict[str, list[float]] = {}
    for folder, value in zip(folders, values, strict=True):
        scenes.setdefault(folder.split("/")[0], []).append(value)
    seeds = min(map(len, scenes.values()))
    return np.array([own[:seeds] for own in scenes.values()])


def table(found: Ablation, metric: str) -> list[str]:
    """The shares as lines of a Markdown table."""
    digits = f".{metric_quantity(metric, ()).decimals + 1}f"
    lines = [
        f"| part | share of {metric} | interval | part of the gain | alone | last |",
        "|---|---|---|---|---|---|",
    ]
    for share in found.shares:
        part = "" if share.part is None else f"{100 * share.part:.0f} %"
        lines.append(
            f"| {share.switch} | {signed(share.value, digits)} | {_interval(share.interval, digits)} | {part} | "
            f"{signed(share.alone, digits)} | {signed(share.last, digits)} |"
        )
    return [*lines, f"| all together | {signed(found.gain, digits)} | {_interval(found.interval, digits)} | | | |"]


def ablation_part(home: Path) -> AblationPart | None:
    """The report's part on the ablation in ``home``; None without one."""
    record = read_record(home)
    if record is None:
        return None
    trials = [one for one in read_experiment(home).by_folder.values() if one.densify == record.densify]
    count = counted(len(record.switches), "part")
    lines = [
        f"{record.densify}: all combinations of {count}, {len(record.runs)} trainings for each scene and seed. "
        "Intervals of "
        "shares are adjusted for the number of parts."
    ]
    lines += [f"{name}: {switch.words}." for name, switch in record.switches.items() if switch.words]
    charts = []
    for metric in metric_keys(trials):
        try:
            found = shares_of(record, home, metric)
        except InputError as error:
            lines.append(f"{metric}: not shown, {error}.")
            continue
        charts.append(_chart(found, metric, trials))
    return AblationPart(lines, charts)


def _chart(found: Ablation, metric: str, trials: Sequence[TrialResult]) -> str:
    shown = metric_quantity(metric, trials)
    rows = [_row(share.switch, share.value, share.interval) for share in found.shares]
    rows.append(_row("all together", found.gain, found.interval))
    return forest_plot(f"Shares in {shown.name}", rows, f"share of {shown.name}", shown.direction)


def _row(name: str, value: float, interval: Interval | None) -> ForestRow:
    return ForestRow(name, value, *((None, None) if interval is None else (interval.low, interval.high)))


def _interval(interval: Interval | None, digits: str) -> str:
    return "unknown" if interval is None else f"{signed(interval.low, digits)} to {signed(interval.high, digits)}"
