"""Many ideas under one error rate: what passes on to a test, the level of the test, its result.

An idea is first compared on the seeds of the ledger, which all ideas share. This cannot keep it:
the next idea may follow from the results of all before, so these seeds have been looked at, and
what looks best on them is partly their luck. So the screening is no statement. An idea that looks
better is tested on new seeds, on which it and its baseline are trained. Whatever was chosen before,
the test of an idea that is no better keeps it with at most its level.

The levels are LOND's (Javanmard and Montanari 2015, arXiv 1502.06197, eq. 3): the n-th test has
``rate * (kept + 1) * w(n)`` with weights that sum to 1. Then the false discovery rate is at most
``rate``: a false discovery is one of at least ``kept + 1`` in the end, so its expected share is at
most ``rate * w(n)``. ``kept`` counts what was kept before the test began, so tests may run side by
side. `scripts/ledger_rates.py` simulates it (findings/simulations.md).

A ledger is an experiment whose commands open it and begin its ideas (`gsbench.runs.commands`). Its
results are verdicts on the questions there, so nothing records them.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from gsbench.analysis.quantities import COSTS, relative_change
from gsbench.analysis.questions import plan_looks
from gsbench.analysis.results import Arm, Experiment, read_experiment
from gsbench.analysis.sentences import numbers, reason, with_notes
from gsbench.analysis.statistics import REFUTED, SUPPORTED, TOO_SMALL
from gsbench.analysis.verdicts import Verdict, gives_up, judge
from gsbench.errors import InputError
from gsbench.runs.commands import (
    BASELINE,
    CONFIRMATION,
    LOND,
    SCREENING,
    Idea,
    Ledger,
    Question,
    read_history,
)
from gsbench.runs.trial_folder import TrialFolder
from gsbench.words import counted, least_text, listed

IDEAS, RATE = 40, 0.1  # the defaults of a ledger
# The chance that an idea without an effect passes on to its test, over all looks. Half of it or
# twice as much finds about as many good ideas (findings/simulations.md).
SCREEN = 0.1
SEEDS_FROM, SEEDS_TO = 100_000, 1_000_000  # of tests
KEPT, DROPPED, UNDECIDED, FAILED = "kept", "dropped", "undecided", "failed"
BEGUN, IN_TEST = "begun", "in its test"
CHOOSES = "it only chooses what is tested on new seeds"
LOOKS_WORSE = "looks worse"  # on the seeds of all ideas, which is no verdict
MEND = "bring back the file as gsbench wrote it, or begin another ledger"


@dataclass(frozen=True)
class Book:
    """A ledger as the files of its experiment show it."""

    experiment: Experiment
    opened: Ledger

    @property
    def ideas(self) -> dict[str, Idea]:
        """All ideas in their order, the baseline first."""
        return self.experiment.history.ideas

    @property
    def begun(self) -> list[str]:
        return [name for name in self.ideas if name != BASELINE]

    @cached_property
    def tests(self) -> dict[str, Question]:
        """The tests on seeds that no idea had seen, in their order."""
        return {one.name: one for one in self.experiment.history.questions if one.rule == LOND}

    @cached_property
    def verdicts(self) -> dict[str, Verdict]:
        """The verdict on each idea: that of its test, else that of the comparison before it."""
        return {
            idea: judge(
                self.experiment.trials,
                self.tests.get(idea) or self.screening(self.ideas[idea]),
                self.experiment.unfinished,
            )
            for idea in self.begun
        }

    def screening(self, idea: Idea) -> Question:
        """The comparison on the seeds of all ideas, in looks, as if it were a test.

        An idea passes by one side of the interval, so the interval has twice the rate.
        """
        seeds, old = self.opened.seeds, self.ideas[idea.against]
        return self.ask(idea, old, SCREENING, seeds, 2 * SCREEN, plan_looks(len(seeds)))

    def test(self, name: str) -> Question:
        """The test of an idea that looks better, in looks on new seeds."""
        rate, ideas = self.opened.rate, self.opened.ideas
        level = level_of_test(rate, ideas, len(self.tests) + 1, len(self.kept))
        idea, seeds = self.ideas[name], self._new_seeds(name)
        looks, level = plan_looks(len(seeds)), min(1.0, 2 * level)
        return self.ask(idea, self.ideas[idea.against], LOND, seeds, level, looks)

    def ask(
        self,
        idea: Idea,
        baseline: Idea,
        rule: str,
        seeds: tuple[int, ...],
        level: float,
        looks: tuple[int, ...] = (),
    ) -> Question:
        """The question of an idea by one of the ledger's rules."""
        opened, scenes = self.opened, baseline.digests
        return Question(
            metric=opened.metric,
            sign=opened.sign,
            least=opened.least,
            relative=opened.relative,
            baseline=Arm("", baseline.name),
            idea=Arm("", idea.name),
            digests={scene: (old, idea.digests[scene]) for scene, old in scenes.items()},
            seeds=dict.fromkeys(scenes, seeds),
            rule=rule,
            level=level,
            looks=looks,
            versions=True,
            name=idea.name,
        )

    def _new_seeds(self, idea: str) -> tuple[int, ...]:
        """As many seeds as the ledger has, in a row, of which no trial of it has one.

        The row begins where the hash of all lines before says, so another ledger on the same
        captures has other seeds.
        """
        seen = {seed for one in self.experiment.history.questions for _, seed in one.places}
        count, text = len(self.opened.seeds), f"{self.experiment.history.head} {idea}"
        while True:
            text = hashlib.sha256(text.encode()).hexdigest()
            first = SEEDS_FROM + int(text, 16) % (SEEDS_TO - SEEDS_FROM - count)
            seeds = tuple(range(first, first + count))
            if seen.isdisjoint(seeds):
                return seeds

    def is_measured(self, idea: str) -> bool:
        """Return whether a trial of the idea gave a result."""
        digests = set(self.ideas[idea].digests.values())
        known = {digest for digest, _ in self.experiment.history.results}
        return not digests.isdisjoint(known | {one.digest for one in self.experiment.trials})

    def failure(self, idea: str) -> str:
        """The reason why an idea has no result, since its trials failed; "" otherwise."""
        digests = self.ideas[idea].digests.items()
        failed = (
            one.path
            for one in self.experiment.unfinished
            if one.failed and (one.scene, one.digest) in digests
        )
        path = None if self.is_measured(idea) else next(failed, None)
        return "" if path is None else TrialFolder(path).failure().reason

    def result(self, idea: str) -> str:
        verdict, tested = self.verdicts[idea], idea in self.tests
        if self.failure(idea):
            return FAILED
        found = result_of(verdict)
        if not verdict.final or (found == KEPT and not tested):
            return IN_TEST if tested else BEGUN
        return found

    def is_decided(self, idea: str) -> bool:
        """Return whether the idea has a result; it has none if its trials failed."""
        return self.result(idea) in (KEPT, DROPPED, UNDECIDED)

    def why(self, idea: str) -> str:
        """The reason of a result."""
        if failure := self.failure(idea):
            return failure
        verdict = self.verdicts[idea]
        looks_worse = idea not in self.tests and verdict.outcome == REFUTED
        return with_notes(LOOKS_WORSE if looks_worse else reason(verdict), verdict)

    def line(self, idea: str) -> str:
        """``larger_splits against baseline: kept: better; psnr +0.5 (…); 3 new seeds, level …``"""
        verdict, test = self.verdicts[idea], self.tests.get(idea)
        where = f"{counted(verdict.pairs.seeds, 'seed')} of all ideas"
        if test:
            where = f"{counted(verdict.pairs.seeds, 'new seed')}, level {50 * test.level:.2g} %"
        facts = [self.why(idea), f"{self.opened.metric} {numbers(verdict)}", where]
        shown = "; ".join(facts if numbers(verdict) else facts[:1])
        return f"{idea} against {self.ideas[idea].against}: {self.result(idea)}: {shown}"

    def ratio(self, idea: str, cost: str) -> float | None:
        """An idea's cost over that of what it is compared with."""
        pairs = self.verdicts[idea].pairs
        change = relative_change(pairs.of_baseline, pairs.of_arm, COSTS[cost][1])
        return None if change is None else 1 + change.of_totals

    @property
    def kept(self) -> list[str]:
        return [idea for idea in self.tests if self.result(idea) == KEPT]

    @property
    def tried(self) -> int:
        """The number of ideas that count; those that failed do not, since they tell nothing."""
        return sum(not self.failure(idea) for idea in self.begun)

    def check_ideas_left(self) -> None:
        """Raise InputError unless another idea may be tried."""
        if self.tried >= self.opened.ideas:
            raise InputError(
                f"all {self.opened.ideas} planned ideas were tried, so the error rate is spent: "
                "begin another ledger, with another baseline or other captures"
            )

    def check_untouched(self, asked: Sequence[Question]) -> None:
        """Raise InputError if a scene of ``asked`` was used before, by name or photographs."""
        earlier = set(self.ideas[BASELINE].digests)
        for one in self.experiment.history.questions:
            if one.rule == CONFIRMATION and not any(map(one.covers, asked)):
                earlier |= one.digests.keys()
        scenes, trials = set(asked[0].digests), self.experiment.trials
        photographs = {one.record.hashes.get("data") for one in trials if one.scene in earlier}
        copies = {one.scene for one in trials if one.record.hashes.get("data") in photographs}
        if used := scenes & (earlier | copies):
            raise InputError(
                f"{listed(sorted(used))} was seen by the ideas, or by an earlier confirmation: "
                "confirm on other captures"
            )

    def describe(self) -> list[str]:
        """Two lines: what decides, and how many of the planned ideas were tried and kept."""
        opened = self.opened
        better = "more" if opened.sign > 0 else "less"
        return [
            f"{opened.metric} decides: {better} is better, and "
            f"{least_text(opened.least, opened.relative)} is the least that matters. At most "
            f"{100 * opened.rate:g} % of the kept ideas are expected to be no better.",
            f"{self.tried} of {opened.ideas} planned ideas were tried, and {len(self.kept)} kept, "
            f"on {', '.join(self.ideas[BASELINE].digests)}, with at most {len(opened.seeds)} "
            "seeds, and as many new ones for what looks better.",
        ]


