"""The questions of a command: what is asked of which trials, and at which level.

All is worked out before the trials run, from the command's trials and from what was asked and
measured before. Nothing changes a question afterwards.

- An *idea* is an arm; rows that differ only in swept settings are tries of one idea. It is compared
  with the baseline densifier of the same cloud and of the swept settings that both have. A cloud is
  compared with the first cloud that the command lists, under each densifier.
- The n-th command about an idea on linked scenes and seeds has the level 5 % * 2 / (n (n + 1)),
  shared equally by its questions about the idea. These levels sum to 10 %, and a test with two
  sides is falsely "better" in half of its level: so an idea without an effect is ever called better
  in at most 5 % of cases, whatever the commands have in common.
- A question that includes a measured trial of the idea includes all of them, and its seeds are the
  first ones of the baseline. Otherwise results could have chosen the trials, and it is not tested.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from gsbench.analysis.addresses import ArmName
from gsbench.analysis.results import group_by
from gsbench.analysis.statistics import ALPHA, MIN_SCENES, sign_test_needs
from gsbench.analysis.trial_result import Trained, seeds_text, settings_text
from gsbench.errors import InputError
from gsbench.runs.commands import Digest, History, Place, Question, code_in
from gsbench.runs.configuration import is_of_scene
from gsbench.runs.experiments import Arm
from gsbench.words import counted, some_of

LAST_LOOK = 0.6  # of a question's level


# ---- levels and looks

FIRST_LOOK = 2  # seeds: one training of each arm does not show how trainings differ
# seeds up to which each seed is a look; more looks would save little
EACH_UP_TO = 12


def plan_looks(maximum: int) -> tuple[int, ...]:
    """The numbers of seeds at which there is a look, up to ``maximum``.

    There is one at each number from `FIRST_LOOK` to `EACH_UP_TO`, then at every fourth, and at
    ``maximum``.
    """
    early = range(FIRST_LOOK, min(maximum, EACH_UP_TO) + 1)
    return tuple(dict.fromkeys([*early, *range(EACH_UP_TO, maximum, 4), maximum]))


def level_of(n: int, among: int = 1) -> float:
    """The level of each of ``among`` questions of the n-th command about an idea."""
    return ALPHA * 2 / (n * (n + 1)) / among


def look_shares(looks: int) -> tuple[float, ...]:
    """The parts of a question's level that its looks have; they sum to 1.

    The last look has `LAST_LOOK`, each earlier one half of the rest, the first what is left.

    Examples:
        >>> look_shares(4)
        (0.1, 0.1, 0.2, 0.6)
    """
    shares, left = [], 1.0
    for part in [LAST_LOOK, *[0.5] * (looks - 2)][: looks - 1]:
        shares.append(round(left * part, 12))
        left -= shares[-1]
    return (round(left, 12), *reversed(shares))


def count_tries(places: Collection[Place], earlier: Iterable[Collection[Place]]) -> int:
    """The number n of a command about an idea on ``places``: scenes and seeds.

    ``earlier`` are the places of each earlier command about it that gave a result. Those count that
    share a place with this one, directly or through others.
    """
    linked, left, found = set(places), [set(one) for one in earlier], 0
    while joined := [one for one in left if one & linked]:
        found += len(joined)
        left = [one for one in left if not one & linked]
        linked = linked.union(*joined)
    return found + 1


def read_least(value: float | str, where: str, is_cost: bool = False) -> tuple[float, bool]:
    """Read the least effect that matters: ``0.005``, or ``10%`` of the baseline's value.

    The second value is True for such a part. Raises InputError unless it is a number above 0, and a
    part if it is that of a cost, whose unit no table shows.
    """
    text = str(value).strip()
    relative = text.endswith("%")
    try:
        size = float(text.removesuffix("%")) / (100 if relative else 1)
    except ValueError:
        size = math.nan
    if not math.isfinite(size) or size <= 0:
        raise InputError(
            f"{where} must be a number above 0, got {value!r}: give a difference such as 0.005, or "
            "10% (of the baseline's value)"
        )
    if is_cost and not relative:
        raise InputError(f"{where} of a count, time or memory must be a part, such as 10%")
    return size, relative


# ---- the trials of a command, and of earlier ones


def place_of(row: Trained) -> Place:
    return row.scene, row.seed


def recipe_of(row: Trained) -> str:
    """The settings and the code, equal for trials that differ in scene and seed alone."""
    kept = {key: value for key, value in row.config.items() if not is_of_scene(key)}
    return f"{row.init}-{row.densify} {code_in(row.digest)} {settings_text(kept)}"


@dataclass(frozen=True)
class NamedQuestion:
    """A question that an experiment's file names: an entry of ``questions``.

    ``idea`` and ``baseline`` are arms as tables name them, such as ``longaxis`` or
    ``mine[decay=0.9]``. Without ``scenes`` it is about all. ``budget`` has the settings of the arms
    that are meant. It ``says`` what a paper says, ``where``.
    """

    idea: str
    baseline: str = "adc"
    metric: str = ""  # "": that of eval.primary
    direction: Literal["higher", "lower", "same", ""] = ""  # "": the better one
    least: float | str | None = None
    scenes: list[str] = field(default_factory=list)
    budget: dict[str, Any] = field(default_factory=dict)
    says: str = ""
    where: str = ""

    def fitting(self, word: str, planned: Sequence[Trained]) -> list[Trained]:
        """The planned trials that ``word`` can mean."""
        name = ArmName.read(word)
        return [
            row
            for row in planned
            if name.fits(row)
            and all(
                str(row.config.get(key, value)) == str(value) for key, value in self.budget.items()
            )
            and row.scene in (self.scenes or [row.scene])
        ]

    def rows(self, word: str, planned: Sequence[Trained]) -> list[Trained]:
        """The planned trials of the arm called ``word``; raises InputError unless it is one."""
        found = self.fitting(word, planned)
        arms = list(dict.fromkeys(row.arm for row in found))
        if len(arms) != 1:
            known = some_of([str(arm) for arm in dict.fromkeys(row.arm for row in planned)])
            fault = "no arm" if not arms else f"several arms, {some_of(list(map(str, arms)))}"
            raise InputError(f"questions: {word} names {fault} of this sweep (it has {known})")
        return found


# the name of a named question, the question, the sign and the least difference
Named = tuple[str, NamedQuestion, int, tuple[float | None, bool]]


@dataclass(frozen=True)
class Asked:
    """The settings of a command's questions, beside its trials.

    The error rate is that of each idea, or ``shared`` by all. ``named`` are the questions that the
    experiment's file names, in place of the usual ones (None).
    """

    metric: str
    sign: int = 1
    least: float | None = None
    baseline: str = "adc"
    controls: Mapping[str, str] = field(default_factory=dict)
    looks: tuple[int, ...] = ()
    shared: bool = False
    split: str = ""  # ask about trials with this rule of held-out views alone
    named: tuple[Named, ...] | None = None


def ask(
    planned: Sequence[Trained], asked: Asked, measured: Sequence[Trained], history: History
) -> tuple[list[Question], list[str]]:
    """The new questions of a command, and the ids of earlier ones that cover its trials.

    ``planned`` are its trials with their variants, in the order given; ``measured`` are the trials
    of the experiment that have a result.
    """
    planned = [
        row for row in planned if not asked.split or row.config.get("scene.split") == asked.split
    ]
    if asked.named is not None:
        drafts = []
        for name, named, sign, (least, relative) in asked.named:
            ideas, baselines = (named.rows(word, planned) for word in (named.idea, named.baseline))
            arms = baselines[0].arm, ideas[0].arm
            question = draft(*arms, [*baselines, *ideas], asked, measured)
            drafts.append(
                replace(
                    question,
                    metric=named.metric or asked.metric,
                    sign=sign,  # type: ignore[arg-type]
                    least=least,
                    relative=relative,
                    name=name,
                    says=named.says,
                    where=named.where,
                )
            )
    else:
        pairs = choose_pairs(planned, asked, measured)
        drafts = [draft(*pair, planned, asked, measured) for pair in pairs]
    return _with_levels(drafts, planned, asked, measured, history)


def choose_pairs(
    planned: Sequence[Trained], asked: Asked, measured: Sequence[Trained] = ()
) -> list[tuple[Arm, Arm]]:
    """The pairs (baseline, idea) of arms that a command asks about.

    A baseline that it does not train is an earlier one, or is awaited.
    """
    by_arm = {arm: _texts(own[0].config) for arm, own in group_by(planned, "arm").items()}
    known = dict(by_arm)
    for row in measured:
        if row.densify in (asked.baseline, *asked.controls.values()):
            known.setdefault(replace(row.arm, variant=()), _texts(row.config))
    arms, inits = list(by_arm), list(dict.fromkeys(arm.init for arm in by_arm))

    def partners(arm: Arm, densify: str) -> list[Arm]:
        for pool in (by_arm, known):
            among = [one for one in pool if (one.init, one.densify) == (arm.init, densify)]
            if among:
                unlike = {one: _unlike(arm, one, known) for one in among}
                return [one for one in among if unlike[one] == min(unlike.values())]
        return [Arm(arm.init, densify)]

    pairs = [
        (one, arm)
        for arm in arms
        if arm.densify != asked.baseline
        for one in partners(arm, asked.baseline)
    ]
    for arm in arms:
        control = asked.controls.get(arm.densify, arm.densify)
        if control != arm.densify:
            pairs += [(one, arm) for one in partners(arm, control)]
    for arm in arms:  # another cloud against the first one, under each densifier
        first = replace(arm, init=inits[0])
        if arm.init != inits[0] and first in by_arm:
            pairs.append((first, arm))
    if not pairs and len({arm.name for arm in arms}) == 1:  # a sweep over the baseline's settings
        pairs = [(arms[0], arm) for arm in arms[1:]]
    return list(dict.fromkeys(pairs))


def _unlike(arm: Arm, other: Arm, configs: Mapping[Arm, Mapping[str, str]]) -> int:
    """The number of swept settings that both arms have with different values."""
    swept = dict([*arm.variant, *other.variant])
    one, two = ({**configs[own], **dict(own.variant)} for own in (arm, other))
    return sum(key in one and key in two and one[key] != two[key] for key in swept)


def _with_levels(
    drafts: Sequence[Question],
    planned: Sequence[Trained],
    asked: Asked,
    measured: Sequence[Trained],
    history: History,
) -> tuple[list[Question], list[str]]:
    """The ``drafts`` that no earlier question covers, with levels, and the ids of those that do."""
    new, shown = list[Question](), list[str]()
    for question in drafts:
        if not question.places:
            continue
        covering = [one for one in history.questions if one.covers(question)]
        if covering:
            shown.append(covering[-1].id)
        else:
            new.append(_with_doubt(question, planned, measured, history))
    tested = [one for one in new if not one.untested]
    levelled = []
    for question in new:
        name = question.idea.name
        own = [one for one in tested if one.idea.name == name]
        places = question.places.union(*(one.places for one in own))
        n = count_tries(places, _earlier(name, measured, history))
        level = level_of(n, max(1, len(tested if asked.shared else own)))
        levelled.append(replace(question, n=n, level=level).with_id(len(history.commands)))
    return levelled, list(dict.fromkeys(shown))


def draft(
    baseline: Arm,
    idea: Arm,
    planned: Sequence[Trained],
    asked: Asked,
    measured: Sequence[Trained] = (),
) -> Question:
    """The question about an idea's trials, without a level."""
    digests: dict[str, tuple[Digest, Digest]] = {}
    seeds: dict[str, tuple[int, ...]] = {}
    of_baseline = {one.scene: one.digest for one in reversed(planned) if one.arm == baseline}
    if not of_baseline:  # the newest ones of earlier commands, or an awaited one
        of_baseline = {row.scene: "" for row in planned}
        for one in measured:
            if (
                one.arm.name == baseline.name
                and dict(baseline.variant).items() <= _texts(one.config).items()
            ):
                of_baseline[one.scene] = one.digest
    for row in planned:
        # a baseline of this command may have other scenes
        if row.arm == idea and row.scene in of_baseline:
            pair = digests.setdefault(row.scene, (of_baseline[row.scene], row.digest))
            if row.digest == pair[1]:
                seeds[row.scene] = tuple(dict.fromkeys([*seeds.get(row.scene, ()), row.seed]))
    return Question(
        idea=idea,
        baseline=baseline,
        metric=asked.metric,
        sign=asked.sign,  # type: ignore[arg-type]
        least=asked.least,
        digests=digests,
        seeds=seeds,
        looks=asked.looks,
    )


