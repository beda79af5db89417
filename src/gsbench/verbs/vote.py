"""``gsbench vote``: a page to compare renders blindly, and people's verdict (docs/vote.md)."""

import argparse
import random
import secrets
from collections.abc import Sequence
from pathlib import Path

from gsbench.analysis.addresses import trials_of_arm
from gsbench.analysis.cells import with_variants
from gsbench.analysis.comparison import compare
from gsbench.analysis.pairing import BASELINE
from gsbench.analysis.results import Arm, Experiment, TrialResult, load_experiment
from gsbench.analysis.statistics import ALPHA, sign_test_needs
from gsbench.analysis.table_formats import to_markdown
from gsbench.analysis.vote_words import describe_round, load_rounds, people_words, vote_table
from gsbench.analysis.votes import LEAST_PREFERENCE, METRIC
from gsbench.errors import InputError
from gsbench.files import make_runs_folder, require_no_links, writable_output, write_json
from gsbench.launch.record import declare_questions
from gsbench.parsing import read_typed, resolved
from gsbench.runs.experiments import Declaration, Question
from gsbench.runs.layout import VOTE_KEY, VOTES
from gsbench.runs.votes import Ballot, RoundKey, StoredBallot, check_ballot, read_key, store_ballots
from gsbench.verbs.arguments import ArgumentParser, names, path, whole_number
from gsbench.words import command, counted

PAIRS, PEOPLE = 40, 9  # nine: the sign test then lets one person disagree
MOST = 1000  # pairs, and people


