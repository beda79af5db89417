"""Simulate every error rate and power that the documents promise (findings/simulations.md).

    python scripts/promises.py                write all rows of the page (15 minutes)
    python scripts/promises.py --only gate    write the rows whose names have this word
    python scripts/promises.py --share 0.05   print them from a twentieth of the draws

Trials' results with known truth go in where results of trials go in: `judge`, looks, gate
and ledger decide as in the verbs; only the training and the files are left out.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import ledger_rates
import numpy as np
import regions
import simulations
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.designs import estimate_components
from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.looks import look_levels, plan_looks, simulate_looks
from gsbench.analysis.planning import Purpose, deviation_range
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.statistics import REFUTED, SUPPORTED
from gsbench.analysis.thresholds import Region
from gsbench.analysis.unfinished import Unfinished
from gsbench.claims import gate as gates
from gsbench.claims import ledger as rules
from gsbench.claims.stopping import KeyAndSeed, SequentialTest
from gsbench.runs import ledger as records
from gsbench.runs.experiments import Declaration, Question, trial_key
from gsbench.runs.trial_record import TrialRecord
from gsbench.verbs.plan import purpose_of

# If no bad training is seen, nothing tells such an arm from a better one (docs/verdict.md).
ONE_ARM_LIMIT = 0.22
TIME, MEASURED = "2020-01-01T00:00:00Z", "2021-01-01T00:00:00Z"
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


def trials(
    arm: str, values: Array, version: str = "aaaa", first_seed: int = 0
) -> list[TrialResult]:
    """Trials of an arm on scenes and seeds with these ``values`` [S, K]."""
    found = []
    for place, row in enumerate(values):
        for seed, value in enumerate(row, first_seed):
            scene = f"scene{place}"
            about: dict[str, Any] = {"scene": scene, "init": "sfm", "densify": arm, "seed": seed}
            filled = NO_RESULTS | {"metrics": {METRIC: float(value)}, "measured": MEASURED}
            record = TrialRecord(status="complete", experiment="simulated", **about, **filled)
            folder = Path("runs", "simulated", scene, f"sfm-{arm}", f"{version}-seed{seed}")
            found.append(TrialResult(folder, version, record))
    return found


def question(arm: str, scenes: int, seeds: int, least: float = LEAST, **more: Any) -> Question:
    """Ask if ``arm`` is better than the baseline."""
    keys = {
        f"scene{k}": (
            trial_key(f"scene{k}", "sfm-adc", "aaaa"),
            trial_key(f"scene{k}", f"sfm-{arm}", "aaaa"),
        )
        for k in range(scenes)
    }
    both = {"baseline": Arm("sfm", "adc"), "arm": Arm("sfm", arm)}
    return Question(
        metric=METRIC, least=least, scenes=keys, seeds=tuple(range(seeds)), **both, **more
    )


def noise_of(scenes: int, ratio: float) -> Array:
    """Deviations [S, 1] of pairs; the first scene is ``ratio`` times as noisy."""
    return np.where(np.arange(scenes) == 0, ratio, 1.0)[:, None] * 0.1


def arms(
    rng: Rng, noise: Array, seeds: int, effects: Sequence[float], correlation: float = 0.0
) -> list[TrialResult]:
    """Trials of the baseline and of arms with these effects."""
    shape = (len(noise), seeds)
    baseline = rng.standard_normal(shape)
    found = trials("adc", 25 + noise * math.sqrt(0.5) * baseline)
    for number, effect in enumerate(effects):
        own = correlation * baseline
        own += math.sqrt(1 - correlation**2) * rng.standard_normal(shape)
        found += trials(f"arm{number}", 25 + effect + noise * math.sqrt(0.5) * own)
    return found


# ---- sweeps and checks


def sweep(
    scenes: int, seeds: int, ratio: float, effect: float, count: int = 1, **more: float
) -> Draw:
    """Judge a sweep; 1 if any sign is false, or with an effect if it is found."""

    def draw(rng: Rng) -> float:
        noise = noise_of(scenes, ratio)
        error = float(np.sqrt((noise**2).sum() / seeds)) / scenes
        made = arms(rng, noise, seeds, [effect * error] * count, **more)
        asked = tuple(question(f"arm{k}", scenes, seeds, 1e-9) for k in range(count))
        verdicts = judge(made, Declaration(time=TIME, questions=asked))
        return float(
            any(
                one.outcome in ((SUPPORTED,) if effect else (SUPPORTED, REFUTED))
                for one in verdicts
            )
        )

    return draw


def failing(finish: bool) -> Draw:
    """A training in ten of one arm is worse by ten deviations of a pair; 3 × 3.

    Otherwise the arm is better by one, so the real mean difference is 0. Such trainings ``finish``
    with their results, or fail. 1 if the arm is called better.
    """
    asked = Question(metric=METRIC, least=1e-9, baseline=Arm("sfm", "adc"), arm=Arm("sfm", "arm0"))

    def draw(rng: Rng) -> float:
        values = rng.normal([[[25.0]], [[25.1]]], 0.1 * math.sqrt(0.5), (2, 3, 3))
        bad = rng.random((3, 3)) < 0.1
        baseline, arm = trials("adc", values[0]), trials("arm0", values[1] - bad)
        lost = [one for one, failed in zip(arm, bad.flat, strict=True) if failed and not finish]
        done = [*baseline, *(one for one in arm if one not in lost)]
        declared = Declaration(time=TIME, questions=(asked,))
        (verdict,) = judge(done, declared, [Unfinished(one.path) for one in lost])
        return float(verdict.outcome == SUPPORTED)

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


def levels_of_looks(scenes: int, looks: tuple[int, ...], level: float) -> Measure:
    """The largest rate of false signs over all looks, as a part of the level, by kinds of noise."""

    def found(share: float) -> tuple[float, float]:
        levels, rates = look_levels(scenes, looks, level), []
        for noise in (1.0,) if scenes == 1 else (1.0, 2.0, 4.0, 8.0, 15.0, 30.0, 100.0):
            drawn = simulate_looks(scenes, looks, round(10_000 + 140_000 * share), noise, seed=11)
            false = [
                drawn.sizes[look] > drawn.region(look).limits(own)
                for look, own in enumerate(levels)
            ]
            errors = np.any(false, axis=0) * drawn.weights * len(drawn.weights) / level
            rates.append((float(errors.mean()), float(errors.std()) / math.sqrt(len(errors))))
        return max(rates)

    return found


def in_looks(declaration: Declaration, made: Sequence[TrialResult]) -> list[Verdict]:
    """The verdicts after all looks; trials are there from the look on that trains them."""
    by_key = {(one.key, one.seed): one for one in made}
    done: dict[KeyAndSeed, TrialResult] = {}

    def run(planned: Iterable[KeyAndSeed]) -> None:
        done.update({key: by_key[key] for key in planned})

    return SequentialTest(declaration, done.values).answer(run)


def check(scenes: int, seeds: int, ratio: float, effect: float, claims: int) -> Draw:
    """A check of claims in looks; 1 if any is false, or with an effect if the first is found."""

    def draw(rng: Rng) -> float:
        made = arms(rng, noise_of(scenes, ratio), seeds, [effect] * claims)
        asked = tuple(question(f"arm{k}", scenes, seeds, 1e-9) for k in range(claims))
        looks = plan_looks(seeds)
        verdicts = in_looks(Declaration(time=TIME, questions=asked, looks=looks), made)
        if effect:
            return float(verdicts[0].outcome == SUPPORTED)
        return float(any(one.outcome in (SUPPORTED, REFUTED) for one in verdicts))

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
        (verdict,) = judge(
            made, Declaration(time=TIME, questions=(question("arm0", scenes, 3, 1e-9),))
        )
        assert verdict.like_these is not None
        return float(verdict.like_these.outcome == (REFUTED if gains else SUPPORTED))

    return draw


# ---- gate


def gate_question(scenes: int, seeds: int) -> Declaration:
    names = {f"scene{k}": ("sfm-adc", "sfm-adc") for k in range(scenes)}
    values: Mapping[str, Any] = {"eval": {"extra": {}}}
    found = gates.declare_gate(METRIC, str(LEAST), names, range(seeds), values)
    return replace(found, time=TIME)


def gate(scenes: int, seeds: int, loss: float, counted: str) -> Draw:
    """A gate of a version with this loss; 1 if its result is the ``counted`` one."""
    asked = gate_question(scenes, seeds)

    def draw(rng: Rng) -> float:
        noise = 0.1 * math.sqrt(0.5)
        old = trials("adc", rng.normal(25, noise, (scenes, seeds)))
        new = trials("adc", rng.normal(25 - loss, noise, (scenes, seeds)))
        most = 0

        def run(planned: Iterable[KeyAndSeed]) -> None:
            nonlocal most
            most = 1 + max(seed for _, seed in planned)

        found = gates.ask_gate(
            asked,
            lambda: [one for one in old if one.seed < most],
            lambda: [one for one in new if one.seed < most],
        )
        (verdict,) = found.answer(run)
        return float(gates.result_of(verdict) == counted)

    return draw


# ---- ledger


def attempt(declaration: Declaration, made: Sequence[TrialResult]) -> Verdict:
    """The verdict on an idea after its looks."""
    most = 0

    def run(planned: Iterable[KeyAndSeed]) -> None:
        nonlocal most
        most = 1 + max(seed for _, seed in planned)

    asked = rules.ask_idea(declaration, lambda: [one for one in made if one.seed < most])
    (verdict,) = asked.answer(run)
    return verdict


@dataclass
class Night:
    """A ledger whose trials are drawn: PSNR, with a deviation of .1 of a pair's difference."""

    rng: Rng
    captures: int
    ideas: int = 40
    seeds: int = 6
    least: float = 0.05

    def __post_init__(self) -> None:
        self.noise = 0.1 * math.sqrt(0.5)
        self.shape = (self.captures, self.seeds)
        opened = records.Opened(
            time=TIME,
            metric=METRIC,
            sign=1,
            least=self.least,
            ideas=self.ideas,
            rate=0.1,
            seeds=tuple(range(self.seeds)),
            words=(),
            keys=self.keys("adc"),
        )
        self.entries: list[records.Entry] = [opened]
        self.baseline = self.made("adc", self.rng.standard_normal(self.shape))

    def keys(self, arm: str) -> dict[str, str]:
        scenes = (f"scene{k}" for k in range(self.captures))
        return {scene: trial_key(scene, f"sfm-{arm}", "aaaa") for scene in scenes}

    def made(
        self, arm: str, noise: Array, gain: float = 0.0, first_seed: int = 0
    ) -> list[TrialResult]:
        return trials(arm, 25 + gain + self.noise * noise, first_seed=first_seed)

    @property
    def book(self) -> records.Ledger:
        return records.Ledger(tuple(self.entries), "")

    def attempt(self, name: str, noise: Array, gain: float = 0.0) -> Verdict:
        """Try an idea with this noise on the shared seeds; the verdict that decides it."""
        started = records.Started(
            time=TIME, idea=name, against=records.BASELINE, identity=name, words=(),
            keys=self.keys(name),
        )  # fmt: skip
        self.entries.append(started)
        made = [*self.baseline, *self.made(name, noise, gain)]
        verdict = attempt(rules.screening_of(self.book, name), made)
        if rules.result_of(verdict) == records.KEPT:
            test = rules.next_test(self.book, name, TIME)
            self.entries.append(test)
            draws = self.rng.standard_normal((2, *self.shape))
            made = self.made("adc", draws[0], first_seed=test.seeds[0])
            made += self.made(name, draws[1], gain, test.seeds[0])
            verdict = attempt(rules.test_of(self.book, name), made)
        self.entries.append(rules.end_of(name, verdict, TIME))
        return verdict


