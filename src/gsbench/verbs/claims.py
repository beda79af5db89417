"""Verbs that answer whether an idea helps: ``check``, ``plan`` and ``ablate`` (docs/claims.md)."""

import argparse
import itertools
import json
import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsbench.analysis.comparison import compare
from gsbench.analysis.designs import Components, Design, estimate_components
from gsbench.analysis.notes import texts
from gsbench.analysis.pairing import BASELINE, pair
from gsbench.analysis.planning import COMMANDS, UNSURE, Plan, Purpose, make_plan
from gsbench.analysis.quantities import Quantity, quantity
from gsbench.analysis.results import TrialResult, load_experiment, read_experiment
from gsbench.analysis.statistics import MIN_SCENES
from gsbench.app.command import compose_trials, run_trials
from gsbench.claims import ablation
from gsbench.claims.check import Check, prepare, recheck
from gsbench.claims.check_page import make_page, to_html, to_text
from gsbench.claims.file import ClaimsFile, read_claims
from gsbench.claims.ledger import GIVE_UP, IDEAS, RATE, SCREEN, level_of_test
from gsbench.claims.stopping import KeyAndSeed, ask
from gsbench.config.command_words import value_text
from gsbench.config.compose import Trial
from gsbench.config.permissions import PERMISSIONS
from gsbench.errors import InputError
from gsbench.files import make_runs_folder, writable_output, write_text
from gsbench.launch.batch import missing_folders, run_batch
from gsbench.launch.dry_run import describe_plan
from gsbench.launch.record import declare_questions
from gsbench.runs.experiments import ERROR_RATE, Question
from gsbench.runs.layout import SEED
from gsbench.verbs.arguments import ArgumentParser, names, path, whole_number
from gsbench.words import counted

HTML = "claims.html"
MAX_DESIGNS = 5  # combinations of scenes and seeds that `plan` shows
DEFAULT_METRIC = "psnr"
MOST_QUESTIONS = 10_000
# the answers of `plan` for each command
PLANNED = {
    "sweep": "Planned for a sweep: each question errs in {:.3g} %; all seeds are judged at once.",
    "looks": "Planned for a sweep that stops when decided: each question errs in {:.3g} %.",
    "check": "Planned for a check of claims: each claim errs in {:.3g} %. It is shown for each, "
    "not for all at once.",
    "gate": "Planned for a gate: it calls a version worse that is worse by the difference.",
    "ledger": "Planned for a ledger: an idea is kept, at {:.3g} % with both sides, after a quarter "
    "of the ideas were tested and none was kept.",
}
NEW_TRIALS = (
    "Train all of them with seeds that the pilot does not have (it has {}), under another name: "
    "what was seen is not declared beforehand."
)


