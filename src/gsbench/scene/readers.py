"""Readers of captures: from a folder on disk to one record of each photograph."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from gsbench.datasets.catalog import how_to_get
from gsbench.errors import InputError
from gsbench.scene.colmap_files import find_model, require_subfolder
from gsbench.scene.companions import companions_beside, photographs_among
from gsbench.scene.images import list_images
from gsbench.scene.names import IMAGE_SUFFIXES, match, match_anywhere, same_folder, stem_of
from gsbench.scene.options import SceneConfig, require_enough
from gsbench.scene.record import Photograph, RawCapture, SceneReader, read_own
from gsbench.scene.rules import Finding
from gsbench.scene.transforms import read_transforms
from gsbench.words import counted, some_of

log = logging.getLogger(__name__)

Reader = Callable[[Path, SceneConfig], RawCapture]


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
    moved = [f"{name} ({file})" for name, file in matches.items() if not same_folder(name, file)]
    noted = {
        "no-file": sorted(posed.keys() - matches.keys()),
        "found-by-last-part": moved,
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
    kept = set(photographs_among(folder, files, report=False)) if others else set()
    return [name for name in others if name in kept]


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
    formats = ", ".join(sorted(suffix[1:] for suffix in IMAGE_SUFFIXES))
    require_enough(len(names), folder, f"({formats})")
    return RawCapture(folder, tuple(Photograph(name, folder / name) for name in names))


READERS: Mapping[str, Reader] = {
    "colmap": read_colmap,
    "courtyard": read_colmap,  # of the folder that gsbench has made
    "photos": read_photos,
    "transforms": lambda root, options: read_transforms(root, options.transparent, options.images),
}


def read_raw(root: Path, options: SceneConfig, own: SceneReader | None = None) -> RawCapture:
    """The photographs in ``root`` by the reader of the scene's kind, or by a user's ``own``."""
    readers = READERS if own is None else {"reader": lambda root, _: read_own(own, root)}
    raw = readers[str(options.kind)](root, options)
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
