"""``gsbench fetch``: download public scenes into the data folder."""

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

from gsbench.datasets.archive import STAGING, fetch_scene, missing_parts, open_archive_at
from gsbench.datasets.catalog import (
    DATA_VARIABLE,
    PublicDataset,
    data_dir,
    read_catalog,
    wanted_files,
)
from gsbench.downloads import RetryPolicy
from gsbench.errors import InputError
from gsbench.files import remove_temporaries, storage_errors
from gsbench.logs import progress
from gsbench.system.locks import hold
from gsbench.verbs.arguments import options_of
from gsbench.words import did_you_mean, is_path, readable_bytes

MIRROR_VARIABLE = "GSBENCH_MIRROR"
LOCK = ".fetch.lock"
PATIENCE = RetryPolicy()


def fetch(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if all requested scenes are here."""
    catalog = read_catalog()
    options = options_of("fetch", argv)
    data = data_dir()
    if options.list or options.dataset is None:
        chosen = [_dataset(catalog, options.dataset)] if options.dataset else list(catalog.values())
        print("\n".join(listing(chosen, data)))
        return 0
    dataset = _dataset(catalog, options.dataset)
    scenes = [wanted_files(name, options.images) for name in _scenes(dataset, options.scenes)]
    mirror = _mirror(options.mirror or os.environ.get(MIRROR_VARIABLE))
    print(
        f"{dataset.title}: {dataset.page}\nlicence: {dataset.licence}\nplease cite: "
        f"{dataset.citation}",
        flush=True,
    )
    _make_folder(data)
    with (
        storage_errors(data),
        progress("fetch") as report,
        hold(data / LOCK, f"fetching into {data}"),
    ):

        def say(phase: str, done: int, total: int | None, note: str = "") -> None:
            report(phase, done, total, f"{readable_bytes(done)} of {readable_bytes(total or done)}")

        remove_temporaries(data / STAGING)
        for archive in dataset.archives:
            unfinished = []
            for files in scenes:
                if files.scene not in archive.scenes:
                    continue
                if missing_parts(data, files):
                    unfinished.append(files)
                else:
                    parts = ", ".join(files.parts)
                    print(f"{files.scene}: is here, in {data / files.folder} ({parts})")
            if not unfinished:
                continue
            where = archive.url if mirror is None else f"{mirror.rstrip('/')}/{archive.name}"
            with open_archive_at(where, PATIENCE) as zipped:
                for files in unfinished:
                    folder = archive.scenes[files.scene]
                    line = fetch_scene(zipped, folder, where, data, files, PATIENCE, say)
                    print(f"{files.scene}: {line}", flush=True)
    return 0


def listing(datasets: Sequence[PublicDataset], data: Path) -> list[str]:
    """A line for each data set, archive and scene: where it comes from, and whether it is here."""
    lines = []
    for dataset in datasets:
        lines.append(f"{dataset.name}: {dataset.title}, {dataset.page}")
        for archive in dataset.archives:
            size = f" (as a whole {archive.size})" if archive.size else ""
            lines.append(f"  {archive.url}{size}")
            for scene in sorted(archive.scenes):
                files = wanted_files(scene)
                missing = missing_parts(data, files)
                state = f"{missing[0]} is missing" if missing else "here"
                if missing == files.parts:
                    state = "not here"
                lines.append(f"    {scene:<12}{', '.join(files.parts):<22}{state}")
    return [*lines, f"data folder: {data} ({DATA_VARIABLE})"]


def _make_folder(data: Path) -> None:
    try:
        data.mkdir(parents=True, exist_ok=True)
    # `data` is a file, or lies in /proc
    except (FileExistsError, NotADirectoryError, FileNotFoundError) as error:
        raise InputError(
            f"{data} cannot be the data folder ({error.strerror}): set {DATA_VARIABLE}"
        ) from error


def _dataset(catalog: Mapping[str, PublicDataset], name: str) -> PublicDataset:
    if name in catalog:
        return catalog[name]
    for dataset in catalog.values():
        if name in dataset.scenes:
            raise InputError(f"{name} is a scene: gsbench fetch {dataset.name} {name}")
    raise InputError(
        f"no data set {name!r}{did_you_mean(name, catalog)} (there are: {', '.join(catalog)})"
    )


def _scenes(dataset: PublicDataset, names: Sequence[str]) -> Sequence[str]:
    for name in names:
        if name not in dataset.scenes:
            raise InputError(
                f"{dataset.name} has no scene {name!r}{did_you_mean(name, dataset.scenes)} "
                f"(it has: {', '.join(dataset.scenes)})"
            )
    return list(dict.fromkeys(names)) or dataset.scenes


def _mirror(mirror: str | None) -> str | None:
    """The address or folder to fetch from instead of the published one.

    Raises InputError if it is neither.
    """
    if not mirror:
        return None
    with suppress(ValueError):  # urlsplit raises for an address such as http://[::1
        if urlsplit(mirror).hostname and mirror.startswith(("http://", "https://")):
            return mirror
    if is_path(mirror) and Path(mirror).expanduser().is_dir():
        return mirror
    raise InputError(f"--mirror {mirror} is neither an http(s) address nor a folder")
