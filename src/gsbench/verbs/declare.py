"""``gsbench declare``: write a sweep's questions and train nothing (docs/verdict.md)."""

from collections.abc import Sequence
from pathlib import Path

from gsbench.app.command import compose_trials
from gsbench.config.command_words import parse
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.record import check_looks, check_questions, planned_rows, record
from gsbench.verbs.arguments import ArgumentParser
from gsbench.words import counted


def declare(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for a wrong sweep."""
    parser = ArgumentParser(
        "declare",
        "It writes the questions of a sweep and trains nothing: for loops and arrays of jobs that "
        "train its trials one by one. Each of these commands then asks nothing more.",
        {"settings* KEY=VALUE": "as of a sweep", "--config-dir FOLDER": "as of a sweep"},
    )
    parser.add_argument("-m", "--multirun", action="store_true", help="is understood")
    parser.parse_args(argv)
    words, _, _ = parse(argv)  # the words of a command
    trials = compose_trials(words, multirun=True)
    if any(trial.values["launch"]["stop_when_decided"] for trial in trials):
        check_looks(trials, planned_rows(trials))
    check_questions(trials)
    make_runs_folder(checked_runs_folder(trials[0].values["runs"]))
    questions = record(trials)  # which says them
    print(
        f"{trials[0].values['name']}: {counted(len(trials), 'trial')} and "
        f"{counted(len(questions), 'question')}"
    )
    return 0
