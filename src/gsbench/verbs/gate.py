"""``gsbench gate``: is this version of a trainer worse than the version whose results an archive holds?"""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from gsbench.analysis.cells import select_trials
from gsbench.analysis.results import TrialResult, group_by, read_experiment
from gsbench.app.command import one_trial_per_scene, run_trials
from gsbench.claims.archive import unpack_archive
from gsbench.claims.gate import NEW, NOT_DECIDED, PASSED, WORSE, Gate, declare_gate, describe, deviations, result_of
from gsbench.claims.stopping import KeyAndSeed, run_looks
from gsbench.config.compose import Trial, with_seed
from gsbench.errors import GsbenchError, InputError
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.record import declare_questions
from gsbench.runs.declaration import trial_key
from gsbench.verbs.arguments import ArgumentParser, add_question, add_where, path
from gsbench.words import listed

EXIT_CODES = {PASSED: 0, WORSE: 1, NOT_DECIDED: 3}


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 passed, 1 worse, 3 not decided; raises GsbenchError (1) if trials fail, InputError (2)."""
    parser = ArgumentParser(
        prog="gsbench gate",
        description="Train this version on scenes and seeds of an archive (gsbench export --results), seed by seed "
        "until it is decided. The exit code says whether it is worse: 0 no (better, or worse by less than what "
        "matters), 1 yes, or its trials fail, 3 the seeds do not tell, 2 bad input (docs/gate.md).",
    )
    parser.add_argument("archive", type=path, help="the results of the version that you trust")
    add_question(parser)
    parser.add_argument("--seeds", type=int, help="the largest number of seeds; default: all that the archive has")
    add_where(parser)
    options = parser.parse_args(argv)
    by_scene = one_trial_per_scene("gate", options.settings, options.metric)
    example = next(iter(by_scene.values()))  # its settings are those of all, apart from the scene
    home = example.files.home
    with tempfile.TemporaryDirectory() as folder:
        archived = unpack_archive(options.archive, Path(folder)).trials
        baseline = _baseline(select_trials(archived, dict(options.where)), by_scene)
        seeds = _seeds(baseline, options.seeds)
        arms = {scene: (_arm(old[0]), by_scene[scene].folder.parent.name) for scene, old in baseline.items()}
        declaration = declare_gate(options.metric, options.least, arms, seeds, example.values)
        trials = {
            (trial_key(scene, arms[scene][1], NEW), seed): with_seed(trial, seed)
            for scene, trial in by_scene.items()
            for seed in seeds
        }
        make_runs_folder(checked_runs_folder(str(home.parent)))
        old = [trial for of_scene in baseline.values() for trial in of_scene if trial.seed in seeds]
        gate = Gate(declare_questions(home, declaration), lambda: old, lambda: _done(home, list(trials.values())))

        def run(planned: Sequence[KeyAndSeed]) -> None:
            if code := run_trials([trials[key] for key in planned if key in trials]):
                raise (InputError if code == 2 else GsbenchError)("the new version's trials fail: nothing is compared")

        (verdict,) = run_looks(gate.declaration, gate.judged, run)
        if verdict.answer is None and not verdict.equal:
            reasons = filter(None, (verdict.untestable, *verdict.notes, "trials are missing"))
            raise InputError(f"the versions cannot be compared: {next(reasons)}")
        print("\n".join([describe(verdict), *deviations(old, list(gate.new()))]))
    return EXIT_CODES[result_of(verdict)]


def _baseline(archived: Sequence[TrialResult], by_scene: Mapping[str, Trial]) -> dict[str, list[TrialResult]]:
    """The archive's trials of each scene. If it has several arms there, the one with the name of the new trial's arm.

    Raises InputError for a scene that the archive lacks, and if several arms or settings are left.
    """
    baseline = {}
    for scene, new in by_scene.items():
        old = [trial for trial in archived if trial.scene == scene]
        if not old:
            scenes = listed(sorted({trial.scene for trial in archived}))
            raise InputError(f"the archive has no trial on {scene} (it has {scenes})")
        old = [trial for trial in old if _arm(trial) == new.folder.parent.name] or old
        if len(variants := group_by(old, lambda trial: (_arm(trial), trial.config_hash))) > 1:
            arms = listed([f"{arm} ({settings})" for arm, settings in variants])
            raise InputError(f"the archive has several arms on {scene}, {arms}: choose by --where KEY=VALUE")
        baseline[scene] = old
    return baseline


def _seeds(baseline: Mapping[str, Sequence[TrialResult]], most: int | None) -> list[int]:
    """The seeds that all scenes have, ``most`` at most; raises InputError if there are fewer."""
    shared = sorted(set.intersection(*({trial.seed for trial in trials} for trials in baseline.values())))
    if most is not None and not 0 < most <= len(shared):
        raise InputError(f"--seeds {most}: the archive has {len(shared)} seeds of all scenes")
    return shared[:most]


def _done(home: Path, trials: Sequence[Trial]) -> list[TrialResult]:
    """The results of those ``trials`` that are done. Results of earlier code do not count as done."""
    by_folder = {trial.folder: trial for trial in trials}
    results = read_experiment(home).trials if home.is_dir() else ()
    return [
        result
        for result in results
        if (trial := by_folder.get(result.path)) is not None and not trial.files.why_not_done(trial.values)
    ]


def _arm(trial: TrialResult) -> str:
    return f"{trial.init}-{trial.densify}"
