"""The page of a check: each claim with its verdict and the evidence."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

from gsbench.analysis.cells import with_variants
from gsbench.analysis.fairness import caveats, fairness_table
from gsbench.analysis.report.charts import ForestRow, forest_plot
from gsbench.analysis.results import TrialResult, group_by, seeds_words
from gsbench.analysis.statistics import Outcome, plan_looks
from gsbench.analysis.table_formats import Table, fill
from gsbench.analysis.tables import cloud_notes, machine_notes
from gsbench.analysis.verdicts import like_these_words, outlying_words
from gsbench.claims.check import NOT_TESTABLE, ClaimVerdict
from gsbench.claims.file import ClaimsFile
from gsbench.runs.experiments import Declaration
from gsbench.runs.layout import SEED
from gsbench.words import counted

LARGE = 1000.0  # numbers from here on are counts or seconds, shown without decimals
OUTCOMES: dict[Outcome, str] = {word: word for word in get_args(Outcome)}
SYMBOLS = {"supported": "✔", "refuted": "✘", "too small to matter": "≈", "undecided": "?", NOT_TESTABLE: "–"}


@dataclass(frozen=True)
class ClaimSection:
    """The text of one claim."""

    verdict: ClaimVerdict
    headline: str
    evidence: tuple[str, ...]
    fairness: tuple[Table, ...]  # one per pair of arms: scenes may differ in the initialiser
    trials: tuple[tuple[str, str], ...]  # folder without the seed, and its seeds
    chart: str


@dataclass(frozen=True)
class Page:
    """The content of the page, for HTML and the terminal."""

    title: str
    lines: tuple[str, ...]
    sections: tuple[ClaimSection, ...]


def make_page(
    file: ClaimsFile,
    verdicts: Sequence[ClaimVerdict],
    declared: Declaration,
    declarations: Sequence[Declaration],
) -> Page:
    """The content of the page.

    ``declared`` is the declaration that the verdicts follow, ``declarations`` are all under the experiment's name.
    """
    counts = {word: sum(verdict.word == word for verdict in verdicts) for word in SYMBOLS}
    tested = sum(one.word != NOT_TESTABLE for one in verdicts)
    lines = [
        f"{file.paper}. " + ", ".join(f"{count} {word}" for word, count in counts.items() if count) + ".",
        _declared_line(declared, declarations),
    ]
    if tested:
        which = "the verdict" if tested == 1 else f"any of the {tested} verdicts"
        lines.insert(
            1,
            f"The chance that {which} is false is at most {100 * file.error_rate:g} %, over all looks, if trainings "
            "differ about normally (docs/verdict.md). A verdict is about these scenes at this size. From six scenes on "
            "there is also a statement about scenes like these, with its own error rate.",
        )
    judged = list({trial.path: trial for one in verdicts for trial in one.verdict.pairs.trials}.values())
    lines += [f"The paper: {file.size}."] if file.size else []
    lines += [*machine_notes(judged), *cloud_notes(judged)]
    return Page(f"{file.name}: claims and verdicts", tuple(lines), tuple(map(_section, verdicts)))


def to_text(page: Page) -> str:
    """The page's lines and headlines, for a terminal."""
    verdicts = []
    for section in page.sections:
        one = section.verdict
        verdicts.append(f"{one.word:<19}  {one.claim.id}: {section.headline}")
        verdicts += [f"{'':<19}  {line}" for line in [_judged_on(one), _like_these(one)] if line]
    return "\n".join([page.title, *page.lines, *verdicts]) + "\n"


def to_html(page: Page) -> str:
    """The page as one HTML file that needs no network and no other file."""
    return fill("page.html.j2", "gsbench.claims", page=page, symbols=SYMBOLS)


