"""``gsbench ledger``: many ideas under one false discovery rate (docs/night.md)."""

import json
import re
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsbench.analysis.quantities import COSTS, relative_change
from gsbench.analysis.results import read_experiment
from gsbench.analysis.sentences import sentence
from gsbench.analysis.verdicts import judge
from gsbench.app.command import compose_trials, require_waiting, run_trials
from gsbench.claims.ledger import SCREEN, Book, read_ledger, result_of
from gsbench.claims.stopping import Needed, SequentialTest, asked_difference, finished_trials
from gsbench.config.command_words import typed_permissions
from gsbench.config.compose import Trial
from gsbench.config.overrides import changed_words, key_of
from gsbench.errors import GsbenchError, InputError
from gsbench.eval.options import EvalConfig
from gsbench.files import make_runs_folder
from gsbench.launch.record import planned_rows
from gsbench.runs.code import config_hash
from gsbench.runs.commands import (
    BASELINE,
    ERROR_RATE,
    Command,
    History,
    Idea,
    Ledger,
    Question,
    append,
    command_now,
)
from gsbench.runs.layout import IN_RUNS
from gsbench.settings import is_folder_name
from gsbench.verbs import VERBS
from gsbench.verbs.arguments import options_of
from gsbench.words import listed

EXIT_CODES = {"kept": 0, "dropped": 1, "failed": 1}
GIVEN = ("name", "runs", "eval.primary")  # settings that the ledger sets itself
# An idea may change how a model is made, not what it is measured on.
OF_IDEAS = ("densify", "init", "train", "raster")
OF_RUNS = ("allow_targets", "launch", "device", "threads", "tracking")
Trials = Mapping[Needed, Trial]


