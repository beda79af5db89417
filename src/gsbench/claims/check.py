"""Checks of a file of claims: what can be tested here, which trials it needs, verdicts, page.

The trials are ordinary trials of one experiment. So a check that was killed continues where it
stopped and ends with the same verdicts. A published archive gives the same verdicts without any
training.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gsbench.analysis.advice import equal_counts_settings
from gsbench.analysis.cells import with_variants
from gsbench.analysis.fairness import caveats, fairness_table
from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.looks import plan_looks
from gsbench.analysis.pairing import Pairs
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.report.charts import ForestRow, forest_plot
from gsbench.analysis.results import TrialResult, group_by, read_experiment, seeds_text
from gsbench.analysis.statistics import SUPPORTED, TOO_SMALL
from gsbench.analysis.table_formats import Table, fill
from gsbench.analysis.table_notes import cloud_notes, machine_notes
from gsbench.analysis.verdicts import like_these_words, outlying_words
from gsbench.claims.archive import unpack_archive
from gsbench.claims.file import Claim, ClaimsFile
from gsbench.claims.stopping import KeyAndSeed, trials_of_look
from gsbench.config.compose import Trial, compose_one, with_seed
from gsbench.errors import InputError
from gsbench.parsing import read_if_sound
from gsbench.runs.experiments import (
    Declaration,
    declared_now,
    latest_declaration,
    read_declarations,
)
from gsbench.runs.layout import FAILED, SEED
from gsbench.runs.trial_record import Failure
from gsbench.words import counted, some_of, without_folders

# a line for each thing that these trials need and lack
FindMissing = Callable[[Sequence[Trial]], Sequence[str]]
NOT_TESTABLE = "not testable here"
LARGE = 1000.0  # numbers from here on are counts or seconds, shown without decimals
SYMBOLS = {
    "supported": "✔",
    "refuted": "✘",
    "too small to matter": "≈",
    "undecided": "?",
    NOT_TESTABLE: "–",
}


@dataclass(frozen=True)
class ClaimVerdict:
    """A claim with its verdict.

    ``missing`` says which scenes could not be tested, and why; ``failed`` why trials failed.
    """

    claim: Claim
    verdict: Verdict
    missing: tuple[str, ...] = ()
    failed: tuple[str, ...] = ()

    @property
    def word(self) -> str:
        """Supported, refuted, too small to matter, undecided, or not testable here."""
        return NOT_TESTABLE if self.verdict.untestable else self.verdict.outcome

    @property
    def reason(self) -> str:
        """The reason for a verdict in a few words."""
        claim, verdict, least = self.claim, self.verdict, self.claim.effect
        if verdict.untestable:
            return verdict.untestable
        if verdict.outcome == TOO_SMALL or (verdict.outcome == SUPPORTED and not claim.sign):
            small = f"any effect is smaller than the least that matters ({least})"
            if verdict.interval is None or not verdict.interval.excludes_zero():
                return small
            return f"{small}; it is {'higher' if verdict.interval.low > 0 else 'lower'}"
        if verdict.outcome == SUPPORTED:
            return f"it is {claim.direction}{self._by_least()}"
        if verdict.outcome == "refuted" and claim.sign:
            return f"it is the opposite of {claim.direction}"
        if verdict.outcome == "refuted":
            return f"it differs by more than {least}"
        if not verdict.final:
            failed = f"; failed: {some_of(list(self.failed))}" if self.failed else ""
            return f"trials are missing: the next look waits for them{failed}"
        if verdict.favours_lacking:
            return "trials of one arm alone failed"
        if verdict.rests_on_outlying:
            return "it depends on trials far outside the others"
        seeds = verdict.pairs.seeds
        return f"all {seeds} seeds show neither a difference nor that it is below {least}"

    def _by_least(self) -> str:
        verdict = self.verdict
        if verdict.interval is None or verdict.least is None:
            return ""
        smallest = verdict.interval.low if self.claim.sign > 0 else -verdict.interval.high
        return "" if smallest >= verdict.least else f"; by {self.claim.effect} or more is not shown"


@dataclass(frozen=True)
class Check:
    """A file of claims that is checked in the runs folder ``runs``, with its declaration.

    ``first_trials`` has the trial of seed 0 for each key (`TrialResult.key`) in the declaration.
    """

    file: ClaimsFile
    runs: Path
    declaration: Declaration
    first_trials: Mapping[str, Trial]

    @property
    def home(self) -> Path:
        return self.runs / self.file.name

    def to_run(self, planned: Sequence[KeyAndSeed]) -> list[Trial]:
        """The planned trials, composed."""
        return [with_seed(self.first_trials[key], seed) for key, seed in planned]

    def trials(self, seeds: int) -> list[Trial]:
        """The trials of the first ``seeds`` seeds of every claim."""
        questions = range(len(self.declaration.questions))
        return self.to_run(trials_of_look(self.declaration, questions, seeds))

    def judged(self) -> list[Verdict]:
        """The verdicts on the declared questions from the trials that are done."""
        experiment = read_experiment(self.home)
        return judge(experiment.trials, self.declaration, experiment.lacking)

    def verdicts(self, judged: Sequence[Verdict]) -> list[ClaimVerdict]:
        """All claims in the order of the file, with the reasons why trials failed."""
        verdicts = claim_verdicts(self.file, self.declaration, judged)
        return [replace(one, failed=tuple(self._failures(one.verdict))) for one in verdicts]

    def _failures(self, verdict: Verdict) -> list[str]:
        """The reasons why trials of an undecided question failed, each once."""
        if verdict.final:
            return []
        keys = itertools.chain(*verdict.question.scenes.values())
        reasons = []
        for key, seed in itertools.product(keys, verdict.question.seeds):
            failure = read_if_sound(self.home / f"{key}{SEED}{seed}" / FAILED, Failure)
            if failure is not None:
                reasons.append(failure.reason)
        return list(dict.fromkeys(reasons))


def prepare(
    file: ClaimsFile, runs: Path, find_missing: FindMissing, permissions: Sequence[str] = ()
) -> Check:
    """Compose the first trial of each scene and arm of each claim.

    Scenes with something missing are not tested. ``permissions`` are words such as
    ``allow_targets=[mine]`` from the command line: a file of claims cannot give permissions.
    Raises InputError that names claim, scene and arm for settings that do not compose.
    """
    first_trials: dict[str, Trial] = {}
    composed: dict[tuple[str, ...], Trial] = {}
    questions, missing = [], {}
    for claim in file.claims:
        scenes: dict[str, tuple[str, str]] = {}
        reasons: dict[str, list[str]] = {}  # scenes by reason
        for scene in () if claim.not_testable else claim.scenes or file.scenes:
            trials = []
            for arm in (claim.baseline, claim.arm):
                own = file.words(claim, scene, arm)
                words = (*own, f"name={file.name}", "seed=0", *permissions)
                if words not in composed:
                    where = f"claim {claim.id}, scene {scene}, arm {arm}"
                    composed[words] = _compose(words, permissions, runs, where)
                trials.append(composed[words])
            if lacking := [*find_missing(trials[:1]), *find_missing(trials[1:])]:
                reasons.setdefault(lacking[0], []).append(scene)
                continue
            baseline, arm_key = (trial.files.key for trial in trials)
            if baseline == arm_key:
                raise InputError(
                    f"claim {claim.id}: {claim.baseline} and {claim.arm} are the same trial on "
                    f"{scene}"
                )
            first_trials |= {baseline: trials[0], arm_key: trials[1]}
            scenes[scene] = baseline, arm_key
        if scenes:
            questions.append(file.question(claim, scenes))
        if reasons:
            missing[claim.id] = [
                without_folders(f"{some_of(names)}: {reason}") for reason, names in reasons.items()
            ]
    declaration = declared_now(
        questions=tuple(questions), error_rate=file.error_rate, looks=file.looks, missing=missing
    )
    return Check(file, runs, declaration, first_trials)


def claim_verdicts(
    file: ClaimsFile, declaration: Declaration, judged: Sequence[Verdict]
) -> list[ClaimVerdict]:
    """Every claim of the file with its verdict in ``judged``, or why it is not tested."""
    by_name = {verdict.question.name: verdict for verdict in judged}
    verdicts = []
    for claim in file.claims:
        reasons = tuple(declaration.missing.get(claim.id, ()))
        verdict = by_name.get(claim.id)
        if verdict is None or claim.not_testable:
            untestable = claim.not_testable or "; ".join(reasons) or "it was not tested"
            quantity = asked_quantity(claim.metric)
            verdict = Verdict(file.question(claim, {}), quantity, Pairs(()), untestable=untestable)
            reasons = ()
        verdicts.append(ClaimVerdict(claim, verdict, reasons))
    return verdicts


def recheck(
    file: ClaimsFile, archive: Path, folder: Path
) -> tuple[list[ClaimVerdict], Declaration, list[Declaration]]:
    """Judge the claims of ``file`` by the trials in ``archive``, unpacked into ``folder``, empty.

    Returns the verdicts, the declaration that they follow, and all declarations of claims. Raises
    InputError, one line, for an archive that is damaged, of another experiment or without declared
    claims, and if the file's claims differ from the declared ones.
    """
    experiment = unpack_archive(archive, folder)
    if experiment.name != file.name:
        raise InputError(f"{archive} is of the experiment {experiment.name}, not of {file.name}")
    declarations = [one for one in read_declarations(experiment.folder) if one.kind == "claims"]
    if not declarations:
        raise InputError(
            f"{archive}: it declares no claims, so it is not an archive of a gsbench check"
        )
    declaration = latest_declaration(declarations)
    _check_same_claims(file, declaration)
    verdicts = claim_verdicts(file, declaration, judge(experiment.trials, declaration))
    return verdicts, declaration, declarations


def _check_same_claims(file: ClaimsFile, declaration: Declaration) -> None:
    """Raise InputError if a claim's question differs from that declared before the trials ran."""
    declared = {question.name: question for question in declaration.questions}
    for claim in file.claims:
        in_file, before = file.question(claim, {}), declared.get(claim.id)
        if before is None:
            continue
        for what in ("metric", "sign", "least", "relative"):
            if getattr(in_file, what) != getattr(before, what):
                raise InputError(
                    f"claim {claim.id}: its {what} was {getattr(before, what)} when it was "
                    f"declared ({declaration.when}), and is {getattr(in_file, what)} in the file: "
                    "use the file as it was then"
                )
        arms = [arm.densify for arm in (before.baseline, before.arm) if arm is not None]
        if arms != [claim.baseline, claim.arm]:
            raise InputError(
                f"claim {claim.id}: other arms were declared ({declaration.when}): use the file "
                "as it was then"
            )
    if unknown := declared.keys() - {claim.id for claim in file.claims}:
        raise InputError(f"the file lacks claims that were declared: {', '.join(sorted(unknown))}")


