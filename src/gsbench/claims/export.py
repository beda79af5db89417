"""Export of an experiment's results as an archive (`gsbench.claims.archive`).

Files are as they are, without what is private: of paths on this machine only the last name is kept,
of addresses no user and password, and settings of folders and servers are left out. The same
results give the same archive, bit by bit.
"""

import hashlib
import json
import re
import time
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any, TypeVar

import yaml

from gsbench import __version__
from gsbench.analysis.comparison import compare
from gsbench.analysis.fairness import searches_of
from gsbench.analysis.images import PixelMeasures, region_record, textured_error
from gsbench.analysis.quantities import TEXTURED
from gsbench.analysis.results import Experiment, TrialResult, group_by, newest_code, read_views
from gsbench.claims.archive import FORMAT, MANIFEST, NO_CONFIGURATION, PICTURES, VERSION, check_size
from gsbench.errors import InputError
from gsbench.files import atomic
from gsbench.parsing import read_bytes, read_typed, read_yaml
from gsbench.runs.commands import Command, Idea, PlannedTrial, chained, read_lines
from gsbench.runs.experiments import STAMP, TuningRecord
from gsbench.runs.layout import (
    ASKED_EARLIER,
    COMMANDS,
    CONFIG,
    FAILED,
    FROM_PIXELS,
    PER_VIEW,
    REGIONS,
    RESULTS,
    TUNING,
)
from gsbench.runs.trial_folder import TrialFolder
from gsbench.words import without_folders

# the date of every file in the zip (the earliest possible), so that archives do not depend on time
FIXED_DATE = (1980, 1, 1, 0, 0, 0)
PRIVATE = ("runs", "tracking")  # settings that only name the user's folders and servers
PASSWORD = re.compile(r"(?<=://)[^/@\s]*@")  # user and password in a URL
FOLDERS = re.compile(r"(?<=:)///+\S*/")  # folders in a file's URL, such as sqlite:////home/me/a.db
Worded = TypeVar("Worded", Command, Idea, PlannedTrial)
ITEM = re.compile(r"[^=,\[\]{}'\"]+")  # one value in a word such as scene=[a,b]


def write_archive(
    experiment: Experiment, out: Path, pictures: bool = False
) -> tuple[list[str], str]:
    """Write the experiment's results to ``out``.

    Returns a line for each trial left out, and how many of its questions are open: ``open: 3 of
    6``, "" if none is. ``pictures`` adds those of the test views. Raises InputError if no trial can
    be exported.
    """
    left_out = list(experiment.warnings)
    unfinished = {one.path for one in experiment.unfinished if one.path.is_dir()}
    files, kept, home = dict[str, bytes](), list[TrialResult](), experiment.folder
    if (home / COMMANDS).is_file():
        files[f"{home.name}/{COMMANDS}"] = _shared_commands(home)
    for name in ASKED_EARLIER:
        if (home / name).is_file():  # that something was asked is told, not what: it may be private
            files[f"{home.name}/{name}"] = b""
    for trial in (*experiment.trials, *experiment.older):
        try:
            files |= _of_trial(trial, pictures)
            kept.append(trial)
        except InputError as error:
            left_out.append(f"{trial.label}: {error}")
            unfinished.add(trial.path)
    if not kept:
        raise InputError(f"{experiment.name} has no whole trial to export (first: {left_out[0]})")
    for path in unfinished:
        files |= _of_unfinished(path)
    if TEXTURED.key in {question.metric for question in experiment.history.questions}:
        for trial in kept:
            with suppress(InputError):  # a trial whose pictures cannot be read
                measures = PixelMeasures(error_textured=textured_error(trial)).to_json()
                files[f"{_folder(trial.path)}/{FROM_PIXELS}"] = _page(measures)
    files |= _searches(home, kept)
    check_size(sum(map(len, files.values())))
    _write_zip(out, experiment.name, dict(sorted(files.items())))
    answers = compare(newest_code(experiment)).answers
    is_open = [verdict.is_open for one in answers for verdict in (one.verdict, *one.others)]
    return left_out, f"open: {sum(is_open)} of {len(is_open)}" if any(is_open) else ""


def _write_zip(out: Path, name: str, files: Mapping[str, bytes]) -> None:
    """Write the archive of these ``files`` by place, with its manifest."""
    digests = {place: hashlib.sha256(content).hexdigest() for place, content in files.items()}
    manifest = {"format": FORMAT, "version": VERSION, "experiment": name}
    manifest |= {"gsbench": __version__, "sha256": digests}
    with atomic(out, sync=False) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for place, content in ({MANIFEST: _page(manifest)} | dict(files)).items():
            info = zipfile.ZipInfo(place, FIXED_DATE)
            archive.writestr(info, content, zipfile.ZIP_DEFLATED, compresslevel=9)


