"""An experiment's results as one small file for others: a zip archive that is also an RO-Crate 1.2.

It holds:

- ``results.jsonl``: the ``results.json`` of every trial, one per line, with the trial's folder;
- ``configurations.jsonl``: every configuration without the seed, with its trials' folders and
  seeds;
- ``per_view.csv``: the metrics of every test view;
- ``declared.jsonl``: the declarations of the experiment, if there are any;
- ``ledger.jsonl``: the ideas of a ledger (`gsbench ledger`), if it is one;
- ``from_pixels.jsonl``: measures of the trials' pictures, if declared claims use them;
- ``pictures/``: renders and photographs of test views by trial, only if they were asked for;
- ``archive.json``: the version of this format and the sha256 of the files above;
- ``ro-crate-metadata.json``: the same in the terms of RO-Crate (w3id.org/ro/crate/1.2), for other
  tools.

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
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from lzma import LZMAError
from pathlib import Path, PurePath
from typing import Any

import yaml

from gsbench import __version__
from gsbench.analysis.images import PixelMeasures, textured_error
from gsbench.analysis.quantities import TEXTURED
from gsbench.analysis.results import (
    Experiment,
    TrialResult,
    newest_code,
    read_experiment,
    read_views,
)
from gsbench.errors import InputError
from gsbench.files import atomic
from gsbench.parsing import read_bytes, read_yaml
from gsbench.runs.experiments import read_declarations
from gsbench.runs.layout import (
    CONFIG,
    DECLARED,
    FROM_PIXELS,
    GROUND_TRUTH,
    LEDGER,
    PER_VIEW,
    RENDERS,
    RESULTS,
)
from gsbench.runs.ledger import as_json, chained, read_ledger
from gsbench.settings import is_folder_name
from gsbench.words import readable_bytes, without_folders

RECORDS = (DECLARED, LEDGER)  # files of the experiment itself
FORMAT, VERSION = "gsbench results", 1
PIXELS = "from_pixels.jsonl"
MANIFEST, CRATE = "archive.json", "ro-crate-metadata.json"
TRIALS, CONFIGURATIONS = "results.jsonl", "configurations.jsonl"
PICTURES_FOLDER, PICTURES = "pictures", (RENDERS, GROUND_TRUTH)
# Archives may come from strangers: these limits stop a zip bomb. They are larger than any
# experiment needs.
MAX_BYTES = 1 << 28  # bytes of one unpacked file
MAX_TOTAL_BYTES = 1 << 30  # bytes of all unpacked files
# the date of every file in the zip (the earliest possible), so that archives do not depend on time
FIXED_DATE = (1980, 1, 1, 0, 0, 0)
PRIVATE = ("runs", "tracking")  # settings that only name the user's folders and servers
PASSWORD = re.compile(r"(?<=://)[^/@\s]*@")  # user and password in a URL
FOLDERS = re.compile(r"(?<=:)///+\S*/")  # folders in a file's URL, such as sqlite:////home/me/a.db
ITEM = re.compile(r"[^=,\[\]{}'\"]+")  # one value in a word such as scene=[a,b]
SEED_KEY = "seed"
NO_CONFIGURATION = f"it has no {CONFIG}"
NAMED_GROUPS = ("scene", "init", "densify")  # groups of settings whose names results.json repeats
SPECIFICATION = "https://w3id.org/ro/crate/1.2"
PICTURE = ("image/png", "A test view of a trial: its render, or the photograph")
FILES = {  # media types and descriptions
    TRIALS: (
        "application/jsonl",
        "Results of every trial, one JSON object a line: metrics, counts, hashes, code",
    ),
    CONFIGURATIONS: ("application/jsonl", "Every configuration, with the trials that had it"),
    PER_VIEW: ("text/csv", "Metrics of every test view of every trial"),
    PIXELS: ("application/jsonl", "What declared claims ask of the trials' pictures, measured"),
    DECLARED: ("application/jsonl", "What was declared before the trials were run"),
    LEDGER: ("application/jsonl", "The ideas in the order of their tests (gsbench ledger)"),
    MANIFEST: ("application/json", "Version of the archive, and the sha256 of its files"),
}


def write_archive(experiment: Experiment, out: Path, pictures: bool = False) -> list[str]:
    """Write the experiment's results to ``out``; return a line for each trial left out.

    ``pictures`` adds those of the test views. Raises InputError if no trial can be exported.
    """
    kept, rows, left_out = [], [], list(experiment.warnings)
    # {configuration as JSON: (folder, seed) of its trials}
    configurations: dict[str, list[tuple[str, int]]] = {}
    for trial in experiment.trials:
        try:
            views, configuration = read_views(trial), _configuration(trial)
        except InputError as error:
            left_out.append(f"{trial.label}: {error}")
            continue
        place = _folder(trial)
        rows += [{"trial": place, "view": view} | views[view] for view in sorted(views)]
        configurations.setdefault(configuration, []).append((place, trial.seed))
        kept.append(trial)
    if not kept:
        raise InputError(f"{experiment.name} has no whole trial to export (first: {left_out[0]})")
    contents = {
        TRIALS: _json_lines(
            {"folder": _folder(trial), "results": _results(trial)} for trial in kept
        ),
        CONFIGURATIONS: _json_lines(
            {"configuration": json.loads(text), "trials": trials}
            for text, trials in configurations.items()
        ),
        PER_VIEW: _table(rows),
        **_declared(experiment.folder, kept),
    }
    for trial in kept if pictures else ():
        for kind in PICTURES:
            place = f"{PICTURES_FOLDER}/{_folder(trial)}/{kind}"
            for path in trial.folder.pictures(kind):
                contents[f"{place}/{path.name}"] = read_bytes(path)
    _check_size(sum(map(len, contents.values())))
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "experiment": experiment.name,
        "gsbench": __version__,
        "sha256": {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()},
    }
    contents[MANIFEST] = _page(manifest)
    sizes = {name: len(content) for name, content in contents.items()}
    # The description of the crate comes first, where other programs look for it.
    contents = {CRATE: _page(crate_metadata(experiment.name, kept, sizes))} | contents
    with atomic(out, sync=False) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, content in contents.items():
            info = zipfile.ZipInfo(name, FIXED_DATE)
            archive.writestr(info, content, zipfile.ZIP_DEFLATED, compresslevel=9)
    return left_out


def _declared(home: Path, trials: Sequence[TrialResult]) -> dict[str, bytes]:
    """The declarations, the ledger, and what declared questions ask of pictures.

    The pictures themselves are mostly not in the archive.
    """
    contents = {}
    if (home / DECLARED).is_file():
        contents[DECLARED] = read_bytes(home / DECLARED)
    if (home / LEDGER).is_file():
        contents[LEDGER] = _shared_ledger(home)
    asked = itertools.chain(*(one.questions for one in read_declarations(home)))
    if TEXTURED.key in {question.metric for question in asked}:
        measured = []
        for trial in trials:
            with suppress(InputError):  # a trial whose pictures cannot be read
                measures = PixelMeasures(error_textured=textured_error(trial)).to_json()
                measured.append({"folder": _folder(trial), "measures": measures})
        contents[PIXELS] = _json_lines(measured)
    return contents


def _shared_ledger(home: Path) -> bytes:
    """The ledger for others, without folders and servers of this machine, and so chained anew."""
    entries = []
    for entry in map(as_json, read_ledger(home).entries):
        if "words" in entry:
            entry["words"] = without_private_words(entry["words"])
        entries.append(without_paths(entry))
    return chained(entries).encode()


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


def unpack_archive(file: Path, runs: Path) -> Experiment:
    """Unpack an archive's trials into the empty runs folder ``runs``; read them as an experiment.

    Raises InputError, one line that names the file, if it is no archive, or is cut, edited or of
    another version.
    """
    try:
        manifest, contents = _read(file)
        name = manifest["experiment"]
        if not isinstance(name, str) or not is_folder_name(name):
            raise InputError(f"{name!r} cannot be the name of an experiment")
        home = runs / name
        trials = [
            (_checked_folder(line["folder"]), line["results"]) for line in _lines(contents[TRIALS])
        ]
        _unpack(home, trials, contents)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError, csv.Error) as error:
        raise InputError(
            f"{file}: its content is not that of an archive ({error!r}): export it again"
        ) from None
    experiment = read_experiment(home)
    if not experiment.trials or experiment.warnings:
        reason = experiment.warnings[0] if experiment.warnings else "it has no trial"
        raise InputError(f"{file}: {reason}")
    for trial in experiment.trials:
        try:
            read_views(trial)
            if not (trial.path / CONFIG).is_file():
                raise InputError(f"{NO_CONFIGURATION}: export it again")
        except InputError as error:
            raise InputError(f"{file}: {trial.label}: {error}") from None
    return newest_code(experiment)


def _check_configuration(
    folder: str, values: Mapping[str, Any], results: Mapping[str, Any]
) -> None:
    """Raise InputError if the configuration ``values`` contradicts ``results`` in ``folder``."""
    names = {SEED_KEY: values[SEED_KEY]}
    for group in NAMED_GROUPS:
        if isinstance(own := values.get(group), dict):
            names[group] = own.get("name")
    for key, value in names.items():
        if value != results[key]:
            raise InputError(
                f"{folder}: its configuration says {key} {value}, its results {results[key]}: "
                "export it again"
            )


def _read(file: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The manifest, and the content of the files that it lists, compared with their checksums."""
    # reading a pipe or a device may never end
    if file.exists() and not (file.is_file() or file.is_dir()):
        raise InputError("it is not a regular file: give an archive")
    try:
        with zipfile.ZipFile(file) as archive:
            manifest = json.loads(_member(archive, MANIFEST))
            if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
                raise InputError(
                    f"its {MANIFEST} is not one of gsbench: give what gsbench export --results "
                    "wrote"
                )
            if manifest.get("version") != VERSION:
                raise InputError(
                    f"it is of version {manifest.get('version')} of the archive (gsbench "
                    f"{manifest.get('gsbench')}), and this gsbench reads {VERSION}: use one "
                    "gsbench for both"
                )
            _check_size(sum(info.file_size for info in archive.infolist()))
            contents = {str(name): _member(archive, str(name)) for name in manifest["sha256"]}
    except FileNotFoundError:
        raise InputError("no such file") from None
    except IsADirectoryError:
        raise InputError("it is a folder: give an archive") from None
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"its {MANIFEST} is not JSON ({error})") from None
    except (
        OSError,
        zipfile.BadZipFile,
        zlib.error,
        LZMAError,
        EOFError,
        NotImplementedError,
        RuntimeError,
    ) as error:
        raise InputError(
            f"it is not a complete zip archive ({error}): fetch or export it again"
        ) from None
    for name, content in contents.items():
        if hashlib.sha256(content).hexdigest() != manifest["sha256"][name]:
            raise InputError(
                f"{name} was changed after the export (another sha256): export it again"
            )
    return manifest, contents


