"""``gsbench ablate``: an experiment that shows which part of a densifier makes its gain.

A switch turns one part of the densifier off by its ``off`` settings; as configured, all switches
are on. The class (``SWITCHES``), the YAML file (``switches``) or the command line declares it. A
switch may have no effect while another is off (the scales of children if nothing is split). Runs
that differ only in such switches are trained once.
"""

from collections.abc import Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from itertools import chain, combinations
from pathlib import Path
from typing import Any

import yaml

from gsbench.app.command import compose_trials
from gsbench.config.compose import Trial
from gsbench.config.overrides import value_text
from gsbench.errors import InputError
from gsbench.files import own_output, write_text
from gsbench.launch.batch import check_parts
from gsbench.settings import Switch, check_values
from gsbench.verbs.arguments import ArgumentParser, names, path
from gsbench.words import command, counted, did_you_mean

MAX_SWITCHES = 8

Run = frozenset[str]  # the switches that are on
EXPERIMENT = """\
# @package _global_
# A study of {densify}: each combination of its parts against all of them.
# {summary}.
# As conf/experiment/{name}.yaml: gsbench --config-dir conf +experiment={name}
{content}"""


def ablate(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0; raises InputError for bad input."""
    from gsbench.pipeline.parts import Parts  # here, for a quick answer to --help

    options = ArgumentParser(
        "ablate",
        "It writes an experiment with a grid for each combination (docs/claims.md).",
        {
            "settings* KEY=VALUE": "as of a sweep: densify=volumetric seed=0,1,2 …",
            "--switches A,B": ("only these; default: all declared", names, ()),
            "--out FILE": ("such as conf/experiment/parts.yaml; default: print it", path),
        },
    ).parse_args(argv)
    words = list(options.settings)
    if strange := [word for word in words if word.startswith(("~", "hydra.", "+experiment="))]:
        raise InputError(f"{strange[0]}: ablate writes an experiment, so give it plain KEY=VALUE")
    if not any(word.startswith("densify=") for word in words):
        raise InputError("ablate needs a densifier, such as densify=volumetric")
    first = compose_trials(words, multirun=True)
    densify, values = _only_densifier(first), first[0].values
    of_class = getattr(type(Parts(values).trainer), "SWITCHES", {})
    declared = declared_switches(of_class, values["densify"])
    switches = choose_switches(declared, options.switches, densify)
    grids = []
    for run in runs_to_train(switches):
        # a key that the densifier lacks needs Hydra's plus
        off = {
            f"{'' if key in values['densify'] else '+'}densify.{key}": value_text(value)
            for key, value in off_settings(run, switches).items()
        }
        settings = [f"{key}={value}" for key, value in off.items()]
        check_parts(compose_trials([*words, *settings], multirun=True)[:1], on_this_machine=False)
        if off in grids:
            raise InputError(f"switching off {', '.join(off)} twice makes no other run")
        grids.append(off)
    given = {key: value for key, _, value in (word.partition("=") for word in words)}
    grids = [{"densify": given["densify"]} | off for off in grids]
    del given["densify"]
    name = given.pop("name", f"ablate_{densify}")
    content = {
        "name": name,
        "eval": {"baseline": densify},
        "hydra": {"mode": "MULTIRUN", "sweeper": {"params": given, "grids": grids}},
    }
    trials = len(first) * len(grids)
    text = EXPERIMENT.format(
        densify=densify,
        name=name,
        summary=f"{counted(len(switches), 'part')} ({', '.join(switches)}), {len(grids)} runs, "
        f"{counted(trials, 'trial')}",
        content=yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=100),
    )
    if options.out is None:
        print(text, end="")
        return 0
    with own_output(options.out):
        write_text(options.out, text)
    print(f"{options.out}: {counted(trials, 'trial')} of {command(f'+experiment={name}')}")
    return 0


def _only_densifier(trials: Sequence[Trial]) -> str:
    arms = {
        (trial.values["init"]["name"], trial.values["densify"]["name"], trial.files.home)
        for trial in trials
    }
    places = {(trial.values["scene"]["name"], trial.values["seed"]) for trial in trials}
    if len(arms) > 1 or len(places) < len(trials):
        raise InputError(
            "ablate needs one initialiser and one densifier: only scene and seed may list values"
        )
    return str(trials[0].values["densify"]["name"])


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
