"""The verdicts of an experiment: each pair of arms in each metric, in families that hold the chance of a false one.

Where nothing was declared (``eval.primary``), all metrics of all pairs are one family, adjusted by Holm (1979). Where a
metric was declared, two questions are kept apart, each with its own 5 % for the chance that any answer is false:

- the declared metric, at one question if one was named (``psnr@extrapolation``), one test for each pair of arms: of a
  single pair it is tested as it is, of several adjusted by Holm, as Demšar (2006, section 3.2.2) adjusts comparisons of
  many methods with one control;
- all other metrics of all pairs, called secondary and adjusted by Holm for their whole number.

There is no gate between the two, though one would hold both under a single 5 % (Dmitrienko and Tamhane 2007): where the
declared metric shows nothing, a secondary one that got worse must still be seen. A metric that was declared when
results were there, or to which seeds or arms were added then, has no place of its own: then all are one family.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from gsbench.analysis.declaration import ActiveDeclaration
from gsbench.analysis.pairing import Paired, ViewCache, arm_name, pair_arms
from gsbench.analysis.power import seeds_needed
from gsbench.analysis.quantities import Quantity, choose_quantities, metric_quantity
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.statistics import Comparison, compare_family
from gsbench.errors import InputError
from gsbench.words import counted, signed

Role = Literal["declared", "secondary", "one of all"]
Pair = tuple[Arm, Arm]


@dataclass(frozen=True)
class Verdict:
    """One metric's comparison with what it takes to read it, and the family that it is one of."""

    quantity: Quantity
    comparison: Comparison
    seeds: int | None  # that would resolve the worthwhile difference; None: unknown or beyond reach
    role: Role = "one of all"

    @property
    def symbol(self) -> str:
        return {"better": "▲", "worse": "▼"}.get(self.comparison.verdict, "●")


@dataclass(frozen=True)
class ArmVerdicts:
    """The verdicts of one pair of arms, the declared metric first; ``notes`` say what could not be had.

    ``missing`` says, of a declared metric that has no verdict here, why.
    """

    verdicts: tuple[Verdict, ...]
    notes: tuple[str, ...]
    declared: Quantity | None = None
    missing: str = ""


@dataclass(frozen=True)
class _Question:
    pair: Pair
    quantity: Quantity
    paired: Paired
    asks: str  # interpolation, extrapolation, or "" for neither


def judge(
    trials: Sequence[TrialResult], pairs: Sequence[Pair], views: ViewCache, declared: ActiveDeclaration | None = None
) -> dict[Pair, ArmVerdicts]:
    """Compare each pair of arms in every metric that has a direction, in the families that ``declared`` makes."""
    primary = None if declared is None else declared_quantity(trials, declared)
    questions: list[_Question] = []
    faults: dict[Pair, dict[str, str]] = {pair: {} for pair in pairs}
    quantities = {}
    for pair in pairs:
        own = [trial for trial in trials if trial.arm in pair]
        shown = [one for one in choose_quantities(own) if not one.cost and one.direction != 0]
        if primary is not None:
            shown = [primary, *(one for one in shown if one.key != primary.key)]
        quantities[pair] = shown
        for one in shown:
            try:
                if one.direction == 0:
                    raise InputError("whether more of it is better is not known")
                paired = pair_arms(own, *pair, one.key, views)
                questions.append(_Question(pair, one, paired, own[0].question))
            except InputError as error:
                reasons = [trial.unavailable[one.key] for trial in own if one.key in trial.unavailable]
                faults[pair][one.key] = reasons[0] if reasons else str(error)
    verdicts = _answer(questions, declared)
    judged = {}
    for pair in pairs:
        own_verdicts = tuple(verdict for question, verdict in verdicts if question.pair == pair)
        compared = {verdict.quantity.key: verdict for verdict in own_verdicts}
        notes = []
        for one in quantities[pair]:
            if one.key in compared:
                notes += [f"{one.name}: {line}" for line in compared[one.key].comparison.left_out]
            else:
                notes.append(f"{one.name}: {faults[pair][one.key]}")
        missing = faults[pair].get(primary.key, "") if primary is not None else ""
        judged[pair] = ArmVerdicts(own_verdicts, tuple(notes), primary, missing)
    return judged


def declared_quantity(trials: Sequence[TrialResult], declared: ActiveDeclaration) -> Quantity:
    """The declared metric; also one of the user's own that no trial could compute."""
    return metric_quantity(declared.metric, trials)


