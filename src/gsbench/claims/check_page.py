"""The page of a check of claims, for HTML and the terminal."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbench.analysis.advice import equal_counts_settings
from gsbench.analysis.cells import with_variants
from gsbench.analysis.fairness import caveats, counts_notes, fairness_table, limit_notes
from gsbench.analysis.looks import plan_looks
from gsbench.analysis.notes import Note, texts
from gsbench.analysis.report.charts import ForestRow, forest_plot
from gsbench.analysis.results import TrialResult, group_by, seeds_text
from gsbench.analysis.table_formats import Table, fill
from gsbench.analysis.table_notes import cloud_notes, machine_notes
from gsbench.analysis.verdict_words import like_these_words, outlying_words
from gsbench.claims.check import NOT_TESTABLE, Checked, ClaimVerdict
from gsbench.runs.experiments import Declaration
from gsbench.runs.layout import SEED
from gsbench.words import counted

LARGE = 1000.0  # numbers from here on are counts or seconds, shown without decimals
SYMBOLS = {
    "supported": "✔",
    "refuted": "✘",
    "too small to matter": "≈",
    "undecided": "?",
    NOT_TESTABLE: "–",
}


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


def make_page(checked: Checked) -> Page:
    """The content of the page."""
    file, verdicts = checked.file, checked.verdicts
    counts = Counter(verdict.word for verdict in verdicts)
    shown = ", ".join(f"{counts[word]} {word}" for word in SYMBOLS if counts[word])
    lines = [f"{file.paper}. {shown}."]
    if tested := len(verdicts) - counts[NOT_TESTABLE]:
        which = "the verdict" if tested == 1 else f"any of the {tested} verdicts"
        lines.append(
            f"The chance that {which} is false is at most {100 * file.error_rate:g} %, over all "
            "looks, if trainings differ about normally (docs/verdict.md). A verdict is about these "
            "scenes at this size. From six scenes on there is also a statement about scenes like "
            "these, with its own error rate."
        )
    lines.append(_declared_line(checked.declared, checked.declarations))
    # Claims may share trials.
    judged: dict[Path, TrialResult] = {}
    for one in verdicts:
        judged |= {trial.path: trial for trial in one.verdict.pairs.trials}
    trials = list(judged.values())
    lines += [f"The paper: {file.size}."] if file.size else []
    lines += texts([*machine_notes(trials), *cloud_notes(trials), *checked.unused])
    return Page(f"{file.name}: claims and verdicts", tuple(lines), tuple(map(_section, verdicts)))


def to_text(page: Page) -> str:
    """The page's lines and headlines, for a terminal."""
    verdicts = []
    for section in page.sections:
        judged = section.verdict
        verdicts.append(f"{judged.word:<19}  {judged.claim.id}: {section.headline}")
        more = _judged_on(judged), like_these_words(judged.verdict)
        verdicts += [f"{'':<19}  {line}" for line in more if line]
    return "\n".join([page.title, *page.lines, *verdicts]) + "\n"


def to_html(page: Page) -> str:
    """The page as one HTML file that needs no network and no other file."""
    return fill("page.html.j2", "gsbench.claims", page=page, symbols=SYMBOLS)


def _section(judged: ClaimVerdict) -> ClaimSection:
    claim, verdict, answer = judged.claim, judged.verdict, judged.verdict.answer
    evidence = [f"what would refute it: {claim.refuted_if}"]
    headline = judged.sentence
    if answer is not None and answer.interval is not None:
        evidence += [
            f"least effect that matters: {claim.effect}; baseline's mean "
            f"{_number(verdict.pairs.baseline)}",
            _judged_on(judged),
            like_these_words(verdict),
        ]
    seen = [Note.of("seen", trials=len(verdict.seen))] if verdict.seen else []
    evidence += [outlying_words(verdict), *texts([*seen, *verdict.notes])]
    fairness, mixed = _fairness(judged)
    if mixed:
        headline += f". {mixed}"
    return ClaimSection(
        judged,
        headline,
        tuple(filter(None, evidence)),
        fairness,
        _folders(verdict.pairs.trials),
        _chart(judged),
    )


def _judged_on(judged: ClaimVerdict) -> str:
    """``judged on 8 trials: 2 scenes, 2 seeds, two arms; ...``; "" if there is no mean."""
    verdict = judged.verdict
    if verdict.answer is None:
        return ""
    planned = ", ".join(str(seeds) for seeds in plan_looks(len(verdict.question.seeds)))
    return (
        f"judged on {counted(len(verdict.pairs.trials), 'trial')}: "
        f"{counted(len(verdict.scenes), 'scene')}, "
        f"{verdict.pairs.seeds} seeds, two arms; looks planned at {planned} seeds"
    )


def _fairness(judged: ClaimVerdict) -> tuple[tuple[Table, ...], str]:
    """The fairness sheets of a claim's arms, and the `caveats` of comparing them."""
    trials = with_variants(judged.verdict.pairs.trials)
    arm_of = {trial.path: trial.arm for trial in trials}
    arms = dict.fromkeys(
        (arm_of[baseline.path], arm_of[new.path]) for baseline, new in judged.verdict.pairs.counting
    )
    pairs = [(baseline, arm) for baseline, arm in arms if baseline != arm]
    # The arms are written in the claims file, so no command alone would change them.
    notes = counts_notes(trials, pairs, equal_counts_settings)
    notes += [note for pair in pairs for note in caveats(trials, *pair)]
    return tuple(fairness_table(trials, *pair) for pair in pairs), " ".join(
        texts([*notes, *limit_notes(trials, pairs)])
    )


def _declared_line(declared: Declaration, declarations: Sequence[Declaration]) -> str:
    line = (
        f"The claims were declared {declared.when}. A claim says so if trials had been "
        "measured before."
    )
    claims = [declaration for declaration in declarations if declaration.kind == "claims"]
    if earlier := {claim.hash for claim in claims if claim.moment < declared.moment}:
        line += f" Earlier declarations under this name: {len(earlier)}."
    return line


def _chart(judged: ClaimVerdict) -> str:
    verdict, answer = judged.verdict, judged.verdict.answer
    if answer is None or answer.interval is None:
        return ""
    rows = [ForestRow(scene.scene, scene.mean) for scene in verdict.scenes]
    rows.append(ForestRow("all", answer.mean, answer.interval))
    unit = "log ratio" if judged.claim.effect.relative else "difference"
    title = f"{judged.claim.arm} against {judged.claim.baseline}"
    return forest_plot(title, rows, f"{verdict.quantity.name}, {unit}", judged.claim.sign)


def _folders(trials: Sequence[TrialResult]) -> tuple[tuple[str, str], ...]:
    """``("exp/garden/sfm-adc/1a2b3c4d", "seeds 0, 1, 2")`` for each scene and arm."""
    groups = group_by(trials, lambda trial: trial.label.rpartition(SEED)[0])
    return tuple((folder, seeds_text(of_arm)) for folder, of_arm in groups.items())


def _number(value: float) -> str:
    """A number with four digits; large numbers whole, with thousands separators."""
    return f"{value:,.0f}" if abs(value) >= LARGE else f"{value:.4g}"
