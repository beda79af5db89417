"""Tables and the picture of `BRIDGE` for docs/findings.md, from small to large, made of its published archive.

The differences at the values of a line are one family of tests (Holm), and so are their changes to the largest value.
"""

from __future__ import annotations

from collections.abc import Sequence

from findings_archives import DATA, PRIMARY, trials_of
from findings_pairs import facts, row

from gsbench.analysis.cells import select_trials
from gsbench.analysis.quantities import quantity
from gsbench.analysis.trends import Answer, Trend, trend
from gsbench.words import signed

BRIDGE = "scale_bridge"
PAIRS = (("volumetric_once", "adc"), ("longaxis", "absgrad"))
LINES = {  # what grows: its unit, and what holds the other still
    "scene.max_size": ("px", {"train.iterations": "5000"}),
    "train.iterations": ("iterations", {"scene.max_size": "256"}),
}
DIGITS = 3  # of the declared metric
OTHERS = {"psnr": 2, "ssim": 3}  # metrics shown beside it, with their digits


def found(name: str, arm: str, against: str, along: str, metric: str) -> Trend:
    """Return how ``arm`` minus ``against`` goes along one of `LINES`."""
    trials = select_trials(trials_of(name), LINES[along][1])
    return trend(trials, against, arm, along, quantity(metric, trials))


def trends_table(name: str, arms: Sequence[str], against: str) -> list[str]:
    """Table of a value a row, both lines below each other: the declared metric, its change from there, two others."""
    titles = [f"{facts(PRIMARY).label}: {arms[0]} − {against}", "scenes with the sign at the largest"]
    titles += ["changes to the largest by", *(facts(metric).label for metric in OTHERS)]
    lines = [row(["", *titles]), row(["---"] * (1 + len(titles)))]
    for along, (unit, _) in LINES.items():
        primary = found(name, arms[0], against, along, PRIMARY)
        others = [(found(name, arms[0], against, along, metric), digits) for metric, digits in OTHERS.items()]
        for place, step in enumerate(primary.steps):
            cells = [cell(step.difference, DIGITS), f"{step.same_sign} of {len(step.by_scene)}"]
            cells.append("" if step.to_largest is None else cell(step.to_largest, DIGITS))
            cells += [cell(other.steps[place].difference, digits) for other, digits in others]
            lines.append(row([f"{step.value:,.0f} {unit}", *cells]))
        doublings = [cell(other.doubling, digits) for other, digits in others]
        lines.append(row([f"*twice the {unit}*", cell(primary.doubling, DIGITS), "", "", *doublings]))
    return lines


def cell(answer: Answer, digits: int) -> str:
    """A mean with its interval; bold where that leaves zero."""
    if answer.interval is None:
        return signed(answer.mean, f".{digits}f")
    low, high = (signed(end, f".{digits}f") for end in (answer.interval.low, answer.interval.high))
    text = f"{signed(answer.mean, f'.{digits}f')} ({low} to {high})"
    return f"**{text}**" if answer.interval.low > 0 or answer.interval.high < 0 else text


def draw(name: str = BRIDGE) -> None:
    """Draw the declared metric, a pair of arms a row, a line of `LINES` a column: scenes, their mean, its interval."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(len(PAIRS), len(LINES), figsize=(9.6, 6.4), squeeze=False, sharey=True)
    for (arm, against), panels in zip(PAIRS, axes, strict=True):
        for (along, (unit, _)), axis in zip(LINES.items(), panels, strict=True):
            steps = found(name, arm, against, along, PRIMARY).steps
            values = [step.value for step in steps]
            for scene in steps[0].by_scene:
                axis.plot(values, [step.by_scene[scene] for step in steps], linewidth=1, marker=".", label=scene)
            answers = [step.difference for step in steps]
            low, high = (
                [abs(a.mean - getattr(a.interval, end)) if a.interval else 0.0 for a in answers]
                for end in ("low", "high")
            )
            means = [a.mean for a in answers]
            axis.errorbar(values, means, yerr=[low, high], color="black", linewidth=2, capsize=3, label="mean")
            axis.axhline(0, color="grey", linewidth=0.8)
            axis.set(xscale="log", title=f"{arm} − {against}", xlabel=unit)
            axis.set_xticks(values, [f"{value:,.0f}" for value in values])
            axis.minorticks_off()
        panels[0].set_ylabel(facts(PRIMARY).label)
    axes[0][0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(DATA / f"{name}.png", dpi=80)
    plt.close(figure)
