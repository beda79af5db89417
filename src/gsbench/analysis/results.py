"""Reading an experiment's results: sound complete trials, and warnings on other folders.

A trial's folder is ``<runs>/<experiment>/<scene>/<init>-<densify>/<hash8>-seed<k>/``. Its
``results.json`` is written last: a folder that has it is complete. Nothing here needs torch, so
tables over thousands of trials start quickly.
"""

import math
import re
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from gsbench.analysis.trial_result import TrialResult as TrialResult
from gsbench.analysis.trial_settings import Configurations, settings_text
from gsbench.errors import InputError
from gsbench.files import require_no_links
from gsbench.parsing import DamagedError, one_line
from gsbench.runs.experiments import Arm as Arm
from gsbench.runs.experiments import Declaration, experiment_home, read_declarations, trial_folders
from gsbench.runs.freshness import Change, code_changes
from gsbench.runs.layout import CONFIG, FAILED, FORGOTTEN, PER_VIEW, RESULTS, SEED
from gsbench.runs.nested import SHOWN
from gsbench.runs.seen import SeenResult, read_seen
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import UnfinishedError
from gsbench.words import command, counted, some_of

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")

MEAN_TOLERANCE = 1e-6  # relative: per-view values must average to the trial's metric
FOREIGN = "foreign"  # first word about a folder that is no trial of the experiment
TRIAL_FOLDER = re.compile(rf"(?P<hash>[0-9a-f]{{8}}){SEED}(?P<seed>\d+)")


TrialPair = tuple[TrialResult, TrialResult]  # a trial of the baseline and one of the arm


@dataclass(frozen=True)
class Experiment:
    """The usable trials of an experiment, and ``faults``, a line for each folder without one.

    ``older`` are trials of earlier code that `newest_code` left out, of which ``versions`` has a
    line for each part of the code, and those that were forgotten (``status --forget-superseded``).
    ``lacking`` are the folders of trials without a usable result: they failed, were stopped, or
    are damaged. ``seen`` is what was ever measured.
    """

    name: str
    folder: Path
    trials: tuple[TrialResult, ...]
    faults: tuple[str, ...]
    older: tuple[TrialResult, ...] = ()
    versions: tuple[str, ...] = ()
    lacking: tuple[Path, ...] = ()
    seen: tuple[SeenResult, ...] = ()

    @cached_property
    def declarations(self) -> list[Declaration]:
        """All declarations, the oldest first, also those that only the trials' results repeat."""
        return read_declarations(self.folder, (trial.record.declared for trial in self.trials))

    @property
    def warnings(self) -> tuple[str, ...]:
        """The lines on all folders that do not count; there are `left_out` of these."""
        return (*self.faults, *self.versions)

    @property
    def left_out(self) -> int:
        forgotten = sum(FORGOTTEN in trial.path.parts for trial in self.older)
        return len(self.faults) + len(self.older) - forgotten

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(sorted({trial.seed for trial in self.trials}))


def trials_of(trials: Sequence[TrialResult], arm: Arm) -> list[TrialResult]:
    """The trials of one arm, in their order."""
    return [trial for trial in trials if trial.arm == arm]


