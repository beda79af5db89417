"""``gsbench ledger``: many ideas under one false discovery rate (docs/night.md)."""

import argparse
import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsbench.analysis.results import read_experiment
from gsbench.analysis.sentences import sentence
from gsbench.analysis.verdicts import judge
from gsbench.app.command import run_trials
from gsbench.app.ledger_trials import (
    Trials,
    check_words,
    compose_words,
    digests_of,
    merged,
    permitted_words,
    seeds_of,
)
from gsbench.claims.gate import asked_difference
from gsbench.claims.ledger import (
    CHOOSES,
    DROPPED,
    FAILED,
    IDEAS,
    KEPT,
    RATE,
    Book,
    read_ledger,
    result_of,
)
from gsbench.claims.stopping import Needed, SequentialTest, finished_trials
from gsbench.config.overrides import key_of
from gsbench.errors import GsbenchError, InputError
from gsbench.eval.options import EvalConfig
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.runs.commands import (
    BASELINE,
    CONFIRMATION,
    ERROR_RATE,
    Command,
    History,
    Idea,
    Ledger,
    Question,
    append,
    command_now,
)
from gsbench.runs.config_hash import config_hash
from gsbench.runs.layout import IN_RUNS
from gsbench.settings import OpenFraction, is_folder_name
from gsbench.verbs.arguments import ArgumentParser, names, number, whole_number
from gsbench.words import did_you_mean, listed

EXIT_CODES = {KEPT: 0, DROPPED: 1, FAILED: 1}
UNDECIDED_CODE = 3
MOST_IDEAS = 10_000

log = logging.getLogger(__name__)


