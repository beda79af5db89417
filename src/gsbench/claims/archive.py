"""Archives: an experiment's results as one small file for others, and how it is unpacked.

An archive is a zip file that is also an RO-Crate 1.2 (`gsbench.claims.export` writes it). It holds:

- ``results.jsonl``: the ``results.json`` of every trial, one per line, with the trial's folder, and
  ``older`` where later code repeated it;
- ``unfinished.jsonl``: folders and configurations of trials without a usable result, if any: no
  verdict favours an arm that lacks them;
- ``configurations.jsonl``: every configuration without the seed, with its trials' folders and
  seeds;
- ``per_view.csv``: the metrics of every test view;
- ``commands.jsonl``: the commands of the experiment and their questions; ``declared.jsonl`` in
  archives of earlier versions;
- ``ledger.jsonl``: the ideas of a ledger (`gsbench ledger`), if it is one;
- ``searches.jsonl``: the records of searches that tuned its arms, or of the search that it is;
- ``from_pixels.jsonl``: measures of the trials' pictures, if declared claims use them;
- ``pictures/``: renders and photographs of test views by trial, only if they were asked for;
- ``archive.json``: the version of this format and the sha256 of the files above;
- ``ro-crate-metadata.json``: the same in the terms of RO-Crate (w3id.org/ro/crate/1.2), for other
  tools.

Archives may come from strangers, so sizes, names, checksums and contents are checked.
"""

import csv
import hashlib
import io
import json
import os
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from lzma import LZMAError
from pathlib import Path
from typing import Any

import yaml

from gsbench.analysis.results import (
    Experiment,
    newest_code,
    read_experiment,
    read_views,
)
from gsbench.errors import InputError
from gsbench.parsing import parse_typed
from gsbench.runs.experiments import TuningRecord
from gsbench.runs.layout import (
    COMMANDS,
    CONFIG,
    DECLARED,
    FAILED,
    FROM_PIXELS,
    GROUND_TRUTH,
    LEDGER,
    PER_VIEW,
    RENDERS,
    RESULTS,
    TUNING,
)
from gsbench.runs.trial_files import Failure
from gsbench.settings import ARM_BYTES, is_folder_name
from gsbench.words import readable_bytes

FORMAT, VERSION = "gsbench results", 1
PIXELS = "from_pixels.jsonl"
MANIFEST, CRATE = "archive.json", "ro-crate-metadata.json"
TRIALS, CONFIGURATIONS = "results.jsonl", "configurations.jsonl"
SEARCHES = "searches.jsonl"
UNFINISHED, OLDER = "unfinished.jsonl", "older"
PICTURES_FOLDER, PICTURES = "pictures", (RENDERS, GROUND_TRUTH)
# Archives may come from strangers: these limits stop a zip bomb. They are larger than any
# experiment needs.
MAX_BYTES = 1 << 28  # bytes of one unpacked file
MAX_TOTAL_BYTES = 1 << 30  # bytes of all unpacked files
SEED_KEY = "seed"
NO_CONFIGURATION = f"it has no {CONFIG}"
NAMED_GROUPS = ("scene", "init", "densify")  # groups of settings whose names results.json repeats


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
        for line in _lines(contents.get(SEARCHES, b"")):
            _unpack_search(runs, line)
        for line in _lines(contents[TRIALS]):
            if line.get(OLDER):  # what was finished last counts
                os.utime(home / line["folder"] / RESULTS, (0, 0))
        unfinished = {
            _unpack_unfinished(home, line) for line in _lines(contents.get(UNFINISHED, b""))
        }
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError, csv.Error) as error:
        raise InputError(
            f"{file}: its content is not that of an archive ({error!r}): export it again"
        ) from None
    experiment = read_experiment(home)
    begun = {one.path for one in experiment.unfinished if one.path.is_dir()}
    others = begun != unfinished or len(experiment.warnings) > len(unfinished)
    if not experiment.trials or others:
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
            check_size(sum(info.file_size for info in archive.infolist()))
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


def check_size(size: int) -> None:
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
    for name, place in records_of(home).items():
        if name in contents:
            place.parent.mkdir(exist_ok=True)
            place.write_bytes(contents[name])


def records_of(home: Path) -> dict[str, Path]:
    """The files of the experiment itself, by their names in an archive."""
    return {name: home / name for name in (COMMANDS, DECLARED, LEDGER)}


def _unpack_unfinished(home: Path, line: Mapping[str, Any]) -> Path:
    """Make the folder of a trial without a usable result, and return it."""
    folder = home / _checked_folder(line["folder"])
    if folder.exists():
        raise InputError(f"the trial {line['folder']} is in it twice")
    folder.mkdir(parents=True)
    (folder / CONFIG).write_text(yaml.safe_dump(line["configuration"]), encoding="utf-8")
    if line.get("failed", True):  # archives of earlier versions do not tell: no verdict waits
        failure = Failure(message="its reason is not in the archive")
        (folder / FAILED).write_text(json.dumps(failure.to_json()), encoding="utf-8")
    return folder


def _unpack_search(runs: Path, line: Mapping[str, Any]) -> None:
    """Write the record of a search into the folder of its experiment."""
    name, content = line["experiment"], json.dumps(line["search"]).encode()
    parse_typed(content, TuningRecord, Path(SEARCHES))
    if not isinstance(name, str) or not is_folder_name(name):
        raise InputError(f"{name!r} cannot be the name of an experiment")
    (runs / name).mkdir(exist_ok=True)
    (runs / name / TUNING).write_bytes(content)


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


def _checked_folder(folder: object) -> str:
    """A trial's folder within its experiment.

    Raises InputError for a path that could lead out of the runs folder.
    """
    parts = str(folder).split("/")
    if len(parts) != 3 or not all(is_folder_name(part, ARM_BYTES) for part in parts):
        raise InputError(f"{folder!r} cannot be the folder of a trial")
    return str(folder)


def _lines(content: bytes) -> list[dict[str, Any]]:
    return [json.loads(line) for line in content.decode().splitlines()]
