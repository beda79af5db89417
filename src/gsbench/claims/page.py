"""The page at the end of a check, in Markdown and HTML: claim by claim the verdict and all that it rests on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

from jinja2 import Environment, StrictUndefined

from gsbench.analysis.caveats import caveats
from gsbench.analysis.cells import by_key, with_variants
from gsbench.analysis.fairness import fairness_table
from gsbench.analysis.origins import cloud_notes, machine_notes
from gsbench.analysis.report.charts import ForestRow, forest_plot
from gsbench.analysis.report.pictures import Crop, choose_pictures
from gsbench.analysis.results import TrialResult
from gsbench.analysis.table_formats import to_html as table_to_html
from gsbench.analysis.table_formats import to_markdown as table_to_markdown
from gsbench.analysis.tables import Table
from gsbench.claims.file import ClaimsFile
from gsbench.claims.verdict import NOT_TESTABLE, Verdict, Word
from gsbench.runs.declaration import DeclaredPlan
from gsbench.runs.layout import SEED
from gsbench.words import counted

LARGE = 1000.0  # numbers from here on are counts or seconds, and shown whole
CROPS = 2  # pictures each for and against an arm
SYMBOLS: dict[Word, str] = {"supported": "✔", "refuted": "✘", "undecided": "?", "not testable here": "–"}


@dataclass(frozen=True)
class Section:
    """One claim, ready to be written."""

    verdict: Verdict
    headline: str
    evidence: tuple[str, ...]
    scenes: tuple[tuple[str, str], ...]
    fairness: tuple[Table, ...]  # one for each two arms that are paired: scenes may differ in the initialiser
    trials: tuple[tuple[str, str], ...]  # folder without the seed, and its seeds


@dataclass(frozen=True)
class Page:
    """Content of the verdicts' page, for both formats."""

    title: str
    lines: tuple[str, ...]
    sections: tuple[Section, ...]


def make_page(
    file: ClaimsFile,
    verdicts: Sequence[Verdict],
    declared: DeclaredPlan,
    plans: Sequence[DeclaredPlan],
    shares: Sequence[str] = (),
) -> Page:
    """The content of the page: the plan that was ``declared``, of all ``plans`` under this name, and its verdicts.

    ``shares`` are the names of archives whose trials count beside those of this machine.
    """
    counts = {word: sum(verdict.word == word for verdict in verdicts) for word in SYMBOLS}
    tested = sum(verdict.word != "not testable here" for verdict in verdicts)
    lines = [
        f"{file.paper}. " + ", ".join(f"{count} {word}" for word, count in counts.items() if count) + ".",
        _declared_line(declared, plans),
        *([f"Trials from {', '.join(shares)} count beside those that were run here."] if shares else []),
    ]
    if tested:
        lines.insert(
            1,
            f"The chance that any of the {counted(tested, 'verdict')} is false is at most {100 * file.error_rate:g} %, "
            "which they share equally, each over all its looks at the trials (docs/verdict.md). A verdict is about "
            f"{_scope(verdicts)} at this size.",
        )
    judged = list({trial.path: trial for verdict in verdicts for trial in verdict.trials}.values())
    lines += [*_size_line(file, judged), *_origin_lines(judged)]
    return Page(f"{file.name}: claims and verdicts", tuple(lines), tuple(map(_section, verdicts)))


def _origin_lines(trials: Sequence[TrialResult]) -> list[str]:
    """Lines on what may differ between pairs of trials: machines, and the clouds of one scene."""
    return [*machine_notes(trials), *cloud_notes(trials)]


def _scope(verdicts: Sequence[Verdict]) -> str:
    """Return the scenes that the verdicts speak of: from six on they are the units, and so stand for others."""
    tested = (verdict for verdict in verdicts if verdict.word != NOT_TESTABLE)
    by_scene = {verdict.design.by_scene for verdict in tested if verdict.design is not None}
    if by_scene == {True}:
        return "scenes like these, which are its units,"
    return "these scenes" if by_scene == {False} else "these scenes (from six on, scenes like these)"


