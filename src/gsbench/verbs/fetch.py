"""``gsbench fetch``: public scenes into the data folder."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

from gsbench.datasets.archive import RangesRefusedError
from gsbench.datasets.catalog import (
    DATA_VARIABLE,
    Archive,
    Dataset,
    SceneFiles,
    data_dir,
    read_catalog,
    wanted_files,
)
from gsbench.datasets.fetch import STAGING, Fetcher, describe
from gsbench.datasets.records import SceneRecord, read_records
from gsbench.downloads import Patience
from gsbench.errors import InputError
from gsbench.files import remove_temporaries, storage_errors
from gsbench.logs import progress
from gsbench.system.locks import hold
from gsbench.verbs.arguments import ArgumentParser
from gsbench.words import closest, is_path, readable_bytes

MIRROR_VARIABLE = "GSBENCH_MIRROR"
LOCK = ".fetch.lock"
MAX_SECONDS, MAX_TRIES = 86_400, 1_000


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if all that was asked for is here."""
    catalog = read_catalog()
    options = _parser(list(catalog)).parse_args(argv)
    data = data_dir()
    if options.list or options.dataset is None:
        chosen = [_dataset(catalog, options.dataset)] if options.dataset else list(catalog.values())
        print("\n".join(listing(chosen, data)))
        return 0
    dataset = _dataset(catalog, options.dataset)
    scenes = [wanted_files(name, options.images) for name in _scenes(dataset, options.scenes)]
    mirror = _mirror(options.mirror or os.environ.get(MIRROR_VARIABLE))
    print(f"{dataset.title}: {dataset.page}\nlicence: {dataset.licence}\nplease cite: {dataset.citation}", flush=True)
    with storage_errors(data), progress("fetch") as report:
        _make_folder(data)

        def show(phase: str, done: int, total: int | None, note: str = "") -> None:
            report(phase, done, total, note or f"{readable_bytes(done)} of {readable_bytes(total or done)}")

        with hold(data / LOCK, f"fetching into {data}"):
            remove_temporaries(data / STAGING)
            patience = Patience(options.timeout, options.tries)
            fetcher = Fetcher(data, mirror, patience, options.accept_changes, show)
            for archive in dataset.archives:
                of_archive = [files for files in scenes if files.scene in archive.scenes]
                _fetch(fetcher, archive, of_archive, options.dry_run)
    return 0


def _make_folder(data: Path) -> None:
    try:
        data.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError, FileNotFoundError) as error:  # a file, or in /proc
        raise InputError(
            f"{data} cannot be the data folder ({error.strerror}): set {DATA_VARIABLE} to another"
        ) from error


def _fetch(fetcher: Fetcher, archive: Archive, scenes: Sequence[SceneFiles], dry_run: bool) -> None:
    """Fetch the scenes of one archive and print a line about each; those that are here ask nothing of the network."""
    unfinished = []
    for files in scenes:
        record = fetcher.record_if_here(files)
        if record is None:
            unfinished.append(files)
        else:
            print(f"{files.scene}: {describe(fetcher.data, files, record)}: is here, as fetched on {record.date}")
    if unfinished and dry_run:
        try:
            for plan in fetcher.plan(archive, unfinished):
                missing = readable_bytes(plan.missing_bytes)
                print(f"{plan.files.scene}: {readable_bytes(plan.bytes)}, of which {missing} are to be fetched")
        except RangesRefusedError:
            names = ", ".join(files.scene for files in unfinished)
            print(f"{names}: the server serves no ranges, so the whole archive comes")
    elif unfinished:
        for line in fetcher.fetch(archive, unfinished):
            print(line, flush=True)


