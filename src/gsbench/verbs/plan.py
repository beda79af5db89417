"""``gsbench plan``: how many scenes and seeds resolve a difference, estimated from an experiment's trials."""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from gsbench.analysis.cells import with_variants
from gsbench.analysis.pairing import BASELINE, choose_pairs, pair
from gsbench.analysis.planning import Components, designs_needed, estimate_components
from gsbench.analysis.quantities import Quantity, quantity
from gsbench.analysis.results import load_experiment
from gsbench.analysis.statistics import MIN_SCENES
from gsbench.errors import InputError
from gsbench.runs.declaration import Question
from gsbench.verbs.arguments import ArgumentParser
from gsbench.words import counted

MAX_DESIGNS = 5  # combinations of scenes and seeds that are shown


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    parser = ArgumentParser(
        prog="gsbench plan",
        description="From an experiment's trials: the scenes and seeds that resolve a difference with 80 % power.",
    )
    parser.add_argument("experiment")
    parser.add_argument("--metric", default="psnr", help="such as psnr (the default), ssim, lpips_squeeze")
    parser.add_argument(
        "--difference", type=_above_zero, help="the difference to see; default: what papers count as an improvement"
    )
    parser.add_argument("--baseline", default=BASELINE, help=f"the densifier to compare with ({BASELINE})")
    options = parser.parse_args(argv)
    trials = with_variants(load_experiment(runs, options.experiment).trials)
    metric = quantity(options.metric, trials)
    if metric.cost:
        raise InputError(f"--metric {options.metric}: only metrics can be planned for, not counts and times")
    difference = options.difference or metric.worthwhile
    if difference is None:
        raise InputError(f"--difference is needed: {metric.name} has no usual least difference that matters")
    pairs = choose_pairs(sorted({trial.arm for trial in trials}), options.baseline)
    if not pairs:
        raise InputError(f"{options.experiment} has one arm, and planning needs pairs of trials of two")
    for baseline, arm in pairs:
        compared = [trial for trial in trials if trial.arm in (baseline, arm)]
        paired = pair(compared, Question(metric=metric.key, baseline=baseline, arm=arm))
        if not paired.rows:
            raise InputError(f"no trials of {baseline} and {arm} can be paired in {metric.name}: {paired.left_out[0]}")
        components = estimate_components([row.arm - row.baseline for row in paired.rows])
        print("\n".join([f"{arm} against {baseline}", *_lines(components, metric, difference)]))
    return 0


def _lines(components: Components, metric: Quantity, difference: float) -> list[str]:
    digits = f".{metric.decimals + 1}f"
    between = "" if components.between is None else f", between scenes by {components.between:{digits}}"
    lines = [
        f"  differences in {metric.name} vary between seeds by {components.within:{digits}}{between} "
        f"(from {counted(components.trials, 'pair')} on {counted(components.scenes, 'scene')})"
    ]
    for like_these in (False, True):
        group = f"scenes like these (from {MIN_SCENES} scenes on)" if like_these else "these scenes"
        if like_these and components.between is None:
            lines.append(f"  for {group}: run pilot trials on a second scene")
            continue
        designs = designs_needed(difference, components, like_these)
        designs.sort(key=lambda design: (design.trials, design.scenes))
        texts = [f"{design.scenes} × {design.seeds} ({design.trials} trials)" for design in designs[:MAX_DESIGNS]]
        lines.append(
            f"  to see {difference:g} on {group}, scenes × seeds: {', '.join(texts) or 'no number that can be run'}"
        )
    return lines


def _above_zero(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not value > 0 or not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a number above 0, got {text!r}")
    return value