def to_text(page: Page) -> str:
    """The page's lines and headlines, for a terminal."""
    verdicts = []
    for section in page.sections:
        one = section.verdict
        verdicts.append(f"{one.word:<17}  {one.claim.id}: {section.headline}")
        verdicts += [f"{'':<17}  {line}" for line in [_judged_on(one)] if line]
    return "\n".join([page.title, *page.lines, *verdicts]) + "\n"


def to_markdown(page: Page) -> str:
    """The page as GitHub-flavoured Markdown."""
    parts = [f"# {page.title}", "", *(line + "\n" for line in page.lines)]
    parts += ["| | claim | verdict |", "|---|---|---|"]
    for section in page.sections:
        one = section.verdict
        parts.append(f"| {SYMBOLS[one.word]} | {one.claim.id} | **{one.word}**: {_pipe(section.headline)} |")
    for section in page.sections:
        claim = section.verdict.claim
        parts += ["", f"## {claim.id}: {section.verdict.word}", "", f"> {claim.says}", ">", f"> {claim.where}", ""]
        parts += [section.headline + "\n"]
        parts += map(table_to_markdown, section.fairness)
        parts += [f"- {line}" for line in section.evidence]
        if section.scenes:
            parts += ["", "| scene | difference |", "|---|---|"]
            parts += [f"| {scene} | {value} |" for scene, value in section.scenes]
        if section.trials:
            parts += ["", "Trials:", "", *(f"- `{folder}` {seeds}" for folder, seeds in section.trials)]
    return "\n".join(parts).rstrip() + "\n"


def to_html(page: Page) -> str:
    """The page as one HTML file, with charts and pictures in it; needs no network and no other file."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(_resource("gsbench.claims", "page.html.j2"))
    shown = [
        (section, tuple(map(table_to_html, section.fairness)), _chart(section.verdict), *_crops(section.verdict))
        for section in page.sections
    ]
    style = _resource("gsbench.analysis.report", "style.css")
    return template.render(page=page, sections=shown, symbols=SYMBOLS, style=style)


def _section(verdict: Verdict) -> Section:
    claim, decision = verdict.claim, verdict.decision
    evidence = [f"what would refute it: {claim.refuted_if}"]
    headline = verdict.reason
    if decision is not None and decision.mean is not None and decision.interval is not None:
        assert verdict.design is not None
        level = f"{100 * (1 - verdict.design.alpha):.3g} %"
        headline = (
            f"{verdict.measure.name} of {claim.arm} against {claim.baseline}: {verdict.shown(decision.mean)} "
            f"({level} interval {verdict.shown_interval(decision.interval)}); {verdict.reason}"
        )
        evidence += [
            f"least effect that matters: {claim.effect}; baseline's mean {_number(verdict.baseline)}",
            _judged_on(verdict),
        ]
    if decision is not None and decision.outcome == "undecided" and not verdict.measure.cost:
        evidence.append(f"how many seeds and scenes would decide, where the trials are: {_plan_words(verdict)}")
    evidence += verdict.notes
    fairness, mixed = _fairness(verdict)
    if mixed:
        headline += f". {mixed}"
    return Section(
        verdict,
        headline,
        tuple(evidence),
        tuple((scene, verdict.shown(value)) for scene, value in verdict.by_scene),
        fairness,
        _folders(verdict.trials),
    )


def _judged_on(verdict: Verdict) -> str:
    """``judged on 8 trials: 2 scenes, 2 seeds, two arms; ...``; "" where no mean is known."""
    decision, design = verdict.decision, verdict.design
    if decision is None or decision.mean is None or decision.interval is None or design is None:
        return ""
    unit = "scenes" if design.by_scene else "pairs of trials"
    planned = ", ".join(map(str, design.looks))
    return (
        f"judged on {counted(decision.trials, 'trial')}: {counted(len(verdict.by_scene), 'scene')}, "
        f"{decision.seeds} seeds, two arms; looks planned at {planned} seeds; units are {unit}"
    )


def _plan_words(verdict: Verdict) -> str:
    """``gsbench plan NAME --metric psnr --difference 0.1``"""
    least, baseline = verdict.claim.effect.size, abs(verdict.baseline or 0.0)
    difference = least * baseline if verdict.claim.effect.relative else least
    name = verdict.trials[0].record.experiment if verdict.trials else "NAME"
    return f"gsbench plan {name} --metric {verdict.claim.metric} --difference {difference:.3g}"


def _fairness(verdict: Verdict) -> tuple[tuple[Table, ...], str]:
    """The fairness sheets of a claim's arms, and what else than the idea may have made a difference (`caveats`)."""
    trials = with_variants(verdict.trials)
    both = dict.fromkeys((one.arm, other.arm) for one, other in _pairs(trials))
    arms = [(one, other) for one, other in both if one != other]
    sentences = dict.fromkeys(caveats(trials, *two) for two in arms)
    return tuple(fairness_table(trials, *two) for two in arms), " ".join(filter(None, sentences))


