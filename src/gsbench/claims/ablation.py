"""Ablation of a densifier: its switches, the runs of all their combinations, and the verdicts on them.

A switch is declared by the densifier's class (``SWITCHES``), by its YAML (``switches``), or on the command line. It is
on as the densifier is configured; its ``off`` settings take that part out. Runs that differ only in what does nothing
there (the scales of children where nothing is split) are one and the same, and trained once.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.results import TrialResult
from gsbench.analysis.verdicts import WORDS
from gsbench.errors import InputError
from gsbench.runs.declaration import Arm, Declaration, Question
from gsbench.settings import Switch, checked
from gsbench.words import closest, listed

MAX_SWITCHES = 8
_ABSENT = object()  # unlike any value

Run = frozenset[str]  # the switches that are on
Keys = Mapping[str, str]  # of a run, by scene: the folder of its trials without the seed


def declared_switches(own: Mapping[str, Switch], values: Mapping[str, Any]) -> dict[str, Switch]:
    """The switches of a densifier's class, and those of its settings ``values``, that take something out there.

    Raises InputError for a switch that is none.
    """
    listed_there = values.get("switches") or {}
    if not isinstance(listed_there, Mapping):
        raise InputError(f"densify.switches must be a mapping NAME: {{off: {{KEY: VALUE}}}}, got {listed_there!r}")
    found = dict(own)
    for name, entry in listed_there.items():
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
    """Choose the switches of ``names``, or all; raises InputError for an unknown name, for none, and for too many."""
    for name in names:
        if name not in found:
            raise InputError(
                f"{name!r} is not a switch of densify={densify}{closest(name, found)} (there are "
                f"{', '.join(found) or 'none'})"
            )
    if not found:
        raise InputError(
            f"densify={densify} declares no switch that is on: name one by +densify.switches.NAME.off.KEY=VALUE, where "
            "the setting turns a part off (docs/claims.md)"
        )
    chosen = {name: found[name] for name in names or found}
    if len(chosen) > MAX_SWITCHES:
        raise InputError(f"{len(chosen)} switches make {2 ** len(chosen)} runs: choose at most {MAX_SWITCHES}")
    return chosen


def effective(run: Run, switches: Mapping[str, Switch]) -> Run:
    """The run without the switches that do nothing in it, because that within which they act is off."""
    return frozenset(name for name in run if _acts(name, run, switches))


def _acts(name: str, run: Run, switches: Mapping[str, Switch]) -> bool:
    within = switches[name].within
    return within not in switches or (within in run and _acts(within, run, switches))


def runs_to_train(switches: Mapping[str, Switch]) -> list[Run]:
    """All combinations, each once, all switches on first; raises InputError for switches within each other."""
    for name in switches:
        seen, place = [name], switches[name].within
        while place in switches:
            if place in seen:
                raise InputError(f"the switches {', '.join(seen)} form a circle: each is within the next")
            seen, place = [*seen, place], switches[place].within
    sizes = range(len(switches) + 1)
    every = [Run(chosen) for size in sizes for chosen in itertools.combinations(switches, size)]
    runs = dict.fromkeys(effective(run, switches) for run in every)
    return sorted(runs, key=lambda run: (-len(run), sorted(run)))


def words_of(run: Run, switches: Mapping[str, Switch]) -> dict[str, Any]:
    """The settings of ``densify`` that take out what is off in the run."""
    settings: dict[str, Any] = {}
    for name, switch in switches.items():
        if name not in run:
            settings |= switch.off
    return settings


def without(run: Run, switches: Sequence[str]) -> str:
    """``without shrink``, or that all parts are on."""
    off = [name for name in switches if name not in run]
    return f"without {listed(off)}" if off else "with all of them"


def judge_runs(trials: Sequence[TrialResult], runs: Mapping[Run, Keys], metric: str) -> list[Verdict]:
    """The verdict on each run, held against the one with all switches on, in the order of ``runs``; one family."""
    quantity = asked_quantity(metric, trials)
    full = max(runs, key=len)
    questions = [
        Question(
            metric=metric,
            sign=quantity.direction or 1,
            least=quantity.worthwhile,
            baseline=Arm("", without(full, sorted(full))),
            arm=Arm("", without(run, sorted(full))),
            scenes={scene: (runs[full][scene], key) for scene, key in keys.items()},
        )
        for run, keys in runs.items()
        if run != full
    ]
    return judge(trials, Declaration(time="1970-01-01T00:00:00Z", questions=tuple(questions)))


def table(verdicts: Sequence[Verdict]) -> list[str]:
    """The verdicts as lines of a Markdown table."""
    name = verdicts[0].quantity.name
    lines = [f"| run | difference in {name} from all parts | interval | verdict |", "|---|---|---|---|"]
    for one in verdicts:
        mean = "unknown" if one.mean is None else one.shown(one.mean)
        interval = "unknown" if one.interval is None else one.shown_interval(one.interval)
        lines.append(f"| {one.question.arm} | {mean} | {interval} | {one.untestable or WORDS[one.outcome]} |")
    return lines