def _texts(config: Mapping[str, Any]) -> dict[str, str]:
    return {key: str(value) for key, value in config.items()}


def _with_doubt(
    question: Question, planned: Sequence[Trained], measured: Sequence[Trained], history: History
) -> Question:
    """The question, with the reason if results could have chosen its trials."""
    ideas = {second for _, second in question.digests.values()}
    own = {recipe_of(row) for row in planned if row.digest in ideas}
    seen = {place_of(row) for row in measured if recipe_of(row) in own}
    if seen & question.places and (gone := seen - question.places):
        return replace(question, untested=f"it leaves out measured trials: {places_text(gone)}")
    earlier = [
        one for one in history.questions if one.idea.name == question.idea.name and not one.untested
    ]
    for scene, seeds in question.seeds.items():
        first = question.digests[scene][0]
        there = sorted({row.seed for row in measured if (row.scene, row.digest) == (scene, first)})
        used = sorted({*seeds} & {*there})
        again = any({*one.seeds.get(scene, ())} & {*there} == {*used} for one in earlier)
        if used != there[: len(used)] and not again:
            left = [(scene, seed) for seed in there if seed < used[-1] and seed not in used]
            what = f"measured trials of {question.baseline}: {places_text(left)}"
            return replace(question, untested=f"it leaves out {what}")
    return question


