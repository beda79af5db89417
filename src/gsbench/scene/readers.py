"""Readers of captures: from a folder on disk to one record of each photograph.

A capture of bare photographs has no list of its files, so the names of files and folders decide
which pictures are no photographs: masks, thumbnails, depth maps.
"""

import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path, PurePosixPath

from gsbench.datasets.catalog import how_to_get
from gsbench.errors import InputError
from gsbench.scene.colmap_files import find_model, require_subfolder
from gsbench.scene.images import list_images
from gsbench.scene.names import (
    FILES,
    IMAGE_SUFFIXES,
    match,
    match_anywhere,
    same_folder,
    stem_of,
)
from gsbench.scene.options import SceneConfig, require_enough
from gsbench.scene.record import Photograph, RawCapture, SceneReader, read_own
from gsbench.scene.rules import Finding
from gsbench.scene.transforms import read_transforms
from gsbench.words import counted, some_of

log = logging.getLogger(__name__)

Reader = Callable[[Path, SceneConfig], RawCapture]
DEPTH_WORDS = FILES["depth"]
# words in the names of folders and files that hold something else than photographs
WORDS = frozenset(word + ending for word in DEPTH_WORDS + FILES["others"] for ending in ("", "s"))
# a folder of this name may hold the photographs of a lens that is neither wide nor long
FOLDER_WORDS = WORDS - {"normal"}
THUMBNAIL = re.compile(r"SYNO(PHOTO|VIDEO|INDEX)_", re.IGNORECASE)  # files of Synology
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
PART = re.compile(r"[^\W\d_]+|\d+")  # of a file's name
PHOTOGRAPH = frozenset(FILES["own"])
FORMATS = frozenset(suffix[1:] for suffix in IMAGE_SUFFIXES)
SMALLER = re.compile(r"(.+?)[_-]([248])")  # images_4: copies a quarter as wide


def read_colmap(root: Path, options: SceneConfig) -> RawCapture:
    """Read a COLMAP folder: ``scene.images`` ("images"), ``scene.sparse`` ("sparse/0", "sparse").

    The photographs are the files in the folder that have a pose in the model; their extensions may
    differ from the model's names. Raises `InputError` if a folder is missing or the model damaged.
    """
    # Photographs alone need no pycolmap.
    from gsbench.scene.colmap import camera_centers, posed_by_name, read_model

    model_folder, others = find_model(root, options.sparse)
    if others:
        found = counted(len(others) + 1, "COLMAP model")
        why = f"is read because it has the most images ({', '.join(others)})"
        chosen = model_folder.relative_to(root)
        log.warning("%s has %s; %s %s; scene.sparse chooses another", root, found, chosen, why)
    folder = require_subfolder(root, options.images or "images", "scene.images")
    model = read_model(model_folder)
    files = _images_outside_masks(root, folder, options.masks)
    posed = posed_by_name(model)
    # In other folders there may be thumbnails with the names of photographs.
    matches = match(posed, files) or match_anywhere(posed, photographs_among(folder, files))
    require_enough(
        len(matches),
        folder,
        f"that the model {model_folder} has a pose for (it names {some_of(sorted(posed))})",
        "set scene.images to the folder of the model's photographs",
    )
    noted = {
        "no-file": sorted(posed.keys() - matches.keys()),
        "found-by-last-part": [
            f"{name} ({file})" for name, file in matches.items() if not same_folder(name, file)
        ],
        "no-pose": _without_pose(folder, files, matches.values()),
    }
    images = {file: image for image, file in matches.items()}
    return RawCapture(
        folder,
        tuple(Photograph(file, folder / file, *posed[images[file]]) for file in sorted(images)),
        model=model_folder,
        centers=camera_centers(model),
        noted={rule: [Finding(len(names), names)] for rule, names in noted.items()},
    )


def _without_pose(folder: Path, files: Sequence[str], matched: Iterable[str]) -> list[str]:
    """The photographs among ``files`` that no image of the model matched."""
    used = {stem_of(file) for file in matched}
    others = [name for name in files if stem_of(name) not in used]
    reasons = _reasons(folder, files) if others else {}
    return [name for name in others if name not in reasons]


def read_photos(root: Path, options: SceneConfig) -> RawCapture:
    """Read bare photographs: all in ``scene.images``, else in ``images``, else in the folder.

    Sub-folders are read too, except that of the masks and what is no photograph by its name
    (`photographs_among`). A COLMAP model beside the photographs is ignored.
    """
    if options.images is not None:
        folder = require_subfolder(root, options.images, "scene.images")
    else:
        folder = root / "images" if (root / "images").is_dir() else root
    names = photographs_among(folder, _images_outside_masks(root, folder, options.masks))
    require_enough(len(names), folder, f"({', '.join(sorted(FORMATS))})")
    return RawCapture(folder, tuple(Photograph(name, folder / name) for name in names))


READERS: Mapping[str, Reader] = {
    "colmap": read_colmap,
    "courtyard": read_colmap,  # of the folder that gsbench has made
    "photos": read_photos,
    "transforms": lambda root, options: read_transforms(root, options.transparent, options.images),
}


def read_raw(root: Path, options: SceneConfig, own: SceneReader | None = None) -> RawCapture:
    """The photographs in ``root`` by the reader of the scene's kind, or by a user's ``own``."""
    raw = read_own(own, root) if own else READERS[str(options.kind)](root, options)
    require_enough(len(raw.photographs), raw.folder, "with a camera")
    return companions_beside(raw, root)


def _images_outside_masks(root: Path, folder: Path, masks: str | None) -> list[str]:
    """The images in ``folder`` that are not in the folder of the masks."""
    if masks is None:
        return list_images(folder)
    resolved = require_subfolder(root, masks, "scene.masks").resolve()
    if resolved == folder.resolve():
        raise InputError(
            f"scene.masks: {root / masks} is the folder of the images: put the masks into one of "
            "their own"
        )
    names = list_images(folder)
    return [name for name in names if not (folder / name).resolve().is_relative_to(resolved)]


def existing_folder(name: str, path: Path | str | None) -> Path:
    """The folder ``path`` of the scene ``name``; raises `InputError` if it is missing."""
    root = Path(path or "").expanduser()
    if not root.is_dir():
        raise InputError(f"{missing_folder(name, root)}: {how_to_get([(name, root)])}")
    return root


def missing_folder(name: str, root: Path) -> str:
    """The message that the folder ``root`` of the scene ``name`` does not exist."""
    return f"scene {name}: the folder {root} {'is a file' if root.exists() else 'does not exist'}"


# ---- what is no photograph by its name


def photographs_among(folder: Path, names: Sequence[str]) -> list[str]:
    """The ``names`` of image files below ``folder`` that are photographs, in their order.

    One log line says which folders and files are left out. Raises InputError if none is left.
    """
    reasons = _reasons(folder, names)
    if reasons:
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
    for folder in sorted(root.iterdir()):
        words = {word.rstrip("s") for word in _words(folder.name) if word in FOLDER_WORDS}
        if not words or "mask" in words or not folder.is_dir() or folder == raw.folder:
            continue
        files = {
            path.relative_to(folder).with_suffix("").as_posix(): path
            for path in folder.rglob("*")
            if path.is_file()
        }
        with suppress(InputError):  # several files may be a photograph's
            for name, file in match_anywhere(rows, files).items():
                row, own = rows[name], files[file]
                if words.isdisjoint(DEPTH_WORDS) or row.depth is not None:
                    rows[name] = replace(row, more={**row.more, folder.name: own})
                else:
                    rows[name] = replace(row, depth=own)
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
