"""The verb ``gsbench gate``: is a new version of a trainer worse than a trusted one? (docs/gate.md)

It is one question in planned looks (`gsbench.claims.stopping`). The new version passes, is worse,
or is undecided after all allowed seeds. It passes if it is better, if any difference is too small
to matter, or if it is shown not to be worse by the least difference that matters.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsbench.analysis.cells import select_trials
from gsbench.analysis.notes import Note
from gsbench.analysis.questions import FIRST_LOOK, plan_looks
from gsbench.analysis.results import Arm, TrialResult, group_by
from gsbench.analysis.sentences import in_words, reason, with_notes
from gsbench.analysis.verdicts import Verdict, passes
from gsbench.app.command import one_trial_per_scene, run_trials
from gsbench.claims.archive import unpack_archive
from gsbench.claims.stopping import Needed, SequentialTest, asked_difference, finished_trials
from gsbench.config.compose import Trial, with_seed
from gsbench.errors import GsbenchError, InputError, TrainingError
from gsbench.files import make_runs_folder
from gsbench.runs.commands import Question
from gsbench.runs.experiments import make_home
from gsbench.verbs.arguments import options_of
from gsbench.words import listed, printable

# stand for the digests of trials, since versions may share settings
BASELINE, NEW = "baseline", "new"
PASSED, WORSE, NOT_DECIDED = "passed", "worse", "undecided"
ReadTrials = Callable[[], Iterable[TrialResult]]
EXIT_CODES = {PASSED: 0, WORSE: 1, NOT_DECIDED: 3}
# exit codes of `git bisect run`: the commit cannot be tested; the search ends (128 and more)
SKIP, STOP = 125, 128


def gate(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 passed, 1 worse, 3 not decided.

    Raises GsbenchError (exit code 1) if trials fail, and InputError (2) for bad input. With
    ``--bisect`` nothing is raised, and the codes are those of ``git bisect run``.
    """
    bisects = "--bisect" in argv
    try:
        result = _result(options_of("gate", argv))
    except GsbenchError as error:
        if not bisects:
            raise
        print(f"gsbench: {printable(str(error))}", file=sys.stderr)
        return STOP if isinstance(error, InputError) else SKIP
    return SKIP if bisects and result == NOT_DECIDED else EXIT_CODES[result]


def _result(options: argparse.Namespace) -> str:
    """Train the new version until it is decided, and print the answer; returns it."""
    by_scene = one_trial_per_scene("gate", options.settings, options.metric)
    example = next(iter(by_scene.values()))  # its settings are those of all, apart from the scene
    home = example.files.home
    with tempfile.TemporaryDirectory() as folder:
        archived = unpack_archive(options.archive, Path(folder)).trials
        baseline = _baseline(select_trials(archived, dict(options.where)), by_scene)
        of_scenes = ({trial.seed for trial in own} for own in baseline.values())
        shared = sorted(set.intersection(*of_scenes))
        if options.seeds is not None and not 0 < options.seeds <= len(shared):
            raise InputError(
                f"--seeds {options.seeds}: the archive has {len(shared)} seeds of all scenes"
            )
        seeds = shared[: options.seeds]
        question = declare_gate(options.metric, options.least, baseline, seeds, example.values)
        trials = {
            (scene, NEW, seed): with_seed(trial, seed)
            for scene, trial in by_scene.items()
            for seed in seeds
        }
        make_runs_folder(home.parent)
        make_home(home)
        old = [trial for of_scene in baseline.values() for trial in of_scene if trial.seed in seeds]

        def new() -> list[TrialResult]:
            return finished_trials(trials.values())

        asked = ask_gate(question, lambda: old, new)

        def run(planned: Sequence[Needed]) -> None:
            own = [trials[key] for key in planned if key in trials]
            # the first one shows whether the two sides can be compared at all
            for batch in (own[:1], own[1:]):
                if any(verdict.untestable for verdict in asked.verdicts()):
                    return
                try:
                    code = run_trials(batch, asks=False)
                except InputError as error:  # code of a commit that cannot be imported, too
                    raise (TrainingError if options.bisect else InputError)(str(error)) from error
                if code:
                    raise (InputError if code == 2 and not options.bisect else TrainingError)(
                        "the new version's trials fail: nothing is compared"
                    )

        (verdict,) = asked.answer(run)
        if verdict.test is None and not verdict.equal:
            why = with_notes(reason(verdict), verdict)
            raise InputError(f"the versions cannot be compared: {why}")
        print("\n".join([describe(verdict), *map(str, deviations(old, new()))]))
    return result_of(verdict)


