"""Reading an experiment's results: sound complete trials, and warnings on other folders.

A trial's folder is ``<runs>/<experiment>/<scene>/<init>-<densify>/<hash8>-seed<k>/``. Its
``results.json`` is written last: a folder that has it is complete. Nothing here needs torch, so
tables over thousands of trials start quickly.
"""

import itertools
import math
import re
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

from gsbench.analysis.trial_result import Configurations, read_configuration, settings_text
from gsbench.analysis.trial_result import TrialResult as TrialResult
from gsbench.errors import InputError
from gsbench.files import require_no_links
from gsbench.parsing import DamagedError, one_line
from gsbench.runs.code import edited
from gsbench.runs.commands import Digest, History, Question, code_in, read_history
from gsbench.runs.configuration import SHOWN
from gsbench.runs.experiments import Arm as Arm
from gsbench.runs.experiments import experiment_home, trial_folders
from gsbench.runs.freshness import Change, code_changes
from gsbench.runs.layout import CONFIG, FAILED, PER_VIEW, RESULTS, SEED
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
class Unfinished:
    """A trial without a usable result: it failed, runs, waits, was stopped, is damaged or gone.

    Or (``failed``) it ended without the metric of a question.
    """

    path: Path
    digest: Digest
    failed: bool = False
    running: bool = False

    @property
    def scene(self) -> str:
        return self.path.parts[-3]

    @property
    def seed(self) -> int:
        return int(self.path.name.partition(SEED)[2])

    @property
    def label(self) -> str:
        return "/".join(self.path.parts[-4:])

    def is_of(self, question: Question, side: int | None = None) -> bool:
        """Return whether a question is about it, as a trial of this side (1: the idea)."""
        sides = question.digests.get(self.scene, ())
        chosen = sides if side is None else sides[side : side + 1]
        # without a digest, as in files of earlier versions, the code is not known
        known = {digest.partition("+")[0] for digest in chosen} | set(chosen)
        return self.digest in known and self.seed in question.seeds.get(self.scene, ())


@dataclass(frozen=True)
class Experiment:
    """The usable trials of an experiment, and ``faults``, a line for each folder without one.

    ``older`` are trials of earlier code that `newest_code` left out, of which ``versions`` has a
    line for each part of the code. ``unfinished`` are the trials without a usable result.
    ``history`` is what was asked.
    """

    name: str
    folder: Path
    trials: tuple[TrialResult, ...]
    faults: tuple[str, ...]
    older: tuple[TrialResult, ...] = ()
    versions: tuple[str, ...] = ()
    unfinished: tuple[Unfinished, ...] = ()
    history: History = field(default_factory=lambda: History(Path()))

    @property
    def warnings(self) -> tuple[str, ...]:
        """The lines on all folders that do not count; there are `left_out` of these."""
        return (*self.faults, *self.versions)

    @property
    def left_out(self) -> int:
        return len(self.faults) + len(self.older)

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(sorted({trial.seed for trial in self.trials}))


def trials_of(trials: Sequence[TrialResult], *arms: Arm) -> list[TrialResult]:
    """The trials of some arms, in their order."""
    return [trial for trial in trials if trial.arm in arms]


def group_by(items: Iterable[T], *by: str | Callable[[T], Any]) -> dict[Any, list[T]]:
    """The items grouped in order of appearance, by attributes with these names or by ``by(item)``.

    Several names give tuples of values as keys.
    """
    first, groups = by[0], dict[Any, list[T]]()
    key = first if callable(first) else attrgetter(*map(str, by))
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


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
    settings: Configurations = {}
    for path in map(Path, trial_folders(folder)):
        try:
            trials.append(read_trial(path, settings))
        except UnusableError as reason:
            faults[path] = one_line(str(reason))
    of_settings = _read_settings(trials, settings)
    for trial in trials:
        if fault := of_settings.get(trial.key):
            faults[trial.path] = f"damaged, {fault}"
    usable = [trial for trial in trials if trial.path not in faults]
    usable.sort(key=lambda one: (one.scene, one.init, one.densify, one.seed, one.config_hash))
    history = read_history(folder)
    warnings = sorted(f"{path.relative_to(runs_dir)}: {fault}" for path, fault in faults.items())
    return Experiment(
        folder.name,
        folder,
        _with_askers(usable),
        (*warnings, *history.faults),
        unfinished=tuple(_unfinished(folder, faults, usable, history)),
        history=history,
    )


