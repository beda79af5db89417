"""Export of an experiment's results as an archive (`gsbench.claims.archive`).

Of paths on this machine only the last name is kept. The same results give the same archive, bit by
bit.
"""

import csv
import hashlib
import io
import itertools
import json
import re
import time
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

from gsbench import __version__
from gsbench.analysis.fairness import searches_of
from gsbench.analysis.images import PixelMeasures, textured_error
from gsbench.analysis.old_declarations import all_questions
from gsbench.analysis.quantities import TEXTURED
from gsbench.analysis.results import (
    Experiment,
    TrialResult,
    group_by,
    newest_code,
    read_views,
)
from gsbench.claims.archive import (
    CONFIGURATIONS,
    CRATE,
    FORMAT,
    MANIFEST,
    NO_CONFIGURATION,
    OLDER,
    PICTURES,
    PICTURES_FOLDER,
    PIXELS,
    SEARCHES,
    SEED_KEY,
    TRIALS,
    UNFINISHED,
    VERSION,
    check_size,
    records_of,
)
from gsbench.errors import InputError
from gsbench.files import atomic
from gsbench.parsing import read_bytes, read_typed, read_yaml
from gsbench.runs.commands import Command, read_lines
from gsbench.runs.commands import chained as chained_commands
from gsbench.runs.experiments import STAMP, TuningRecord
from gsbench.runs.layout import (
    COMMANDS,
    CONFIG,
    DECLARED,
    FAILED,
    LEDGER,
    PER_VIEW,
    TUNING,
)
from gsbench.runs.ledger import as_json, chained, read_ledger
from gsbench.words import without_folders

# the date of every file in the zip (the earliest possible), so that archives do not depend on time
FIXED_DATE = (1980, 1, 1, 0, 0, 0)
PRIVATE = ("runs", "tracking")  # settings that only name the user's folders and servers
PASSWORD = re.compile(r"(?<=://)[^/@\s]*@")  # user and password in a URL
FOLDERS = re.compile(r"(?<=:)///+\S*/")  # folders in a file's URL, such as sqlite:////home/me/a.db
ITEM = re.compile(r"[^=,\[\]{}'\"]+")  # one value in a word such as scene=[a,b]
SPECIFICATION = "https://w3id.org/ro/crate/1.2"
PICTURE = ("image/png", "A test view of a trial: its render, or the photograph")
FILES = {  # media types and descriptions
    TRIALS: (
        "application/jsonl",
        "Results of every trial, one JSON object a line: metrics, counts, hashes, code",
    ),
    UNFINISHED: ("application/jsonl", "Trials that failed or were stopped, with configurations"),
    CONFIGURATIONS: ("application/jsonl", "Every configuration, with the trials that had it"),
    PER_VIEW: ("text/csv", "Metrics of every test view of every trial"),
    PIXELS: ("application/jsonl", "What declared claims ask of the trials' pictures, measured"),
    SEARCHES: ("application/jsonl", "The searches that tuned arms, with all points"),
    COMMANDS: ("application/jsonl", "The commands, with the questions that they asked"),
    DECLARED: ("application/jsonl", "What was declared before the trials were run"),
    LEDGER: ("application/jsonl", "The ideas of a ledger and their tests (gsbench ledger)"),
    MANIFEST: ("application/json", "Version of the archive, and the sha256 of its files"),
}