def _check_size(size: int) -> None:
    if size > MAX_TOTAL_BYTES:
        raise InputError(
            f"its files are {readable_bytes(size)}, more than the limit of "
            f"{readable_bytes(MAX_TOTAL_BYTES)}"
        )


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    try:
        info = archive.getinfo(name)
    except KeyError:
        raise InputError(
            f"it lacks {name}: it is not an archive of gsbench, or it is incomplete"
        ) from None
    if info.file_size > MAX_BYTES:
        raise InputError(
            f"{name} would be {info.file_size} bytes: an archive of gsbench never has that many"
        )
    with archive.open(info) as stream:
        return stream.read(MAX_BYTES)


def _unpack(
    home: Path, trials: Sequence[tuple[str, dict[str, Any]]], contents: Mapping[str, bytes]
) -> None:
    """Write the files of every trial into its folder below ``home``."""
    for folder, results in trials:
        if (home / folder).exists():
            raise InputError(f"the trial {folder} is in it twice")
        (home / folder).mkdir(parents=True)
        (home / folder / RESULTS).write_text(json.dumps(results), encoding="utf-8")
    results_by_folder = dict(trials)
    for line in _lines(contents[CONFIGURATIONS]):
        for folder, seed in line["trials"]:
            if folder in results_by_folder:
                configuration = line["configuration"] | {SEED_KEY: seed}
                _check_configuration(folder, configuration, results_by_folder[folder])
                (home / folder / CONFIG).write_text(
                    yaml.safe_dump(configuration, sort_keys=False), encoding="utf-8"
                )
    reader = csv.DictReader(io.StringIO(contents[PER_VIEW].decode()))
    by_trial: dict[str, list[dict[str, str]]] = {}
    for row in reader:
        by_trial.setdefault(row.pop("trial"), []).append(row)
    columns = [name for name in reader.fieldnames or () if name != "trial"]
    for folder in results_by_folder.keys() & by_trial.keys():
        with (home / folder / PER_VIEW).open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, columns)
            writer.writeheader()
            writer.writerows(by_trial[folder])
    for line in _lines(contents.get(PIXELS, b"")):
        if line["folder"] in results_by_folder:
            (home / line["folder"] / FROM_PIXELS).write_text(
                json.dumps(line["measures"]), encoding="utf-8"
            )
    for name in contents:
        if name.startswith(f"{PICTURES_FOLDER}/"):
            _unpack_picture(home, name, contents[name])
    for name in RECORDS:
        if name in contents:
            (home / name).write_bytes(contents[name])