def _with_askers(trials: Sequence[TrialResult]) -> tuple[TrialResult, ...]:
    """The trials; those that share a training are asked by the questions of any of them."""
    by_training = group_by(trials, lambda trial: trial.record.hashes.get("train", trial.path))
    found = {}
    for own in by_training.values():
        questions = list(itertools.chain(*(trial.record.questions for trial in own)))
        for trial in own:
            if questions and not trial.record.questions:
                trial = replace(trial, record=replace(trial.record, questions=questions))
            found[trial.path] = trial
    return tuple(found[trial.path] for trial in trials)


def _unfinished(
    home: Path, faults: Mapping[Path, str], usable: Sequence[TrialResult], history: History
) -> Iterable[Unfinished]:
    """The trials without a usable result, planned ones included."""
    done = {trial.path for trial in usable}
    begun = {path for path, fault in faults.items() if not fault.startswith(FOREIGN)}
    for path in sorted((begun | history.planned.keys()) - done):
        if TRIAL_FOLDER.fullmatch(path.name):
            planned, folder = history.planned.get(path), TrialFolder(path)
            digest = f"{path.parent.name}/{path.name.partition(SEED)[0]}"
            state = folder.state() if path.is_dir() else "missing"
            yield Unfinished(
                path,
                digest if planned is None else planned.digest or digest,
                failed=state in ("failed", "damaged"),
                running=state == "running",
            )


def newest_code(experiment: Experiment) -> Experiment:
    """The experiment without trials of earlier code.

    The code of an idea is that of its newest question; without one, that of the trial which was
    finished last. A warning for each part of the code names the earlier versions.
    """
    older: list[TrialResult] = []
    # {(part, version that counts): {earlier version: its trials}}
    replaced: dict[tuple[str, str], dict[str, list[TrialResult]]] = {}

    def fold(made: Sequence[TrialResult], now: TrialResult | None, name: str) -> None:
        older.extend(made)
        change = Change("code", name, now="newer")
        if now:  # the first part in which they differ
            parts = dict.fromkeys([*now.code, *made[0].code], "none")
            change = next(code_changes(parts | made[0].code, (parts | now.code).get))
        earlier = replaced.setdefault((change.name, change.now), {})
        earlier.setdefault(change.made, []).extend(made)

    asked, by_key = _asked_code(experiment), group_by(experiment.trials, "key")
    texts = {key: settings_text(own[0].config) for key, own in by_key.items()}
    for name, own in group_by(experiment.trials, lambda t: f"{t.init}-{t.densify}").items():
        by_code = group_by(own, lambda trial: code_in(trial.digest))
        questions = asked.get(name, [])
        is_awaited = _awaits_other_code(questions, by_code)
        newest: list[TrialResult] = []  # one of each code that counts
        current: list[TrialResult] = []
        # The newest code comes first; what contradicts it is earlier code.
        for code in dict.fromkeys([*reversed(questions), *_newest_first(by_code)]):
            if code not in by_code:  # asked about, and not trained yet
                continue
            made = by_code[code]
            newer = next((one for one in newest if _contradicts(one, made[0])), None)
            if newer is not None or is_awaited:
                fold(made, newer, name)
            else:
                newest.append(made[0])
                current += made
        # an update of gsbench: the trials of a scene and settings that it repeated
        same = group_by(current, lambda trial: (trial.scene, texts[trial.key]))
        for repeated in same.values():
            stages = group_by(repeated, lambda trial: frozenset(trial.code.items()))
            last, *earlier = _newest_first(stages)
            for one in earlier:
                fold(stages[one], stages[last][0], name)
    if not older:
        return experiment
    left_out = {trial.path for trial in older}
    kept = tuple(trial for trial in experiment.trials if trial.path not in left_out)
    lines = tuple(_versions_line(*part, earlier) for part, earlier in replaced.items())
    return replace(experiment, trials=kept, older=(*experiment.older, *older), versions=lines)


