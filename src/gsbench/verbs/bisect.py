"""``gsbench bisect GOOD BAD``: which commit of a trainer made its results worse?"""

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gsbench.analysis.results import TrialResult, read_experiment
from gsbench.app.command import one_trial_per_scene
from gsbench.claims.gate import BASELINE, NEW, Gate, declare_gate, describe, first_worse, most_steps, result_of
from gsbench.claims.stopping import KeyAndSeed, run_looks
from gsbench.errors import InputError, TrainingError
from gsbench.external.program import run_program
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.record import declare_questions
from gsbench.runs.declaration import ERROR_RATE, Declaration
from gsbench.runs.experiments import make_home
from gsbench.runs.keys import sha256_of
from gsbench.system.install import WorkTrees
from gsbench.verbs.arguments import ArgumentParser, add_question
from gsbench.words import counted, printable

FOUND, NOT_FOUND = 0, 3
HASH_LENGTH = 10  # characters of a commit's hash that are shown
OWN_SOURCE = Path("src/gsbench/__init__.py")  # present in a checkout of gsbench itself
LOG = "bisect.log"


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if the commit is found, 3 if not; raises TrainingError if GOOD or BAD does not train."""
    parser = ArgumentParser(
        prog="gsbench bisect",
        description="Find the commit that made results worse in the git repository of this folder: one with a "
        "densifier of your own, or gsbench's checkout. Each step trains one commit in a work tree of its own and "
        "compares it with GOOD, as gsbench gate does; all steps share an error rate of 5 %. The same command goes on "
        "after a kill. Exit code 0: found, 3: not found (docs/gate.md).",
    )
    parser.add_argument("good", help="a commit, tag or branch whose results are good")
    parser.add_argument("bad", help="a later one whose results are worse")
    add_question(parser)
    parser.add_argument("--seeds", type=int, default=6, help="the largest number of seeds for each commit (6)")
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="gsbench-bisect-") as scratch:
        trees = WorkTrees(Path.cwd(), Path(scratch).resolve())
        commits = trees.commits(options.good, options.bad)
        search = _begin(options, trees, commits)
        found = first_worse(len(commits) - 1, search.result)
    print("\n".join([*search.table(), "", *_conclusion(found, search)]))
    return FOUND if found is not None and found[1] - found[0] == 1 else NOT_FOUND


@dataclass
class CommitSearch:
    """A search through ``commits``, the first of which is good, with one declaration for all its steps."""

    home: Path  # an experiment without trials for the declaration; each commit's trials are in one of its own
    settings: Sequence[str]
    scenes: frozenset[str]
    declaration: Declaration
    trees: WorkTrees
    commits: Sequence[tuple[str, str, str]]
    answers: dict[int, str] = field(default_factory=dict)  # what was found out, by the commit's index

    def result(self, number: int) -> str | None:
        """The result of a commit against the first one; None if it does not train. Trains what is missing."""
        good, new = (self.home.parent / f"{self.home.name}_{self.commits[k][0][:HASH_LENGTH]}" for k in (0, number))
        gate = Gate(self.declaration, lambda: _trials(good), lambda: _trials(new))

        def run(planned: Sequence[KeyAndSeed]) -> None:
            for version, commit, home in ((BASELINE, 0, good), (NEW, number, new)):
                self._train(commit, home, [seed for key, seed in planned if key.endswith(f"/{version}")])

        try:
            (verdict,) = run_looks(self.declaration, gate.judged, run)
        except TrainingError as error:
            if number == len(self.commits) - 1 or not _trials(good):
                raise
            self.answers[number] = f"does not train: {error}"
            return None
        self.answers[number] = describe(verdict)
        return result_of(verdict)

    def _train(self, number: int, home: Path, seeds: Sequence[int]) -> None:
        """Train a commit with the seeds that are not done, by the code in its work tree."""
        done = {(trial.scene, trial.seed) for trial in _trials(home)}
        missing = [str(seed) for seed in seeds if not {(scene, seed) for scene in self.scenes} <= done]
        if not missing:
            return
        commit, _, subject = self.commits[number]
        print(f"{commit[:HASH_LENGTH]} {printable(subject)}: seeds {', '.join(missing)}", file=sys.stderr)
        tree = self.trees.tree(commit)
        environment = os.environ | {"GSBENCH_RUNS": str(home.parent)}
        if (tree / OWN_SOURCE).is_file():
            environment["PYTHONPATH"] = str(tree / OWN_SOURCE.parts[0])
        make_home(home)
        words = ["-m", *self.settings, f"name={home.name}", f"seed={','.join(missing)}"]
        command = [sys.executable, "-m", "gsbench", *words]
        run_program(command, home / LOG, tree / self.trees.prefix, environment, None)

    def table(self) -> list[str]:
        """Lines about every commit, the newest first."""
        lines = []
        for number in reversed(range(len(self.commits))):
            commit, date, subject = self.commits[number]
            answer = "the good one" if number == 0 else self.answers.get(number, "not tried")
            lines.append(printable(f"{commit[:HASH_LENGTH]}  {date}  {subject}\n            {answer}"))
        return lines


def _begin(options: argparse.Namespace, trees: WorkTrees, commits: Sequence[tuple[str, str, str]]) -> CommitSearch:
    """Check the settings, and declare the question of all steps before the first one."""
    by_scene = one_trial_per_scene("bisect", options.settings, options.metric)
    example = next(iter(by_scene.values()))  # its settings are those of all, apart from the scene
    for trial in by_scene.values():
        place = trial.values["scene"].get("path")
        if place and not Path(place).expanduser().is_absolute():
            raise InputError(f"scene.path={place}: commits are trained in other folders, so give the whole path")
    arms = {scene: (trial.folder.parent.name,) * 2 for scene, trial in by_scene.items()}
    share = ERROR_RATE / most_steps(len(commits) - 1)  # of each step, so that all together err in 5 % at most
    seeds = range(max(0, options.seeds))
    declaration = declare_gate(options.metric, options.least, arms, seeds, example.values, share)
    settings = [word for word in options.settings if not word.startswith(("name=", "runs="))]
    runs = checked_runs_folder(str(example.files.runs))
    make_runs_folder(runs)
    # The name is a hash of the question, so that the same command continues the same search.
    home = runs / f"{example.values['name']}_{sha256_of([commits[0][0], commits[-1][0], *settings])[:HASH_LENGTH]}"
    declaration = declare_questions(home, declaration)
    return CommitSearch(home, settings, frozenset(by_scene), declaration, trees, commits)


def _trials(home: Path) -> tuple[TrialResult, ...]:
    return read_experiment(home).trials if home.is_dir() else ()


def _conclusion(found: tuple[int, int] | None, search: CommitSearch) -> list[str]:
    """The lines that say which commit, or which commits, the search found."""
    if found is None:
        return [
            "The last commit is not shown to be worse than the first: allow more --seeds, or look at another metric."
        ]
    good, bad = found
    commit, date, subject = search.commits[bad]
    if bad - good == 1:
        return [printable(f"It became worse with {commit[:HASH_LENGTH]} ({date}): {subject}")]
    first = search.commits[good + 1][0][:HASH_LENGTH]
    return [f"It became worse with one of {counted(bad - good, 'commit')}, from {first} to {commit[:HASH_LENGTH]}."]