def ledger(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 kept (or nothing was tried), 1 dropped or failed, 3 undecided."""
    action = next(filter(ACTIONS.__contains__, argv), "")  # without one, all words are shown
    rows = {
        words: (f"{actions}: {meaning}", *how)
        for words, (actions, meaning, *how) in VERBS["ledger"]["of_actions"].items()
        if action in actions
    }
    options = options_of("ledger", argv, rows)
    if not is_folder_name(options.name) or options.name in IN_RUNS:
        raise InputError(f"ledger: {options.name!r} cannot be the name of an experiment")
    return ACTIONS[action](options, runs / options.name)


def new(options: Namespace, home: Path) -> int:
    """Declare a ledger; the same command again changes nothing."""
    baseline, trials = _compose(home, options.settings, options.settings, BASELINE)
    values = next(iter(trials.values())).values
    terms = asked_difference(options.metric, options.least, values)
    EvalConfig(**values["eval"] | {"primary": options.metric})  # raises if it is not computed
    opened = Ledger(**terms, ideas=options.ideas, rate=options.fdr, seeds=_seeds(trials))

    def make(history: History) -> Command | None:
        if (history.ledger, history.ideas.get(BASELINE)) == (opened, baseline):
            return None
        if history.ledger or read_experiment(home).trials:
            raise InputError(
                f"{home.name} is another ledger already, or has trials: give this one another name"
            )
        return command_now(ledger=opened, idea=baseline)

    make_runs_folder(home.parent)
    append(home, make)
    print("\n".join(read_ledger(home).describe()))
    return 0


def try_idea(options: Namespace, home: Path) -> int:
    """Run one idea until it is decided; an idea that was decided before is only shown."""
    book, typed, against = read_ledger(home), options.settings, options.against
    if against not in (allowed := [BASELINE, *book.kept]):
        raise InputError(f"--against {against}: it must be one of {listed(allowed)}")
    for key in map(key_of, typed):
        if re.split("[./]", key)[0] not in OF_IDEAS + OF_RUNS:
            raise InputError(f"{key}: an idea may change {listed(OF_IDEAS)}, not what decides")
    start = _permitted_words(book.ideas[against], typed)
    words = (start, changed_words(start, typed))
    # The idea's new seeds need new trials of the baseline, so it must be what it was.
    if _compose(home, start, typed)[0].digests != book.ideas[against].digests:
        raise InputError(
            f"the settings or the code of {against} have changed since its trials ran: bring them "
            "back"
        )
    asked = _compose(home, words[1], typed, options.idea, against)[0]
    idea, fails = _begin(home, asked), ""

    def promotion(_: History) -> Command | None:
        test = read_ledger(home).next_test(idea)
        return command_now(questions=(test,)) if test else None

    for rule in ("screening", "lond"):
        book = read_ledger(home)
        question = book.questions[idea]
        if question.rule == rule and book.result(idea) in ("begun", "failed"):
            seeds = f"seed={','.join(map(str, next(iter(question.seeds.values()))))}"
            sides = [_compose(home, changed_words(own, [seeds]), typed)[1] for own in words]
            fails = _train(question, {**sides[0], **sides[1]})
            append(home, promotion)
    book = read_ledger(home)
    facts, line = _facts(book, idea), book.line(idea)
    if fails:
        why = book.failure(idea) or f"{fails}; to go on, give the same command again"
        facts |= {"result": "failed", "reason": why}
        line = f"{idea}: failed: {why}"
    print(json.dumps(facts | _left(book)) if options.json else f"{line}\n{book.describe()[1]}")
    return EXIT_CODES.get(facts["result"], 3)


def confirm(options: Namespace, home: Path) -> int:
    """Train the baseline and the kept ideas on captures that no idea has seen."""
    book, typed = read_ledger(home), options.settings
    if not book.kept:
        raise InputError("no idea was kept, so there is nothing to confirm")
    sides = [
        _compose(home, changed_words(_permitted_words(book.ideas[one], typed), typed), typed, one)
        for one in (BASELINE, *book.kept)
    ]
    (old, trials), *ideas = sides
    seeds, level = _seeds(trials), ERROR_RATE / len(ideas)
    asked = [book.ask(one, old, "confirmation", seeds, level) for one, _ in ideas]

    def make(history: History) -> Command | None:
        read_ledger(home).check_untouched(asked)
        if any(one.covers(new) for one in history.questions for new in asked):
            return None
        return command_now(questions=tuple(one.with_id(history.head) for one in asked))

    append(home, make)
    for _, trials in sides:
        if code := run_trials(list(trials.values()), asks=False):
            raise (InputError if code == 2 else GsbenchError)("trials fail: nothing is confirmed")
        # only now are the photographs' hashes known, which show a copy under another name
        read_ledger(home).check_untouched(asked)
    done = finished_trials([one for _, trials in sides for one in trials.values()])
    for question in asked:
        verdict = judge(done, question)
        print(f"{question.name}: {result_of(verdict)}: {sentence(verdict)}")
    return 0


def show(options: Namespace, home: Path) -> int:
    """Print the ledger."""
    book = read_ledger(home)
    if options.json:
        opened = book.opened.to_json() | {"words": book.ideas[BASELINE].words}
        ideas = [_facts(book, idea) for idea in book.questions]
        print(json.dumps({"opened": opened, "ideas": ideas} | _left(book), indent=1))
        return 0
    lines = [f"{number}. {book.line(idea)}" for number, idea in enumerate(book.questions, 1)]
    print("\n".join([*book.describe(), *lines]))
    return 0


ACTIONS = {"new": new, "try": try_idea, "confirm": confirm, "show": show}


# ---- lines of the ledger


def _begin(home: Path, idea: Idea) -> str:
    """Enter an idea unless the ledger has it; return its name there."""
    name = idea.name

    def make(history: History) -> Command | None:
        nonlocal name
        book = read_ledger(home)
        if idea.digests in (book.ideas[BASELINE].digests, book.ideas[idea.against].digests):
            raise InputError(f"the idea is {idea.against} itself: give it other settings or code")
        same = ""
        for one in book.ideas.values():
            if (one.identity, one.against) == (idea.identity, idea.against):
                same = one.name
        # other ideas may have taken the place of one that failed
        if (not same or book.failure(same)) and book.tried >= book.opened.ideas:
            raise InputError(
                f"all {book.opened.ideas} planned ideas were tried, so the error rate is spent: "
                "begin another ledger, with another baseline or other captures"
            )
        if same:
            name = same
            return None
        if name in book.ideas:
            name = f"{name}-{len(book.ideas)}"
        own = replace(idea, name=name)
        asked = book.ask(own, book.ideas[own.against], "screening", book.opened.seeds, 2 * SCREEN)
        return command_now(idea=own, questions=(asked.with_id(history.head),))

    append(home, make)
    return name


# ---- trials of the ledger's words


def _compose(
    home: Path, words: Sequence[str], typed: Sequence[str], name: str = "", against: str = ""
) -> tuple[Idea, Trials]:
    """The idea of some words, and its trials; under another name it is the same one.

    Only the ``typed`` words give permissions. Raises InputError for settings that the ledger sets,
    and for several arms.
    """
    for key in map(key_of, words):
        if key in GIVEN:
            raise InputError(f"ledger: {key} follows from the ledger: leave it out")
    trials = compose_trials([*words, f"name={home.name}"], multirun=True, typed=typed)
    require_waiting("ledger", trials)
    values, rows = trials[0].values, planned_rows(trials)
    digests = {row.scene: row.digest for row in rows}
    if any(digests[row.scene] != row.digest for row in rows):
        raise InputError("a ledger compares one arm at a time: only scene and seed may list values")
    nameless = values | {part: values[part] | {"name": ""} for part in ("init", "densify")}
    idea = Idea(
        name=name or values["densify"]["name"],
        identity=config_hash(nameless),
        words=tuple(words),
        digests=digests,
        against=against,
    )
    places = ((row.scene, row.digest, row.seed) for row in rows)
    return idea, dict(zip(places, trials, strict=True))


def _seeds(trials: Trials) -> tuple[int, ...]:
    seeds = tuple(dict.fromkeys(seed for _, _, seed in trials))
    if len(seeds) < 2:
        raise InputError("a ledger needs at least 2 seeds, such as seed=0,1,2,3,4,5")
    return seeds


def _permitted_words(idea: Idea, typed: Sequence[str]) -> list[str]:
    """The recorded settings of an idea, with what is typed about tracking.

    Raises InputError if they would run code that the ``typed`` words do not allow: the ledger is a
    file, and may be somebody else's.
    """
    allowed = set(typed_permissions(typed))
    if needed := set(typed_permissions(idea.words)) - allowed:
        names = ",".join(sorted(needed | allowed))
        raise InputError(f"{idea.name} runs code of yours: add allow_targets=[{names}]")
    tracking = [word for word in typed if key_of(word).startswith("tracking")]
    return changed_words(idea.words, tracking)


def _train(question: Question, trials: Trials) -> str:
    """Train the trials of a question look by look until it is decided; "", or why trials fail."""
    fails = ""

    def run(planned: Sequence[Needed]) -> None:
        nonlocal fails
        try:
            code = run_trials([trials[one] for one in planned], asks=False)
            fails = "its trials fail" if code else ""
        except GsbenchError as error:
            fails = str(error)

    asked = SequentialTest((question,), lambda: finished_trials(trials.values()))
    (verdict,) = asked.answer(run)
    return "" if verdict.final else fails


# ---- what is printed


def _facts(book: Book, idea: str) -> dict[str, Any]:
    """The known facts of an idea, for programs."""
    verdict, test = book.verdicts[idea], book.tests.get(idea)
    interval = verdict.interval
    change = relative_change(*verdict.pairs.sides, COSTS["gaussians"][1])
    known = {
        "idea": idea,
        "against": book.ideas[idea].against,
        "level": test and test.level / 2,
        "test_seeds": test and next(iter(test.seeds.values())),
        "result": book.result(idea),
        "reason": book.why(idea),
        "seeds": verdict.pairs.seeds,
        "difference": interval
        and {"mean": verdict.mean, "low": interval.low, "high": interval.high},
        "gaussians": change and 1 + change.of_totals,
    }
    return {name: fact for name, fact in known.items() if fact is not None}


def _left(book: Book) -> dict[str, Any]:
    return {"tried": book.tried, "planned": book.opened.ideas, "kept": book.kept}
