"""``gsbench plan``: how many scenes and seeds show a difference (docs/claims.md)."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pydantic import PositiveFloat

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
from gsbench.runs.commands import ERROR_RATE
from gsbench.runs.experiments import DEFAULT_METRIC
from gsbench.verbs.arguments import ArgumentParser, number, whole_number
from gsbench.words import counted

MAX_DESIGNS = 5  # combinations of scenes and seeds that `plan` shows
MOST_QUESTIONS = 10_000
PLANNED = "Planned for a sweep: each question errs in {:.3g} %; all seeds are judged at once."
NEW_TRIALS = (
    "Train all of them with seeds that the pilot does not have (it has {}), under another name: "
    "what was seen is not declared beforehand."
)


def plan(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    options = ArgumentParser(
        "plan",
        "It estimates from an experiment's trials how many scenes and seeds show a difference of "
        "one arm in 80 of 100 cases. The seeds are new ones: those of the trials are seen "
        "(docs/verdict.md). How many ideas will be found, it cannot say.",
        {
            "experiment": "of the pilot trials",
            "--questions N": (
                "pairs of arms that share the error rate (1)",
                whole_number(MOST_QUESTIONS),
                1,
            ),
            "--metric NAME": "such as ssim; default: that of the experiment's question, or psnr",
            "--difference SIZE": (
                "to be seen; default: what papers count as an improvement",
                number(PositiveFloat),
            ),
            "--baseline NAME": (f"the densifier to compare with ({BASELINE})", str, BASELINE),
        },
    ).parse_args(argv)
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
