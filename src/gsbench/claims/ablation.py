"""Ablation of a densifier: its switches, and the runs of all combinations.

A switch turns one part of the densifier off by its ``off`` settings; as configured, all switches
are on. The class (``SWITCHES``), the YAML file (``switches``) or the command line declares it. A
switch may have no effect while another is off (the scales of children if nothing is split). Runs
that differ only in such switches are trained once.
"""

from collections.abc import Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from itertools import chain, combinations
from typing import Any

from gsbench.errors import InputError
from gsbench.settings import Switch, check_values
from gsbench.words import did_you_mean

MAX_SWITCHES = 8

Run = frozenset[str]  # the switches that are on


def declared_switches(
    of_class: Mapping[str, Switch], values: Mapping[str, Any]
) -> dict[str, Switch]:
    """The switches of a densifier's class (``own``) and of its settings.

    Those whose ``off`` settings hold already are left out. Raises InputError for a malformed
    switch.
    """
    in_settings = values.get("switches") or {}
    if not isinstance(in_settings, Mapping):
        raise InputError(
            f"densify.switches must be a mapping NAME: {{off: {{KEY: VALUE}}}}, got {in_settings!r}"
        )
    switches = dict(of_class)
    for name, entry in in_settings.items():
        where = f"densify.switches.{name}"
        if not isinstance(entry, Mapping) or "off" not in entry:
            raise InputError(f"{where} must be {{off: {{KEY: VALUE}}}}, got {entry!r}")
        switches[str(name)] = Switch(**check_values(Switch, dict(entry), where))
    present = dict(values)
    return {
        name: switch
        for name, switch in switches.items()
        if present | dict(switch.off) != present  # else it is off already
    }


def choose_switches(
    declared: Mapping[str, Switch], names: Sequence[str], densify: str
) -> dict[str, Switch]:
    """The declared switches of these names, by default all.

    Raises InputError for an unknown name, if no switch is declared, and for too many switches.
    """
    for name in names:
        if name not in declared:
            raise InputError(
                f"{name!r} is not a switch of densify={densify}{did_you_mean(name, declared)} "
                f"(there are {', '.join(declared) or 'none'})"
            )
    if not declared:
        raise InputError(
            f"densify={densify} declares no switch that is on: name one by "
            "+densify.switches.NAME.off.KEY=VALUE, where the setting turns a part off "
            "(docs/claims.md)"
        )
    chosen = {name: declared[name] for name in names or declared}
    if len(chosen) > MAX_SWITCHES:
        raise InputError(
            f"{len(chosen)} switches make {2 ** len(chosen)} runs: choose at most {MAX_SWITCHES}"
        )
    return chosen


def effective_run(run: Run, switches: Mapping[str, Switch]) -> Run:
    """The run without the switches that have no effect in it: the switch that they need is off."""

    def acts(name: str) -> bool:
        within = switches[name].within
        return within not in switches or (within in run and acts(within))

    return frozenset(filter(acts, run))


def runs_to_train(switches: Mapping[str, Switch]) -> list[Run]:
    """All different runs, the one with all switches on first.

    Raises InputError if switches depend on each other.
    """
    try:
        TopologicalSorter({name: [one.within] for name, one in switches.items()}).prepare()
    except CycleError as error:
        raise InputError(
            f"the switches {', '.join(error.args[1][1:])} form a circle: each is within the next"
        ) from None
    sizes = range(len(switches) + 1)
    on = chain.from_iterable(combinations(switches, size) for size in sizes)
    runs = {effective_run(Run(one), switches) for one in on}
    return sorted(runs, key=lambda run: (-len(run), sorted(run)))


def off_settings(run: Run, switches: Mapping[str, Switch]) -> dict[str, Any]:
    """The settings of ``densify`` that turn off the parts that are off in the run."""
    settings: dict[str, Any] = {}
    for name, switch in switches.items():
        if name not in run:
            settings |= switch.off
    return settings
