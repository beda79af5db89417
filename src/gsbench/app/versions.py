"""Words and trials of the verbs that hold two versions of a trainer against each other: ``gate``, ``bisect``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from gsbench.analysis.quantities import COSTS
from gsbench.app.command import compose_trials
from gsbench.config.compose import Trial
from gsbench.errors import InputError

GIVEN = ("seed", "eval.primary")  # settings that such a verb sets by itself


def add_question(parser: argparse.ArgumentParser) -> None:
    """Add the words that say what is trained, and what decides."""
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="of the trials, as of a sweep; no seeds")
    parser.add_argument("--metric", default="psnr", help="decides: psnr (the default), lpips_squeeze, gaussians, …")
    parser.add_argument("--least", help="the least difference that matters, as 0.1 or 10%%; default: the metric's")


def first_trials(verb: str, settings: Sequence[str], metric: str) -> dict[str, Trial]:
    """A trial of each scene; raises InputError for settings that make more than one arm."""
    keys = [word.partition("=")[0].lstrip("+") for word in settings]
    if given := [key for key in keys if key in GIVEN]:
        raise InputError(f"{verb}: {given[0]} follows from the other words: leave it out")
    asked = [] if metric in COSTS else [f"eval.primary={metric}"]  # looks whether the settings compute it
    words = [*settings, "seed=0", *([] if "name" in keys else [f"name={verb}"]), *asked]
    trials = [_undeclared(trial) for trial in compose_trials(words, multirun=True)]
    by_scene = {trial.values["scene"]["name"]: trial for trial in trials}
    if len(by_scene) < len(trials):
        raise InputError(f"{verb} is about one arm: only scene may list values")
    if not trials[0].values["launch"]["wait"]:
        raise InputError(f"{verb} needs results to go on: leave launch.wait=false out")
    return by_scene


def _undeclared(trial: Trial) -> Trial:
    """The trial without ``eval.primary``: the verb declares its question itself, and once for all seeds."""
    words = tuple(word for word in trial.overrides if not word.startswith("eval.primary="))
    return Trial(trial.values | {"eval": trial.values["eval"] | {"primary": None}}, words)
