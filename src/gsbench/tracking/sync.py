"""Sending to trackers what they lack of trials (`gsbench sync`), while they run and later."""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, chdir, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsbench.config.build import build
from gsbench.config.trust import foreign_address
from gsbench.errors import InputError
from gsbench.files import write_json
from gsbench.parsing import one_line, read_if_sound
from gsbench.runs.configuration import GSBENCH
from gsbench.runs.layout import CONFIG, FAILED, LOG
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import BusyError, hold
from gsbench.system.programs import own_folder
from gsbench.tracking.ideas import show_ideas
from gsbench.tracking.mlflow_sink import VARIABLE, absolute_address
from gsbench.tracking.sinks import Run, Sink
from gsbench.tracking.trial import TrackedTrial, Update
from gsbench.words import counted

Tracking = Mapping[str, Any]  # the settings of the group ``tracking``
OWN = "gsbench.tracking."
MLFLOW = f"{OWN}MLflow"
# The settings ``tracking`` that are not options of the tracker's class; configurations of earlier
# versions name it by ``sink``.
NOT_OPTIONS = ("name", "enabled", "flush_seconds", "patience_seconds", "images", "model", "sink")


def class_of(options: Tracking) -> str:
    """The import path of the tracker's class."""
    return str(options.get("_target_") or MLFLOW)


def place_for(options: Tracking) -> AbstractContextManager[str | Path]:
    """The folder to call a tracker in: an empty one, but a user's own tracker stays here.

    Trackers' clients read settings in the current folder: W&B would take its server's address from
    a stranger's ``wandb/settings``.
    """
    return own_folder() if class_of(options).startswith(GSBENCH) else nullcontext(Path.cwd())


def tracker_name(options: Tracking) -> str:
    """The tracker's name in messages."""
    return class_of(options).removeprefix(OWN)


def make_sink(options: Tracking, allowed: Sequence[str]) -> Sink:
    """The tracker that the settings describe.

    ``allowed`` are the modules whose code may run. Raises InputError naming a wrong setting.
    """
    left_out = (*NOT_OPTIONS, "uri") if options.get("uri") is None else NOT_OPTIONS
    own = {key: value for key, value in options.items() if key not in left_out}
    return build("tracking", own | {"_target_": class_of(options)}, list(allowed))


# the errors of a tracker's client; a user's class may even end the process
ERRORS = (Exception, SystemExit)


def with_absolute_address(options: dict[str, Any]) -> dict[str, Any]:
    """The settings ``tracking`` for a process in another folder than the command's."""
    uri = options.get("uri")
    if not uri and class_of(options) == MLFLOW:
        uri = os.environ.get(VARIABLE)
    return options | {"uri": absolute_address(uri)} if uri else options


class MirrorError(Exception):
    """The error of a mirror that could not be written. Its text is the reason, in one line."""


# in the trial's folder: one process at a time mirrors a trial, to any tracker
LOCK = ".mlflow.lock"


def sync(
    folders: Iterable[TrialFolder], uri: str | None, allowed: Sequence[str] = ()
) -> Iterator[str]:
    """Send what trackers lack of these trials; yields a line for each ended one, and a summary.

    Of a trial that runs, the curves are sent. ``allowed`` are the modules whose code may run, and
    the addresses that may get results. Raises MirrorError if the tracker refuses a trial.
    """
    new = already_there = 0
    # for each experiment and tracker, a trial and its settings
    pages: dict[tuple[Path, str | None], tuple[TrialFolder, Tracking]] = {}
    for folder in folders:
        state = folder.state()
        if state == "damaged":
            yield f"left out: {folder.label}: damaged, see gsbench status"
        if state in ("damaged", "missing"):
            continue
        try:
            values = folder.configuration()
        except InputError as error:
            yield f"left out: {error}"
            continue
        options = values["tracking"] | ({"uri": uri} if uri else {})
        # The runs folder may be a stranger's. It must not make gsbench send files or passwords to
        # the stranger's address.
        if address := foreign_address(options, [*allowed, *([uri] if uri else [])]):
            yield (
                f"left out: {folder.label}: its configuration names the tracker {address}, and "
                f"--uri {address} was not typed"
            )
            continue
        options = with_absolute_address(options)
        if state == "partial" and not _state_file(folder, options).exists():
            continue  # it never began to be sent
        try:  # a class of a user's is run only with permission
            make_sink(options, allowed)
        except InputError as error:
            yield f"left out: {folder.label}: {error}"
            continue
        try:
            with place_for(options) as place, chdir(place):
                is_new = mirror(folder, options, values, allowed, live=state == "running")
        except BusyError:
            yield f"{folder.label} is being mirrored by another process"
            continue
        except ERRORS as error:
            raise refusal(folder, options, error) from error
        if state == "running":
            continue
        if class_of(options) == MLFLOW:
            pages[folder.home, options["uri"]] = folder, options
        new, already_there = new + is_new, already_there + (not is_new)
        if is_new:
            yield f"mirrored {folder.label}"
    for folder, options in pages.values():
        try:
            show_ideas(folder.home, options["uri"])
        except Exception as error:  # any error of the tracker's client
            raise refusal(folder, options, error) from error
    yield f"{counted(new, 'trial')} mirrored now, {already_there} before"