def _of_trial(trial: TrialResult, pictures: bool) -> dict[str, bytes]:
    """The files of a trial by their places; raises InputError if one is damaged."""
    read_views(trial)
    folder = _folder(trial.path)
    files = {
        f"{folder}/{RESULTS}": _page(_results(trial)),
        f"{folder}/{CONFIG}": _configuration(trial.path),
        f"{folder}/{PER_VIEW}": read_bytes(trial.path / PER_VIEW),
    }
    with suppress(InputError):  # pictures may have been deleted to make room
        files[f"{folder}/{REGIONS}"] = _page(region_record(trial).to_json())
    for kind in PICTURES if pictures else ():
        for path in trial.folder.pictures(kind):
            files[f"{folder}/{kind}/{path.name}"] = read_bytes(path)
    return files


def _of_unfinished(path: Path) -> dict[str, bytes]:
    """The files of a trial without a usable result; its configuration may be unreadable, too."""
    folder, configuration = _folder(path), b"{}\n"
    with suppress(InputError, OSError):
        configuration = _configuration(path)
    files = {f"{folder}/{CONFIG}": configuration}
    if TrialFolder(path).state() in ("failed", "damaged"):
        reason = without_folders(TrialFolder(path).failure().reason)
        files[f"{folder}/{FAILED}"] = _page({"status": "failed", "message": reason})
    return files


def _searches(home: Path, trials: Sequence[TrialResult]) -> dict[str, bytes]:
    """The search that the experiment in ``home`` is, and those that tuned its arms.

    Points of a search were chosen by their results, so nothing about them may be tested.
    """
    found = {}
    if (home / TUNING).exists():
        found[home.name] = read_typed(home / TUNING, TuningRecord)
    for of_arm in group_by(trials, "key").values():
        found |= searches_of(of_arm[0])
    return {
        f"{name}/{TUNING}": _page(without_paths(search.to_json())) for name, search in found.items()
    }


def _shared_commands(home: Path) -> bytes:
    """The commands for others, without folders and servers of this machine, and so linked anew."""
    lines = []
    for line in read_lines(home):
        if isinstance(line, Command):
            own = {name: _shared(trial) for name, trial in line.trials.items()}
            idea = line.idea and _shared(line.idea)
            line = replace(_shared(line), cwd="", trials=own, idea=idea)
        lines.append(line)
    return chained(lines).encode()


def _shared(entry: Worded) -> Worded:
    return replace(entry, words=tuple(without_private_words(entry.words)))


def without_private_words(words: Sequence[str]) -> list[str]:
    """Settings as words, without the user's folders and servers; of paths, only the names."""
    shared = []
    for word in words:
        group = re.split(r"[./=]", word.lstrip("+~"), maxsplit=1)[0]
        if group not in PRIVATE:
            shared.append(ITEM.sub(lambda item: without_paths(item[0]), word))
    return shared


def _page(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=1) + "\n").encode()


def _folder(path: Path) -> str:
    """A trial's folder within the runs folder."""
    return "/".join(path.parts[-4:])


def _configuration(path: Path) -> bytes:
    """The trial's ``config.yaml`` without paths of this machine.

    Raises InputError if it is damaged.
    """
    try:
        values = read_yaml(path / CONFIG)
    except FileNotFoundError:
        raise InputError(NO_CONFIGURATION) from None
    if not isinstance(values, dict):
        raise InputError(f"its {CONFIG} is not a mapping")
    kept = {key: value for key, value in values.items() if key not in PRIVATE}
    return yaml.safe_dump(without_paths(kept), sort_keys=False).encode()


def _results(trial: TrialResult) -> dict[str, Any]:
    """The record of the trial without paths of this machine."""
    record = trial.record.to_json()
    # unpacked files are new, so what was measured before a declaration would look later
    record.setdefault("measured", time.strftime(STAMP, time.gmtime(trial.measured)))
    reasons = {metric: without_folders(reason) for metric, reason in record["unavailable"].items()}
    return without_paths(record | {"unavailable": reasons})


def without_paths(value: Any) -> Any:
    """Plain values with only the last name of each path on this machine, no password in a URL."""
    if isinstance(value, Mapping):
        return {key: without_paths(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [without_paths(entry) for entry in value]
    if isinstance(value, str):
        # `without_folders` would stop at a blank
        if value.startswith(("/", "~")) or PurePath(value).is_absolute():
            return PurePath(value).name
        return without_folders(FOLDERS.sub("///", PASSWORD.sub("", value)))
    return value
