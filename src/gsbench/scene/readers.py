"""Readers: a folder on disk becomes a `Capture`."""

import hashlib
import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from gsbench.datasets.catalog import how_to_get
from gsbench.errors import InputError
from gsbench.files import require_regular
from gsbench.scene.colmap_files import model_files
from gsbench.scene.hold_out import Cameras, hold_out
from gsbench.scene.images import IMAGE_SUFFIXES
from gsbench.scene.masks import check_sizes, find_masks
from gsbench.scene.names import MAX_IMAGES, MIN_IMAGES, check_picture_names, match_names, select_images
from gsbench.scene.options import EVERY_NTH, TEST_LIST, TRAIN_LIST, SplitRule
from gsbench.scene.transforms import Transforms
from gsbench.scene.types import Capture
from gsbench.words import counted, some_of

log = logging.getLogger(__name__)

HEIC_SUFFIXES = frozenset({".heic", ".heif"})  # of telephones; neither Pillow nor COLMAP reads them
SPARSE_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")


def read_colmap(
    name: str,
    path: Path | str,
    images: str | None = None,
    sparse: str | None = None,
    max_images: int = MAX_IMAGES,
    split: SplitRule = EVERY_NTH,
    exact_poses: bool = False,
    masks: str | None = None,
) -> Capture:
    """Read a COLMAP folder: ``path/<images>`` (else "images") and ``path/<sparse>`` (else "sparse/0" or "sparse").

    The photos are those that the model has a pose for and that are in the folder; a file may have another extension
    than the model says. See `select_images` for which are kept and `SplitRule` for which are held out. ``masks`` is the
    folder of their masks below ``path`` (see `gsbench.scene.masks.find_masks`).

    Raises `InputError` if a folder is missing, the model is damaged, or fewer than three photos are usable.
    """
    from gsbench.scene.colmap import read_model, reference_cameras, registered_names  # photos alone need no pycolmap

    root = existing_folder(name, path)
    model_folder = _find_sparse(root, sparse)
    folder = _subfolder(root, images or "images", "scene.images")
    model = read_model(model_folder)
    wanted = registered_names(model)
    mask_folder, there = _beside_masks(root, folder, masks)
    matches = match_names(wanted, there)
    missing = [image for image in wanted if image not in matches]
    if missing:
        log.warning(
            "%s: %d of %d images of the model have no file: %s", folder, len(missing), len(wanted), some_of(missing)
        )
    _require_enough(len(matches), folder, f"that the model {model_folder} has a pose for")
    files = {file: image for image, file in matches.items()}
    return _capture(
        name, folder, sorted(matches.values()), model_folder, exact_poses, max_images, split, root,
        lambda names: reference_cameras(model, [files[file] for file in names]), mask_folder,
    )  # fmt: skip


def read_transforms(
    name: str,
    path: Path | str,
    said: Transforms,
    model: Path,
    max_images: int = MAX_IMAGES,
    split: SplitRule = EVERY_NTH,
    masks: str | None = None,
) -> Capture:
    """Read the photographs that ``transforms.json`` in ``path`` names, with the cameras in the COLMAP folder ``model``.

    ``said`` is what `gsbench.scene.transforms.read_transforms` reads of the file, ``model`` what
    `gsbench.scene.colmap.write_frames` makes of that. ``split=list`` takes the views of Blender's file of test views.
    ``masks`` is the folder of their masks. Raises InputError where the file names masks and no folder was given.
    """
    from gsbench.scene.colmap import read_model, reference_cameras

    root = existing_folder(name, path)
    names = list(said.frames)
    _require_enough(len(names), root, "that its transforms.json names are")
    if said.names_masks and masks is None:
        raise InputError(f"{said.files[0]}: mask_path is not read: give the folder of the masks as scene.masks")
    capture = _capture(
        name, root, names, model, False, max_images, split, root,
        lambda chosen: reference_cameras(read_model(model), chosen),
        None if masks is None else _subfolder(root, masks, "scene.masks"), said.split,
    )  # fmt: skip
    return replace(capture, read_from=said.sources)


