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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from gsbench.analysis.questions import plan_looks
from gsbench.analysis.results import Arm, Experiment, read_experiment
from gsbench.analysis.sentences import numbers, reason, with_notes
from gsbench.analysis.verdicts import Verdict, gives_up, judge
from gsbench.errors import InputError
from gsbench.runs.commands import BASELINE, Idea, Ledger, Question, Rule, read_history
from gsbench.runs.trial_folder import TrialFolder
from gsbench.words import counted, least_text, listed

# The chance that an idea without an effect passes on to its test, over all looks, by one side of
# its interval. Half or twice as much finds about as many good ideas (findings/simulations.md).
SCREEN = 0.1
SEEDS_FROM, SEEDS = 100_000, 900_000  # of tests
# of an idea; it has none ("begun") before it is decided
Result = Literal["kept", "dropped", "undecided", "failed", "begun"]


@dataclass(frozen=True)
class Book:
    """A ledger as the files of its experiment show it."""

    experiment: Experiment
    opened: Ledger

    @property
    def ideas(self) -> dict[str, Idea]:
        """All ideas in their order, the baseline first."""
        return self.experiment.history.ideas

    @cached_property
    def questions(self) -> dict[str, Question]:
        """The question of each idea in their order: its test, else its screening as a test."""
        rules = ("screening", "lond")  # a test comes after its screening
        asked = (one for one in self.experiment.history.questions if one.rule in rules)
        return {one.name: replace(one, untested="") for one in asked}

    @property
    def tests(self) -> dict[str, Question]:
        """The tests on seeds that no idea had seen."""
        return {name: one for name, one in self.questions.items() if one.rule == "lond"}

    @cached_property
    def verdicts(self) -> dict[str, Verdict]:
        """The verdict on the question of each idea."""
        trials, unfinished = self.experiment.trials, self.experiment.unfinished
        return {name: judge(trials, one, unfinished) for name, one in self.questions.items()}

    def ask(
        self, idea: Idea, baseline: Idea, rule: Rule, seeds: tuple[int, ...], level: float
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
            looks=() if rule == "confirmation" else plan_looks(len(seeds)),
            rule=rule,
            level=level,
            untested="it only chooses what is tested on new seeds" if rule == "screening" else "",
            versions=True,
            name=idea.name,
        )

    def next_test(self, name: str) -> Question | None:
        """The test of an idea that looks better and has none, in as many looks on new seeds.

        These are in a row that begins where the hash of all lines before says, so another ledger on
        the same captures has other seeds.
        """
        verdict = self.verdicts[name]
        if name in self.tests or not verdict.final or result_of(verdict) != "kept":
            return None
        history, count = self.experiment.history, len(self.opened.seeds)
        seen = {seed for one in history.questions for _, seed in one.places}
        first = SEEDS_FROM + int(history.head, 16) % SEEDS
        while not seen.isdisjoint(range(first, first + count)):
            first += count
        number, ideas = len(self.tests) + 1, range(1, self.opened.ideas + 1)
        # The weights 1 / number give the first tests more than equal ones would: few ideas of the
        # planned ones pass on to a test, and each kept one raises the levels after it.
        level = self.opened.rate * (len(self.kept) + 1) / number / sum(1 / one for one in ideas)
        seeds = dict.fromkeys(self.questions[name].seeds, tuple(range(first, first + count)))
        test = replace(self.questions[name], rule="lond", seeds=seeds, level=min(1.0, 2 * level))
        return test.with_id(history.head)

    def failure(self, idea: str) -> str:
        """The reason why an idea has no result, since its trials failed; "" otherwise."""
        own = self.ideas[idea].digests
        experiment = self.experiment
        measured = {digest for digest, _ in experiment.history.results}
        measured |= {one.digest for one in experiment.trials}
        for one in experiment.unfinished:
            is_own = one.failed and own.get(one.scene) == one.digest
            if is_own and measured.isdisjoint(own.values()):
                return TrialFolder(one.path).failure().reason
        return ""

    def result(self, idea: str) -> Result:
        if self.failure(idea):
            return "failed"
        verdict = self.verdicts[idea]
        found = result_of(verdict)
        return found if verdict.final and (found != "kept" or idea in self.tests) else "begun"

    def why(self, idea: str) -> str:
        """The reason of a result."""
        if failure := self.failure(idea):
            return failure
        verdict = self.verdicts[idea]
        # on the seeds of all ideas that is no verdict
        looks_worse = idea not in self.tests and verdict.outcome == "refuted"
        return with_notes("looks worse" if looks_worse else reason(verdict), verdict)

    def line(self, idea: str) -> str:
        """``larger_splits against baseline: kept: better; psnr +0.5 (…); 3 new seeds, level …``"""
        verdict, test = self.verdicts[idea], self.tests.get(idea)
        text, result, seeds = self.why(idea), self.result(idea), verdict.pairs.seeds
        if not text.startswith(result):  # such as undecided
            text = f"{result}: {text}"
        if shown := numbers(verdict):
            where = f"{counted(seeds, 'seed')} of all ideas"
            if test:
                where = f"{counted(seeds, 'new seed')}, level {50 * test.level:.2g} %"
            text += f"; {self.opened.metric} {shown}; {where}"
        return f"{idea} against {self.ideas[idea].against}: {text}"

    @property
    def kept(self) -> list[str]:
        return [idea for idea in self.tests if self.result(idea) == "kept"]

    @property
    def tried(self) -> int:
        """The number of ideas that count; those that failed do not, since they tell nothing."""
        return sum(not self.failure(idea) for idea in self.questions)

    def check_untouched(self, asked: Sequence[Question]) -> None:
        """Raise InputError if a scene of ``asked`` was used before, by name or photographs."""
        earlier = set(self.ideas[BASELINE].digests)
        for one in self.experiment.history.questions:
            if one.rule == "confirmation" and not any(map(one.covers, asked)):
                earlier |= one.digests.keys()
        data = {one.scene: one.record.hashes.get("data") for one in self.experiment.trials}
        seen = {data.get(scene) for scene in earlier} - {None}
        if used := sorted(
            one for one in asked[0].digests if one in earlier or data.get(one) in seen
        ):
            raise InputError(
                f"{listed(used)} was seen by the ideas, or by an earlier confirmation: "
                "confirm on other captures"
            )

    def describe(self) -> list[str]:
        """Two lines: what decides, and how many of the planned ideas were tried and kept."""
        opened = self.opened
        return [
            f"{opened.metric} decides: {'more' if opened.sign > 0 else 'less'} is better, and "
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
        raise InputError(
            f"{history.faults[0]}: bring back the file as gsbench wrote it, or begin another ledger"
        )
    experiment = read_experiment(home)
    unknown = {(one.scene, one.digest) for one in experiment.trials}
    for one in history.questions:
        unknown -= {(scene, digest) for scene, both in one.digests.items() for digest in both}
    if unknown:
        raise InputError(
            f"the ledger does not know {counted(len(unknown), 'configuration')} with trials "
            f"({'/'.join(min(unknown))}): give other sweeps another name; if lines of the ledger "
            "are missing, bring them back"
        )
    return Book(experiment, history.ledger)


def result_of(verdict: Verdict) -> Result:
    """The result by a verdict; an undecided idea may change with more seeds."""
    if verdict.outcome == "supported":
        return "kept"
    is_open = verdict.outcome == "undecided" and not (verdict.equal or gives_up(verdict))
    return "undecided" if is_open else "dropped"