def _asked_code(experiment: Experiment) -> dict[str, list[str]]:
    """The code of the questions about each arm's name, the newest last."""
    found: dict[str, list[str]] = {}
    for question in experiment.history.questions:
        for arm, side in ((question.baseline, 0), (question.idea, 1)):
            digests = [both[side] for both in question.digests.values() if both[side]]
            found.setdefault(arm.name, []).extend(map(code_in, digests[-1:]))
    return found


def _awaits_other_code(questions: Sequence[str], by_code: Mapping[str, list[TrialResult]]) -> bool:
    """Return whether the newest question is about a later version of all trials' code.

    No trial with its code has ended, so its modules are not known. It is a version of what is there
    if that has a module of the user's; otherwise its idea may be what brings one.
    """
    modules = {frozenset(made[0].record.code.sources) for made in by_code.values()}
    is_waiting = bool(questions) and questions[-1] not in by_code
    return is_waiting and len(modules) == 1 and frozenset() not in modules


def _contradicts(one: TrialResult, other: TrialResult) -> bool:
    """Return whether two trials of an arm have different versions of the same code.

    Settings of one densifier may name different modules of the user's, as a term does that the
    baseline lacks: a module that only one of them has makes no version.
    """
    first, second = one.record.code, other.record.code
    shared = first.sources.keys() & second.sources.keys()
    return edited(first.packages) != edited(second.packages) or any(
        first.sources[name] != second.sources[name] for name in shared
    )


def _newest_first(groups: Mapping[K, Sequence[TrialResult]]) -> list[K]:
    """The keys of groups of trials, by the time at which the last of each was finished."""
    if len(groups) == 1:  # the time takes a file of each trial
        return list(groups)
    return sorted(groups, key=lambda key: max(one.finished for one in groups[key]), reverse=True)


def _versions_line(part: str, now: str, earlier: Mapping[str, Sequence[TrialResult]]) -> str:
    """``sw: 6 trials of sfm-mine made by earlier versions of mine: 3fa9c1d2 (4), …``"""
    trials = [trial for made in earlier.values() for trial in made]
    arms = sorted({f"{trial.init}-{trial.densify}" for trial in trials})
    versions = [
        f"{version:.{SHOWN}} ({len(made)})" for version, made in reversed(list(earlier.items()))
    ]
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
        paths = group_by([(t.key, t.path) for t in of_arm], lambda pair: pair[0])
        if len(paths) > 1:
            for key, own in paths.items():
                faults[key] = read_configuration(settings, key, [path for _, path in own])
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


def read_trial(path: Path, settings: Configurations) -> TrialResult:
    """Read and check one of `trial_folders`; raises `UnusableError`."""
    folder = TrialFolder(path)
    try:
        require_no_links(path, path, below=True)  # `trial_folders` has followed none to it
        record = folder.record()
        if change := folder.change():
            raise UnusableError(
                f"damaged, {change}: `{command('retry', record.experiment)}` repairs it"
            )
    except FileNotFoundError:
        why = f"unfinished, no {RESULTS} yet"
        if (path / FAILED).exists():
            why = f"failed, {folder.failure().reason}"
        elif not (path / CONFIG).is_file():
            why = f"{FOREIGN}, not a trial"
        raise UnusableError(why) from None
    except DamagedError as error:
        state = "unfinished" if isinstance(error, UnfinishedError) else "damaged"
        raise UnusableError(f"{state}, {error.path.name} {error.reason}") from None
    except InputError as error:
        raise UnusableError(f"strange, {error}") from None
    match = TRIAL_FOLDER.fullmatch(path.name)
    if match is None:
        raise UnusableError(f"{FOREIGN}, the folder is not named <hash8>-seed<k>")
    names = (*path.parts[-4:-1], match["seed"])
    arm = f"{record.init}-{record.densify}"
    recorded = record.experiment, record.scene, arm, str(record.seed)
    for key, value, name in zip(
        ("experiment", "scene", "arm", "seed"), recorded, names, strict=True
    ):
        if value != name:
            raise UnusableError(f"{FOREIGN}, its {RESULTS} is of {key} {value!r}")
    return TrialResult(path, match["hash"], record, settings=settings)
