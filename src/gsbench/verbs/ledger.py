"""``gsbench ledger``: many ideas under one false discovery rate (docs/night.md)."""

import argparse
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsbench.analysis.ledger_table import describe_ledger, difference_text, ledger_tables, why
from gsbench.analysis.results import read_experiment
from gsbench.analysis.table_formats import to_markdown
from gsbench.analysis.verdicts import judge
from gsbench.app.command import run_trials
from gsbench.app.ledger_trials import (
    Trials,
    check_words,
    compose_words,
    keys_by_scene,
    merged,
    permitted_words,
    seeds_of,
)
from gsbench.claims import ledger as rules
from gsbench.claims.gate import asked_difference
from gsbench.claims.ledger import IDEAS, RATE
from gsbench.claims.stopping import Needed, finished_trials
from gsbench.config.overrides import key_of
from gsbench.errors import GsbenchError, InputError
from gsbench.eval.options import EvalConfig
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.runs import ledger as records
from gsbench.runs.commands import Question
from gsbench.runs.config_hash import config_hash
from gsbench.runs.experiments import make_home, stamp_now
from gsbench.runs.layout import IN_RUNS, LEDGER
from gsbench.runs.ledger import BASELINE, DROPPED, FAILED, KEPT, UNDECIDED, Ledger
from gsbench.settings import OpenFraction, is_folder_name
from gsbench.verbs.arguments import ArgumentParser, names, number, whole_number
from gsbench.words import did_you_mean, listed

EXIT_CODES = {KEPT: 0, DROPPED: 1, FAILED: 1, UNDECIDED: 3}
MOST_IDEAS = 10_000


log = logging.getLogger(__name__)


