"""Archives: an experiment's results as one small file for others, and how it is unpacked.

An archive is a zip file of a runs folder's files as they are (`gsbench.claims.export` writes it):
each trial's ``results.json``, ``config.yaml``, ``per_view.csv`` and errors of regions, the
experiment's commands or ledger, records of searches, and pictures if they were asked for.
``archive.json`` has the version of this form and the sha256 of each file. The folder of a trial
without a usable result has its configuration alone: no verdict favours an arm that lacks results.

Archives may come from strangers, so sizes, names, checksums and contents are checked. Those of the
first version have other files (`as_files`).
"""

import hashlib
import io
import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from lzma import LZMAError
from pathlib import Path
from typing import Any

import yaml

from gsbench.analysis.results import Experiment, newest_code, read_experiment, read_views
from gsbench.analysis.trial_result import GROUPS
from gsbench.errors import InputError
from gsbench.parsing import read_typed
from gsbench.runs.experiments import TuningRecord
from gsbench.runs.layout import (
    ASKED_EARLIER,
    COMMANDS,
    CONFIG,
    FAILED,
    FROM_PIXELS,
    GROUND_TRUTH,
    PER_VIEW,
    REGIONS,
    RENDERS,
    RESULTS,
    TUNING,
)
from gsbench.settings import ARM_BYTES, is_folder_name
from gsbench.words import readable_bytes

# errors of contents that no gsbench wrote
NOT_AN_ARCHIVE = (KeyError, TypeError, ValueError, AttributeError, RecursionError)
BAD_ZIP = (
    OSError,
    zipfile.BadZipFile,
    zlib.error,
    LZMAError,
    EOFError,
    NotImplementedError,
    RuntimeError,
)
FORMAT, VERSION, FIRST_VERSION = "gsbench results", 2, 1
MANIFEST = "archive.json"
PICTURES = (RENDERS, GROUND_TRUTH)
OF_EXPERIMENT = (COMMANDS, *ASKED_EARLIER)
OF_TRIAL = (RESULTS, CONFIG, PER_VIEW, FROM_PIXELS, REGIONS, FAILED)
# Archives may come from strangers: these limits stop a zip bomb. They are larger than any
# experiment needs.
MAX_BYTES = 1 << 28  # bytes of one unpacked file
MAX_TOTAL_BYTES = 1 << 30  # bytes of all unpacked files
NO_CONFIGURATION = f"it has no {CONFIG}"


def unpack_archive(file: Path, runs: Path) -> Experiment:
    """Unpack an archive's trials into the empty runs folder ``runs``; read them as an experiment.

    Raises InputError, one line that names the file, if it is no archive, or is cut, edited or of
    another version.
    """
    try:
        name, files = _read(file)
        for place, content in files.items():
            _check_place(place, name)
            (runs / place).parent.mkdir(parents=True, exist_ok=True)
            (runs / place).write_bytes(content)
        return _checked(runs / name)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    except NOT_AN_ARCHIVE as error:
        raise InputError(
            f"{file}: its content is not that of an archive ({error!r}): export it again"
        ) from None


def _check_place(place: str, name: str) -> None:
    """Raise InputError unless ``place`` is one of a file in the archive of experiment ``name``."""
    parts = place.split("/")
    own = parts[0] == name
    known = {
        2: parts[-1] == TUNING or (own and parts[-1] in OF_EXPERIMENT),
        5: own and parts[-1] in OF_TRIAL,
        6: own and parts[-2] in PICTURES,
    }
    if not known.get(len(parts)) or not all(is_folder_name(part, ARM_BYTES) for part in parts):
        raise InputError(f"{place!r} cannot be a file of an archive")


def _checked(home: Path) -> Experiment:
    """The unpacked experiment; raises InputError if one of its files is damaged or missing."""
    for search in home.parent.glob(f"*/{TUNING}"):
        read_typed(search, TuningRecord)
    experiment = read_experiment(home)
    for trial in experiment.trials:
        # the trial finished last counts, and unpacked files are new
        os.utime(trial.path / RESULTS, (trial.measured, trial.measured))
    results = {file.parent for file in home.glob(f"*/*/*/{RESULTS}")}
    damaged = [one for one in experiment.unfinished if one.path in results]
    if not experiment.trials or damaged or len(results) > len(experiment.trials):
        reason = experiment.warnings[0] if experiment.warnings else "it has no trial"
        raise InputError(reason)
    for trial in experiment.trials:
        try:
            read_views(trial)
            if not (trial.path / CONFIG).is_file():
                raise InputError(f"{NO_CONFIGURATION}: export it again")
            _check_configuration(trial.whole_config, trial.record.to_json())
        except InputError as error:
            raise InputError(f"{trial.label}: {error}") from None
    return newest_code(experiment)