def _declared_line(declared: DeclaredPlan, plans: Sequence[DeclaredPlan]) -> str:
    line = f"The plan {declared.hash[:12]} was declared {declared.when}; a claim says where trials were there before."
    earlier = [plan for plan in plans if plan.hash != declared.hash and plan.kind == declared.kind]
    if earlier:
        line += f" Before it, {counted(len(earlier), 'other plan')} had been declared under this name."
    return line


def _size_line(file: ClaimsFile, trials: Sequence[TrialResult]) -> list[str]:
    """Sentence on what was smaller than in the paper, where the file says how large that was."""
    if not file.size or not trials:
        return []
    scenes = sorted({trial.scene for trial in trials})
    steps = sorted({trial.record.iterations for trial in trials})
    sizes = sorted({f"{size[0]}×{size[1]}" for trial in trials if (size := trial.record.resolution)})
    seeds = len({trial.seed for trial in trials})
    here = (
        f"{counted(len(scenes), 'scene')} ({', '.join(scenes)}), up to {seeds} seeds, "
        f"{' or '.join(f'{step:,}' for step in steps)} iterations, {', '.join(sizes)} px"
    )
    return [f"Here: {here}. The paper: {file.size}."]


def _chart(verdict: Verdict) -> str:
    decision = verdict.decision
    if decision is None or decision.interval is None or decision.mean is None:
        return ""
    rows = [ForestRow(scene, value, None, None) for scene, value in verdict.by_scene]
    rows.append(ForestRow("all", decision.mean, decision.interval.low, decision.interval.high))
    unit = "log ratio" if verdict.claim.effect.relative else "difference"
    title = f"{verdict.claim.arm} against {verdict.claim.baseline}"
    return forest_plot(title, rows, f"{verdict.measure.name}, {unit}", verdict.claim.sign)


def _crops(verdict: Verdict) -> tuple[list[Crop], list[Crop]]:
    """Places where the arm is closer to the photographs, and where the baseline is."""
    pairs = _pairs(verdict.trials)
    if not pairs or verdict.measure.cost:
        return [], []
    found = choose_pictures(pairs, CROPS)
    return list(found.gained), list(found.lost)


def _pairs(trials: Sequence[TrialResult]) -> list[tuple[TrialResult, TrialResult]]:
    """Pairs of a verdict's trials, which stand baseline and arm in turn."""
    return list(zip(trials[::2], trials[1::2], strict=True))


def _folders(trials: Sequence[TrialResult]) -> tuple[tuple[str, str], ...]:
    """``("exp/garden/sfm-adc/1a2b3c4d", "seeds 0, 1, 2")`` for each arm of a scene."""
    groups = by_key(trials, lambda trial: trial.label.rpartition(SEED)[0])
    return tuple(
        (folder, f"{'seeds' if len(own) > 1 else 'seed'} {', '.join(str(trial.seed) for trial in own)}")
        for folder, own in groups.items()
    )


def _number(value: float | None) -> str:
    """Four digits, and none of powers of ten in large counts."""
    return "unknown" if value is None else f"{value:,.0f}" if abs(value) >= LARGE else f"{value:.4g}"


def _pipe(text: str) -> str:
    return text.replace("|", "\\|")


def _resource(package: str, name: str) -> str:
    return files(package).joinpath(name).read_text(encoding="utf-8")