def read_photos(
    name: str,
    path: Path | str,
    images: str | None = None,
    max_images: int = MAX_IMAGES,
    split: SplitRule = EVERY_NTH,
    masks: str | None = None,
) -> Capture:
    """Read bare photographs: all images in ``path/<images>``, or ``path/images`` if there is one, or ``path``.

    Sub-folders are read too, but for ``masks``, the folder of their masks below ``path``. Any COLMAP model beside them
    is left alone.

    Raises `InputError` if the folder is missing or holds fewer than three images.
    """
    root = existing_folder(name, path)
    if images is not None:
        folder = _subfolder(root, images, "scene.images")
    else:
        folder = root / "images" if (root / "images").is_dir() else root
    mask_folder, names = _beside_masks(root, folder, masks)
    _require_enough(len(names), folder, f"({', '.join(sorted(s[1:] for s in IMAGE_SUFFIXES))})")
    return _capture(name, folder, names, None, False, max_images, split, root, None, mask_folder)


def _beside_masks(root: Path, folder: Path, masks: str | None) -> tuple[Path | None, list[str]]:
    """The folder of masks, and the images in ``folder`` that are none."""
    if masks is None:
        return None, list_images(folder)
    home = _subfolder(root, masks, "scene.masks")
    if home.resolve() == folder.resolve():
        raise InputError(f"scene.masks: {home} is the folder of the images: put the masks into one of their own")
    return home, [name for name in list_images(folder) if not (folder / name).resolve().is_relative_to(home.resolve())]


def existing_folder(name: str, path: Path | str) -> Path:
    """The folder ``path`` of the scene ``name``; raises `InputError` where it is not set or there is none."""
    if path is None or str(path) == "":
        raise InputError(f"scene {name}: scene.path is not set: give the folder of the photos")
    root = Path(path).expanduser()
    if not root.is_dir():
        raise InputError(f"{missing_folder(name, root)}: {how_to_get([(name, root)])}")
    return root


def missing_folder(name: str, root: Path) -> str:
    """Explain that the folder ``root`` of the scene ``name`` is not there, and what to do about it."""
    return f"scene {name}: the folder {root} {'is a file' if root.exists() else 'does not exist'}"


def missing_model(name: str, root: Path, sparse: str | None) -> str:
    """The reason why the folder ``root`` of the scene ``name`` has no COLMAP model, "" where it has one."""
    try:
        _find_sparse(root, sparse)
    except InputError as error:
        return f"scene {name}: {error}"
    return ""


def list_images(folder: Path) -> list[str]:
    """The sorted image files in a folder and its sub-folders, relative, with "/" as separator; hidden ones left out.

    Links to folders are followed, and no folder is read twice.
    """
    names: list[str] = []
    unread = 0
    waiting, links, seen = [folder], list[Path](), set[tuple[int, int]]()
    while waiting or links:
        parent = waiting.pop() if waiting else links.pop(0)  # a folder goes by its own name rather than by a link's
        if (place := _identity(parent)) in seen:
            continue
        seen.add(place)
        for entry in sorted(_entries(parent), key=lambda entry: entry.name):
            if entry.name.startswith("."):
                continue
            if entry.is_dir():
                (links if entry.is_symlink() else waiting).append(Path(entry.path))
            elif Path(entry.name).suffix.lower() in IMAGE_SUFFIXES:
                names.append(Path(entry.path).relative_to(folder).as_posix())
            elif Path(entry.name).suffix.lower() in HEIC_SUFFIXES:
                unread += 1
    if unread:
        log.warning(
            "%s: %s not read: save as JPEG", folder, f"{counted(unread, 'HEIC file')} {'is' if unread == 1 else 'are'}"
        )
    return sorted(names)


def _identity(folder: Path) -> tuple[int, int]:
    found = folder.stat()
    return found.st_dev, found.st_ino


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except PermissionError:  # as if it were not there
        return []


