"""``gsbench trend``: whether the difference of two arms holds from small to large, along one setting."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from gsbench.analysis.cells import select_trials
from gsbench.analysis.pairing import BASELINE
from gsbench.analysis.quantities import Quantity, quantity
from gsbench.analysis.report.charts import Bar, Series, line_chart
from gsbench.analysis.report.page import write_page
from gsbench.analysis.results import Experiment, load_experiment
from gsbench.analysis.trends import Answer, Trend, trend
from gsbench.analysis.verdicts import p_text
from gsbench.claims.archive import unpack_archive
from gsbench.verbs.arguments import ArgumentParser, add_where, path
from gsbench.words import counted, signed


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    parser = ArgumentParser(
        prog="gsbench trend",
        description="The difference of two arms at every value of a setting, how it changes when the value doubles, "
        "and from each value to the largest: how far a verdict at a small size can be trusted.",
    )
    parser.add_argument("experiment", help="its name, or an archive of `gsbench export --results` (NAME.zip)")
    parser.add_argument("--along", required=True, metavar="SETTING", help="such as scene.max_size, train.iterations")
    parser.add_argument("--arm", required=True, help="the densifier")
    parser.add_argument("--baseline", default=BASELINE, help=f"what it is held against ({BASELINE})")
    parser.add_argument("--metric", default="psnr", help="such as psnr (the default), ssim, lpips_squeeze")
    parser.add_argument("--init", help="only trials of this initialiser")
    add_where(parser)
    parser.add_argument("--out", type=path, metavar="FILE", help="also write this HTML file, with the chart")
    options = parser.parse_args(argv)
    with TemporaryDirectory() as folder:
        experiment = _experiment(options.experiment, runs, Path(folder))
        trials = select_trials(experiment.trials, dict(options.where))
        shown = quantity(options.metric, trials)
        found = trend(trials, options.baseline, options.arm, options.along, shown, options.init)
    print("\n".join([*_rows(found, options.along, shown), "", *describe(found, shown)]))
    if options.out is not None:
        title = f"{options.arm} − {options.baseline}: {shown.name} along {options.along}"
        write_page(options.out, title, trend_chart(found, title, options.along, shown), describe(found, shown))
        print(options.out)
    return 0


def _experiment(name: str, runs: Path, folder: Path) -> Experiment:
    """Return the experiment, or that of an archive, unpacked into ``folder``."""
    if name.endswith(".zip"):
        return unpack_archive(path(name), folder)
    return load_experiment(runs, name)


def _rows(found: Trend, along: str, shown: Quantity) -> list[str]:
    scenes = len(found.steps[0].by_scene)
    lines = [
        f"| {along} | difference | from here to the largest | scenes with the sign of the largest |",
        "|---|---|---|---|",
    ]
    for step in found.steps:
        rest = "" if step.to_largest is None else _words(step.to_largest, shown)
        lines.append(f"| {step.value:g} | {_words(step.difference, shown)} | {rest} | {step.same_sign} of {scenes} |")
    return lines


def describe(found: Trend, shown: Quantity) -> list[str]:
    """The trend in sentences."""
    scenes, values = len(found.steps[0].by_scene), len(found.steps)
    return [
        f"when the value doubles, the difference in {shown.name} changes by {_words(found.doubling, shown)}",
        f"and that change itself, from one doubling to the next, by {_words(found.bend, shown)}",
        f"of {counted(found.pairs, 'pair')} of scene and seed on {counted(scenes, 'scene')}; p and intervals of the "
        f"{values} differences are adjusted for their number, those of the changes to the largest for theirs",
        *(f"left out: {line}" for line in found.left_out),
    ]


def trend_chart(found: Trend, title: str, along: str, shown: Quantity) -> str:
    """The means with their intervals, the fitted line, and each scene's differences as a line, as SVG."""
    values = [step.value for step in found.steps]
    means = Series("mean", [(step.value, step.difference.mean) for step in found.steps])
    fitted = Series("fitted line", list(zip(values, found.line, strict=True)))
    scenes = [
        Series(scene, [(step.value, step.by_scene[scene]) for step in found.steps]) for scene in found.steps[0].by_scene
    ]
    bars = [
        Bar(step.value, step.difference.interval.low, step.difference.interval.high)
        for step in found.steps
        if step.difference.interval is not None
    ]
    label = f"difference in {shown.name}"
    return line_chart(title, [means, fitted, *scenes], along, label, log_x=True, dots=True, bars=bars, x_ticks=values)


def _words(answer: Answer, shown: Quantity) -> str:
    """``−0.0123 (−0.0200 to −0.0046), p 0.012``"""
    spec = f".{shown.decimals + 1}f"
    text = signed(answer.mean, spec)
    if answer.interval is None or answer.p is None:
        return text
    return f"{text} ({signed(answer.interval.low, spec)} to {signed(answer.interval.high, spec)}), p {p_text(answer.p)}"
