"""``gsbench ablate``: which part of a densifier makes its gain."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsbench.analysis.results import read_experiment
from gsbench.app.command import compose_trials, run_trials
from gsbench.claims.ablation import (
    choose_switches,
    declared_switches,
    judge_runs,
    markdown_table,
    off_settings,
    run_name,
    runs_to_train,
)
from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.launch.dry_run import describe_plan
from gsbench.runs.layout import SEED
from gsbench.settings import Switch
from gsbench.verbs.arguments import ArgumentParser, names
from gsbench.words import counted

DEFAULT_METRIC = "psnr"


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: the exit code says, as a sweep's does, whether a trial failed; raises InputError for bad input."""
    options = _parser().parse_args(argv)
    settings = options.settings
    words = [*settings, *([] if _names_experiment(settings) else [f"name={_default_name(settings)}"])]
    first = _trials(words)
    densify = _only_densifier(first)
    declared = declared_switches(_class_switches(first[0]), first[0].values["densify"])
    switches = choose_switches(declared, options.switches, densify)
    by_run = {run: _trials([*words, *_words(off_settings(run, switches), first[0])]) for run in runs_to_train(switches)}
    _check_different(by_run)
    trials = [trial for group in by_run.values() for trial in group]
    print(
        f"{densify}: {counted(len(switches), 'part')} ({', '.join(switches)}), {len(by_run)} runs, "
        f"{counted(len(trials), 'trial')}"
    )
    for run, group in by_run.items():
        hashes = ", ".join(dict.fromkeys(trial.folder.name.partition(SEED)[0] for trial in group))
        print(f"  {hashes}: {run_name(run, list(switches))}")
    if options.dry_run:
        print("\n".join(describe_plan(trials, trials[0].values["launch"]["parallel"])))
        return 0
    home = trials[0].files.home
    code = run_trials(trials)
    if code == 0:
        keys = {run: {t.values["scene"]["name"]: t.files.key for t in group} for run, group in by_run.items()}
        metric = options.metric or trials[0].values["eval"].get("primary") or DEFAULT_METRIC
        print("\n".join(markdown_table(judge_runs(read_experiment(home).trials, keys, metric))))
        print(f"all metrics and pictures: gsbench report {home.name}")
    return code


def _parser() -> ArgumentParser:
    parser = ArgumentParser(
        prog="gsbench ablate",
        description="Train a densifier with its parts switched off in all combinations (docs/claims.md), and judge "
        "each against the densifier with all of them.",
    )
    parser.add_argument(
        "settings", nargs="*", metavar="KEY=VALUE", help="as of a sweep: densify=volumetric_once seed=0,1,2 …"
    )
    parser.add_argument(
        "--switches", type=names, default=(), metavar="A,B", help="only these; default: all it declares"
    )
    parser.add_argument("--metric", help="printed; default: eval.primary, else psnr")
    parser.add_argument("--dry-run", action="store_true", help="list the trials and their state; run nothing")
    return parser


def _trials(words: Sequence[str]) -> list[Trial]:
    trials = compose_trials(words, multirun=True)
    if trials[0].values["launch"]["stop_when_decided"]:
        raise InputError("ablate needs all seeds of all runs: leave launch.stop_when_decided out")
    return trials


def _only_densifier(trials: Sequence[Trial]) -> str:
    arms = {(trial.values["init"]["name"], trial.values["densify"]["name"]) for trial in trials}
    if len(arms) > 1 or len({trial.files.home for trial in trials}) > 1:
        raise InputError("ablate takes one initialiser and one densifier apart: only scene and seed may list values")
    if len({(trial.values["scene"]["name"], trial.values["seed"]) for trial in trials}) < len(trials):
        raise InputError("ablate: only scene and seed may list values")
    return str(trials[0].values["densify"]["name"])


def _class_switches(trial: Trial) -> dict[str, Switch]:
    from gsbench.pipeline.parts import Parts

    return dict(getattr(type(Parts(trial.values).trainer), "SWITCHES", {}))


def _words(settings: dict[str, Any], first: Trial) -> list[str]:
    """The words that give the densifier these settings; a key that it lacks needs Hydra's plus."""
    densify = first.values["densify"]
    return [f"{'' if key in densify else '+'}densify.{key}={_text(value)}" for key, value in settings.items()]


def _text(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _names_experiment(words: Sequence[str]) -> bool:
    return any(word.startswith(("name=", "+experiment=")) for word in words)


def _default_name(words: Sequence[str]) -> str:
    chosen = [word.partition("=")[2] for word in words if word.startswith("densify=")]
    return f"ablate_{chosen[-1].replace('/', '_')}" if chosen else "ablate"


def _check_different(by_run: dict[frozenset[str], list[Trial]]) -> None:
    """Raise InputError for two runs that are the same trial, because a switch changes nothing."""
    seen: dict[Path, frozenset[str]] = {}
    for run, group in by_run.items():
        earlier = seen.setdefault(group[0].folder, run)
        if earlier != run:
            raise InputError(f"switching {', '.join(sorted(earlier ^ run))} changes no setting: give another VALUE")
