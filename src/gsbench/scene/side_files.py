"""Picture files beside photographs that are no photographs: masks, thumbnails, smaller copies.

A capture of bare photographs has no list of its files, so their names and folders decide.
"""

import logging
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from gsbench.errors import InputError
from gsbench.scene.images import image_size, stem_of
from gsbench.words import counted

log = logging.getLogger(__name__)

# words in the names of folders and files that hold something else than photographs
WORDS = frozenset(
    word + ending
    for word in (
        *("mask", "thumb", "thumbnail", "preview", "depth", "depthmap", "disparity", "normal"),
        *("segmentation", "seg", "semantic", "matte", "render", "undistorted"),
    )
    for ending in ("", "s")
)
# a folder of this name may hold the photographs of a lens that is neither wide nor long
FOLDER_WORDS = WORDS - {"normal"}
# folders of file systems: Synology, QNAP, Windows, macOS, Linux
SYSTEM = frozenset({"@eadir", "#recycle", "@recycle", "$recycle.bin", "__macosx", "lost+found"})
THUMBNAIL = re.compile(r"SYNO(PHOTO|VIDEO|INDEX)_", re.IGNORECASE)  # files of Synology
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
REDUCED = re.compile(r"(.*?)[_-]?(2|4|8|16)")  # images_4: sides divided by 4
WORKSPACES = ("store", "stereo")  # sub-folders of gsbench's runs and of COLMAP's dense workspace


def photographs_among(folder: Path, names: Sequence[str]) -> list[str]:
    """The ``names`` of image files below ``folder`` that are photographs, in their order.

    One log line says which folders and files are left out. Raises InputError if none is left.
    """
    reasons = _reasons(folder, names)
    if not reasons:
        return list(names)
    counts = Counter(reasons.values())
    listed = ", ".join(f"{place} ({count})" for place, count in sorted(counts.items()))
    files = counted(len(reasons), "file")
    if len(reasons) == len(names):
        raise InputError(
            f"{folder}: by their names, all {files} are masks, thumbnails or the like: {listed}: "
            "scene.images=FOLDER reads a folder"
        )
    log.warning(
        "%s: %s left out, by name no photographs or smaller copies of them: %s; "
        "scene.images=FOLDER reads one folder alone",
        folder,
        files,
        listed,
    )
    return [name for name in names if name not in reasons]


def _reasons(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Map each name that is no photograph to the folder or the kind of file that says so."""
    reasons: dict[str, str] = {}
    verdicts: dict[str, bool] = {}
    for name in names:
        for parent in _parents(name):
            if parent not in verdicts:
                verdicts[parent] = _is_side_folder(folder / parent)
            if verdicts[parent]:
                reasons[name] = f"{parent}/"
                break
    left = [name for name in names if name not in reasons]
    reasons |= _companions(left)
    reasons |= _smaller_copies(folder, [name for name in left if name not in reasons])
    return reasons


def _parents(name: str) -> Iterator[str]:
    """The folders of a name from the outermost inwards: ``a`` and ``a/b`` for ``a/b/c.png``."""
    for parent in reversed(PurePosixPath(name).parents[:-1]):
        yield parent.as_posix()


def _is_side_folder(folder: Path) -> bool:
    if folder.name.casefold() in SYSTEM or FOLDER_WORDS.intersection(_words(folder.name)):
        return True
    return any((folder / name).is_dir() for name in WORKSPACES)


def _words(name: str) -> list[str]:
    return [word.lower() for word in WORD.findall(name)]


def _companions(names: Sequence[str]) -> dict[str, str]:
    """Files beside their photograph: ``a_mask.png`` or ``a.jpg.png`` for ``a.jpg``, thumbnails."""
    paths = {name: PurePosixPath(name) for name in names}
    stems = {stem_of(name).casefold() for name in names}
    found: dict[str, str] = {}
    for name, path in paths.items():
        stem = PurePosixPath(stem_of(name))
        words = re.split(r"[^A-Za-z]+", stem.name)
        word = next((word for word in (words[-1], words[0]) if word.lower() in WORDS), "")
        rest = re.sub(rf"^{word}[^A-Za-z0-9]|[^A-Za-z0-9]{word}$", "", stem.name)
        if THUMBNAIL.match(path.name):
            found[name] = "SYNO….jpg"
        elif word and rest != stem.name and str(stem.with_name(rest or "-")).casefold() in stems:
            found[name] = f"…{word.lower()}{path.suffix}"
        elif str(stem) in paths:
            found[name] = f"….*{path.suffix}"
    return found


def _smaller_copies(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Files in ``images_2``, ``images_4``, … if ``images``, or the larger of them, has them too."""
    files: dict[str, dict[str, str]] = defaultdict(dict)  # by folder, the names by stem
    for name in names:
        for parent in _parents(name):
            files[parent][stem_of(PurePosixPath(name).relative_to(parent).as_posix())] = name
    families: dict[str, list[tuple[int, str]]] = defaultdict(list)
    for place in files:
        if match := REDUCED.fullmatch(PurePosixPath(place).name):
            path = PurePosixPath(place)
            families[path.with_name(match[1] or path.name).as_posix()].append(
                (int(match[2]), place)
            )
    found: dict[str, str] = {}
    for original, reduced in families.items():
        ordered = [original] * (original in files) + [place for _, place in sorted(reduced)]
        for place in ordered[1:]:
            common = files[ordered[0]].keys() & files[place].keys()
            # Folders such as cam_2 and cam_4 of two cameras have photographs of one size.
            if common and _is_smaller(folder, files[place], files[ordered[0]], min(common)):
                found |= dict.fromkeys(files[place].values(), f"{place}/")
    return found


def _is_smaller(folder: Path, small: dict[str, str], large: dict[str, str], stem: str) -> bool:
    one, other = image_size(folder / small[stem]), image_size(folder / large[stem])
    return one[0] < other[0] and one[1] < other[1]