def places_text(places: Iterable[Place]) -> str:
    """``garden seeds 0, 1; room seed 0``"""
    texts = []
    for scene, own in itertools.groupby(sorted(places), lambda place: place[0]):
        texts.append(f"{scene} {seeds_text(seed for _, seed in own)}")
    return "; ".join(texts)


def _earlier(name: str, measured: Sequence[Trained], history: History) -> list[set[Place]]:
    """The places of each earlier command about the idea called ``name`` that gave a result.

    Results of which no command asked count as those of a command for each version.
    """
    done = history.results | {(row.digest, place_of(row)) for row in measured}
    found, asked = list[set[Place]](), set[tuple[Digest, Place]]()
    for command in history.commands:
        own = [one for one in command.questions if one.idea.name == name]
        trials = {(one.digests[place[0]][1], place) for one in own for place in one.places}
        asked |= trials
        if trials & done:
            found.append({place for _, place in trials})
    recipes = {row.digest: recipe_of(row) for row in measured}
    rest: dict[str, set[Place]] = {}
    for digest, place in done - asked:
        if digest.partition("/")[0] == name:
            rest.setdefault(recipes.get(digest, code_in(digest)), set()).add(place)
    return [*found, *rest.values()]


# ---- what is said before the training


def announce(question: Question) -> str:
    """The number and the level of a question in words, and what it cannot reach."""
    if question.untested:
        return f"{question.idea}: not tested, since {question.untested}"
    which, level = ordinal(question.n), f"{100 * question.level:.2g} %"
    text = f"{question.idea} against {question.baseline}: {which} on these seeds: {level}"
    if question.n > 1:
        text += f"; new seeds have {100 * ALPHA:.2g} %"
    return "; ".join([text, *unreachable(question)])


def ordinal(number: int) -> str:
    """``first`` to ``fifth``, then ``6th`` and so on."""
    words = "first", "second", "third", "fourth", "fifth"
    return dict(enumerate(words, 1)).get(number, f"{number}th")


def unreachable(question: Question) -> list[str]:
    """Lines on statements that the question's trials cannot decide, whatever comes."""
    scenes, seeds = len(question.seeds), min(map(len, question.seeds.values()))
    lines = []
    if seeds < 2:
        lines.append("one training of each cannot decide: give two seeds or more")
    level = question.level * look_shares(max(1, len(question.looks)))[-1]
    if scenes >= MIN_SCENES and sign_test_needs(scenes, level) is None:
        needed = next(n for n in itertools.count(scenes) if sign_test_needs(n, level))
        lines.append(
            f"scenes like these need {counted(needed, 'scene')} at {100 * level:.2g} %, not "
            f"{scenes}"
        )
    return lines
