"""Verbs that compare versions of a trainer: ``gsbench gate`` and ``bisect`` (docs/gate.md)."""

import argparse
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gsbench.analysis.cells import select_trials
from gsbench.analysis.comparison import unused_trials
from gsbench.analysis.notes import texts
from gsbench.analysis.results import TrialResult, group_by, read_experiment
from gsbench.analysis.verdict_words import reason, with_notes
from gsbench.app.command import one_trial_per_scene, run_trials
from gsbench.claims import gate as gates
from gsbench.claims.archive import unpack_archive
from gsbench.claims.stopping import KeyAndSeed, finished_trials
from gsbench.config.compose import Trial, with_seed
from gsbench.errors import GsbenchError, InputError, TrainingError
from gsbench.external.program import run_program
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.record import declare_questions
from gsbench.runs.experiments import ERROR_RATE, Declaration, make_home, trial_key
from gsbench.runs.nested import sha256_of
from gsbench.system.install import WorkTrees
from gsbench.verbs.arguments import ArgumentParser, add_question, add_where, path
from gsbench.words import counted, listed, printable

EXIT_CODES = {gates.PASSED: 0, gates.WORSE: 1, gates.NOT_DECIDED: 3}  # of a gate
FOUND, NOT_FOUND = 0, 3  # exit codes of a bisection
HASH_LENGTH = 10  # characters of a commit's hash that are shown
OWN_SOURCE = Path("src/gsbench/__init__.py")  # present in a checkout of gsbench itself
LOG = "bisect.log"


def gate(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 passed, 1 worse, 3 not decided.

    Raises GsbenchError (exit code 1) if trials fail, and InputError (2) for bad input.
    """
    parser = ArgumentParser(
        "gate",
        "It trains this version on scenes and seeds of an archive (gsbench export --results), seed "
        "by seed until it is decided. Exit code 0: not worse by --least; 1: worse, or a trial "
        "failed; 3: undecided; 2: bad input (docs/gate.md).",
    )
    parser.add_argument("archive", type=path, help="the results of the version that you trust")
    add_question(parser)
    parser.add_argument(
        "--seeds", type=int, help="the largest number of seeds; default: all that the archive has"
    )
    add_where(parser)
    options = parser.parse_args(argv)
    by_scene = one_trial_per_scene("gate", options.settings, options.metric)
    example = next(iter(by_scene.values()))  # its settings are those of all, apart from the scene
    home = example.files.home
    with tempfile.TemporaryDirectory() as folder:
        archived = unpack_archive(options.archive, Path(folder)).trials
        baseline = _baseline(select_trials(archived, dict(options.where)), by_scene)
        seeds = _seeds(baseline, options.seeds)
        arms = {
            scene: (str(old[0].arm), by_scene[scene].folder.parent.name)
            for scene, old in baseline.items()
        }
        declaration = gates.declare_gate(options.metric, options.least, arms, seeds, example.values)
        trials = {
            (trial_key(scene, arms[scene][1], gates.NEW), seed): with_seed(trial, seed)
            for scene, trial in by_scene.items()
            for seed in seeds
        }
        make_runs_folder(checked_runs_folder(str(home.parent)))
        old = [trial for of_scene in baseline.values() for trial in of_scene if trial.seed in seeds]

        def new() -> list[TrialResult]:
            return finished_trials(home, trials.values())

        asked = gates.ask_gate(declare_questions(home, declaration), lambda: old, new)

        def run(planned: Sequence[KeyAndSeed]) -> None:
            if code := run_trials([trials[key] for key in planned if key in trials]):
                raise (InputError if code == 2 else GsbenchError)(
                    "the new version's trials fail: nothing is compared"
                )

        (verdict,) = asked.answer(run)
        if verdict.answer is None and not verdict.equal:
            why = with_notes(reason(verdict), verdict)
            raise InputError(f"the versions cannot be compared: {why}")
        made = [*asked.read()]
        left_out = texts(unused_trials(made, [verdict]))
        new_trials = [trial for trial in made if trial.config_hash == gates.NEW]
        deviations = map(str, gates.deviations(old, new_trials))
        print("\n".join([gates.describe(verdict), *left_out, *deviations]))
    return EXIT_CODES[gates.result_of(verdict)]


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


def _seeds(baseline: Mapping[str, Sequence[TrialResult]], most: int | None) -> list[int]:
    """The seeds that all scenes have, ``most`` at most; raises InputError if there are fewer."""
    shared = sorted(
        set.intersection(*({trial.seed for trial in trials} for trials in baseline.values()))
    )
    if most is not None and not 0 < most <= len(shared):
        raise InputError(f"--seeds {most}: the archive has {len(shared)} seeds of all scenes")
    return shared[:most]


def bisect(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if the commit is found, 3 if not.

    Raises TrainingError if GOOD or BAD does not train.
    """
    parser = ArgumentParser(
        "bisect",
        "It searches the git repository of this folder: one with a densifier of your own, or "
        "gsbench's checkout. Each step trains one commit in a work tree of its own and compares it "
        "with GOOD and BAD; all steps share an error rate of 5 %. The same command goes on after a "
        "kill. Exit code 0: found, 3: not found (docs/gate.md).",
    )
    parser.add_argument("good", help="a commit, tag or branch whose results are good")
    parser.add_argument("bad", help="a later one whose results are worse")
    add_question(parser)
    parser.add_argument(
        "--seeds", type=int, default=6, help="the largest number of seeds for each commit (6)"
    )
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="gsbench-bisect-") as scratch:
        trees = WorkTrees(Path.cwd(), Path(scratch).resolve())
        commits = trees.commits(options.good, options.bad)
        search = _begin(options, trees, commits)
        found = gates.first_worse(len(commits) - 1, search.result)
    print("\n".join([*search.table(), "", *_conclusion(found, search)]))
    return FOUND if found is not None and found[1] - found[0] == 1 else NOT_FOUND


