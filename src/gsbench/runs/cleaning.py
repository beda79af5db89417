"""Content of the store, references of trials to it, and removal of the rest (`gsbench clean`).

A trial's ``results.json`` and ``building.json`` name the keys of its results in the store, and
their manifests the keys of what they were made from. Keys are looked for as text, so that a damaged
record still protects what it names. Loads no torch.
"""

import re
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gsbench.errors import InputError
from gsbench.files import require_no_links
from gsbench.parsing import DamagedError, read_bytes
from gsbench.runs.layout import BUILDING, MANIFEST, RESULTS, STORE
from gsbench.runs.store import remove
from gsbench.system.locks import BusyError, hold

KEY = re.compile(rb"(?<![0-9a-f])[0-9a-f]{64}(?![0-9a-f])")
FOLDER = re.compile(r"\.?[0-9a-f]+(\.partial)?")


@dataclass(frozen=True)
class Stored:
    """A folder in the store, finished or not.

    ``size`` are its bytes, ``own`` those of files that no trial's folder shares by a hard link:
    removing the folder frees them. ``age`` is in seconds. ``needed`` says that a trial refers to
    it.
    """

    path: Path
    size: int
    own: int
    age: float
    needed: bool

    @property
    def stage(self) -> str:
        return self.path.parent.name


def stored(runs: Path, trials: Iterable[Path]) -> list[Stored]:
    """All folders in the store of ``runs``; those that the folders ``trials`` need are marked.

    Raises InputError for a link in place of the store.
    """
    places = list(_folders(runs))
    keys = {place: _key_of(place) for place in places}
    by_key: dict[str, list[Path]] = {}
    for place, key in keys.items():
        by_key.setdefault(key, []).append(place)
    wanted = set[str]()
    new = {key for trial in trials for key in _keys_in(trial / RESULTS, trial / BUILDING)}
    while new := (new & by_key.keys()) - wanted:
        wanted |= new
        new = {key for name in new for place in by_key[name] for key in _keys_in(place / MANIFEST)}
    now = time.time()
    return [_measured(place, now, keys[place] in wanted) for place in places]


def _folders(runs: Path) -> Iterator[Path]:
    store = runs / STORE
    require_no_links(runs, store)
    for stage in sorted(store.iterdir()) if store.is_dir() else ():
        if stage.is_dir() and not stage.is_symlink():
            for place in sorted(stage.iterdir()):
                if place.is_dir() and not place.is_symlink() and FOLDER.fullmatch(place.name):
                    yield place


def _key_of(place: Path) -> str:
    return place.name.removeprefix(".").removesuffix(".partial")


def _keys_in(*files: Path) -> set[str]:
    found = set[str]()
    for file in files:
        with suppress(FileNotFoundError, DamagedError):
            found |= {key.decode() for key in KEY.findall(read_bytes(file))}
    return found


def _measured(place: Path, now: float, needed: bool) -> Stored:
    """Sizes and age of a folder; its age is that of its newest file."""
    states = [place.lstat()]
    for path in place.rglob("*"):
        with suppress(FileNotFoundError):
            states.append(path.lstat())
    files = states[1:]
    own = sum(state.st_size for state in files if state.st_nlink == 1)
    newest = max(state.st_mtime for state in states)
    return Stored(place, sum(state.st_size for state in files), own, now - newest, needed)


def free(runs: Path, places: Collection[Stored]) -> list[Stored]:
    """Remove folders of the store; returns those that were removed, without those being built.

    Raises InputError if a folder is a link.
    """
    removed = []
    for one in places:
        if one.needed:
            raise InputError(f"{one.path} is needed by a finished trial: it stays")
        require_no_links(runs, one.path)
        lock = one.path.with_name(f".{_key_of(one.path)}.lock")
        with suppress(BusyError), hold(lock, one.path.name, wait=False):
            remove(one.path)
            removed.append(one)
    return removed