def write_archive(experiment: Experiment, out: Path, pictures: bool = False) -> list[str]:
    """Write the experiment's results to ``out``; return a line for each trial left out.

    ``pictures`` adds those of the test views. Raises InputError if no trial can be exported.
    """
    left_out, unfinished = list(experiment.warnings), [*_begun(experiment)]
    experiment = newest_code(experiment)
    kept, rows = list[TrialResult](), list[dict[str, Any]]()
    # {configuration as JSON: (folder, seed) of its trials}
    configurations: dict[str, list[tuple[str, int]]] = {}
    # results of earlier code were seen, so a declaration after it is late
    for trial in (*experiment.trials, *experiment.older):
        try:
            views, configuration = read_views(trial), _configuration(trial.path)
        except InputError as error:
            left_out.append(f"{trial.label}: {error}")
            unfinished.append(trial.path)
            continue
        place = _folder(trial.path)
        rows += [{"trial": place, "view": view} | views[view] for view in sorted(views)]
        configurations.setdefault(configuration, []).append((place, trial.seed))
        kept.append(trial)
    if not kept:
        raise InputError(f"{experiment.name} has no whole trial to export (first: {left_out[0]})")
    older = {trial.path for trial in experiment.older}
    contents = {
        TRIALS: _json_lines(
            {"folder": _folder(trial.path), "results": _results(trial)}
            | ({OLDER: True} if trial.path in older else {})
            for trial in kept
        ),
        CONFIGURATIONS: _json_lines(
            {"configuration": json.loads(text), "trials": trials}
            for text, trials in configurations.items()
        ),
        PER_VIEW: _table(rows),
        **_declared(experiment, kept),
        **_searches(experiment.folder, kept),
    }
    if unfinished:
        contents[UNFINISHED] = _json_lines(map(_unfinished, unfinished))
    for trial in kept if pictures else ():
        for kind in PICTURES:
            place = f"{PICTURES_FOLDER}/{_folder(trial.path)}/{kind}"
            for path in trial.folder.pictures(kind):
                contents[f"{place}/{path.name}"] = read_bytes(path)
    check_size(sum(map(len, contents.values())))
    _write_zip(out, experiment.name, kept, contents)
    return left_out


def _write_zip(
    out: Path, name: str, trials: Sequence[TrialResult], contents: dict[str, bytes]
) -> None:
    """Write the archive of these ``contents`` by name, with its manifest and its description."""
    digests = {file: hashlib.sha256(content).hexdigest() for file, content in contents.items()}
    manifest = {"format": FORMAT, "version": VERSION, "experiment": name}
    contents = contents | {MANIFEST: _page(manifest | {"gsbench": __version__, "sha256": digests})}
    sizes = {file: len(content) for file, content in contents.items()}
    # The description of the crate comes first, where other programs look for it.
    contents = {CRATE: _page(crate_metadata(name, trials, sizes))} | contents
    with atomic(out, sync=False) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for file, content in contents.items():
            info = zipfile.ZipInfo(file, FIXED_DATE)
            archive.writestr(info, content, zipfile.ZIP_DEFLATED, compresslevel=9)


def _declared(experiment: Experiment, trials: Sequence[TrialResult]) -> dict[str, bytes]:
    """The experiment's own records, and what declared questions ask of pictures.

    The pictures themselves are mostly not in the archive.
    """
    home = experiment.folder
    records = {name: place for name, place in records_of(home).items() if place.is_file()}
    shared = {LEDGER: _shared_ledger, COMMANDS: _shared_commands}
    contents = {
        name: shared[name](home) if name in shared else read_bytes(place)
        for name, place in records.items()
    }
    if TEXTURED.key in {question.metric for question in all_questions(experiment)}:
        measured = []
        for trial in trials:
            with suppress(InputError):  # a trial whose pictures cannot be read
                measures = PixelMeasures(error_textured=textured_error(trial)).to_json()
                measured.append({"folder": _folder(trial.path), "measures": measures})
        contents[PIXELS] = _json_lines(measured)
    return contents


def _searches(home: Path, trials: Sequence[TrialResult]) -> dict[str, bytes]:
    """The search that the experiment in ``home`` is, and those that tuned its arms.

    Points of a search were chosen by their results, so nothing about them may be tested.
    """
    found = {}
    if (home / TUNING).exists():
        found[home.name] = read_typed(home / TUNING, TuningRecord)
    for of_arm in group_by(trials, lambda trial: trial.key).values():
        found |= searches_of(of_arm[0])
    lines = [
        {"experiment": name, "search": without_paths(search.to_json())}
        for name, search in sorted(found.items())
    ]
    return {SEARCHES: _json_lines(lines)} if lines else {}


def _shared_ledger(home: Path) -> bytes:
    """The ledger for others, without folders and servers of this machine, and so chained anew."""
    entries = []
    for entry in map(as_json, read_ledger(home).entries):
        if "words" in entry:
            entry["words"] = without_private_words(entry["words"])
        entries.append(without_paths(entry))
    return chained(entries).encode()


