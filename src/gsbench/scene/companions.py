"""Picture files beside photographs that are no photographs: masks, thumbnails, depth maps.

A capture of bare photographs has no list of its files, so the names of files and folders decide.
"""

import logging
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path, PurePosixPath

from gsbench.errors import InputError
from gsbench.scene.names import FILES, IMAGE_SUFFIXES, match_anywhere, stem_of
from gsbench.scene.record import RawCapture
from gsbench.words import counted

log = logging.getLogger(__name__)

DEPTH = FILES["depth"]
# words in the names of folders and files that hold something else than photographs
WORDS = frozenset(word + ending for word in DEPTH + FILES["others"] for ending in ("", "s"))
# a folder of this name may hold the photographs of a lens that is neither wide nor long
FOLDER_WORDS = WORDS - {"normal"}
THUMBNAIL = re.compile(r"SYNO(PHOTO|VIDEO|INDEX)_", re.IGNORECASE)  # files of Synology
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
PART = re.compile(r"[^\W\d_]+|\d+")  # of a file's name
PHOTOGRAPH = frozenset(FILES["own"])
FORMATS = frozenset(suffix[1:] for suffix in IMAGE_SUFFIXES)
SMALLER = re.compile(r"(.+?)[_-]([248])")  # images_4: copies a quarter as wide


def photographs_among(folder: Path, names: Sequence[str], report: bool = True) -> list[str]:
    """The ``names`` of image files below ``folder`` that are photographs, in their order.

    With ``report``, one log line says which folders and files are left out, and InputError is
    raised if none is left.
    """
    reasons = _reasons(folder, names)
    if reasons and report:
        counts = Counter(reasons.values())
        listed = ", ".join(f"{place} ({count})" for place, count in sorted(counts.items()))
        files = counted(len(reasons), "file")
        if len(reasons) == len(names):
            raise InputError(
                f"{folder}: by their names, all {files} are masks, thumbnails or the like: "
                f"{listed}: scene.images=FOLDER reads a folder"
            )
        way = "scene.images=FOLDER reads one folder alone"
        log.warning("%s: %s left out, no photographs: %s; %s", folder, files, listed, way)
    return [name for name in names if name not in reasons]


def companions_beside(raw: RawCapture, root: Path) -> RawCapture:
    """Give photographs the files of their names in folders beside theirs, such as ``depth``.

    A file of a folder of depth maps is the photograph's ``depth``, others are ``more`` by the
    folder's name. Folders of masks are read by ``scene.masks`` alone.
    """
    rows = {row.name: row for row in raw.photographs}
    stems = {stem_of(name): name for name in rows}
    for folder in sorted(root.iterdir()):
        words = {word.rstrip("s") for word in _words(folder.name) if word in FOLDER_WORDS}
        if not words or "mask" in words or not folder.is_dir() or folder == raw.folder:
            continue
        files = {
            path.relative_to(folder).with_suffix("").as_posix(): path
            for path in folder.rglob("*")
            if path.is_file()
        }
        try:
            found = match_anywhere(stems, files)
        except InputError:  # several files may be a photograph's
            continue
        for stem, file in found.items():
            row = rows[stems[stem]]
            if words.isdisjoint(DEPTH) or row.depth is not None:
                rows[row.name] = replace(row, more={**row.more, folder.name: files[file]})
            else:
                rows[row.name] = replace(row, depth=files[file])
    return replace(raw, photographs=tuple(rows.values()))


def _reasons(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Map each name that is no photograph to the folder or the kind of file that says so."""
    reasons: dict[str, str] = {}
    is_side = cache(_is_side_folder)
    for name in names:  # folders from the outermost inwards: a and a/b for a/b/c.png
        parents = reversed(PurePosixPath(name).parents[:-1])
        if side := next((parent for parent in parents if is_side(folder / parent)), None):
            reasons[name] = f"{side}/"
    return reasons | _companions([name for name in names if name not in reasons])


def _is_side_folder(folder: Path) -> bool:
    if folder.name.casefold() in FILES["systems"] or FOLDER_WORDS.intersection(_words(folder.name)):
        return True
    if found := SMALLER.fullmatch(folder.name):
        larger = [""]
        if {word.rstrip("s") for word in _words(found[1])} <= PHOTOGRAPH:  # else another camera
            larger += [f"{mark}{size}" for mark in "_-" for size in "248" if size < found[2]]
        if any((folder.parent / f"{found[1]}{ending}").is_dir() for ending in larger):
            return True
    return any((folder / name).is_dir() for name in FILES["workspaces"])


def _words(name: str) -> list[str]:
    return [word.lower() for word in WORD.findall(name)]


def _companions(names: Sequence[str]) -> dict[str, str]:
    """Files beside their photograph: ``a_mask.png`` or ``a.jpg.png`` for ``a.jpg``, thumbnails."""
    paths = {name: PurePosixPath(name) for name in names}
    parts = {name: PART.findall(PurePosixPath(stem_of(name)).name.lower()) for name in names}
    photographs = {
        (paths[name].parent, _rest(own)) for name, own in parts.items() if WORDS.isdisjoint(own)
    }
    found: dict[str, str] = {}
    for name, path in paths.items():
        own = parts[name]
        at = next((index for index, part in enumerate(own) if part in WORDS), None)
        if THUMBNAIL.match(path.name):
            found[name] = "SYNO….jpg"
        elif stem_of(name) in paths:
            found[name] = f"….*{path.suffix}"
        # The word may have a number of its own: Blender writes 0001_depth_0001.png.
        elif at is not None and any(
            rest and (path.parent, rest) in photographs for rest in (_rest(own), _rest(own[:at]))
        ):
            found[name] = f"…{own[at]}{path.suffix}"
    return found


def _rest(parts: Sequence[str]) -> tuple[str, ...]:
    """The parts of a name that a photograph and its companions have in common."""
    return tuple(part for part in parts if part not in WORDS | PHOTOGRAPH | FORMATS)
