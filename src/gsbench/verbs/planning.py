"""Verbs that plan a study: ``plan`` (how many scenes and seeds show a difference, docs/claims.md)
and ``ablate`` (an experiment that shows which part of a densifier makes its gain).

A switch turns one part of a densifier off by its ``off`` settings; as configured, all switches are
on. The class (``SWITCHES``), the YAML file (``switches``) or the command line declares it. A switch
may have no effect while another is off (the scales of children if nothing is split). Runs that
differ only in such switches are trained once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from graphlib import CycleError, TopologicalSorter
from itertools import chain, combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from gsbench.analysis.comparison import compare
from gsbench.analysis.notes import texts
from gsbench.analysis.pairs import BASELINE
from gsbench.analysis.planning import (
    UNSURE,
    Components,
    Design,
    designs_like_these,
    deviation_range,
    estimate_components,
    sweep_designs,
    sweep_power,
)
from gsbench.analysis.quantities import Quantity, quantity
from gsbench.analysis.results import Arm, TrialResult, load_experiment
from gsbench.analysis.statistics import MIN_SCENES
from gsbench.analysis.verdicts import interval_of
from gsbench.errors import InputError
from gsbench.files import own_output, write_text
from gsbench.runs.commands import ERROR_RATE
from gsbench.runs.experiments import DEFAULT_METRIC
from gsbench.settings import Switch, check_values
from gsbench.verbs.arguments import options_of
from gsbench.words import command, counted, did_you_mean

if TYPE_CHECKING:
    from gsbench.config.compose import Trial

MAX_DESIGNS = 5  # combinations of scenes and seeds that `plan` shows
PLANNED = "Planned for a sweep: each question errs in {:.3g} %; all seeds are judged at once."
NEW_TRIALS = (
    "Train all of them with seeds that the pilot does not have (it has {}), under another name: "
    "what was seen is not declared beforehand."
)

MAX_SWITCHES = 8

Run = frozenset[str]  # the switches that are on
EXPERIMENT = """\
# @package _global_
# A study of {densify}: each combination of its parts against all of them.
# {summary}.
# As conf/experiment/{name}.yaml: gsbench --config-dir conf +experiment={name}
{content}"""


def plan(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    options = options_of("plan", argv)
    experiment = load_experiment(runs, options.experiment)
    comparison = compare(experiment, None if options.baseline == BASELINE else options.baseline)
    trials = comparison.trials
    questions = [answer.verdict.question for answer in comparison.answers]
    usual = questions[0].metric if questions else DEFAULT_METRIC
    metric = quantity(options.metric or usual, trials)
    if metric.cost:
        raise InputError(
            f"--metric {metric.key}: only metrics can be planned for, not counts and times"
        )
    difference = options.difference or metric.worthwhile
    if difference is None:
        raise InputError(
            f"--difference is needed: {metric.name} has no usual least difference that matters"
        )
    if not comparison.pairs:
        raise InputError(
            f"{options.experiment} has one arm, and planning needs pairs of trials of two"
        )
    level = ERROR_RATE / options.questions
    lines = [*comparison.sentences, *texts(comparison.remarks), *experiment.warnings]
    for baseline, arm in comparison.pairs:
        try:
            components = _components(trials, baseline, arm, metric)
        except InputError as error:
            if len(comparison.pairs) == 1:  # with several, the others may be planned for
                raise
            lines.append(str(error))
            continue
        planned = _lines(components, metric, difference, level)
        lines += [f"{arm} against {baseline}", *planned]
    seeds = sorted({trial.seed for trial in trials})
    lines.append(PLANNED.format(100 * level))
    lines.append(NEW_TRIALS.format(", ".join(map(str, seeds))))
    print("\n".join(lines))
    return 0


def _components(
    trials: Sequence[TrialResult], baseline: Arm, arm: Arm, metric: Quantity
) -> Components:
    """The variation of two arms' differences; raises InputError if their trials cannot tell."""
    paired = interval_of(trials, baseline, arm, metric.key).pairs
    arms = f"{baseline} and {arm}"
    if not paired.rows:
        reason = next(map(str, paired.left_out), "they share no scene and seed")
        raise InputError(f"no trials of {arms} can be paired in {metric.name}: {reason}")
    try:
        components = estimate_components([row.arm - row.baseline for row in paired.rows])
    except InputError as error:
        raise InputError(f"{arms}: {error}") from None
    if not components.within:
        raise InputError(
            f"{arms}: differences in {metric.name} do not vary between seeds, so nothing tells how "
            "many would show one"
        )
    return components


def _lines(components: Components, metric: Quantity, difference: float, level: float) -> list[str]:
    digits, between = f".{metric.decimals + 1}f", ""
    if components.between is not None:
        between = f", between scenes by {components.between:{digits}}"
    these = sweep_designs(difference, components, level)
    lines = [
        f"  differences in {metric.name} vary between seeds by "
        f"{components.within:{digits}}{between} (from {counted(components.trials, 'pair')} on "
        f"{counted(components.scenes, 'scene')})",
        _designs_line("these scenes", these, difference),
    ]
    for first in these[:1]:
        low, high = deviation_range(components)
        least, most = (
            100 * sweep_power(first, difference, replace(components, within=end), level)
            for end in (high, low)
        )
        lines.append(
            "  the pilot knows the variation between seeds only within "
            f"{low / components.within:.2f} to {high / components.within:.2f} times "
            f"({100 * UNSURE:.0f} % of pilots): so {first.scenes} × {first.seeds} sees it in "
            f"{least:.0f} to {most:.0f} of 100 cases"
        )
    group = f"scenes like these (from {MIN_SCENES} scenes on)"
    if components.between is None:
        return [*lines, f"  for {group}: run pilot trials on a second scene"]
    return [*lines, _designs_line(group, designs_like_these(difference, components), difference)]


def _designs_line(group: str, designs: Sequence[Design], difference: float) -> str:
    shown = [f"{one.scenes} × {one.seeds} ({one.trials} trials)" for one in designs[:MAX_DESIGNS]]
    what = f"  to see {difference:g} on {group}, scenes × seeds"
    return f"{what}: {', '.join(shown) or 'none that can be run'}"


# ---- ablation


def ablate(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0; raises InputError for bad input."""
    options = options_of("ablate", argv)
    # here, since `plan` needs no Hydra and --help no torch
    from gsbench.app.command import compose_trials
    from gsbench.config.overrides import value_text
    from gsbench.launch.batch import check_parts
    from gsbench.pipeline.parts import Parts

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
    return trials[0].values["densify"]["name"]


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
        switches[str(name)] = Switch(**check_values(Switch, entry, where))
    present = dict(values)
    return {
        name: switch
        for name, switch in switches.items()
        if present | switch.off != present  # else it is off already
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