def _compose(words: Sequence[str], typed: Sequence[str], runs: Path, where: str) -> Trial:
    try:
        trial = compose_one(words, typed)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return Trial(trial.values | {"runs": str(runs.resolve())}, trial.overrides)


# ---- the page


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

    ``declared`` is the declaration that the verdicts follow. ``declarations`` are all
    declarations under the experiment's name.
    """
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
    lines.append(_declared_line(declared, declarations))
    # Claims may share trials.
    judged: dict[Path, TrialResult] = {}
    for one in verdicts:
        judged |= {trial.path: trial for trial in one.verdict.pairs.trials}
    trials = list(judged.values())
    lines += [f"The paper: {file.size}."] if file.size else []
    lines += [*machine_notes(trials), *cloud_notes(trials)]
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
            f"{verdict.quantity.name} of {claim.arm} against {claim.baseline}: "
            f"{verdict.shown(answer.mean)} ({100 * (1 - answer.level):.3g} % interval "
            f"{verdict.shown_interval(answer.interval)}); {one.reason}"
        )
        evidence += [
            f"least effect that matters: {claim.effect}; baseline's mean "
            f"{_number(verdict.pairs.baseline)}",
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
        f"judged on {counted(len(verdict.pairs.trials), 'trial')}: "
        f"{counted(len(verdict.scenes), 'scene')}, "
        f"{verdict.pairs.seeds} seeds, two arms; looks planned at {planned} seeds"
    )


def _like_these(one: ClaimVerdict) -> str:
    """The statement about scenes like these; "" with too few scenes."""
    word = one.claim.direction if one.claim.sign else "higher"
    return like_these_words(one.verdict, {}, f"it is {word}")


def _late_words(one: ClaimVerdict) -> str:
    if not one.verdict.late:
        return ""
    return (
        f"{counted(one.verdict.late, 'trial')} had been measured before this was declared. So the "
        "metric shares the error rate with all metrics that could have been chosen"
    )


def _fairness(one: ClaimVerdict) -> tuple[tuple[Table, ...], str]:
    """The fairness sheets of a claim's arms, and the `caveats` of comparing them."""
    trials = with_variants(one.verdict.pairs.trials)  # baseline and arm alternate
    arms = dict.fromkeys(
        (baseline.arm, new.arm) for baseline, new in zip(trials[::2], trials[1::2], strict=True)
    )
    pairs = [(baseline, arm) for baseline, arm in arms if baseline != arm]
    # The arms are written in the claims file, so no command alone would change them.
    sentences = dict.fromkeys(caveats(trials, *pair, equal_counts_settings) for pair in pairs)
    return tuple(fairness_table(trials, *pair) for pair in pairs), " ".join(filter(None, sentences))


def _declared_line(declared: Declaration, declarations: Sequence[Declaration]) -> str:
    line = (
        f"The claims were declared {declared.when}. A claim says so if trials had been "
        "measured before."
    )
    claims = [one for one in declarations if one.kind == "claims"]
    if earlier := {one.hash for one in claims if one.moment < declared.moment}:
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
    return tuple((folder, seeds_text(own)) for folder, own in groups.items())


def _number(value: float) -> str:
    """A number with four digits; large numbers whole, with thousands separators."""
    return f"{value:,.0f}" if abs(value) >= LARGE else f"{value:.4g}"