def check(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 whatever the verdicts are; raises InputError for bad input."""
    parser = ArgumentParser(
        "check", "It runs trials until each claim is decided, and writes a page (docs/claims.md)."
    )
    parser.add_argument(
        "claims", type=path, help="a YAML file, such as conf/claims/volumetric.yaml"
    )
    parser.add_argument(
        "permissions",
        nargs="*",
        default=[],
        metavar="allow_targets=[MINE]",
        help="what the claims' arms may run beside gsbench; a file of claims cannot allow it",
    )
    parser.flag("--dry-run", "show trials, time and what is not testable here")
    parser.add_argument(
        "--from",
        dest="archive",
        type=path,
        metavar="ARCHIVE",
        help="make the verdicts again from what gsbench export --results wrote; runs nothing, "
        "needs no photographs",
    )
    parser.add_argument(
        "--out", type=path, metavar="PAGE", help="with --from: write the whole page, a .html file"
    )
    options = parser.parse_args(argv)
    file = read_claims(options.claims)
    if options.archive is not None:
        if options.dry_run:
            raise InputError(
                "check --from runs nothing, so no other option than --out goes with it"
            )
        _recheck(file, options.archive, options.out)
        return 0
    if options.out is not None:
        raise InputError(
            f"--out goes with --from; what is run here writes {HTML} beside its trials"
        )
    check = prepare(file, runs, missing_folders, _permissions(options.permissions))
    if options.dry_run:
        print("\n".join(describe(check)))
    else:
        _run(check)
    return 0


def _recheck(file: ClaimsFile, archive: Path, out: Path | None) -> None:
    """Print the verdicts by the archive's trials, and write their page to ``out`` if given.

    Raises InputError for an ``out`` of another format.
    """
    if out is not None and out.suffix != ".html":
        raise InputError(f"--out {out}: a page ends in .html")
    with tempfile.TemporaryDirectory() as folder:
        page = make_page(recheck(file, archive, Path(folder)))
        print(to_text(page), end="")
        if out is None:
            print("The whole page says what each verdict rests on: --out PAGE.html")
        else:
            with writable_output(out):
                write_text(out, to_html(page))
            print(out)


def _permissions(words: Sequence[str]) -> Sequence[str]:
    """The words after the file. Raises InputError for words that are no permissions."""
    for word in words:
        if word.split("=")[0] != PERMISSIONS:
            raise InputError(
                f"{word}: settings of a check are in its file of claims; here only "
                f"{PERMISSIONS}=[…]"
            )
    return words


def describe(check: Check) -> list[str]:
    """The lines of a dry run: each claim's question or why it is not testable, trials, and time."""
    file, declaration = check.file, check.declaration
    questions = {question.name: question for question in declaration.questions}
    lines = [f"{file.paper}: {counted(len(questions), 'claim')} to be tested"]
    for claim in file.claims:
        missing = declaration.missing.get(claim.id, [])
        if claim.id not in questions:
            why = claim.not_testable or "; ".join(missing)
            lines.append(f"not testable here  {claim.id}: {why}")
            continue
        scenes = ", ".join(questions[claim.id].scenes)
        looks = ", ".join(map(str, declaration.looks))
        lines.append(
            f"to be tested       {claim.id}: {claim.metric} of {claim.arm} against "
            f"{claim.baseline}: {claim.direction}, by {claim.effect} at least; on {scenes}; "
            f"looks at {looks} seeds"
        )
        lines += [f"                   without {reason}" for reason in missing]
    if not questions:
        return lines
    first, most = check.trials(declaration.looks[0]), check.trials(declaration.looks[-1])
    lines.append(
        f"{counted(len(first), 'trial')} until the first look, {len(most)} at most; "
        f"each test may err in {100 * file.error_rate / len(questions):.3g} % of such sweeps"
    )
    if most:
        lines += describe_plan(most, most[0].values["launch"]["parallel"])
    return lines


def _run(check: Check) -> None:
    make_runs_folder(check.runs)
    check = replace(check, declaration=declare_questions(check.home, check.declaration))

    def run(planned: Sequence[KeyAndSeed]) -> None:
        unfinished = [
            trial for trial in check.to_run(planned) if trial.files.why_not_done(trial.values)
        ]
        if unfinished:
            run_batch(unfinished)

    checked = check.checked(ask(check).answer(run))
    write_text(check.home / HTML, to_html(make_page(checked)))
    for verdict in checked.verdicts:
        print(f"{verdict.word:<19}  {verdict.claim.id}: {verdict.sentence}")
    for note in texts(checked.unused):
        print(note)
    print(check.home / HTML)


def _plan_parser() -> ArgumentParser:
    parser = ArgumentParser(
        "plan",
        "It estimates from an experiment's trials how many scenes and seeds show a difference of "
        "one arm in 80 of 100 cases. The seeds are new ones: those of the trials are seen "
        "(docs/verdict.md). How many ideas will be found, it cannot say.",
    )
    parser.add_argument("experiment")
    parser.add_argument(
        "--for",
        dest="command",
        choices=COMMANDS,
        default=COMMANDS[0],
        help="what is planned: a sweep (the default), a sweep that stops when decided (looks), a "
        "check of claims, a gate, or a ledger of ideas",
    )
    parser.add_argument(
        "--questions",
        type=whole_number(MOST_QUESTIONS),
        help="pairs of arms, claims, or planned ideas that share the error rate (1; ledger: 40)",
    )
    parser.add_argument(
        "--metric", default="psnr", help="such as psnr (the default), ssim, lpips_squeeze"
    )
    parser.add_argument(
        "--difference",
        type=_above_zero,
        help="to be seen; default: what papers count as an improvement",
    )
    parser.add_argument(
        "--baseline", default=BASELINE, help=f"the densifier to compare with ({BASELINE})"
    )
    parser.flag("--json", "print JSON")
    return parser


def plan(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    options = _plan_parser().parse_args(argv)
    experiment = load_experiment(runs, options.experiment)
    comparison = compare(experiment, options.baseline)
    trials = comparison.trials
    metric = quantity(options.metric, trials)
    if metric.cost:
        raise InputError(
            f"--metric {options.metric}: only metrics can be planned for, not counts and times"
        )
    difference = options.difference or metric.worthwhile
    if difference is None:
        raise InputError(
            f"--difference is needed: {metric.name} has no usual least difference that matters"
        )
    if not comparison.pairs:
        raise InputError(
            f"{options.experiment} has one arm, and planning needs pairs of trials of two"
        )
    purpose, plans = purpose_of(options.command, options.questions), list[dict[str, Any]]()
    lines = [*comparison.sentences, *texts(comparison.remarks), *experiment.warnings]
    for baseline, arm in comparison.pairs:
        plans.append({"arm": str(arm), "baseline": str(baseline)})
        question = Question(metric=metric.key, baseline=baseline, arm=arm)
        try:
            components = _components(trials, question, metric)
        except InputError as error:
            if len(comparison.pairs) == 1:
                raise
            lines.append(str(error))
            plans[-1]["no_plan"] = str(error)
            continue
        planned = make_plan(components, difference, purpose, MAX_DESIGNS)
        lines += [f"{arm} against {baseline}", *_lines(planned, metric, difference)]
        if purpose.screen:
            lines.append("  an idea that looks better takes as many new seeds, its baseline too")
        plans[-1] |= planned.to_json()
    seeds = sorted({trial.seed for trial in trials})
    lines.append(PLANNED[options.command].format(100 * purpose.rate))
    lines.append(NEW_TRIALS.format(", ".join(map(str, seeds))))
    if options.json:
        asked = {"metric": metric.key, "difference": difference, "for": options.command}
        asked |= {"error_rate": purpose.rate, "pilot_seeds": seeds}
        found = asked | comparison.to_json() | {"plans": plans}
        lines = [json.dumps(found, indent=1)]
    print("\n".join(lines))
    return 0


def _components(trials: Sequence[TrialResult], question: Question, metric: Quantity) -> Components:
    """The variation of a question's differences; raises InputError if its trials cannot tell."""
    paired = pair(trials, question)
    arms = f"{question.baseline} and {question.arm}"
    if not paired.rows:
        reason = next(map(str, paired.left_out), "they share no scene and seed")
        raise InputError(f"no trials of {arms} can be paired in {metric.name}: {reason}")
    try:
        components = estimate_components([row.arm - row.baseline for row in paired.rows])
    except InputError as error:
        raise InputError(f"{arms}: {error}") from None
    if not components.within:
        raise InputError(
            f"{arms}: differences in {metric.name} do not vary between seeds, so nothing tells how "
            "many would show one"
        )
    return components


def purpose_of(command: str, questions: int | None) -> Purpose:
    """The purpose of a command's trials; each idea takes one side of its level.

    A ledger is planned for the test after a quarter of the ideas were tested and none kept: no more
    pass on where few are good (findings/simulations.md).
    """
    if command == "ledger":
        ideas = questions or IDEAS
        level = level_of_test(RATE, ideas, math.ceil(ideas / 4), 0)
        return Purpose(2 * level, looks=True, give_up=GIVE_UP, screen=2 * SCREEN)
    return Purpose(ERROR_RATE / (questions or 1), looks=command != "sweep")


def _lines(planned: Plan, metric: Quantity, difference: float) -> list[str]:
    components, digits = planned.components, f".{metric.decimals + 1}f"
    between = ""
    if components.between is not None:
        between = f", between scenes by {components.between:{digits}}"
    lines = [
        f"  differences in {metric.name} vary between seeds by "
        f"{components.within:{digits}}{between} (from {counted(components.trials, 'pair')} on "
        f"{counted(components.scenes, 'scene')})",
        _designs_line("these scenes", planned.these, difference),
    ]
    if planned.powers is not None:
        (low, high), first = planned.factors, planned.these[0]
        least, most = (100 * power for power in planned.powers)
        lines.append(
            f"  the pilot knows the variation between seeds only within {low:.2f} to {high:.2f} "
            f"times ({100 * UNSURE:.0f} % of pilots): so {first.scenes} × {first.seeds} sees it in "
            f"{least:.0f} to {most:.0f} of 100 cases"
        )
    group = f"scenes like these (from {MIN_SCENES} scenes on)"
    if planned.like_these is None:
        return [*lines, f"  for {group}: run pilot trials on a second scene"]
    return [*lines, _designs_line(group, planned.like_these, difference)]


def _designs_line(group: str, designs: Sequence[Design], difference: float) -> str:
    shown = [f"{design.scenes} × {design.seeds} ({design.trials} trials)" for design in designs]
    what = f"  to see {difference:g} on {group}, scenes × seeds"
    return f"{what}: {', '.join(shown) or 'none that can be run'}"


def _above_zero(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not value > 0 or not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a number above 0, got {text!r}")
    return value


def ablate(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: the exit code says whether a trial failed, as that of a sweep does.

    Raises InputError for bad input.
    """
    from gsbench.pipeline.parts import Parts  # here, for a quick answer to --help

    options = _ablate_parser().parse_args(argv)
    words = list(options.settings)
    if not any(word.startswith(("name=", "+experiment=")) for word in words):
        words.append(f"name={_default_name(words)}")
    first = _trials(words)
    densify = _only_densifier(first)
    values = first[0].values
    own = getattr(type(Parts(values).trainer), "SWITCHES", {})
    declared = ablation.declared_switches(own, values["densify"])
    switches = ablation.choose_switches(declared, options.switches, densify)
    by_run = {}
    for run in ablation.runs_to_train(switches):
        off = _words(ablation.off_settings(run, switches), values["densify"])
        by_run[run] = _trials([*words, *off])
    _check_different(by_run)
    trials = list(itertools.chain(*by_run.values()))
    print(
        f"{densify}: {counted(len(switches), 'part')} ({', '.join(switches)}), {len(by_run)} runs, "
        f"{counted(len(trials), 'trial')}"
    )
    for run, group in by_run.items():
        hashes = ", ".join(dict.fromkeys(trial.folder.name.partition(SEED)[0] for trial in group))
        print(f"  {hashes}: {ablation.run_name(run, list(switches))}")
    if options.dry_run:
        print("\n".join(describe_plan(trials, values["launch"]["parallel"])))
        return 0
    code = run_trials(trials)
    if code == 0:
        home = trials[0].files.home
        keys = {
            run: {t.values["scene"]["name"]: t.files.key for t in group}
            for run, group in by_run.items()
        }
        metric = options.metric or values["eval"].get("primary") or DEFAULT_METRIC
        judged = ablation.judge_runs(read_experiment(home).trials, keys, metric)
        print("\n".join(ablation.markdown_table(judged)))
        print(f"all metrics and pictures: gsbench report {home.name}")
    return code


def _ablate_parser() -> ArgumentParser:
    parser = ArgumentParser(
        "ablate", "Each is judged against the densifier with all of them on (docs/claims.md)."
    )
    parser.add_argument(
        "settings",
        nargs="*",
        metavar="KEY=VALUE",
        help="as of a sweep: densify=volumetric seed=0,1,2 …",
    )
    parser.add_argument(
        "--switches",
        type=names,
        default=(),
        metavar="A,B",
        help="only these; default: all declared",
    )
    parser.add_argument("--metric", help="printed; default: eval.primary, else psnr")
    parser.flag("--dry-run", "list the trials and their state; run nothing")
    return parser


def _trials(words: Sequence[str]) -> list[Trial]:
    trials = compose_trials(words, multirun=True)
    if trials[0].values["launch"]["stop_when_decided"]:
        raise InputError("ablate needs all seeds of all runs: leave launch.stop_when_decided out")
    return trials


def _only_densifier(trials: Sequence[Trial]) -> str:
    arms = {
        (trial.values["init"]["name"], trial.values["densify"]["name"], trial.files.home)
        for trial in trials
    }
    places = {(trial.values["scene"]["name"], trial.values["seed"]) for trial in trials}
    if len(arms) > 1 or len(places) < len(trials):
        raise InputError(
            "ablate needs one initialiser and one densifier: only scene and seed may list values"
        )
    return str(trials[0].values["densify"]["name"])


def _words(settings: dict[str, Any], densify: dict[str, Any]) -> list[str]:
    """The words that give the densifier these settings; a key that it lacks needs Hydra's plus."""
    words = []
    for key, value in settings.items():
        plus = "" if key in densify else "+"
        words.append(f"{plus}densify.{key}={value_text(value)}")
    return words


def _default_name(words: Sequence[str]) -> str:
    chosen = [word.partition("=")[2] for word in words if word.startswith("densify=")]
    return f"ablate_{chosen[-1].replace('/', '_')}" if chosen else "ablate"


def _check_different(by_run: dict[frozenset[str], list[Trial]]) -> None:
    """Raise InputError for two runs that are the same trial, because a switch changes nothing."""
    seen: dict[Path, frozenset[str]] = {}
    for run, group in by_run.items():
        earlier = seen.setdefault(group[0].folder, run)
        if earlier != run:
            raise InputError(
                f"switching {', '.join(sorted(earlier ^ run))} changes no setting: give another "
                "VALUE"
            )