def fingerprint(
    folder: Path,
    names: Iterable[str],
    model_files: Iterable[Path] = (),
    masks: Mapping[str, Path] = MappingProxyType({}),
) -> str:
    """sha256 over names and contents of the images, sorted, of the model's files and of ``masks`` by image.

    It is independent of where they lie.
    """
    digest = hashlib.sha256()
    entries = [(f"image/{name}", folder / name) for name in sorted(names)]
    entries += [(f"model/{file.name}", file) for file in sorted(model_files)]
    entries += [(f"mask/{name}", file) for name, file in sorted(masks.items())]
    for label, file in entries:
        require_regular(file)
        try:
            with file.open("rb") as stream:
                content = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from error
        digest.update(f"{label}\0{content}\n".encode())
    return digest.hexdigest()


def _capture(
    name: str,
    folder: Path,
    names: list[str],
    model: Path | None,
    exact_poses: bool,
    max_images: int,
    split: SplitRule,
    root: Path,
    cameras: Cameras | None = None,
    mask_folder: Path | None = None,
    own_split: tuple[list[str], list[str]] | None = None,
) -> Capture:
    lists = own_split if own_split and split.asks_the_capture else _read_lists(root, split)
    train, test = (None if wanted is None else _resolve(wanted, names, folder) for wanted in lists)
    if train is not None and test is not None:
        names = sorted({*train, *test})
    held_out = hold_out(select_images(names, max_images), split, (train, test), cameras)
    kept = tuple(sorted([*held_out.train, *held_out.test]))
    check_picture_names(held_out.test, folder)
    _require_enough(len(kept), folder, "in the split lists" if split.by_lists else "left by the split")
    masks = {} if mask_folder is None else find_masks(mask_folder, kept)
    check_sizes(folder, masks)
    return Capture(
        name=name,
        images=folder,
        image_names=kept,
        test_names=held_out.test,
        model=model,
        exact_poses=exact_poses,
        fingerprint=fingerprint(folder, kept, model_files(model) if model is not None else (), masks),
        held_out=held_out.description,
        masks=masks,
    )


def _resolve(wanted: Sequence[str], names: Sequence[str], folder: Path) -> list[str]:
    """The files that the names in a split list mean; their extension may be left out or differ."""
    matches = match_names(wanted, names)
    if unknown := [entry for entry in wanted if entry not in matches]:
        raise InputError(
            f"the split lists name {some_of(unknown)}, not among the usable images of {folder}: correct the lists"
        )
    return sorted(matches.values())


def _read_lists(root: Path, split: SplitRule) -> tuple[list[str] | None, list[str] | None]:
    """The training and the test list; ``split=list`` without names finds those that nerfbaselines writes."""
    train, test = split.train_list, split.test_list
    if split.split == "list" and train is None and test is None:
        train, test = (name if (root / name).is_file() else None for name in (TRAIN_LIST, TEST_LIST))
        if train is None and test is None:
            raise InputError(
                f"scene.split=list: neither {TRAIN_LIST} nor {TEST_LIST} is in {root}: name the files with "
                "scene.train_list and scene.test_list"
            )
    return _read_list(root, train, "scene.train_list"), _read_list(root, test, "scene.test_list")


def _read_list(root: Path, file: str | None, key: str) -> list[str] | None:
    if file is None:
        return None
    path = root / file  # an absolute path stays as it is
    require_regular(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{key}: {path} cannot be read ({reason}): name a text file of image names") from error
    return [line.strip() for line in lines if line.strip() and not line.startswith("#")]


def _subfolder(root: Path, folder: str, key: str) -> Path:
    found = root / folder
    if not found.is_dir():
        near = sorted(entry.name for entry in root.iterdir() if entry.is_dir())
        raise InputError(f"{found}: no such folder; set {key} to one of: {', '.join(near) or '(there is no folder)'}")
    return found


def _find_sparse(root: Path, sparse: str | None) -> Path:
    if sparse is not None:
        folder = root / sparse
        model_files(folder)
        return folder
    for candidate in SPARSE_FOLDERS:
        try:
            model_files(root / candidate)
        except InputError:
            continue
        return root / candidate
    raise InputError(f"{root}: no COLMAP model in {' or '.join(SPARSE_FOLDERS)}: set scene.sparse, or use scene=photos")


def _require_enough(count: int, folder: Path, which: str) -> None:
    if count < MIN_IMAGES:
        raise InputError(f"{folder}: {counted(count, 'image')} {which}, but at least {MIN_IMAGES} are needed")