def _baseline(
    archived: Sequence[TrialResult], by_scene: Mapping[str, Trial]
) -> dict[str, list[TrialResult]]:
    """The archive's trials of each scene.

    If one of its arms there has the name of the new trial's arm, only that one counts. Raises
    InputError for a scene that the archive lacks, and if several arms or settings are left.
    """
    baseline = {}
    for scene, new in by_scene.items():
        old = [trial for trial in archived if trial.scene == scene]
        if not old:
            scenes = listed(sorted({trial.scene for trial in archived}))
            raise InputError(f"the archive has no trial on {scene} (it has {scenes})")
        old = [trial for trial in old if str(trial.arm) == new.folder.parent.name] or old
        if len(variants := group_by(old, lambda trial: (trial.arm, trial.config_hash))) > 1:
            arms = listed([f"{arm} ({settings})" for arm, settings in variants])
            raise InputError(
                f"the archive has several arms on {scene}, {arms}: choose by --where KEY=VALUE"
            )
        baseline[scene] = old
    return baseline


def ask_gate(question: Question, baseline: ReadTrials, new: ReadTrials) -> SequentialTest:
    """The question of a gate, with functions that read each version's finished trials.

    The versions are the digests of their trials.
    """
    sides = {BASELINE: baseline, NEW: new}

    def read() -> list[TrialResult]:
        return [replace(one, alias=version) for version, own in sides.items() for one in own()]

    return SequentialTest((question,), read)


def declare_gate(
    metric: str,
    least: str | None,
    scenes: Iterable[str],
    seeds: Sequence[int],
    values: Mapping[str, Any],
) -> Question:
    """The question of a gate about ``metric`` on ``scenes``.

    Seeds are added in the order of ``seeds``. Raises InputError, one line, for a metric that cannot
    be judged (`asked_difference`), and for too few seeds.
    """
    terms = asked_difference(metric, least, values)
    if len(seeds) < FIRST_LOOK:
        raise InputError(
            f"a gate needs at least {FIRST_LOOK} seeds, and there is {len(seeds)}: allow more"
        )
    names = list(scenes)
    return Question(
        **terms,
        baseline=Arm("", BASELINE),
        idea=Arm("", NEW),
        digests=dict.fromkeys(names, (BASELINE, NEW)),
        seeds=dict.fromkeys(names, tuple(seeds)),
        looks=plan_looks(len(seeds)),
        rule="gate",
        versions=True,
        name="gate",
    )


def result_of(verdict: Verdict) -> str:
    """``passed``, ``worse``, or ``undecided``; the result may change until the verdict is final."""
    if verdict.equal or passes(verdict):
        return PASSED
    results = {"supported": PASSED, "too small to matter": PASSED, "refuted": WORSE}
    return results.get(verdict.outcome, NOT_DECIDED)


def describe(verdict: Verdict) -> str:
    """The result in a sentence.

    For example ``worse: worse in PSNR (dB) on this scene: −1.20 (interval −1.50 to −0.90), …``.
    """
    sentence = reason(verdict) if passes(verdict) else in_words(verdict)
    return with_notes(f"{result_of(verdict)}: {sentence}", verdict)


def deviations(baseline: Sequence[TrialResult], new: Sequence[TrialResult]) -> list[Note]:
    """A note for each difference of machine or libraries between the two versions' trials."""

    def made(trials: Sequence[TrialResult], name: str) -> list[str]:
        values = (
            one.record.versions.get(name, "none") if name else one.machine or "not recorded"
            for one in trials
        )
        return sorted(set(values))

    names = {name for one in (*baseline, *new) for name in one.record.versions} - {"gsbench"}
    return [
        Note.of("other library" if name else "other machine", library=name, baseline=old, new=now)
        for name in ("", *sorted(names))  # the machine, and each library
        if (old := made(baseline, name)) != (now := made(new, name))
    ]