def read_ledger(home: Path) -> Book:
    """The ledger in ``home``.

    Raises InputError if there is none, if lines of its file were changed, and for trials that it
    does not know: these are looks that were not counted.
    """
    history = read_history(home)
    if history.ledger is None:
        raise InputError(
            f"{home.name} has no ledger: gsbench ledger new {home.name} --metric … begins one"
        )
    if history.faults:
        raise InputError(f"{history.faults[0]}: {MEND}")
    book = Book(read_experiment(home), history.ledger)
    known = {pair for idea in book.ideas.values() for pair in idea.digests.items()}
    for one in book.experiment.history.questions:
        known |= {(scene, digest) for scene, both in one.digests.items() for digest in both}
    unknown = {(one.scene, one.digest) for one in book.experiment.trials} - known
    if unknown:
        raise InputError(
            f"the ledger does not know {counted(len(unknown), 'configuration')} with trials "
            f"({'/'.join(min(unknown))}): give other sweeps another name; if lines of the ledger "
            "are missing, bring them back"
        )
    return book


def level_of_test(rate: float, ideas: int, number: int, kept: int) -> float:
    """The level of the test ``number`` (from 1) after ``kept`` ideas were kept.

    The weights ``1 / number`` give the first tests more than equal weights would: few ideas of the
    planned ones pass on to a test, and each kept one raises the levels after it.
    """
    return rate * (kept + 1) / number / sum(1 / test for test in range(1, ideas + 1))


def result_of(verdict: Verdict) -> str:
    """``kept``, ``dropped`` or ``undecided``; an undecided idea may change with more seeds."""
    if verdict.outcome == SUPPORTED:
        return KEPT
    dropped = verdict.equal or verdict.outcome in (REFUTED, TOO_SMALL) or gives_up(verdict)
    return DROPPED if dropped else UNDECIDED