def _check_configuration(config: Mapping[str, Any], results: Mapping[str, Any]) -> None:
    """Raise InputError if a trial's configuration contradicts its results."""
    for key in ("seed", *GROUPS):  # results.json repeats the names of these groups
        value = config.get(key if key == "seed" else f"{key}.name", results[key])
        if value != results[key]:
            raise InputError(
                f"its configuration says {key} {value}, its results {results[key]}: export it again"
            )


def _read(file: Path) -> tuple[str, dict[str, bytes]]:
    """The experiment's name, and its files by their places in a runs folder."""
    if not file.is_file():  # reading a pipe or a device may never end
        raise InputError(
            "it is not a regular file: give an archive" if file.exists() else "no such file"
        )
    try:
        with zipfile.ZipFile(file) as archive:
            manifest = json.loads(_member(archive, MANIFEST))
            _check_manifest(manifest)
            check_size(sum(info.file_size for info in archive.infolist()))
            contents = {str(name): _member(archive, str(name)) for name in manifest["sha256"]}
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"its {MANIFEST} is not JSON ({error})") from None
    except BAD_ZIP as error:
        raise InputError(
            f"it is not a complete zip archive ({error}): fetch or export it again"
        ) from None
    for place, content in contents.items():
        if hashlib.sha256(content).hexdigest() != manifest["sha256"][place]:
            raise InputError(
                f"{place} was changed after the export (another sha256): export it again"
            )
    name = manifest["experiment"]
    if not isinstance(name, str) or not is_folder_name(name):
        raise InputError(f"{name!r} cannot be the name of an experiment")
    old = manifest["version"] == FIRST_VERSION
    return name, as_files(name, contents) if old else contents


def _check_manifest(manifest: Any) -> None:
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InputError(
            f"its {MANIFEST} is not one of gsbench: give what gsbench export --results wrote"
        )
    if manifest.get("version") not in (FIRST_VERSION, VERSION):
        raise InputError(
            f"it is of version {manifest.get('version')} of the archive (gsbench "
            f"{manifest.get('gsbench')}), and this gsbench reads {VERSION} and {FIRST_VERSION}: "
            "use one gsbench for both"
        )


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


def as_files(name: str, contents: Mapping[str, bytes]) -> dict[str, bytes]:
    """The files of the experiment ``name`` by their places in a runs folder.

    ``contents`` are those of an archive of the first version: JSON lines of all trials.
    """
    import pandas as pd  # here, since it is slow to import

    def lines(member: str) -> list[dict[str, Any]]:
        return [json.loads(line) for line in contents.get(member, b"").decode().splitlines()]

    texts: dict[str, str] = {}
    for member, file, part in (
        ("results.jsonl", RESULTS, "results"),
        ("from_pixels.jsonl", FROM_PIXELS, "measures"),
    ):
        for line in lines(member):
            texts[f"{line['folder']}/{file}"] = json.dumps(line[part])
    for line in lines("configurations.jsonl"):
        for folder, seed in line["trials"]:
            values = line["configuration"] | {"seed": seed}
            texts[f"{folder}/{CONFIG}"] = yaml.safe_dump(values)
    for line in lines("unfinished.jsonl"):
        texts[f"{line['folder']}/{CONFIG}"] = yaml.safe_dump(line["configuration"])
        texts[f"{line['folder']}/{FAILED}"] = "{}"
    frame = pd.read_csv(io.BytesIO(contents[PER_VIEW]), dtype=str, keep_default_na=False)
    for folder, own in frame.groupby("trial", sort=False):
        views = own.drop(columns="trial").to_csv(index=False, lineterminator="\n")
        texts[f"{folder}/{PER_VIEW}"] = views
    files = {f"{name}/{place}": text.encode() for place, text in texts.items()}
    return files | {f"{name}/{own}": contents[own] for own in OF_EXPERIMENT if own in contents}