def mirror(
    folder: TrialFolder,
    options: Tracking,
    values: dict[str, Any],
    allowed: Sequence[str] = (),
    live: bool = False,
) -> bool:
    """Send a trial that has ended or (``live``) runs; returns False if the tracker lacks nothing.

    ``values`` are the whole configuration; ``allowed`` are the modules whose code may run. Raises
    BusyError if another process mirrors the trial, and any error of the tracker.
    """
    folder.require_no_links()
    file = _state_file(folder, options)

    def keep(run: Run, **changes: Any) -> Run:
        run = replace(run, **changes)
        write_json(file, run.to_json())
        return run

    with hold(folder.path / LOCK, "mirroring", wait=False):
        sink, trial = make_sink(options, allowed), TrackedTrial(folder, values)
        results = trial.results_hash()
        run = read_if_sound(file, Run) or Run()
        if run.token is None or run.complete not in (None, results):  # it shows other results
            now = int(time.time() * 1000)
            run = Run(token=uuid.uuid4().hex, started=now, replaces=run.token)
        # Kept before the tracker creates the run, so that the token finds it even if the tracker's
        # answer is lost.
        keep(run)
        shown = run.complete if live or results else run.ended
        is_shown = shown == (results or trial.ending())
        name = sink.open(trial, replace(run, complete=shown if is_shown else None))
        if name != run.id:
            is_shown, run = False, Run(token=run.token, started=run.started, id=name)
        if not run.described:
            sink.send(Update(params=trial.params(), tags=trial.tags()))
        run = keep(run, described=True)
        if is_shown and not live:
            return False
        for name, newest, scalars in trial.curves(run.logged, live):
            sink.send(Update(scalars=scalars))
            run = keep(run, logged=run.logged | {name: newest})
        if not live:
            ending = _ending(trial, options)
            sink.send(ending)
            if ending.status == "FINISHED":
                keep(run, complete=trial.results_hash())
            else:
                keep(run, ended=trial.ending())
        return True


def _ending(trial: TrackedTrial, options: Tracking) -> Update:
    """The end of a trial as its files say: failed, done, else killed."""
    folder = trial.folder
    if folder.has_failed():
        files = trial.files((CONFIG, FAILED, LOG))
        return Update(files=files, status="FAILED", reason=folder.failure().reason)
    if (results := folder.sound_record()) is None:
        return Update(status="KILLED")
    return trial.summary(results, int(options["images"]), bool(options.get("model")))


def _state_file(folder: TrialFolder, options: Tracking) -> Path:
    """The file in a trial's folder that says what its tracker has got."""
    name = tracker_name(options)
    own = class_of(options).startswith(OWN)
    return folder.path / f"{name.lower() if own else f'tracker-{name}'}.json"


def refusal(folder: TrialFolder, options: Tracking, error: BaseException) -> MirrorError:
    """A MirrorError, in one line, for an ``error`` of the tracker's client about a trial."""
    reason = one_line(f"{type(error).__name__}: {error}")
    return MirrorError(f"{folder.label} could not be sent to {tracker_name(options)} ({reason})")