def group_by(items: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    """The items grouped by ``key(item)``, in order of appearance."""
    groups: dict[K, list[T]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def seeds_text(trials: Iterable[TrialResult]) -> str:
    """``seed 0`` or ``seeds 0, 1``"""
    seeds = sorted(trial.seed for trial in trials)
    return f"{'seed' if len(seeds) == 1 else 'seeds'} {', '.join(map(str, seeds))}"


def load_experiment(runs_dir: Path, name: str) -> Experiment:
    """Read the trials of the experiment ``name`` that count (`newest_code`).

    Raises ``InputError`` if none can be used.
    """
    return newest_code(load_all_trials(runs_dir, name))


def load_all_trials(runs_dir: Path, name: str) -> Experiment:
    """The same as `load_experiment`, with the trials of earlier code."""
    experiment = read_experiment(experiment_home(runs_dir, name))
    if not experiment.trials:
        warnings = experiment.warnings
        first = f" (first: {warnings[0]})" if warnings else ""
        raise InputError(
            f"experiment {name!r} has no complete trial among {len(warnings)} folders{first}; run "
            "it first"
        )
    return experiment


def read_experiment(folder: Path) -> Experiment:
    """Read every trial of the experiment in ``folder``; it may have no trials yet."""
    runs_dir = folder.parent
    trials: list[TrialResult] = []
    faults: dict[Path, str] = {}
    settings = Configurations()
    for path in map(Path, trial_folders(folder)):
        try:
            trials.append(read_trial(path, runs_dir, settings))
        except UnusableError as reason:
            faults[path] = one_line(str(reason))
    of_settings = _read_settings(trials, settings)
    faults |= {
        trial.path: f"damaged, {fault}" for trial in trials if (fault := of_settings.get(trial.key))
    }
    usable = [trial for trial in trials if trial.path not in faults]
    usable.sort(
        key=lambda trial: (trial.scene, trial.init, trial.densify, trial.seed, trial.config_hash)
    )
    known = {
        (key, seed): declared.moment
        for declared in reversed(read_declarations(folder))
        for key, seeds in declared.known.items()
        for seed in seeds
    }
    usable = [
        replace(trial, known=known[trial.key, trial.seed])
        if (trial.key, trial.seed) in known
        else trial
        for trial in usable
    ]
    forgotten, unread = _forgotten(folder, {trial.path for trial in usable})
    warnings = sorted(f"{path.relative_to(runs_dir)}: {fault}" for path, fault in faults.items())
    lacking = tuple(
        path
        for path, fault in sorted(faults.items())
        if TRIAL_FOLDER.fullmatch(path.name) and not fault.startswith(FOREIGN)
    )
    return Experiment(
        folder.name,
        folder,
        tuple(usable),
        (*warnings, *unread),
        forgotten,
        lacking=lacking,
        seen=read_seen(folder),
    )


def _forgotten(home: Path, there: Collection[Path]) -> tuple[tuple[TrialResult, ...], list[str]]:
    """The forgotten trials of an experiment that are not ``there`` again, and warnings."""
    found, warnings, settings = list[TrialResult](), [], Configurations()
    for path in map(Path, trial_folders(home / FORGOTTEN)) if (home / FORGOTTEN).is_dir() else ():
        try:
            trial = read_trial(path, home.parent, settings)
        except UnusableError as reason:
            if (path / RESULTS).exists():  # others failed, and showed nothing
                warnings.append(f"{path.relative_to(home.parent)}: {one_line(str(reason))}")
            continue
        if home / path.relative_to(home / FORGOTTEN) not in there:
            found.append(trial)
    return tuple(sorted(found, key=lambda trial: trial.path)), warnings


def newest_code(experiment: Experiment) -> Experiment:
    """The experiment without trials that later code repeated.

    A warning for each part of the code names its earlier versions, with their numbers of trials.
    Trials of one scene, arm and settings that differ only in their code are versions of one thing.
    Those count whose user's code is what it is now, or else those that were finished last.
    """
    older: list[TrialResult] = []
    # {(part, version that counts): {earlier version: its trials}}
    replaced: dict[tuple[str, str], dict[str, list[TrialResult]]] = {}
    for of_arm in group_by(experiment.trials, lambda t: (t.scene, t.init, t.densify)).values():
        if len({frozenset(trial.code.items()) for trial in of_arm}) < 2:
            continue
        # eval.primary, switches and the place of the photographs do not tell trials apart
        for same in group_by(of_arm, lambda trial: settings_text(trial.config)).values():
            versions = group_by(same, lambda trial: frozenset(trial.code.items()))
            newest = max(
                versions.values(),
                key=lambda made: (not made[0].edits, max(trial.finished for trial in made)),
            )
            for made in versions.values():
                if made is not newest:
                    older += made
                    change = _change_of_code(made[0], newest[0])
                    earlier = replaced.setdefault((change.name, change.now), {})
                    earlier.setdefault(change.made, []).extend(made)
    if not older:
        return experiment
    left_out = {trial.path for trial in older}
    kept = tuple(trial for trial in experiment.trials if trial.path not in left_out)
    lines = tuple(_versions_line(*code, earlier) for code, earlier in replaced.items())
    return replace(experiment, trials=kept, older=(*experiment.older, *older), versions=lines)


def _change_of_code(made: TrialResult, newest: TrialResult) -> Change:
    """The first part of the code in which two trials differ."""
    parts = dict.fromkeys([*newest.code, *made.code], "none")
    return next(code_changes(parts | made.code, (parts | newest.code).get))


def _versions_line(part: str, now: str, earlier: Mapping[str, Sequence[TrialResult]]) -> str:
    """``sw: 6 trials of sfm-mine made by earlier versions of mine: 3fa9c1d2 (4), …``"""
    trials = [trial for made in earlier.values() for trial in made]
    arms = sorted({f"{trial.init}-{trial.densify}" for trial in trials})
    versions = [f"{version:.{SHOWN}} ({len(made)})" for version, made in earlier.items()]
    return (
        f"{trials[0].experiment}: {counted(len(trials), 'trial')} of {some_of(arms)} made by "
        f"earlier versions of {part}: {', '.join(versions)}; the trials that count have "
        f"{now:.{SHOWN}}"
    )


def _read_settings(trials: Sequence[TrialResult], settings: Configurations) -> dict[str, str]:
    """Read the settings that are needed; return by trials' `key` what is wrong, "" if nothing.

    Settings are needed only if trials of one scene, initialiser and densifier have different
    ones. Other trials' files are not opened here, which saves time.
    """
    faults: dict[str, str] = {}
    for of_arm in group_by(trials, lambda trial: trial.key.rpartition("/")[0]).values():
        by_key = group_by(of_arm, lambda trial: trial.key)
        if len(by_key) > 1:
            faults |= {
                key: settings.read(key, [trial.path for trial in same])
                for key, same in by_key.items()
            }
    return faults


def read_views(trial: TrialResult) -> dict[str, dict[str, float]]:
    """The metrics of every test view, ``{view: {metric: value}}``.

    Their means must equal the trial's metrics, so a truncated file is detected. Raises
    ``InputError`` if the file is missing or damaged.
    """
    path = trial.path / PER_VIEW
    try:
        views = trial.folder.views()
    except FileNotFoundError:
        raise InputError(f"{path} is missing: give the trial's own command again") from None
    except DamagedError as error:
        raise InputError(f"{error}: delete it, and give the trial's own command again") from None
    for key, expected in trial.metrics.items():
        values = [view[key] for view in views.values() if key in view]
        mean = math.fsum(values) / len(values) if values else math.nan
        if len(values) != len(views) or not math.isclose(
            mean, expected, rel_tol=MEAN_TOLERANCE, abs_tol=MEAN_TOLERANCE
        ):
            raise InputError(
                f"{path} does not average to the {key} of its trial ({mean:.6g}, not "
                f"{expected:.6g}): damaged"
            )
    return views


class UnusableError(Exception):
    """A folder is not a usable trial; the text says why."""


def read_trial(path: Path, runs_dir: Path, settings: Configurations) -> TrialResult:
    """Read and check one trial folder; raises `UnusableError`."""
    try:
        require_no_links(runs_dir, path, below=True)
        folder = TrialFolder(path)
        record = folder.record()
        if change := folder.change():
            raise UnusableError(
                f"damaged, {change}: `{command('retry', record.experiment)}` repairs it"
            )
    except FileNotFoundError:
        raise UnusableError(_why_unfinished(path)) from None
    except UnfinishedError as error:
        raise UnusableError(f"unfinished, {error.path.name} {error.reason}") from None
    except DamagedError as error:
        raise UnusableError(f"damaged, {error.path.name} {error.reason}") from None
    except InputError as error:
        raise UnusableError(f"strange, {error}") from None
    match = TRIAL_FOLDER.fullmatch(path.name)
    if match is None:
        raise UnusableError(f"{FOREIGN}, the folder is not named <hash8>-seed<k>")
    recorded = {
        "experiment": record.experiment,
        "scene": record.scene,
        "arm": f"{record.init}-{record.densify}",
    }
    recorded["seed"] = str(record.seed)
    names = (path.relative_to(runs_dir).parts[0], *path.parts[-3:-1], match["seed"])
    for (key, value), name in zip(recorded.items(), names, strict=True):
        if value != name:
            raise UnusableError(f"{FOREIGN}, its {RESULTS} is of {key} {value!r}")
    return TrialResult(path, match["hash"], record, settings=settings)


def _why_unfinished(path: Path) -> str:
    if (path / FAILED).exists():
        return f"failed, {TrialFolder(path).failure().reason}"
    return (
        f"unfinished, no {RESULTS} yet" if (path / CONFIG).is_file() else f"{FOREIGN}, not a trial"
    )