def declared_lines(declared: ActiveDeclaration, judged: dict[Pair, ArmVerdicts]) -> list[str]:
    """Lines below a table that say what was declared, and the verdict on it for each pair of arms."""
    quantity = next(iter(judged.values())).declared if judged else None
    lines = declared.sentences(declared.metric if quantity is None else quantity.name)
    for (first, second), one in judged.items():
        against = f"{arm_name(second)} against {arm_name(first)}"
        found = [verdict for verdict in one.verdicts if verdict.quantity.key == declared.metric]
        if found and found[0].role == "secondary":
            continue  # the other question
        lines += [f"Verdict, {against}: {_in_words(verdict)}." for verdict in found]
        if not found:
            lines.append(f"Verdict, {against}: none, since {declared.metric} has no value: {one.missing}.")
    return lines


def families(judged: Sequence[ArmVerdicts]) -> list[str]:
    """Lines that say how many tests each family had, and how it was adjusted."""
    sizes: dict[Role, int] = {}
    for one in judged:
        sizes |= {verdict.role: verdict.comparison.family for verdict in one.verdicts}
    lines = []
    if "declared" in sizes:
        how = "tested as it is" if sizes["declared"] == 1 else f"adjusted by Holm for {sizes['declared']} pairs of arms"
        lines.append(f"The declared metric is {how}.")
    if "secondary" in sizes:
        lines.append(
            f"Secondary: all other metrics of all pairs of arms, {sizes['secondary']} tests adjusted by Holm among "
            "themselves; they do not make the verdict."
        )
    if "one of all" in sizes:
        number = counted(sizes["one of all"], "test")
        none = any(one.declared is None for one in judged)
        opening = "No metric was declared beforehand (eval.primary): all" if none else "All"
        lines.append(f"{opening} metrics of all pairs of arms are one family, {number} adjusted by Holm.")
    return lines


def _answer(questions: Sequence[_Question], declared: ActiveDeclaration | None) -> list[tuple[_Question, Verdict]]:
    """Every question's verdict, in the order of ``questions``."""
    answers: dict[int, Verdict] = {}
    roles: list[Role] = [_role(one, declared) for one in questions]
    for role in set(roles):
        places = [place for place, found in enumerate(roles) if found == role]
        members = [(questions[place].paired, questions[place].quantity.direction) for place in places]
        for place, comparison in zip(places, compare_family(members), strict=True):
            answers[place] = _verdict(questions[place].quantity, comparison, role)
    return [(one, answers[place]) for place, one in enumerate(questions)]


def _role(question: _Question, declared: ActiveDeclaration | None) -> Role:
    if declared is None or not declared.beforehand:
        return "one of all"
    asked = declared.question in ("", question.asks)
    return "declared" if asked and question.quantity.key == declared.metric else "secondary"


def _verdict(quantity: Quantity, comparison: Comparison, role: Role) -> Verdict:
    seeds = None
    if comparison.deviation is not None and quantity.worthwhile is not None:
        seeds = seeds_needed(comparison.deviation, len(comparison.scenes), quantity.worthwhile)
    return Verdict(quantity, comparison, seeds, role)


def _in_words(verdict: Verdict) -> str:
    """``better in LPIPS VGG raw on these scenes: −0.0123 (95 % interval −0.0200 to −0.0046), p 0.012``"""
    one, spec = verdict.comparison, f".{verdict.quantity.decimals + 1}f"

    word = "no evidence of a difference in" if one.verdict == "no evidence" else f"{one.verdict} in"
    text = f"{word} {verdict.quantity.name} on {one.scope}: {signed(one.mean, spec)}"
    if one.interval is not None:
        text += f" (interval {signed(one.interval.low, spec)} to {signed(one.interval.high, spec)})"
    if one.p is None or one.p_family is None:
        return f"{text}, no test: {one.test}"
    adjusted = f", both adjusted for {one.family} tests" if one.family > 1 else ""
    return f"{text}, p {p_text(one.p_family)}{adjusted}{beyond_words(one)}"


def beyond_words(comparison: Comparison) -> str:
    """``; it holds for scenes like these (p 0.012)`` of a difference that was found in scenes enough, else nothing."""
    beyond = comparison.beyond
    if beyond is None or comparison.verdict == "no evidence":
        return ""
    word = "it holds" if beyond.holds else "not shown"
    return f"; {word} for scenes like these (p {p_text(beyond.p_family)} over {beyond.scenes} scenes)"


def p_text(p: float) -> str:
    """``below 0.001``, or p to three places."""
    return "below 0.001" if p < 0.001 else f"{p:.3f}"
