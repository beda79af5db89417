"""Checks of a file of claims: what can be tested here, which trials it needs, and verdicts.

The trials are ordinary trials of one experiment. So a check that was killed continues where it
stopped and ends with the same verdicts. A published archive gives the same verdicts without any
training.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gsbench.analysis.comparison import unused_trials
from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.notes import Note, texts
from gsbench.analysis.pairing import Pairs
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.results import read_experiment
from gsbench.analysis.statistics import SUPPORTED
from gsbench.analysis.verdict_words import in_words, reason
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
from gsbench.runs.trial_files import Failure
from gsbench.words import some_of, without_folders

# a line for each thing that these trials need and lack
FindMissing = Callable[[Sequence[Trial]], Sequence[str]]
NOT_TESTABLE = "not testable here"


@dataclass(frozen=True)
class ClaimVerdict:
    """A claim with its verdict; ``failed`` says why trials failed that an undecided one needs."""

    claim: Claim
    verdict: Verdict
    failed: tuple[str, ...] = ()

    @property
    def word(self) -> str:
        """Supported, refuted, too small to matter, undecided, or not testable here."""
        return NOT_TESTABLE if self.verdict.untestable else self.verdict.outcome

    @property
    def sentence(self) -> str:
        """The verdict in a sentence, with what it lacks."""
        verdict = self.verdict
        if verdict.untestable:
            return reason(verdict)
        notes = []
        if verdict.outcome == SUPPORTED and not self._by_least():
            notes.append(Note.of("least not shown", effect=self.claim.effect))
        if not verdict.final:
            notes.append(Note.of("look waits"))
        if self.failed:
            notes.append(Note.of("failed", reasons=self.failed))
        words = f"{self.claim.arm} against {self.claim.baseline}: {in_words(verdict)}"
        return "; ".join([words, *texts(notes)])

    def _by_least(self) -> bool:
        """Return whether the difference is shown to be the least that matters, or more."""
        interval, least, sign = self.verdict.interval, self.verdict.least, self.claim.sign
        if not sign or interval is None or least is None:
            return True
        return (interval.low if sign > 0 else -interval.high) >= least


@dataclass(frozen=True)
class Checked:
    """All claims of a file with their verdicts.

    ``declared`` is the declaration that they follow, ``declarations`` are all of the experiment.
    ``unused`` names its trials that are in no verdict.
    """

    file: ClaimsFile
    verdicts: Sequence[ClaimVerdict]
    declared: Declaration
    declarations: Sequence[Declaration]
    unused: Sequence[Note] = ()


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

    def checked(self, judged: Sequence[Verdict]) -> Checked:
        """All claims in the order of the file, with the reasons why trials failed."""
        verdicts = claim_verdicts(self.file, self.declaration, judged)
        verdicts = [
            replace(verdict, failed=tuple(self._failures(verdict.verdict))) for verdict in verdicts
        ]
        unused = unused_trials(read_experiment(self.home).trials, judged)
        declarations = read_declarations(self.home)
        return Checked(self.file, verdicts, self.declaration, declarations, unused)

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
                if words not in composed:  # claims share scenes and arms
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
        missing = declaration.missing.get(claim.id, [])
        notes = tuple(Note.of("as given", text=line) for line in missing)
        verdict = by_name.get(claim.id)
        if verdict is None or claim.not_testable:
            why = claim.not_testable or "; ".join(missing) or "it was not tested"
            verdict = Verdict(
                file.question(claim, {}),
                asked_quantity(claim.metric),
                Pairs(()),
                untestable=Note.of("as given", text=why),
            )
        else:
            verdict = replace(verdict, notes=(*notes, *verdict.notes))
        verdicts.append(ClaimVerdict(claim, verdict))
    return verdicts


def recheck(file: ClaimsFile, archive: Path, folder: Path) -> Checked:
    """Judge the claims of ``file`` by the trials in ``archive``, unpacked into ``folder``, empty.

    Raises InputError, one line, for an archive that is damaged, of another experiment or without
    declared claims, and if the file's claims differ from the declared ones.
    """
    experiment = unpack_archive(archive, folder)
    if experiment.name != file.name:
        raise InputError(f"{archive} is of the experiment {experiment.name}, not of {file.name}")
    declarations = [
        declaration
        for declaration in read_declarations(experiment.folder)
        if declaration.kind == "claims"
    ]
    if not declarations:
        raise InputError(
            f"{archive}: it declares no claims, so it is not an archive of a gsbench check"
        )
    declaration = latest_declaration(declarations)
    _check_same_claims(file, declaration)
    judged = judge(experiment.trials, declaration)
    verdicts = claim_verdicts(file, declaration, judged)
    unused = unused_trials(experiment.trials, judged)
    return Checked(file, verdicts, declaration, declarations, unused)


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