def vote(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    options = _parser().parse_args(argv)
    experiment = load_experiment(runs, options.experiment)
    if options.action == "make":
        if options.out is None or options.files:
            raise InputError(
                "vote make needs --out DIR, a new folder for the page, and takes no files"
            )
        make(experiment, options)
    else:
        if options.out is not None or options.arms:
            raise InputError("vote judge takes an experiment and files of votes alone")
        judge(experiment, options.files)
    return 0


def _parser() -> ArgumentParser:
    parser = ArgumentParser(
        "vote",
        "`make` writes the page, a folder that works without a server. `judge` takes the files "
        "that people save.",
    )
    parser.add_argument("action", choices=["make", "judge"])
    parser.add_argument("experiment")
    parser.add_argument(
        "files",
        nargs="*",
        type=path,
        metavar="VOTES.json",
        help="for judge; it remembers those of earlier calls",
    )
    parser.add_argument(
        "--arms",
        type=names,
        default=(),
        metavar="A,B",
        help="the baseline first; default: all arms",
    )
    parser.add_argument(
        "--pairs",
        type=whole_number(MOST),
        default=PAIRS,
        help=f"of renders that each person compares ({PAIRS}), before repeats",
    )
    parser.add_argument(
        "--people",
        type=whole_number(MOST),
        default=PEOPLE,
        help=f"whose votes are declared to count ({PEOPLE}), no more or fewer",
    )
    parser.add_argument("--out", type=path, metavar="DIR", help="for make: a new folder")
    return parser


def make(experiment: Experiment, options: argparse.Namespace) -> None:
    """Write the page, then its key and its declaration into the experiment's folder."""
    from gsbench.claims.vote_page import PAGE, make_round  # here, for a quick answer to --help

    trials = with_variants(experiment.trials)
    arms = choose_arms(trials, options.arms)
    out: Path = options.out
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(
            f"--out {out} is there already: give a new folder, since a page that people use must "
            "not change"
        )
    make_runs_folder(experiment.folder.parent)
    rng = random.Random(secrets.randbits(256))
    with writable_output(out / PAGE):
        key = make_round(trials, arms, options.pairs, options.people, out, rng)
    folder = experiment.folder / VOTES / key.round
    require_no_links(experiment.folder.parent, folder)
    folder.mkdir(parents=True)
    write_json(folder / VOTE_KEY, key.to_json())
    name, baseline = f"vote {key.round}", arms[0]
    asked = tuple(
        Question(metric=METRIC, least=LEAST_PREFERENCE, baseline=baseline, arm=arm, name=name)
        for arm in arms[1:]
    )
    declaration = Declaration(time=key.time, questions=asked, votes=key.votes, vote_round=key.round)
    declare_questions(experiment.folder, declaration)
    pairs, scenes = len(key.pairs), len({showing.scene for showing in key.pairs})
    print(
        f"round {key.round}: {counted(len(key.showings), 'showing')}, {counted(pairs, 'pair')} of "
        "renders, and repeats"
    )
    print(f"declared: judged at {counted(key.votes, 'vote')} of {people_words(key.people)}")
    print(f"declared: whoever has more than {counted(key.traps_allowed, 'wrong trap')} is left out")
    if pairs < options.pairs:
        print(f"the trials have no more than {pairs} views for {options.pairs} pairs")
    level = ALPHA / len(asked)
    if not sign_test_needs(key.people, level) and not sign_test_needs(scenes, level):
        needed = next(n for n in range(1, 99) if sign_test_needs(n, level))
        print(
            f"it will decide nothing: that needs {needed} people (--people {needed}) or {needed} "
            "scenes"
        )
    print(out / PAGE)


def judge(experiment: Experiment, files: Sequence[Path]) -> None:
    """Take people's files into their rounds, and print the verdicts of these rounds, or all."""
    ballots: dict[str, Ballot] = {}
    new: dict[Path, tuple[RoundKey, list[Ballot]]] = {}
    for file in files:
        if not file.is_file():
            raise InputError(f"{file} is not there: give the files of votes that people saved")
        ballot = read_typed(resolved(file), Ballot)
        folder = experiment.folder / VOTES / ballot.round
        require_no_links(experiment.folder.parent, folder, below=True)
        key = read_key(folder)
        check_ballot(ballot, key, file)
        if ballot.person in ballots:
            raise InputError(
                f"{file} is of the same person as another file: give one file for each person"
            )
        ballots[ballot.person] = ballot
        place = folder / f"{ballot.person}.json"
        # A person who goes back and saves again would otherwise change votes after seeing a
        # verdict.
        if not place.exists():
            new.setdefault(folder, (key, []))[1].append(ballot)
        elif read_typed(place, StoredBallot).ballot != ballot:
            raise InputError(
                f"{file}: this person handed in other votes before, which stay ({place})"
            )
    for folder, (key, handed_in) in new.items():
        store_ballots(folder, key, handed_in)
    verdicts = load_rounds(experiment.folder)
    if not verdicts:
        raise InputError(
            f"{experiment.name} has no round of votes: "
            + command("vote", "make", experiment.name, "--out", "DIR")
        )
    comparison = compare(experiment)
    trials, judged = comparison.trials, comparison.answers
    rounds = {ballot.round for ballot in ballots.values()} or {
        verdict.key.round for verdict in verdicts
    }
    for verdict in verdicts:
        if verdict.key.round in rounds:
            tables = [
                to_markdown(vote_table(pair, verdict.final, trials, judged))
                for pair in verdict.pairs
            ]
            print("\n".join([*describe_round(verdict), *tables]))


def choose_arms(trials: Sequence[TrialResult], wanted: Sequence[str]) -> list[Arm]:
    """The wanted arms of ``trials``, the baseline first; all arms by default.

    Raises InputError unless each word names one arm, and there are two.
    """
    arms = sorted({trial.arm for trial in trials})
    chosen = [trials_of_arm(trials, word)[0].arm for word in wanted]
    # Two words may name the same arm.
    unique = list(dict.fromkeys(chosen)) or sorted(arms, key=lambda arm: arm.densify != BASELINE)
    if len(unique) < 2:
        raise InputError(f"votes compare two arms or more, and here is {unique[0]} alone")
    return unique