def _unpack_picture(home: Path, name: str, content: bytes) -> None:
    """Write a picture of a test view into its trial's folder.

    Raises InputError for a name that leads elsewhere.
    """
    folder, kind, file = name.removeprefix(f"{PICTURES_FOLDER}/").rsplit("/", 2)
    if (
        kind not in PICTURES
        or not is_folder_name(file)
        or not (home / _checked_folder(folder) / RESULTS).is_file()
    ):
        raise InputError(f"{name!r} cannot be a picture of a trial")
    (home / folder / kind).mkdir(exist_ok=True)
    (home / folder / kind / file).write_bytes(content)


def _folder(trial: TrialResult) -> str:
    """A trial's folder within its experiment."""
    return "/".join(trial.path.parts[-3:])


def _checked_folder(folder: object) -> str:
    """A trial's folder within its experiment.

    Raises InputError for a path that could lead out of the runs folder.
    """
    parts = str(folder).split("/")
    if len(parts) != 3 or not all(map(is_folder_name, parts)):
        raise InputError(f"{folder!r} cannot be the folder of a trial")
    return str(folder)


def _configuration(trial: TrialResult) -> str:
    """The trial's ``config.yaml`` as JSON, without paths of this machine.

    Raises InputError if it is damaged.
    """
    try:
        values = read_yaml(trial.path / CONFIG)
    except FileNotFoundError:
        raise InputError(NO_CONFIGURATION) from None
    if not isinstance(values, dict):
        raise InputError(f"its {CONFIG} is not a mapping")
    kept = {key: value for key, value in values.items() if key not in (*PRIVATE, SEED_KEY)}
    return json.dumps(without_paths(kept))


def _results(trial: TrialResult) -> dict[str, Any]:
    """The record of the trial without paths of this machine."""
    record = trial.record.to_json()
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


def _lines(content: bytes) -> list[dict[str, Any]]:
    return [json.loads(line) for line in content.decode().splitlines()]


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
