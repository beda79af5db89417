"""``gsbench gate``: is this version of a trainer worse than the one that an archive is of?"""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from gsbench.analysis.cells import select_trials
from gsbench.analysis.results import TrialResult, group_by, read_experiment
from gsbench.app.command import one_trial_per_scene, run_trials
from gsbench.claims.archive import unpack_archive
from gsbench.claims.gate import NEW, NOT_DECIDED, PASSED, WORSE, Gate, ask, describe, deviations, result_of
from gsbench.claims.stopping import Planned, run_looks
from gsbench.config.compose import Trial, with_seed
from gsbench.errors import GsbenchError, InputError
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.record import declare_questions
from gsbench.runs.declaration import trial_key
from gsbench.verbs.arguments import ArgumentParser, add_question, add_where, path
from gsbench.words import listed

EXIT_CODES = {PASSED: 0, WORSE: 1, NOT_DECIDED: 3}


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 passed, 1 worse, 3 not decided; raises GsbenchError (1) where trials fail, InputError (2)."""
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
    first = one_trial_per_scene("gate", options.settings, options.metric)
    some = next(iter(first.values()))
    home = some.files.home
    with tempfile.TemporaryDirectory() as folder:
        every = unpack_archive(options.archive, Path(folder)).trials
        baseline = _baseline(select_trials(every, dict(options.where)), first)
        seeds = _seeds(baseline, options.seeds)
        arms = {scene: (_arm(one[0]), first[scene].folder.parent.name) for scene, one in baseline.items()}
        declaration = ask(options.metric, options.least, arms, seeds, some.values)
        trials = {
            (trial_key(scene, arms[scene][1], NEW), seed): with_seed(one, seed)
            for scene, one in first.items()
            for seed in seeds
        }
        make_runs_folder(checked_runs_folder(str(home.parent)))
        old = [one for own in baseline.values() for one in own if one.seed in seeds]
        gate = Gate(declare_questions(home, declaration), lambda: old, lambda: _done(home, list(trials.values())))

        def run(planned: Sequence[Planned]) -> None:
            if code := run_trials([trials[key] for key in planned if key in trials]):
                raise (InputError if code == 2 else GsbenchError)("the new version's trials fail: nothing is compared")

        (verdict,) = run_looks(gate.declaration, gate.judged, run)
        if verdict.answer is None and not verdict.equal:
            reasons = filter(None, (verdict.untestable, *verdict.notes, "trials are missing"))
            raise InputError(f"the versions cannot be compared: {next(reasons)}")
        print("\n".join([describe(verdict), *deviations(old, list(gate.new()))]))
    return EXIT_CODES[result_of(verdict)]


def _baseline(trials: Sequence[TrialResult], first: Mapping[str, Trial]) -> dict[str, list[TrialResult]]:
    """The archive's trials by scene: of several arms on a scene those whose name the new trials have.

    Raises InputError for a scene that the archive lacks, and where it has several such arms.
    """
    found = {}
    for scene, new in first.items():
        own = [trial for trial in trials if trial.scene == scene]
        if not own:
            there = listed(sorted({trial.scene for trial in trials}))
            raise InputError(f"the archive has no trial on {scene} (it has {there})")
        own = [trial for trial in own if _arm(trial) == new.folder.parent.name] or own
        if len(kinds := group_by(own, lambda trial: (_arm(trial), trial.config_hash))) > 1:
            arms = listed([f"{arm} ({settings})" for arm, settings in kinds])
            raise InputError(f"the archive has several arms on {scene}, {arms}: choose by --where KEY=VALUE")
        found[scene] = own
    return found


def _seeds(baseline: Mapping[str, Sequence[TrialResult]], most: int | None) -> list[int]:
    """The seeds that all scenes have, ``most`` at most; raises InputError where there are fewer than asked for."""
    shared = sorted(set.intersection(*({trial.seed for trial in own} for own in baseline.values())))
    if most is not None and not 0 < most <= len(shared):
        raise InputError(f"--seeds {most}: the archive has {len(shared)} seeds of all scenes")
    return shared[:most]


def _done(home: Path, trials: Sequence[Trial]) -> list[TrialResult]:
    """The results of those trials that are done by the code as it is now: others are of an earlier version."""
    ours = {trial.folder: trial for trial in trials}
    found = read_experiment(home).trials if home.is_dir() else ()
    return [one for one in found if one.path in ours and not ours[one.path].files.why_not_done(ours[one.path].values)]


def _arm(trial: TrialResult) -> str:
    return f"{trial.init}-{trial.densify}"