def night(captures: int, retried: float, correlation: float) -> Draw:
    """A night of ideas without any effect; 1 if an idea is kept.

    A share of them are other tries of what looked best so far, with correlated noise.
    """

    def draw(rng: Rng) -> float:
        own = Night(rng, captures)
        best, best_noise = -math.inf, np.zeros(own.shape)
        for number in range(own.ideas):
            noise = rng.standard_normal(own.shape)
            if math.isfinite(best) and rng.random() < retried:
                noise = correlation * best_noise + math.sqrt(1 - correlation**2) * noise
            verdict = own.attempt(f"idea{number}", noise)
            if rules.result_of(verdict) == records.KEPT:
                return 1.0  # of ideas without an effect, the first one kept makes the share 1
            if verdict.mean is not None and verdict.mean > best:
                best, best_noise = verdict.mean, noise
        return 0.0

    return draw


def tested(scenes: int, seeds: int, difference: float) -> Draw:
    """A good idea after a quarter of the ideas were tested; 1 if it is kept."""

    def draw(rng: Rng) -> float:
        own = Night(rng, scenes, seeds=seeds, least=difference)
        for number in range(own.ideas // 4 - 1):
            first = 1000 + seeds * number
            seen = tuple(range(first, first + seeds))
            own.entries.append(records.Promoted(time=TIME, idea=str(number), level=0.1, seeds=seen))
        verdict = own.attempt("good", rng.standard_normal(own.shape), difference)
        return float(rules.result_of(verdict) == records.KEPT)

    return draw


def nights_at_once(noise: tuple[float, ...], correlation: float, most: bool = False) -> Measure:
    """The same of many nights at once, by the rule as `ledger_rates` restates it.

    With ``most``, nine of ten ideas are other tries of what has the most standard errors.
    """
    rule = ledger_rates.RULES["the ledger"]
    # The gain that matters is half a deviation of the mean of a pair on each capture.
    least = 0.5 * math.sqrt(sum(one**2 for one in noise) / len(noise))

    def found(share: float) -> tuple[float, float]:
        nights, asked = (
            round(100 + (NIGHTS - 100) * share),
            ledger_rates.Night(
                least, 0.0, 0.0, 0.9 if most else 0.7, correlation, noise, by_size=most
            ),
        )
        rate = ledger_rates.simulate(rule, asked, nights).false
        return rate, math.sqrt(max(rate * (1 - rate), 1 / nights) / nights)

    return found


# ---- plans


def planned(command: str, difference: float) -> Draw:
    """A command with the design that `plan` names; 1 if it shows the difference.

    The deviation of trainings is known, and two scenes have it.
    """
    claims = 4 if command == "check" else 1
    seeds = min(one.seeds for one in PURPOSES[command].designs(difference, 0.1) if one.scenes == 3)
    if command == "sweep":
        return sweep(3, seeds, 1.0, difference / 0.1 * math.sqrt(3 * seeds))
    if command == "gate":
        return gate(3, seeds, difference, gates.WORSE)
    if command == "ledger":
        return tested(3, seeds, difference)
    return check(3, seeds, 1.0, difference, claims)


PURPOSES = {
    "sweep": Purpose(),
    "looks": Purpose(looks=True),
    "check": Purpose(0.05 / 4, looks=True),
    "gate": Purpose(looks=True),
    "ledger": purpose_of("ledger", None),
}


def unsure(rng: Rng) -> float:
    """A pilot of 3 × 3 pairs: 1 if the real deviation lies in the range that `plan` gives."""
    low, high = deviation_range(estimate_components(list(rng.normal(0, 0.1, (3, 3)))))
    return float(low <= 0.1 <= high)


# ---- the page


def promises() -> Iterator[Promise]:
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
    yield Promise(
        "false signs, 8 × 6, trainings of a seed correlate by −.17",
        judged,
        0.05,
        2000,
        sweep(8, 6, 1.0, 0.0, correlation=-0.17),
    )
    yield Promise("false signs of four arms, 3 × 3", judged, 0.05, 1500, sweep(3, 3, 1.0, 0.0, 4))
    yield Promise(
        "power at three standard errors, 3 × 3", judged, 0.5, 3000, sweep(3, 3, 1.0, 3.0), True
    )
    for scenes, seeds, ratio in ((1, 6, 1.0), (3, 4, 4.0), (20, 4, 30.0)):
        name = (
            f"a false sign of four claims in looks, {scenes} × {seeds}, one scene {ratio:g} × noise"
        )
        yield Promise(name, "`SequentialTest`", 0.05, 1000, check(scenes, seeds, ratio, 0.0, 4))
    for finish, how in ((True, "finishes, far worse"), (False, "fails")):
        name = f"better, although a training in ten of one arm {how}, 3 × 3"
        yield Promise(name, judged, ONE_ARM_LIMIT, 4000, failing(finish))
    for level, most in ((0.05, 1.04), (0.025, 1.04), (0.0125, 1.07), (0.005, 1.2)):
        name = f"false signs at {100 * level:g} %, in parts of it, at all shapes and kinds of noise"
        yield Promise(name, "`Region`", most, 32_000, found=largest_size(level))
    for scenes, looks in ((1, (2, 3, 4, 5, 6)), (3, (2, 3, 4))):
        for level in (0.05, 0.0125, 0.0025):
            name = f"false signs at {100 * level:g} %, in parts of it, over all looks, "
            name += f"{scenes} × {looks[-1]}"
            measure = levels_of_looks(scenes, looks, level)
            yield Promise(name, "`look_levels`", 1.02, 150_000, found=measure)
    for count in (6, 9, 20):
        yield Promise(
            f"scenes like these, {count} scenes, skewed effects with noise",
            "`judge_like_these`",
            0.05,
            1500,
            like_these(count),
        )
    yield Promise(
        "gate: worse although nothing changed, 2 × 6",
        "`ask_gate`",
        0.025,
        1500,
        gate(2, 6, 0.0, gates.WORSE),
    )
    yield Promise(
        "gate: passed although the loss is the least that matters, 2 × 6",
        "`ask_gate`",
        0.025,
        1500,
        gate(2, 6, LEAST, gates.PASSED),
    )
    for captures in (1, 3):
        name = f"ledger: false discoveries, captures: {captures}, retries correlate by 0.8"
        draw = night(captures, 0.7, 0.8)
        yield Promise(name, "`next_test`, `ask_idea`", 0.1, 150, draw)
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
    for command in PURPOSES:
        name = f"plan for a {command}: shows the difference on three scenes"
        # With the smaller one, no ledger of three scenes is planned.
        difference = 0.12 if command == "ledger" else 0.1
        yield Promise(name, "`Purpose`", 0.8, 500, planned(command, difference), True)
    yield Promise(
        "plan: range of the deviation from a 3 × 3 pilot",
        "`deviation_range`",
        0.8,
        8000,
        unsure,
        True,
    )


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