@dataclass
class CommitSearch:
    """A search through ``commits`` with one declaration for all steps; the first commit is good."""

    # an experiment without trials for the declaration; each commit's trials are in one of its own
    home: Path
    settings: Sequence[str]
    scenes: frozenset[str]
    declaration: Declaration
    share: float  # the chance that a step is wrong
    trees: WorkTrees
    commits: Sequence[tuple[str, str, str]]
    # results so far, by the commit's index
    answers: dict[int, str] = field(default_factory=dict)

    def result(self, number: int) -> str | None:
        """The result of a commit; None if it does not train.

        The last commit is compared with the first one, any other with both. What is missing is
        trained.
        """
        last = len(self.commits) - 1
        places = {gates.BASELINE: 0, gates.LAST: last, gates.NEW: number}
        homes = {
            version: self.home.parent / f"{self.home.name}_{self.commits[k][0][:HASH_LENGTH]}"
            for version, k in places.items()
        }
        good, bad, new = (lambda home=home: _trials(home) for home in homes.values())
        asked = (
            gates.ask_gate(self.declaration, good, new)
            if number == last
            else gates.ask_step(self.declaration, self.share, good, bad, new)
        )

        def run(planned: Sequence[KeyAndSeed]) -> None:
            for version, place in places.items():
                seeds = [seed for key, seed in planned if key.endswith(f"/{version}")]
                self._train(place, homes[version], seeds)

        try:
            verdicts = asked.answer(run)
        except TrainingError as error:
            if number == last or not good():
                raise
            self.answers[number] = f"does not train: {error}"
            return None
        if number < last:
            self.answers[number] = gates.describe_step(verdicts)
            return gates.step_result(verdicts)
        (verdict,) = verdicts
        self.answers[number] = gates.describe(verdict)
        result = gates.result_of(verdict)
        if result == gates.WORSE and (warning := gates.too_small_to_place(verdict, self.share)):
            print(warning, file=sys.stderr)
        return result

    def _train(self, number: int, home: Path, seeds: Sequence[int]) -> None:
        """Train a commit with the seeds that are not done, by the code in its work tree."""
        done = {(trial.scene, trial.seed) for trial in _trials(home)}
        missing = [
            str(seed) for seed in seeds if not {(scene, seed) for scene in self.scenes} <= done
        ]
        if not missing:
            return
        commit, _, subject = self.commits[number]
        print(
            f"{commit[:HASH_LENGTH]} {printable(subject)}: seeds {', '.join(missing)}",
            file=sys.stderr,
        )
        tree = self.trees.tree(commit)
        environment = os.environ | {"GSBENCH_RUNS": str(home.parent)}
        if (tree / OWN_SOURCE).is_file():
            environment["PYTHONPATH"] = str(tree / OWN_SOURCE.parts[0])
        make_home(home)
        words = ["-m", *self.settings, f"name={home.name}", f"seed={','.join(missing)}"]
        command = [sys.executable, "-P", "-m", "gsbench", *words]
        run_program(command, home / LOG, tree / self.trees.prefix, environment, None)

    def table(self) -> list[str]:
        """Lines about every commit, the newest first."""
        lines = []
        for number in reversed(range(len(self.commits))):
            commit, date, subject = self.commits[number]
            answer = "the good one" if number == 0 else self.answers.get(number, "not tried")
            lines.append(
                printable(f"{commit[:HASH_LENGTH]}  {date}  {subject}\n            {answer}")
            )
        return lines


