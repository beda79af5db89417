"""The listing of a dry run: each trial with its state, what changed, and the time that is left."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Any

from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.eval.facts import LPIPS
from gsbench.launch.guess import Guess, guess_training
from gsbench.launch.states import arm_names, ask_queue, label_of, state_in_queue, summary_of
from gsbench.parsing import DamagedError
from gsbench.runs.config_hash import determining_settings
from gsbench.runs.layout import RESULTS, SEED, TRIAL_GLOB
from gsbench.runs.nested import SHOWN, flatten, sha256_of
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.user_code import user_modules
from gsbench.words import counted, readable_time, some_of


class FinishedTrials:
    """The finished trials below the folder ``runs``.

    All are read once, to compare ten thousand planned ones with them.
    """

    def __init__(self, runs: Path) -> None:
        self._folders: dict[str, list[Path]] = defaultdict(list)
        # seconds per iteration, by `_similarities`
        self._seconds: dict[str, list[float]] = defaultdict(list)
        for path in runs.glob(f"*/{TRIAL_GLOB}/{RESULTS}"):
            files = TrialFolder(path.parent)
            record = files.sound_record()
            if record is None:
                continue
            self._folders[path.parent.name].append(path.parent)
            if record.iterations:
                seconds = sum(record.seconds.get(step, 0.0) for step in ("train", "evaluate"))
                with suppress(FileNotFoundError, DamagedError, KeyError, TypeError):
                    for similarity in _similarities(files.settings()):
                        self._seconds[similarity].append(seconds / record.iterations)

    def elsewhere(self, trial: TrialFolder) -> str | None:
        """Another experiment that has finished the same trial, whose stages are reused, or None."""
        others = (
            folder for folder in self._folders.get(trial.path.name, ()) if folder != trial.path
        )
        return next((folder.relative_to(trial.runs).parts[0] for folder in others), None)

    def estimate(self, values: Mapping[str, Any]) -> tuple[float, int]:
        """Seconds for the trial with ``values``, and the number of trials that this rests on.

        These trials have the same scene at the same size, the same rasterizer and, if possible, the
        same densifier. Times are taken per iteration. Returns ``(0, 0)`` without such trials.
        """
        for similarity in _similarities(values):
            if seconds := self._seconds.get(similarity):
                return fmean(seconds) * values["train"]["iterations"], len(seconds)
        return 0.0, 0


def _similarities(settings: Mapping[str, Any]) -> tuple[str, str]:
    """Hashes of scene, rasterizer and densifier, and of scene and rasterizer.

    Trials that share one of them take similar times.
    """
    shared = [settings["scene"], settings["raster"]["name"]]
    return sha256_of([*shared, settings["densify"]["name"]]), sha256_of(shared)


def describe_plan(trials: Sequence[Trial], parallel: int = 1) -> list[str]:
    """Lines for ``--dry-run``: each trial with its state, and the time for the unfinished ones."""
    lines: list[str] = []
    remaining, without_estimate, learned_from = 0.0, 0, 0
    guess: Guess | None = None  # of the last trial that no finished one is similar to
    states: list[str] = []
    finished = FinishedTrials(trials[0].files.runs)
    queue = ask_queue(trial.folder for trial in trials)
    arms = arm_names({trial.folder: trial.overrides for trial in trials})
    for trial in trials:
        folder = trial.files
        state: str = folder.state()
        if state not in ("done", "running"):
            state = state_in_queue(folder.path, queue) or state
        note = ""
        if state == "done":
            note = _what_is_left(trial)
        elif experiment := finished.elsewhere(folder):
            note = f"  as in {experiment}: nothing to compute"
        else:
            seconds, known_from = finished.estimate(trial.values)
            if not known_from and (found := guess_training(trial.values, parallel)):
                seconds, guess = found.seconds, found
            # a stopped training goes on from its checkpoint
            remaining += seconds * (1 - folder.share_done(trial.values["train"]["iterations"]))
            learned_from = max(learned_from, known_from)
            without_estimate += seconds == 0
        if state == "missing" and (change := _change_since_last(trial, arms)):
            note += f"  {change}"
        states.append(state)
        lines.append(f"{state:<8} {label_of(folder.path, arms)}{note}")
    lines.append(summary_of(states))
    if {*states} == {"done"}:
        return lines
    if without_estimate:
        time = (
            "no estimate: no finished trial of this scene with this rasterizer tells how long "
            "one takes here"
        )
    elif learned_from == 0 and guess is None:
        time = "seconds, since other experiments have the results"
    else:
        at_once = f", {parallel} at once" if parallel > 1 else ""
        duration = readable_time(remaining / parallel)
        sources = [f"estimated from {counted(learned_from, 'finished trial')}"] * (learned_from > 0)
        sources += [str(guess)] * (guess is not None)
        time = f"about {duration}{at_once}, {'; '.join(sources)}"
    return [*lines, f"time: {time}"]


def _what_is_left(trial: Trial) -> str:
    """A note on what a run would do with a finished trial; "" if nothing. Downloads nothing."""
    change = trial.files.why_not_done(trial.values, lambda options: ())
    if change is not None and change.kind == "computable":
        lacking, asked = change.name.split(", "), trial.values["eval"]
        absent = unavailable_now(asked | {"download": False})
        here = [name for name in lacking if name not in absent]
        if not here:
            weights = ", ".join(name for name in lacking if name.startswith(LPIPS))
            note = f"  lacks {weights}: its weights are not here; a run will try to download them"
            return note if weights and asked["download"] else ""
        change = replace(change, name=", ".join(here))
    return "" if change is None else f"  will be checked: {change}"


def _change_since_last(trial: Trial, planned: Collection[Path]) -> str:
    """A line on what changed since the arm's last finished trial of this scene and seed.

    It is "" if there is none. A trial that is ``planned`` too is another arm of this sweep, not an
    earlier form of this one.
    """
    pattern = f"*{SEED}{trial.values['seed']}/{RESULTS}"
    earlier = [
        path.parent for path in trial.folder.parent.glob(pattern) if path.parent not in planned
    ]
    if not earlier:
        return ""
    last = TrialFolder(max(earlier, key=lambda folder: (folder / RESULTS).stat().st_mtime))
    record = last.sound_record()
    try:
        before = _determining(last.configuration(), {} if record is None else record.code.sources)
    except (InputError, OSError):
        return ""
    now, hash8 = _determining(trial.values, user_modules(trial.values)), last.path.name[:SHOWN]
    keys = [key for key in {**now, **before} if now.get(key) != before.get(key)]
    changes = [f"{key} {before.get(key, 'unset')} → {now.get(key, 'unset')}" for key in keys]
    return f"since {hash8} changed: {some_of(changes)}" if changes else ""


def _determining(values: Mapping[str, Any], modules: Mapping[str, str]) -> dict[str, Any]:
    """The settings that determine a result, with dotted keys, and the user's code."""
    code = {f"code of {module}": digest[:SHOWN] for module, digest in modules.items()}
    return flatten(determining_settings(values)) | code


def unavailable_now(options: Mapping[str, Any]) -> Collection[str]:
    """The metrics that cannot be computed now, by the ``eval`` settings.

    Weights are searched for, and downloaded, once per sweep.
    """
    return _unavailable_now(json.dumps(options, sort_keys=True))


@cache
def _unavailable_now(options: str) -> Collection[str]:
    from gsbench.eval.options import EvalConfig
    from gsbench.pipeline.parts import make_evaluator

    return make_evaluator(EvalConfig(**json.loads(options))).awaited
