"""Simulate every error rate and power that the documents promise (findings/simulations.md).

    python scripts/promises.py                write all rows of the page (15 minutes)
    python scripts/promises.py --only habit   write the rows whose names have this word
    python scripts/promises.py --share 0.05   print them from a twentieth of the draws

Trials' results with known truth go in where results of trials go in: `judge` and the gate decide as
in the verbs; only the training and the files are left out. What people do with commands, one after
another, is simulated by `habits`; nights of ideas by `ledger_rates`.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import habits
import ledger_rates
import numpy as np
import regions
import simulations
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.planning import (
    Components,
    deviation_range,
    estimate_components,
    sweep_designs,
)
from gsbench.analysis.questions import plan_looks
from gsbench.analysis.results import Arm, TrialResult, Unfinished
from gsbench.analysis.statistics import Region
from gsbench.analysis.verdicts import judge
from gsbench.runs.commands import Question
from gsbench.runs.trial_record import TrialRecord
from gsbench.verbs import gate as gates

# If no bad training is seen, nothing tells such an arm from a better one (docs/verdict.md).
ONE_ARM_LIMIT = 0.22
METRIC, LEAST = "psnr", 0.1
NIGHTS = 8000  # at once
NO_RESULTS: dict[str, Any] = {
    **dict.fromkeys(("raster", "protocol"), ""),
    **dict.fromkeys(("iterations", "num_gaussians"), 0),
    **dict.fromkeys(("num_init_points", "peak_memory_mb")),
    **{name: {} for name in ("metrics", "unavailable", "seconds", "hashes", "versions")},
}

Array = NDArray[np.float64]
Rng = np.random.Generator
Draw = Callable[[Rng], float]  # whether one simulated use is counted
Measure = Callable[[float], tuple[float, float]]  # from a share of the draws: mean, standard error


@dataclass(frozen=True)
class Promise:
    """A promise: ``limit`` is the most, or (``at_least``) the least, that holds.

    ``draw`` simulates one use; ``found`` instead measures several uses at once.
    """

    name: str
    where: str
    limit: float
    draws: int
    draw: Draw | None = None
    at_least: bool = False
    found: Measure | None = None

    def measure(self, share: float) -> tuple[float, float]:
        """The mean of the draws, and its standard error."""
        if self.found is not None:
            return self.found(share)
        assert self.draw is not None
        return repeated(self.draw, max(20, round(share * self.draws)), sum(map(ord, self.name)))

    def holds(self, mean: float, error: float) -> bool:
        """Return whether the promise holds within three standard errors."""
        side = 1 if self.at_least else -1
        return side * (mean - self.limit) > -3 * error


def repeated(draw: Draw, draws: int, seed: int) -> tuple[float, float]:
    """The mean of the draws, and its standard error."""
    rng = np.random.default_rng(seed)
    found = np.array([draw(rng) for _ in range(draws)])
    # A rate of 0 or 1 in n draws is not known without error.
    spread = max(float(found.std(ddof=1)), 1 / math.sqrt(draws))
    return float(found.mean()), spread / math.sqrt(draws)


# ---- trials with known truth


def trials(arm: str, values: Array) -> list[TrialResult]:
    """Trials of an arm on scenes and seeds with these ``values`` [S, K]; its name is its digest."""
    found = []
    for place, row in enumerate(values):
        for seed, value in enumerate(row):
            scene = f"scene{place}"
            about: dict[str, Any] = {"scene": scene, "init": "sfm", "densify": arm, "seed": seed}
            filled = NO_RESULTS | {"metrics": {METRIC: float(value)}}
            record = TrialRecord(status="complete", experiment="simulated", **about, **filled)
            folder = Path("runs", "simulated", scene, f"sfm-{arm}", f"aaaa-seed{seed}")
            found.append(TrialResult(folder, "aaaa", record, alias=arm))
    return found


def question(
    arm: str, scenes: int, seeds: int, level: float = 0.05, looks: tuple[int, ...] = ()
) -> Question:
    """Ask if ``arm`` is better than the baseline, by all trials or in looks."""
    names = [f"scene{k}" for k in range(scenes)]
    return Question(
        idea=Arm("sfm", arm),
        baseline=Arm("sfm", "adc"),
        metric=METRIC,
        least=1e-9,
        digests=dict.fromkeys(names, ("adc", arm)),
        seeds=dict.fromkeys(names, tuple(range(seeds))),
        looks=looks,
        level=level,
        rule="declaration",
    )


def noise_of(scenes: int, ratio: float) -> Array:
    """Deviations [S, 1] of pairs; the first scene is ``ratio`` times as noisy."""
    return np.where(np.arange(scenes) == 0, ratio, 1.0)[:, None] * 0.1


def arms(
    rng: Rng,
    noise: Array,
    seeds: int,
    effects: Sequence[float],
    correlation: float = 0.0,
    degrees: float = math.inf,
) -> list[TrialResult]:
    """Trials of the baseline and of arms with these effects.

    Their noise is normal, or (``degrees``) Student's of unit variance, with heavy tails.
    """
    shape = (len(noise), seeds)

    def drawn() -> Array:
        if math.isinf(degrees):
            return rng.standard_normal(shape)
        return rng.standard_t(degrees, shape) * math.sqrt((degrees - 2) / degrees)

    baseline = drawn()
    found = trials("adc", 25 + noise * math.sqrt(0.5) * baseline)
    for number, effect in enumerate(effects):
        own = correlation * baseline
        own += math.sqrt(1 - correlation**2) * drawn()
        found += trials(f"arm{number}", 25 + effect + noise * math.sqrt(0.5) * own)
    return found


# ---- single questions


def sweep(
    scenes: int,
    seeds: int,
    ratio: float,
    effect: float,
    count: int = 1,
    looks: bool = False,
    **more: float,
) -> Draw:
    """Judge ``count`` questions of a command, which share 5 %.

    1 if any sign is false, or with an effect, in standard errors, if it is found.
    """

    def draw(rng: Rng) -> float:
        noise = noise_of(scenes, ratio)
        error = float(np.sqrt((noise**2).sum() / seeds)) / scenes
        made = arms(rng, noise, seeds, [effect * error] * count, **more)
        at = plan_looks(seeds) if looks else ()
        asked = [question(f"arm{k}", scenes, seeds, 0.05 / count, at) for k in range(count)]
        outcomes = {judge(made, one).outcome for one in asked}
        return float(bool(outcomes & {"supported", *(() if effect else ("refuted",))}))

    return draw


def failing(finish: bool) -> Draw:
    """A training in ten of one arm is worse by ten deviations of a pair; 3 × 3.

    Otherwise the arm is better by one, so the real mean difference is 0. Such trainings ``finish``
    with their results, or fail. 1 if the arm is called better.
    """
    asked = question("arm0", 3, 3)

    def draw(rng: Rng) -> float:
        values = rng.normal([[[25.0]], [[25.1]]], 0.1 * math.sqrt(0.5), (2, 3, 3))
        bad = rng.random((3, 3)) < 0.1
        baseline, arm = trials("adc", values[0]), trials("arm0", values[1] - bad)
        lost = [one for one, failed in zip(arm, bad.flat, strict=True) if failed and not finish]
        done = [*baseline, *(one for one in arm if one not in lost)]
        missing = [Unfinished(one.path, one.digest, failed=True) for one in lost]
        verdict = judge(done, asked, missing)
        return float(verdict.outcome == "supported")

    return draw


def like_these(scenes: int) -> Draw:
    """Skewed effects with noise: 1 if the statement on a new scene like these is false.

    12 % of scenes gain three deviations of a pair, the others lose a tenth; three seeds. So the
    median effect is a loss, but of measured means just as many gain.
    """
    rng = np.random.default_rng(0)
    many = np.where(rng.random(400_000) < 0.12, 0.3, -0.01) + rng.normal(0, 0.1 / 3**0.5, 400_000)
    gains = (many > 0).mean() > 0.5

    def draw(rng: Rng) -> float:
        effects = np.where(rng.random((scenes, 1)) < 0.12, 0.3, -0.01)
        shape, part = (scenes, 3), 0.1 * math.sqrt(0.5)
        made = trials("adc", rng.normal(25, part, shape))
        made += trials("arm0", 25 + effects + rng.normal(0, part, shape))
        verdict = judge(made, question("arm0", scenes, 3))
        assert verdict.like_these is not None
        return float(verdict.like_these.outcome == ("refuted" if gains else "supported"))

    return draw


# ---- the rules at all shapes, with importance sampling: a verb could not show such small rates


def largest_size(level: float) -> Measure:
    """The largest rate of false signs, as a part of the level, of all shapes and kinds of noise.

    1 to 30 scenes, 2 to 8 seeds, 1, 2, 3, half and all but one of the scenes up to 100 times as
    noisy, and noise that rises evenly. The shapes with the largest sizes are drawn once more.
    """

    def sizes(scenes: int, seeds: int, draws: int, seed: int) -> tuple[float, float]:
        drawn = regions.Sample(regions.noises(scenes), seeds, draws, seed)
        limits = Region(scenes, seeds, drawn.even).limits(level)
        rates = 2 * special.ndtr(-limits * drawn.ratio) * drawn.weight * draws / level
        worst = rates[rates.mean(axis=1).argmax()]
        return float(worst.mean()), float(worst.std()) / math.sqrt(draws)

    def found(share: float) -> tuple[float, float]:
        shapes = product(range(2, 31), range(2, 9))  # the test of one scene is Student's
        first = {one: sizes(*one, round(2000 + 2000 * share), 11) for one in shapes}
        again = sorted(first, key=lambda one: first[one])[-3:]
        return max(sizes(*one, round(4000 + 28_000 * share), 12) for one in again)

    return found


# ---- gate


def gate(scenes: int, seeds: int, loss: float, counted: str) -> Draw:
    """A gate of a version with this loss; 1 if its result is the ``counted`` one."""
    values: Mapping[str, Any] = {"eval": {"extra": {}}}
    names = [f"scene{k}" for k in range(scenes)]
    asked = gates.declare_gate(METRIC, str(LEAST), names, range(seeds), values)

    def draw(rng: Rng) -> float:
        noise = 0.1 * math.sqrt(0.5)
        old = trials("adc", rng.normal(25, noise, (scenes, seeds)))
        new = trials("adc", rng.normal(25 - loss, noise, (scenes, seeds)))
        most = 0

        def run(planned: Iterable[tuple[Any, ...]]) -> None:
            nonlocal most
            most = 1 + max(one[-1] for one in planned)

        found = gates.ask_gate(
            asked,
            lambda: [one for one in old if one.seed < most],
            lambda: [one for one in new if one.seed < most],
        )
        (verdict,) = found.answer(run)
        return float(gates.result_of(verdict) == counted)

    return draw


# ---- commands one after another, nights of ideas


def habit(own: habits.Habit, which: int = 0) -> Measure:
    """The rate of a habit: how often an idea without an effect is ever called better."""
    return lambda share: habits.rate(own, max(400, round(40_000 * share)), 0, which)


def nights_at_once(noise: tuple[float, ...], correlation: float, most: bool = False) -> Measure:
    """Nights of a ledger without a good idea, by its rule as `ledger_rates` restates it.

    With ``most``, nine of ten ideas are other tries of what has the most standard errors.
    """
    rule = ledger_rates.RULES["the ledger"]
    # The gain that matters is half a deviation of the mean of a pair on each capture.
    least = 0.5 * math.sqrt(sum(one**2 for one in noise) / len(noise))

    def found(share: float) -> tuple[float, float]:
        nights = round(100 + (NIGHTS - 100) * share)
        retried = 0.9 if most else 0.7
        asked = ledger_rates.Night(least, 0.0, 0.0, retried, correlation, noise, by_size=most)
        rate = ledger_rates.simulate(rule, asked, nights).false
        return rate, math.sqrt(max(rate * (1 - rate), 1 / nights) / nights)

    return found


# ---- plans


def planned(difference: float, ratio: float = 1.0) -> Draw:
    """A sweep with the design that `plan` names; 1 if it shows the difference.

    The deviations of trainings are known; the first of three scenes is ``ratio`` times as noisy.
    """
    noise = noise_of(3, ratio)[:, 0]
    within = float(np.sqrt((noise**2).mean()))
    shares = tuple(sorted(noise**2 / within**2))
    known = Components(between=None, within=within, scenes=3, trials=9, shares=shares)
    seeds = min(one.seeds for one in sweep_designs(difference, known) if one.scenes == 3)
    return sweep(3, seeds, ratio, difference / (within / math.sqrt(3 * seeds)))


def unsure(rng: Rng) -> float:
    """A pilot of 3 × 3 pairs: 1 if the real deviation lies in the range that `plan` gives."""
    low, high = deviation_range(estimate_components(list(rng.normal(0, 0.1, (3, 3)))))
    return float(low <= 0.1 <= high)


# ---- the page


def promises() -> Iterator[Promise]:
    yield from _of_single_questions()
    yield from _of_habits()
    for name, counted, loss in (
        ("worse although nothing changed", gates.WORSE, 0.0),
        ("passed although the loss is the least that matters", gates.PASSED, LEAST),
    ):
        yield Promise(f"gate: {name}, 2 × 6", "`ask_gate`", 0.025, 1500, gate(2, 6, loss, counted))
    yield from _of_nights()
    for detail, difference, ratio in (
        ("the difference on three scenes", 0.1, 1.0),
        ("the difference, deviations 4 : 1 : 1", 0.25, 4.0),
    ):
        name = f"plan for a sweep: shows {detail}"
        yield Promise(name, "`sweep_designs`", 0.8, 500, planned(difference, ratio), True)
    name = "plan: range of the deviation from a 3 × 3 pilot"
    yield Promise(name, "`deviation_range`", 0.8, 8000, unsure, True)


def _of_single_questions() -> Iterator[Promise]:
    judged = "`judge`"
    for scenes, seeds, ratio in (
        (1, 3, 1.0),
        (3, 3, 1.0),
        (3, 3, 4.0),
        (3, 3, 100.0),
        (13, 2, 20.0),
        (30, 2, 20.0),
    ):
        name = f"false signs, {scenes} × {seeds}, one scene {ratio:g} times as noisy"
        yield Promise(name, judged, 0.05, 3000, sweep(scenes, seeds, ratio, 0.0))
    name = "false signs, 8 × 6, trainings of a seed correlate by −.17"
    yield Promise(name, judged, 0.05, 2000, sweep(8, 6, 1.0, 0.0, correlation=-0.17))
    for scenes, seeds in ((1, 3), (3, 3), (8, 3)):
        name = f"false signs, {scenes} × {seeds}, heavy tails (Student's with 3 degrees)"
        yield Promise(name, judged, 0.05, 3000, sweep(scenes, seeds, 1.0, 0.0, degrees=3.0))
    name = "false signs of four questions of a command, 3 × 3"
    yield Promise(name, judged, 0.05, 1500, sweep(3, 3, 1.0, 0.0, 4))
    for scenes, seeds in ((1, 6), (3, 4), (20, 4)):
        name = f"false signs in looks, {scenes} × {seeds}"
        yield Promise(name, judged, 0.05, 1500, sweep(scenes, seeds, 1.0, 0.0, looks=True))
    name = "power at three standard errors, 3 × 3"
    yield Promise(name, judged, 0.5, 3000, sweep(3, 3, 1.0, 3.0), True)
    for finish, how in ((True, "finishes, far worse"), (False, "fails")):
        name = f"better, although a training in ten of one arm {how}, 3 × 3"
        yield Promise(name, judged, ONE_ARM_LIMIT, 4000, failing(finish))
    for level, most in ((0.05, 1.04), (0.025, 1.04), (0.0125, 1.07), (0.005, 1.2)):
        name = f"false signs at {100 * level:g} %, in parts of it, at all shapes and kinds of noise"
        yield Promise(name, "`Region`", most, 32_000, found=largest_size(level))
    for count in (6, 9, 20):
        name = f"scenes like these, {count} scenes, skewed effects with noise"
        yield Promise(name, "`judge_like_these`", 0.05, 1500, like_these(count))


def _of_habits() -> Iterator[Promise]:
    """Rows of what people do with one idea: ever called better, whatever they do."""
    rows: list[tuple[str, habits.Habit]] = [
        (f"twelve settings one after another, {scenes} × 3", habits.settings(scenes))
        for scenes in (1, 3, 9)
    ]
    rows += [
        (f"twelve edits that correlate by 0.8, {scenes} × 3", habits.settings(scenes, 0.8))
        for scenes in (1, 3)
    ]
    rows.append(("forty tries on one scene that correlate by 0.8", habits.settings(1, 0.8, 40)))
    for what, when in product(("seeds", "scenes"), habits.WHEN):
        rows.append((f"{what} added {when}", habits.adding(what, when)))
    rows += [
        ("three seeds added at a time", habits.adding("seeds", "always", 3)),
        ("seeds, edits and scenes in turn, by the mean so far", habits.mixed),
        ("four metrics one after another", habits.metrics),
        ("sweeps stopped where the first seed looks bad, then edited", habits.partial),
    ]
    for name, own in rows:
        found = habit(own)
        yield Promise(f"habit: {name}", "`level_of`, `count_tries`", 0.05, 40_000, found=found)
    found = habit(habits.chosen_beginning)
    name = "habit: a flattering number of a baseline's seen seeds (a half of 5 % for a new idea)"
    yield Promise(name, "`ask`", 0.06, 40_000, found=found)


def _of_nights() -> Iterator[Promise]:
    for correlation, noise in (
        *product((0.0, 0.39, 0.7, 0.8, 0.95), ((1.0,),)),
        *product((0.8, 0.95), ((1.0, 1.0, 1.0), (10.0, 1.0, 1.0), (100.0, 1.0, 1.0), (10.0, 1.0))),
    ):
        name = f"ledger: false discoveries, noise {' : '.join(f'{one:g}' for one in noise)}, "
        name += f"retries correlate by {correlation:g}"
        measure = nights_at_once(noise, correlation)
        yield Promise(name, "`in_tests`", 0.1, NIGHTS, found=measure)
    for correlation in (0.7, 0.95):
        name = "ledger: false discoveries, one capture, "
        name += f"nine of ten retry the most standard errors, by {correlation:g}"
        measure = nights_at_once((1.0,), correlation, most=True)
        yield Promise(name, "`in_tests`", 0.1, NIGHTS, found=measure)


HEAD = (
    "| promise | decided by | promised | simulated | draws | holds |\n|---|---|---|---|---|---|\n"
)


def line(promise: Promise, mean: float, error: float, share: float) -> str:
    """The row of a promise in Markdown."""
    limit = f"{'≥' if promise.at_least else '≤'} {100 * promise.limit:g} %"
    draws = max(20, round(share * promise.draws))
    return (
        f"| {promise.name} | {promise.where} | {limit} | {100 * mean:.1f} ± {100 * error:.1f} % "
        f"| {draws} | {'yes' if promise.holds(mean, error) else '**no**'} |\n"
    )


def with_row(table: str, row: str) -> str:
    """The table with this row in place of the one with its name, at the place of its promise."""
    rows = {own.split(" | ")[0]: f"{own}\n" for own in table.splitlines()[2:]}
    rows[row.split(" | ")[0]] = row
    names = [f"| {one.name}" for one in promises()]
    return HEAD + "".join(rows[name] for name in names if name in rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--share", type=float, help="print from this share of the draws")
    parser.add_argument("--only", default="", help="those whose names have this word")
    options = parser.parse_args()
    broken = False
    for promise in promises():
        if options.only not in promise.name:
            continue
        share, begun = options.share or 1.0, time.process_time()
        mean, error = promise.measure(share)
        row = line(promise, mean, error, share)
        broken = broken or not promise.holds(mean, error)
        print(f"{row[:-1]} {time.process_time() - begun:.0f} s", flush=True)
        if not options.share:  # row by row, so that nothing is lost if the command is stopped
            simulations.write_table("promises", with_row(simulations.table("promises"), row))
    if broken:
        sys.exit("a promise does not hold")


if __name__ == "__main__":
    main()