def ledger(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 kept (or nothing was tried), 1 dropped or failed, 3 undecided."""
    options = _parser().parse_args(argv)
    if not is_folder_name(options.name) or options.name in IN_RUNS:
        raise InputError(f"ledger: {options.name!r} cannot be the name of an experiment")
    action, taken = ACTIONS[options.action]
    for option, flag in FLAGS.items():
        if getattr(options, option) and option not in taken:
            raise InputError(f"ledger {options.action} takes no {flag}")
    return action(options, runs / options.name)


def _parser() -> ArgumentParser:
    parser = ArgumentParser(
        "ledger",
        "`new` declares metric, baseline, captures, seeds and error rate. `try` trains one idea, "
        "seed by seed until it is decided; what looks better is tested on new seeds. Exit code 0: "
        "kept, 1: dropped, or its trials fail, 3: undecided, 2: bad input. `confirm` trains what "
        "was kept on other captures. `show` lists all (docs/night.md).",
    )
    parser.add_argument("action", choices=list(ACTIONS))
    parser.add_argument("name", help="the ledger, which is an experiment in the runs folder")
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="as of a sweep")
    parser.add_argument("--metric", help="new: decides, such as lpips_squeeze (psnr)")
    parser.add_argument(
        "--least", help="new: the least difference that matters, as 0.1 or 10%% (the metric's)"
    )
    parser.add_argument(
        "--ideas",
        type=whole_number(MOST_IDEAS),
        help=f"new: the most ideas that will be tried ({IDEAS})",
    )
    parser.add_argument(
        "--fdr",
        type=number(OpenFraction),
        help=f"new: the false discovery rate, from 0 to 1 ({RATE})",
    )
    parser.add_argument("--against", help="try: a kept idea to start from (default: the baseline)")
    parser.add_argument("--as", dest="idea", help="try: the idea's name (default: densify.name)")
    parser.add_argument("--only", type=names, help="confirm: these ideas (default: all kept)")
    parser.add_argument("--json", action="store_true", help="try, show: print JSON")
    return parser


def new(options: argparse.Namespace, home: Path) -> int:
    """Declare a ledger; the same command again changes nothing."""
    trials = compose_words(options.name, options.settings, options.settings)
    keys, seeds = keys_by_scene(trials, options.name), seeds_of(trials)
    values = next(iter(trials.values())).values
    metric = options.metric or "psnr"
    sign, least = asked_difference(metric, options.least, values)
    EvalConfig(**values["eval"] | {"primary": metric})  # raises if it is not computed
    opened = records.Opened(
        time=stamp_now(),
        metric=metric,
        sign=1 if sign > 0 else -1,
        least=least.size,
        relative=least.relative,
        ideas=options.ideas or IDEAS,
        rate=options.fdr or RATE,
        seeds=seeds,
        words=tuple(options.settings),
        keys=keys,
    )
    make_runs_folder(checked_runs_folder(str(home.parent)))
    if home.is_dir() and not (home / LEDGER).exists() and read_experiment(home).trials:
        raise InputError(f"{home.name} has trials already: give the ledger another name")
    make_home(home)
    begun = records.begin_ledger(home, opened)
    if begun.opened.to_json() | {"time": ""} != opened.to_json() | {"time": ""}:
        raise InputError(f"{home.name} is another ledger already: give this one another name")
    print("\n".join(describe_ledger(begun)))
    return 0


def try_idea(options: argparse.Namespace, home: Path) -> int:
    """Run one idea until it is decided; an idea that was decided before is only shown."""
    book = records.read_ledger(home)
    rules.check_unknown_trials(book, read_experiment(home).trials)
    against = options.against or BASELINE
    if against != BASELINE and against not in book.kept:
        kept = listed([BASELINE, *book.kept])
        raise InputError(
            f"--against {against}: it must be one of {kept}{did_you_mean(against, book.kept)}"
        )
    check_words(options.settings)
    start = permitted_words(book, against, options.settings)
    trials = compose_words(home.name, start, options.settings)
    # The idea's new seeds need new trials of the baseline, so it must be what it was.
    if keys_by_scene(trials, home.name) != book.keys_of(against):
        raise InputError(
            f"the settings or the code of {against} have changed since its trials ran: bring them "
            "back"
        )
    words = merged(start, options.settings)
    of_idea = compose_words(home.name, words, options.settings)
    idea, book = _start(home, of_idea, against, options)
    if not book.is_decided(idea) and idea not in book.tests:
        book = _screen(home, book, idea, trials | of_idea)
    if not book.is_decided(idea) and idea in book.tests:
        seeds = [f"seed={','.join(map(str, book.tests[idea].seeds))}"]
        baseline, new = (
            compose_words(home.name, merged(side, seeds), options.settings)
            for side in (start, words)
        )
        book = _test(home, book, idea, baseline | new)
    _print_idea(book, idea, options.json)
    return EXIT_CODES[book.ended[idea].result]


def _start(
    home: Path, trials: Trials, against: str, options: argparse.Namespace
) -> tuple[str, Ledger]:
    """Enter an idea unless the ledger has it; return its name and the ledger."""
    keys, values = keys_by_scene(trials, home.name), next(iter(trials.values())).values
    # An idea under another name is the same idea: it must not be tried twice.
    nameless = values | {part: values[part] | {"name": ""} for part in ("init", "densify")}
    identity = config_hash(nameless)
    chosen: list[str] = []

    def make(book: Ledger) -> records.Started | None:
        same = [
            one
            for one in book.started.values()
            if (one.identity, one.against) == (identity, against)
        ]
        if keys in (book.opened.keys, book.keys_of(against)):
            raise InputError(f"the idea is {against} itself: give it other settings or code")
        if same:
            chosen.append(same[0].idea)
            ended = book.ended.get(same[0].idea)
            begun = ended is None and not book.shares_seeds
            if not begun and not book.is_decided(same[0].idea):
                rules.check_ideas_left(book)  # other ideas may have taken its place
            return None
        rules.check_ideas_left(book)
        name = options.idea or values["densify"]["name"]
        if name in (*book.started, BASELINE):
            if options.idea:
                raise InputError(f"--as {name}: another idea has this name: give another")
            name = f"{name}-{len(book.started) + 1}"
        chosen.append(name)
        return records.Started(
            time=stamp_now(),
            idea=name,
            against=against,
            identity=identity,
            words=tuple(merged(book.words_of(against), options.settings)),
            keys=keys,
        )

    book = records.append(home, make)
    return chosen[0], book


def _screen(home: Path, book: Ledger, idea: str, trials: Trials) -> Ledger:
    """Compare the idea on the seeds of all ideas; write its result, or its test if it passes."""
    ended = _answer(book, idea, rules.screening_of(book, idea), trials)

    def make(now: Ledger) -> records.Entry | None:
        # A process that ran the same command may have been faster.
        if idea in now.tests or now.is_decided(idea):
            return None
        if ended.result != KEPT:
            return ended
        return rules.next_test(now, idea, stamp_now())

    return records.append(home, make)


def _test(home: Path, book: Ledger, idea: str, trials: Trials) -> Ledger:
    """Test the idea on its new seeds, and write its result."""
    test = book.tests[idea]
    log.info(
        "%s looks better, so it is tested on new seeds, %d to %d, with the level %.2g",
        idea,
        test.seeds[0],
        test.seeds[-1],
        test.level,
    )
    ended = _answer(book, idea, rules.test_of(book, idea), trials)
    return records.append(home, lambda now: None if now.is_decided(idea) else ended)


def _answer(book: Ledger, idea: str, question: Question, trials: Trials) -> records.Ended:
    """Train the idea and what it is compared with, look by look; the result, not yet written."""
    fails = ""

    def run(planned: Sequence[Needed]) -> None:
        nonlocal fails
        try:
            code = run_trials([trials[key, seed] for _, key, seed in planned], asks=False)
        except GsbenchError as error:
            fails = str(error)
        else:
            fails = "its trials fail" if code else ""

    asked = rules.ask_idea(question, lambda: finished_trials(trials.values()))
    (verdict,) = asked.answer(run)
    tested = idea in book.tests
    if not fails or verdict.final:
        return rules.end_of(idea, verdict, stamp_now(), tested)
    of_idea = set(book.keys_of(idea).values())
    failed = {key for key, trial in trials.items() if trial.files.has_failed()}
    measured = {trial.key for trial in finished_trials(trials.values())}
    # An idea of which something is known cannot be tried anew as if it were not.
    if tested or of_idea & measured or not {key for key, _ in failed} <= of_idea:
        raise GsbenchError(f"{idea}: {fails}; to go on, give the same command again")
    reason = next((trials[key].files.failure().reason for key in sorted(failed)), fails)
    return records.Ended(time=stamp_now(), idea=idea, result=FAILED, reason=reason, seeds=0)


def confirm(options: argparse.Namespace, home: Path) -> int:
    """Train the baseline and the kept ideas on captures that no idea has seen."""
    book = records.read_ledger(home)
    rules.check_unknown_trials(book, read_experiment(home).trials)
    ideas = list(options.only or book.kept)
    if missing := [idea for idea in ideas if idea not in book.kept]:
        raise InputError(f"--only {missing[0]}: kept were {listed(book.kept) or 'no ideas'}")
    if not ideas:
        raise InputError("no idea was kept, so there is nothing to confirm")
    if not any(key_of(word) == "scene" for word in options.settings):
        raise InputError("confirm needs captures that no idea has seen: scene=…")
    by_idea = {
        idea: compose_words(
            home.name,
            merged(permitted_words(book, idea, options.settings), options.settings),
            options.settings,
        )
        for idea in (BASELINE, *ideas)
    }
    keys = {idea: keys_by_scene(trials, home.name) for idea, trials in by_idea.items()}
    asked = records.Confirming(time=stamp_now(), seeds=seeds_of(by_idea[BASELINE]), keys=keys)

    def make(now: Ledger) -> records.Confirming | None:
        if now.number_of(asked) is not None:
            return None
        rules.check_untouched(now, read_experiment(home).trials, asked)
        return asked

    book = records.append(home, make)
    number = book.number_of(asked)
    assert number is not None  # `make` has just added it
    if book.confirmations[number][1] is None:
        book = _run_confirmation(home, book, number, by_idea)
    print(to_markdown(ledger_tables(book)[1 + number]))
    return 0


def _run_confirmation(
    home: Path, book: Ledger, number: int, by_idea: Mapping[str, Trials]
) -> Ledger:
    """Train all trials of a confirmation, and write its results."""
    asked, _ = book.confirmations[number]
    first = {key: trial for key, trial in by_idea[BASELINE].items() if key[1] == asked.seeds[0]}
    _run_all(first)
    # Only now are the photographs' hashes known, which show a copy under another name.
    rules.check_untouched(book, read_experiment(home).trials, asked)
    trials = {key: trial for of_idea in by_idea.values() for key, trial in of_idea.items()}
    _run_all(trials)
    done = rules.named_by_key(finished_trials(trials.values()))
    unfinished = [one.by_key for one in read_experiment(home).unfinished]
    questions = rules.confirmation_of(book.opened, asked)
    verdicts = [judge(done, question, unfinished) for question in questions]

    def make(now: Ledger) -> records.Confirmed | None:
        if now.confirmations[number][1] is not None:  # by a process that ran the same command
            return None
        return rules.confirmed(number, verdicts, stamp_now())

    return records.append(home, make)


def show(options: argparse.Namespace, home: Path) -> int:
    """Print the ledger."""
    book, trials = records.read_ledger(home), read_experiment(home).trials
    rules.check_unknown_trials(book, trials)
    for note in rules.contradictions(book, trials):
        log.warning("%s", note)
    if options.json:
        ideas = [_facts(book, idea) for idea in book.started]
        confirmations = [one.to_json() for pair in book.confirmations for one in pair if one]
        values = {"opened": book.opened.to_json(), "ideas": ideas, "confirmations": confirmations}
        print(json.dumps(values | _left(book), indent=1))
        return 0
    print("\n".join([*describe_ledger(book), "", *map(to_markdown, ledger_tables(book))]))
    return 0


FLAGS = {
    "settings": "settings",
    "metric": "--metric",
    "least": "--least",
    "ideas": "--ideas",
    "fdr": "--fdr",
    "against": "--against",
    "idea": "--as",
    "only": "--only",
    "json": "--json",
}
ACTIONS = {  # with the options that each of them takes
    "new": (new, ("settings", "metric", "least", "ideas", "fdr")),
    "try": (try_idea, ("settings", "against", "idea", "json")),
    "confirm": (confirm, ("settings", "only")),
    "show": (show, ("json",)),
}


def _run_all(trials: Trials) -> None:
    if code := run_trials(list(trials.values()), asks=False):
        raise (InputError if code == 2 else GsbenchError)("trials fail: nothing is confirmed")


# ---- what is printed


def _print_idea(book: Ledger, idea: str, as_json: bool) -> None:
    if as_json:
        print(json.dumps(_facts(book, idea) | _left(book)))
        return
    ended = book.ended[idea]
    difference = difference_text(book.opened, ended.difference)
    facts = [f"{book.opened.metric} {difference}"] if difference else []
    if ended.seconds is not None:
        facts.append(f"{ended.seconds:.2f} times the training time")
    print("; ".join([f"{idea}: {ended.result}: {why(ended)}", *facts]))
    print(describe_ledger(book)[1])


def _facts(book: Ledger, idea: str) -> dict[str, Any]:
    """The known facts of an idea, for programs."""
    started, ended = book.started[idea], book.ended.get(idea)
    facts: dict[str, Any] = {"idea": idea, "against": started.against}
    if test := book.tests.get(idea):
        facts |= {"level": test.level, "test_seeds": test.seeds}
    if ended is None:
        return facts | {"result": "begun"}
    return facts | {
        key: value for key, value in ended.to_json().items() if key not in ("idea", "time")
    }


def _left(book: Ledger) -> dict[str, Any]:
    return {"tried": book.tried, "planned": book.opened.ideas, "kept": book.kept}