def ledger(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 kept (or nothing was tried), 1 dropped or failed, 3 undecided."""
    options = _parser().parse_args(argv)
    if not is_folder_name(options.name) or options.name in IN_RUNS:
        raise InputError(f"ledger: {options.name!r} cannot be the name of an experiment")
    for flag, actions, how in OPTIONS:
        given = getattr(options, how.get("dest") or flag.lstrip("-"))
        if given and options.action not in actions:
            raise InputError(f"ledger {options.action} takes no {flag}")
    return ACTIONS[options.action](options, runs / options.name)


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
    for flag, actions, how in OPTIONS:
        words = f"{', '.join(actions)}: {how['help']}"
        parser.add_argument(flag, **how | {"help": words})
    return parser


def new(options: argparse.Namespace, home: Path) -> int:
    """Declare a ledger; the same command again changes nothing."""
    trials = compose_words(home.name, options.settings, options.settings)
    baseline = _idea(BASELINE, trials, options.settings)
    values = next(iter(trials.values())).values
    metric = options.metric or "psnr"
    sign, least = asked_difference(metric, options.least, values)
    EvalConfig(**values["eval"] | {"primary": metric})  # raises if it is not computed
    opened = Ledger(
        metric=metric,
        sign=1 if sign > 0 else -1,
        least=least[0],
        relative=least[1],
        ideas=options.ideas or IDEAS,
        rate=options.fdr or RATE,
        seeds=seeds_of(trials),
    )

    def make(history: History) -> Command | None:
        if history.ledger is None:
            if read_experiment(home).trials:
                raise InputError(f"{home.name} has trials already: give the ledger another name")
            return command_now(ledger=opened, idea=baseline)
        if (history.ledger, history.ideas[BASELINE]) != (opened, baseline):
            raise InputError(f"{home.name} is another ledger already: give this one another name")
        return None

    make_runs_folder(checked_runs_folder(str(home.parent)))
    append(home, make)
    print("\n".join(read_ledger(home).describe()))
    return 0


def _idea(name: str, trials: Trials, words: Sequence[str], against: str = "") -> Idea:
    """An idea with these trials; under another name it is the same one."""
    values = next(iter(trials.values())).values
    nameless = values | {part: values[part] | {"name": ""} for part in ("init", "densify")}
    return Idea(
        name=name,
        identity=config_hash(nameless),
        words=tuple(words),
        digests=digests_of(trials, name),
        against=against,
    )


def try_idea(options: argparse.Namespace, home: Path) -> int:
    """Run one idea until it is decided; an idea that was decided before is only shown."""
    book, typed = read_ledger(home), options.settings
    against = options.against or BASELINE
    if against not in (BASELINE, *book.kept):
        kept = listed([BASELINE, *book.kept])
        raise InputError(
            f"--against {against}: it must be one of {kept}{did_you_mean(against, book.kept)}"
        )
    check_words(typed)
    start = permitted_words(book.ideas[against], typed)
    words = merged(start, typed)
    baseline, of_idea = (compose_words(home.name, own, typed) for own in (start, words))
    # The idea's new seeds need new trials of the baseline, so it must be what it was.
    if digests_of(baseline, against) != book.ideas[against].digests:
        raise InputError(
            f"the settings or the code of {against} have changed since its trials ran: bring them "
            "back"
        )
    name = options.idea or next(iter(of_idea.values())).values["densify"]["name"]
    idea = _begin(home, _idea(name, of_idea, words, against), is_named=bool(options.idea))
    book, fails = read_ledger(home), ""
    if not book.is_decided(idea) and idea not in book.tests:
        fails = _train(book.screening(book.ideas[idea]), baseline | of_idea)
        append(home, lambda history: _promotion(history, home, idea))
        book = read_ledger(home)
    if not book.is_decided(idea) and idea in book.tests:
        test = book.tests[idea]
        seeds = next(iter(test.seeds.values()))
        log.info(
            "%s looks better, so it is tested on new seeds, %d to %d, with the level %.2g",
            *(idea, seeds[0], seeds[-1], test.level / 2),
        )
        again = [f"seed={','.join(map(str, seeds))}"]
        sides = [compose_words(home.name, merged(own, again), typed) for own in (start, words)]
        fails = _train(test, sides[0] | sides[1])
        book = read_ledger(home)
    # An idea of which something is known cannot be tried anew as if it were not.
    if fails and book.is_measured(idea):
        raise GsbenchError(f"{idea}: {fails}; to go on, give the same command again")
    fails = fails and (book.failure(idea) or fails)
    if options.json:
        failed = {"result": FAILED, "reason": fails} if fails else {}
        print(json.dumps(_facts(book, idea) | failed | _left(book)))
    else:
        print(f"{idea}: {FAILED}: {fails}" if fails else book.line(idea))
        print(book.describe()[1])
    return EXIT_CODES.get(FAILED if fails else book.result(idea), UNDECIDED_CODE)


def _begin(home: Path, idea: Idea, is_named: bool) -> str:
    """Enter an idea unless the ledger has it; return its name there."""
    chosen = [idea.name]

    def make(history: History) -> Command | None:
        book = read_ledger(home)
        if idea.digests in (book.ideas[BASELINE].digests, book.ideas[idea.against].digests):
            raise InputError(f"the idea is {idea.against} itself: give it other settings or code")
        for name in book.begun:
            if (book.ideas[name].identity, book.ideas[name].against) == (
                idea.identity,
                idea.against,
            ):
                chosen[0] = name
                if book.failure(name):
                    book.check_ideas_left()  # other ideas may have taken its place
                return None
        book.check_ideas_left()
        if idea.name in book.ideas:
            if is_named:
                raise InputError(f"--as {idea.name}: another idea has this name: give another")
            chosen[0] = f"{idea.name}-{len(book.begun) + 1}"
        named = replace(idea, name=chosen[0])
        question = replace(book.screening(named), untested=CHOOSES)
        return command_now(idea=named, questions=(question.with_id(history.head),))

    append(home, make)
    return chosen[0]


def _promotion(history: History, home: Path, idea: str) -> Command | None:
    """The test of an idea that looks better, unless it has one."""
    book = read_ledger(home)
    verdict = book.verdicts[idea]
    if idea in book.tests or not verdict.final or result_of(verdict) != KEPT:
        return None
    return command_now(questions=(book.test(idea).with_id(history.head),))


def _train(question: Question, trials: Trials) -> str:
    """Train the trials of a question look by look until it is decided; "", or why trials fail."""
    fails = ""

    def run(planned: Sequence[Needed]) -> None:
        nonlocal fails
        try:
            code = run_trials([trials[one] for one in planned], asks=False)
        except GsbenchError as error:
            fails = str(error)
        else:
            fails = "its trials fail" if code else ""

    asked = SequentialTest((question,), lambda: finished_trials(trials.values()))
    (verdict,) = asked.answer(run)
    return "" if verdict.final else fails


def confirm(options: argparse.Namespace, home: Path) -> int:
    """Train the baseline and the kept ideas on captures that no idea has seen."""
    book, typed = read_ledger(home), options.settings
    ideas = list(options.only or book.kept)
    if missing := [idea for idea in ideas if idea not in book.kept]:
        raise InputError(f"--only {missing[0]}: kept were {listed(book.kept) or 'no ideas'}")
    if not ideas:
        raise InputError("no idea was kept, so there is nothing to confirm")
    if not any(key_of(word) == "scene" for word in typed):
        raise InputError("confirm needs captures that no idea has seen: scene=…")
    by_idea = {
        idea: compose_words(
            home.name, merged(permitted_words(book.ideas[idea], typed), typed), typed
        )
        for idea in (BASELINE, *ideas)
    }
    old, *new = (_idea(idea, trials, ()) for idea, trials in by_idea.items())
    seeds, level = seeds_of(by_idea[BASELINE]), ERROR_RATE / len(ideas)
    asked = [book.ask(one, old, CONFIRMATION, seeds, level) for one in new]

    def make(history: History) -> Command | None:
        read_ledger(home).check_untouched(asked)
        known = [one for one in history.questions if any(map(one.covers, asked))]
        own = tuple(one.with_id(history.head) for one in asked)
        return None if known else command_now(questions=own)

    append(home, make)
    for trials in by_idea.values():
        if code := run_trials(list(trials.values()), asks=False):
            raise (InputError if code == 2 else GsbenchError)("trials fail: nothing is confirmed")
        # only now are the photographs' hashes known, which show a copy under another name
        read_ledger(home).check_untouched(asked)
    done = finished_trials([one for trials in by_idea.values() for one in trials.values()])
    for question in asked:
        verdict = judge(done, question)
        print(f"{question.name}: {result_of(verdict)}: {sentence(verdict)}")
    return 0


def show(options: argparse.Namespace, home: Path) -> int:
    """Print the ledger."""
    book = read_ledger(home)
    if options.json:
        opened = book.opened.to_json() | {"words": book.ideas[BASELINE].words}
        ideas = [_facts(book, idea) for idea in book.begun]
        print(json.dumps({"opened": opened, "ideas": ideas} | _left(book), indent=1))
        return 0
    lines = [f"{number}. {book.line(idea)}" for number, idea in enumerate(book.begun, 1)]
    print("\n".join([*book.describe(), *lines]))
    return 0


ACTIONS = {"new": new, "try": try_idea, "confirm": confirm, "show": show}
OPTIONS: tuple[tuple[str, tuple[str, ...], dict[str, Any]], ...] = (  # with their actions
    (
        "settings",
        ("new", "try", "confirm"),
        {"nargs": "*", "metavar": "KEY=VALUE", "help": "as of a sweep"},
    ),
    ("--metric", ("new",), {"help": "decides, such as lpips_squeeze (psnr)"}),
    (
        "--least",
        ("new",),
        {"help": "the least difference that matters, as 0.1 or 10%% (the metric's)"},
    ),
    (
        "--ideas",
        ("new",),
        {"type": whole_number(MOST_IDEAS), "help": f"the most that will be tried ({IDEAS})"},
    ),
    (
        "--fdr",
        ("new",),
        {"type": number(OpenFraction), "help": f"false discovery rate, from 0 to 1 ({RATE})"},
    ),
    ("--against", ("try",), {"help": "a kept idea to start from (default: the baseline)"}),
    ("--as", ("try",), {"dest": "idea", "help": "the idea's name (default: densify.name)"}),
    ("--only", ("confirm",), {"type": names, "help": "these ideas (default: all kept)"}),
    ("--json", ("try", "show"), {"action": "store_true", "help": "print JSON"}),
)


# ---- what is printed


def _facts(book: Book, idea: str) -> dict[str, Any]:
    """The known facts of an idea, for programs."""
    verdict = book.verdicts[idea]
    interval = verdict.interval
    known: dict[str, Any] = {"idea": idea, "against": book.ideas[idea].against}
    if test := book.tests.get(idea):
        known |= {"level": test.level / 2, "test_seeds": next(iter(test.seeds.values()))}
    known |= {"result": book.result(idea), "reason": book.why(idea), "seeds": verdict.pairs.seeds}
    if interval is not None:
        known["difference"] = {"mean": verdict.mean, "low": interval.low, "high": interval.high}
    for name, cost in (("gaussians", "gaussians"), ("seconds", "train_time")):
        if (ratio := book.ratio(idea, cost)) is not None:
            known[name] = ratio
    return known


def _left(book: Book) -> dict[str, Any]:
    return {"tried": book.tried, "planned": book.opened.ideas, "kept": book.kept}