def _section(one: ClaimVerdict) -> ClaimSection:
    claim, verdict, answer = one.claim, one.verdict, one.verdict.answer
    evidence = [f"what would refute it: {claim.refuted_if}"]
    headline = one.reason
    if answer is not None and answer.interval is not None:
        headline = (
            f"{verdict.quantity.name} of {claim.arm} against {claim.baseline}: {verdict.shown(answer.mean)} "
            f"({100 * (1 - answer.level):.3g} % interval {verdict.shown_interval(answer.interval)}); {one.reason}"
        )
        evidence += [
            f"least effect that matters: {claim.effect}; baseline's mean {_number(verdict.pairs.baseline)}",
            _judged_on(one),
            _like_these(one),
        ]
    evidence += [outlying_words(verdict), _late_words(one), *one.missing, *verdict.notes]
    fairness, mixed = _fairness(one)
    if mixed:
        headline += f". {mixed}"
    return ClaimSection(
        one,
        headline,
        tuple(filter(None, evidence)),
        fairness,
        _folders(verdict.pairs.trials),
        _chart(one),
    )


def _judged_on(one: ClaimVerdict) -> str:
    """``judged on 8 trials: 2 scenes, 2 seeds, two arms; ...``; "" if there is no mean."""
    verdict = one.verdict
    if verdict.answer is None:
        return ""
    planned = ", ".join(str(seeds) for seeds in plan_looks(len(verdict.question.seeds)))
    return (
        f"judged on {counted(len(verdict.pairs.trials), 'trial')}: {counted(len(verdict.scenes), 'scene')}, "
        f"{verdict.pairs.seeds} seeds, two arms; looks planned at {planned} seeds"
    )


def _like_these(one: ClaimVerdict) -> str:
    """The statement about scenes like these; "" with too few scenes."""
    word = one.claim.direction if one.claim.sign else "higher"
    return like_these_words(one.verdict, OUTCOMES, f"it is {word}")


def _late_words(one: ClaimVerdict) -> str:
    if not one.verdict.late:
        return ""
    return (
        f"{counted(one.verdict.late, 'trial')} had been measured before this was declared. So the metric shares the "
        "error rate with all metrics that could have been chosen"
    )


def _fairness(one: ClaimVerdict) -> tuple[tuple[Table, ...], str]:
    """The fairness sheets of a claim's arms, and the `caveats` of comparing them."""
    trials = with_variants(one.verdict.pairs.trials)  # baseline and arm alternate
    arms = dict.fromkeys((baseline.arm, new.arm) for baseline, new in zip(trials[::2], trials[1::2], strict=True))
    pairs = [(baseline, arm) for baseline, arm in arms if baseline != arm]
    sentences = dict.fromkeys(caveats(trials, *pair) for pair in pairs)
    return tuple(fairness_table(trials, *pair) for pair in pairs), " ".join(filter(None, sentences))


def _declared_line(declared: Declaration, declarations: Sequence[Declaration]) -> str:
    line = f"The claims were declared {declared.when}. A claim says so if trials had been measured before."
    earlier = {one.hash for one in declarations if one.of_claims and one.moment < declared.moment}
    if earlier:
        line += f" Earlier declarations under this name: {len(earlier)}."
    return line


def _chart(one: ClaimVerdict) -> str:
    verdict, answer = one.verdict, one.verdict.answer
    if answer is None or answer.interval is None:
        return ""
    rows = [ForestRow(scene.scene, scene.mean) for scene in verdict.scenes]
    rows.append(ForestRow("all", answer.mean, answer.interval))
    unit = "log ratio" if one.claim.effect.relative else "difference"
    title = f"{one.claim.arm} against {one.claim.baseline}"
    return forest_plot(title, rows, f"{verdict.quantity.name}, {unit}", one.claim.sign)


def _folders(trials: Sequence[TrialResult]) -> tuple[tuple[str, str], ...]:
    """``("exp/garden/sfm-adc/1a2b3c4d", "seeds 0, 1, 2")`` for each scene and arm."""
    groups = group_by(trials, lambda trial: trial.label.rpartition(SEED)[0])
    return tuple((folder, seeds_words(own)) for folder, own in groups.items())


def _number(value: float) -> str:
    """A number with four digits; large numbers whole, with thousands separators."""
    return f"{value:,.0f}" if abs(value) >= LARGE else f"{value:.4g}"