def listing(datasets: Sequence[Dataset], data: Path) -> list[str]:
    """A line for each data set, archive and scene: where it comes from, how large it is, whether it is here."""
    lines = []
    records = read_records(data)
    for dataset in datasets:
        lines.append(f"{dataset.name}: {dataset.title}, {dataset.page}")
        for archive in dataset.archives:
            size = f"about {readable_bytes(archive.bytes)}" if archive.bytes else "size not known"
            lines.append(f"  {archive.url} (as a whole {size})")
            for scene in sorted(archive.scenes):
                files = wanted_files(scene)
                state = _state(data, files, records.get(files.key))
                lines.append(f"    {scene:<12}{', '.join(files.parts):<22}{state}")
    lines.append(
        f"data folder: {data} ({DATA_VARIABLE}); gsbench fetch DATASET --dry-run asks how large the scenes are"
    )
    return lines


def _state(data: Path, files: SceneFiles, record: SceneRecord | None) -> str:
    folder = data / files.folder
    if record is not None:
        here = sum((folder / name).is_file() for name in record.files)
        if here == len(record.files):
            return f"here, {readable_bytes(record.bytes)}, fetched on {record.date}"
        return f"{here} of {len(record.files)} files here, {readable_bytes(record.bytes)} in all"
    if all((folder / part).is_dir() for part in files.parts):
        return "here, not by fetch"
    return "partly fetched" if (data / STAGING / files.scene).is_dir() else "not here"


def _dataset(catalog: Mapping[str, Dataset], name: str) -> Dataset:
    if name in catalog:
        return catalog[name]
    for dataset in catalog.values():
        if name in dataset.scenes:
            raise InputError(f"{name} is a scene: gsbench fetch {dataset.name} {name}")
    raise InputError(f"no data set {name!r}{closest(name, list(catalog))} (there are: {', '.join(catalog)})")


def _scenes(dataset: Dataset, names: Sequence[str]) -> Sequence[str]:
    for name in names:
        if name not in dataset.scenes:
            raise InputError(
                f"{dataset.name} has no scene {name!r}{closest(name, list(dataset.scenes))} "
                f"(it has: {', '.join(dataset.scenes)})"
            )
    return list(dict.fromkeys(names)) or dataset.scenes


def _mirror(mirror: str | None) -> str | None:
    """The address or folder to fetch from instead of the published address; raises `InputError` for others."""
    if not mirror:
        return None
    with suppress(ValueError):  # an address such as http://[::1
        if urlsplit(mirror).hostname and mirror.startswith(("http://", "https://")):
            return mirror
    if is_path(mirror) and Path(mirror).expanduser().is_dir():
        return mirror
    raise InputError(f"--mirror {mirror} is neither an http(s) address nor a folder")


def _parser(names: Sequence[str]) -> ArgumentParser:
    parser = ArgumentParser(
        prog="gsbench fetch",
        description=f"Bring public scenes into the data folder (${DATA_VARIABLE}, else ./data), where scene=NAME finds "
        "them: only the wanted scenes and image folders out of the archives, where the server serves ranges. Stopped, "
        "the same command goes on.",
    )
    parser.add_argument("dataset", nargs="?", metavar="DATASET", help=", ".join(names))
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="the scenes wanted; none: all of the data set")
    parser.add_argument("--list", action="store_true", help="what there is, how large, and what is here")
    parser.add_argument("--dry-run", action="store_true", help="ask how large the scenes are; fetch nothing")
    parser.add_argument("--images", metavar="FOLDER", help="another image folder than the scene file's, such as images")
    parser.add_argument(
        "--mirror",
        metavar="PLACE",
        help=f"where the archives lie instead: the start of an address, or a folder with them (${MIRROR_VARIABLE})",
    )
    parser.add_argument(
        "--accept-changes", action="store_true", help="take files that differ from an earlier fetch's as the new record"
    )
    parser.add_argument("--timeout", type=_seconds, default=30.0, metavar="SECONDS", help="patience with silence (30)")
    parser.add_argument("--tries", type=_tries, default=5, help="tries of one file until it gives up (5)")
    return parser


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= MAX_SECONDS:
        raise argparse.ArgumentTypeError(f"must be a number of seconds above 0, up to {MAX_SECONDS:,}, got {text!r}")
    return value


def _tries(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= MAX_TRIES:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to {MAX_TRIES}, got {text!r}")
    return int(text)