def _begin(
    options: argparse.Namespace, trees: WorkTrees, commits: Sequence[tuple[str, str, str]]
) -> CommitSearch:
    """Check the settings, and declare the question of all steps before the first one."""
    by_scene = one_trial_per_scene("bisect", options.settings, options.metric)
    example = next(iter(by_scene.values()))  # its settings are those of all, apart from the scene
    for trial in by_scene.values():
        place = trial.values["scene"].get("path")
        if place and not Path(place).expanduser().is_absolute():
            raise InputError(
                f"scene.path={place}: commits are trained in other folders, so give the whole path"
            )
    arms = {scene: (trial.folder.parent.name,) * 2 for scene, trial in by_scene.items()}
    # of each step, so that all together err in 5 % at most; only "worse" can be wrong, so the
    # interval with both sides has twice the share
    share = ERROR_RATE / gates.most_steps(len(commits) - 1)
    seeds = range(max(0, options.seeds))  # too few are refused below
    declaration = gates.declare_gate(
        options.metric, options.least, arms, seeds, example.values, 2 * share
    )
    settings = [word for word in options.settings if not word.startswith(("name=", "runs="))]
    runs = checked_runs_folder(str(example.files.runs))
    make_runs_folder(runs)
    # The name is a hash of the question, so that the same command continues the same search.
    question = sha256_of([commits[0][0], commits[-1][0], *settings])[:HASH_LENGTH]
    home = runs / f"{example.values['name']}_{question}"
    declaration = declare_questions(home, declaration)
    return CommitSearch(home, settings, frozenset(by_scene), declaration, share, trees, commits)


def _trials(home: Path) -> tuple[TrialResult, ...]:
    return read_experiment(home).trials if home.is_dir() else ()


def _conclusion(found: tuple[int, int] | None, search: CommitSearch) -> list[str]:
    """The lines that say which commit, or which commits, the search found."""
    if found is None:
        return [
            "The last commit is not shown to be worse than the first: allow more --seeds, or take "
            "another metric."
        ]
    good, bad = found
    commit, date, subject = search.commits[bad]
    if bad - good == 1:
        return [printable(f"It became worse with {commit[:HASH_LENGTH]} ({date}): {subject}")]
    first = search.commits[good + 1][0][:HASH_LENGTH]
    return [
        f"It became worse with one of {counted(bad - good, 'commit')}, from {first} to "
        f"{commit[:HASH_LENGTH]}."
    ]
