"""``gsbench ablate``: which part of a densifier makes its gain (docs/claims.md)."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsbench.analysis.results import read_experiment
from gsbench.app.command import compose_trials, run_trials
from gsbench.claims import ablation
from gsbench.config.compose import Trial
from gsbench.config.overrides import value_text
from gsbench.errors import InputError
from gsbench.launch.dry_run import describe_plan
from gsbench.runs.layout import SEED
from gsbench.verbs.arguments import ArgumentParser, names
from gsbench.words import command, counted

DEFAULT_METRIC = "psnr"


def ablate(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: the exit code says whether a trial failed, as that of a sweep does.

    Raises InputError for bad input.
    """
    from gsbench.pipeline.parts import Parts  # here, for a quick answer to --help

    options = _parser().parse_args(argv)
    words = list(options.settings)
    if not any(word.startswith(("name=", "+experiment=")) for word in words):
        words.append(f"name={_default_name(words)}")
    first = _trials(words)
    densify = _only_densifier(first)
    values = first[0].values
    of_class = getattr(type(Parts(values).trainer), "SWITCHES", {})
    declared = ablation.declared_switches(of_class, values["densify"])
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
        print(f"all metrics and pictures: {command('report', home.name)}")
    return code


def _parser() -> ArgumentParser:
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