def _shared_commands(home: Path) -> bytes:
    """The commands for others, without folders and servers of this machine, and so linked anew."""
    lines = []
    for line in read_lines(home):
        if isinstance(line, Command):
            trials = {
                name: replace(trial, words=tuple(without_private_words(trial.words)))
                for name, trial in line.trials.items()
            }
            words = tuple(without_private_words(line.words))
            line = replace(line, words=words, cwd="", trials=trials)
        lines.append(line)
    return chained_commands(lines).encode()


def _begun(experiment: Experiment) -> list[Path]:
    """The folders of trials without a usable result."""
    return [one.path for one in experiment.unfinished if one.path.is_dir()]


def without_private_words(words: Sequence[str]) -> list[str]:
    """Settings as words, without the user's folders and servers; of paths, only the names."""
    shared = []
    for word in words:
        group = re.split(r"[./=]", word.lstrip("+~"), maxsplit=1)[0]
        if group not in PRIVATE:
            shared.append(ITEM.sub(lambda item: str(without_paths(item[0])), word))
    return shared


def _page(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=1) + "\n").encode()


def _folder(path: Path) -> str:
    """A trial's folder within its experiment."""
    return "/".join(path.parts[-3:])


def _unfinished(path: Path) -> dict[str, Any]:
    """The line of a trial without a usable result; its configuration may be unreadable, too."""
    configuration = "{}"
    with suppress(InputError, OSError):
        configuration = _configuration(path)
    failed = (path / FAILED).exists()
    return {"folder": _folder(path), "configuration": json.loads(configuration), "failed": failed}


def _configuration(path: Path) -> str:
    """The trial's ``config.yaml`` as JSON, without paths of this machine.

    Raises InputError if it is damaged.
    """
    try:
        values = read_yaml(path / CONFIG)
    except FileNotFoundError:
        raise InputError(NO_CONFIGURATION) from None
    if not isinstance(values, dict):
        raise InputError(f"its {CONFIG} is not a mapping")
    kept = {key: value for key, value in values.items() if key not in (*PRIVATE, SEED_KEY)}
    return json.dumps(without_paths(kept))


def _results(trial: TrialResult) -> dict[str, Any]:
    """The record of the trial without paths of this machine."""
    record = trial.record.to_json()
    # unpacked files are new, so what was measured before a declaration would look later
    record.setdefault("measured", time.strftime(STAMP, time.gmtime(trial.measured)))
    reasons = {metric: without_folders(reason) for metric, reason in record["unavailable"].items()}
    results: dict[str, Any] = without_paths(record | {"unavailable": reasons})
    return results


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


def _json_lines(entries: Any) -> bytes:
    return "".join(json.dumps(entry, separators=(",", ":")) + "\n" for entry in entries).encode()


def _table(rows: Sequence[Mapping[str, object]]) -> bytes:
    text, columns = io.StringIO(), dict.fromkeys(itertools.chain(*rows))
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def crate_metadata(
    name: str, trials: Sequence[TrialResult], sizes: Mapping[str, int]
) -> dict[str, Any]:
    """The archive in the terms of RO-Crate; ``sizes`` are the bytes of each of its files."""
    scenes = sorted({trial.scene for trial in trials})
    arms = sorted({str(trial.arm) for trial in trials})
    protocols = sorted({trial.record.protocol for trial in trials})
    day = time.strftime("%Y-%m-%d", time.gmtime(max(trial.measured for trial in trials)))
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": f"{name}: results of gsbench",
        "description": f"{len(trials)} trainings of 3D Gaussian Splatting: {', '.join(arms)} on "
        f"{', '.join(scenes)}, measured by {', '.join(protocols)}. No models.",
        "datePublished": day,
        "hasPart": [{"@id": file} for file in sizes],
    }
    files = [
        {
            "@id": file,
            "@type": "File",
            "name": file,
            "description": FILES.get(file, PICTURE)[1],
            "encodingFormat": FILES.get(file, PICTURE)[0],
            "contentSize": str(size),
        }
        for file, size in sizes.items()
    ]
    about = {"conformsTo": {"@id": SPECIFICATION}, "about": {"@id": "./"}}
    descriptor = {"@id": CRATE, "@type": "CreativeWork"} | about
    return {"@context": f"{SPECIFICATION}/context", "@graph": [descriptor, root, *files]}
