"""Readers that turn a folder on disk into a `Capture`."""

import hashlib
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from types import MappingProxyType

from gsbench.datasets.catalog import how_to_get
from gsbench.errors import InputError
from gsbench.files import require_regular
from gsbench.normalization import find_normalization
from gsbench.parsing import text_of
from gsbench.scene.colmap_files import has_both_forms, model_files
from gsbench.scene.hold_out import CamerasByName, hold_out, select_images
from gsbench.scene.images import (
    IMAGE_SUFFIXES,
    check_picture_names,
    list_images,
    match_names,
    same_folder,
    stem_of,
)
from gsbench.scene.masks import find_masks
from gsbench.scene.model_folders import find_model, require_subfolder
from gsbench.scene.options import (
    EVERY_NTH,
    MAX_IMAGES,
    MIN_IMAGES,
    TEST_LIST,
    TRAIN_LIST,
    SplitRule,
)
from gsbench.scene.own_reader import PosedImages
from gsbench.scene.side_files import photographs_among
from gsbench.scene.transforms import Transforms
from gsbench.scene.twins import copies_by_name, copies_of_test_views, report_left_out
from gsbench.scene.types import Capture
from gsbench.words import counted, some_of

log = logging.getLogger(__name__)


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
    """Read a COLMAP folder: ``path/<images>`` ("images"), ``path/<sparse>`` ("sparse/0", "sparse").

    The photographs are the files in the folder that have a pose in the model; their extensions may
    differ from the model's names. `select_images` chooses the ones that are kept, `SplitRule` the
    ones that are held out. ``masks`` is the folder of the masks below ``path`` (see
    `gsbench.scene.masks.find_masks`).

    Raises `InputError` if a folder is missing, the model is damaged, or fewer than three
    photographs are usable.
    """
    # Photographs alone need no pycolmap.
    from gsbench.scene.colmap import camera_centers, read_model, reference_cameras, registered_names

    root = existing_folder(name, path)
    model_folder, others = find_model(root, sparse)
    if others:
        found = counted(len(others) + 1, "COLMAP model")
        why = f"is read because it has the most images ({', '.join(others)})"
        chosen = model_folder.relative_to(root)
        log.warning("%s has %s; %s %s; scene.sparse chooses another", root, found, chosen, why)
    folder = require_subfolder(root, images or "images", "scene.images")
    if has_both_forms(model_folder):
        log.warning("%s: the binary model is read, and not the text beside it", model_folder)
    model = read_model(model_folder)
    mask_folder, files = _masks_and_images(root, folder, masks)
    matches = _files_of_model(folder, files, registered_names(model), model_folder)
    _report_unused(folder, files, matches)
    model_names = {file: image for image, file in matches.items()}
    capture = _make_capture(
        name,
        folder,
        sorted(matches.values()),
        root=root,
        max_images=max_images,
        split=split,
        mask_folder=mask_folder,
        model=model_folder,
        exact_poses=exact_poses,
        cameras=lambda chosen: reference_cameras(model, [model_names[file] for file in chosen]),
    )
    # Only the courtyard has exact poses, and its units fit the paper's threshold without
    # normalisation.
    if exact_poses:
        return capture
    return replace(capture, advised_normalization=find_normalization(camera_centers(model)))


def _files_of_model(
    folder: Path, files: Sequence[str], wanted: Sequence[str], model: Path
) -> dict[str, str]:
    """The file of each image ``wanted`` by the ``model``; images without one are reported."""
    matches = match_names(wanted, files)
    if not matches:
        photographs = photographs_among(folder, files)
        matches = match_names(wanted, photographs, other_folders=True)
    if missing := [image for image in wanted if image not in matches]:
        share = f"{len(missing)} of {len(wanted)} images of the model"
        log.warning("%s: %s have no file: %s", folder, share, some_of(missing))
    _require_enough(
        len(matches),
        folder,
        f"that the model {model} has a pose for (it names {some_of(wanted)})",
        "set scene.images to the folder of the model's photographs",
    )
    if moved := [image for image, file in matches.items() if not same_folder(image, file)]:
        pairs = some_of([f"{image} ({matches[image]})" for image in moved])
        log.warning("%s: files found by the last part of their path: %s", folder, pairs)
    return matches


def _report_unused(folder: Path, files: Sequence[str], matches: Mapping[str, str]) -> None:
    """Log one line on photographs without a pose in the model."""
    used = {stem_of(file) for file in matches.values()}
    if any(stem_of(name) not in used for name in files):
        photographs = photographs_among(folder, files, report=False)
        if others := [name for name in photographs if stem_of(name) not in used]:
            share = f"{len(others)} of {len(others) + len(used)} photographs"
            log.warning("%s: %s have no pose in the model: %s", folder, share, some_of(others))


def read_transforms(
    name: str,
    path: Path | str,
    transforms: Transforms,
    model: Path,
    max_images: int = MAX_IMAGES,
    split: SplitRule = EVERY_NTH,
    masks: str | None = None,
) -> Capture:
    """Read the photographs that ``transforms.json`` names, with cameras of the COLMAP ``model``.

    ``transforms`` is the content of the file (`gsbench.scene.transforms.read_transforms`), and
    ``model`` was written from it (`gsbench.scene.colmap.write_frames`). ``split=list`` holds out
    the views of Blender's file of test views. ``masks`` is the folder of the masks. Raises
    InputError if the file names masks and no folder was given.
    """
    root = existing_folder(name, path)
    lacking = f", while {some_of(transforms.missing)} have no file" if transforms.missing else ""
    _require_enough(
        len(transforms.images),
        root,
        f"with a file and a camera in {transforms.files[0].name}{lacking}",
        transforms.remedy,
    )
    if transforms.has_mask_paths and masks is None:
        raise InputError(
            f"{transforms.files[0]}: mask_path is not read: give the folder of the masks as "
            "scene.masks"
        )
    posed = PosedImages(transforms.images, files=transforms.sources, split=transforms.split)
    return read_posed(name, root, posed, model, max_images, split, masks)


def read_posed(
    name: str,
    root: Path,
    posed: PosedImages,
    model: Path,
    max_images: int,
    split: SplitRule,
    masks: str | None,
) -> Capture:
    """Read the photographs ``posed`` below ``root``, whose cameras the COLMAP ``model`` has."""
    from gsbench.scene.colmap import read_model, reference_cameras

    names = list(posed.images)
    _require_enough(len(names), root, "with a camera")
    if posed.split is not None and not split.asks_the_capture and not split.by_lists:
        log.warning("%s has its own split: scene.split=list uses it", [*posed.files, root][0])
    capture = _make_capture(
        name,
        root,
        names,
        root=root,
        max_images=max_images,
        split=split,
        mask_folder=None if masks is None else require_subfolder(root, masks, "scene.masks"),
        model=model,
        cameras=lambda chosen: reference_cameras(read_model(model), chosen),
        own_split=posed.split,
    )
    centers = [-rotation.T @ translation for _, rotation, translation in posed.images.values()]
    return replace(
        capture, read_from=tuple(posed.files), advised_normalization=find_normalization(centers)
    )


def read_photos(
    name: str,
    path: Path | str,
    images: str | None = None,
    max_images: int = MAX_IMAGES,
    split: SplitRule = EVERY_NTH,
    masks: str | None = None,
) -> Capture:
    """Read bare photographs: all in ``path/<images>``, else ``path/images``, else ``path``.

    Sub-folders are read too, except ``masks``, the folder of the masks below ``path``, and files
    that are no photographs by their names (`photographs_among`). A COLMAP model beside the
    photographs is ignored.

    Raises `InputError` if the folder is missing or holds fewer than three images.
    """
    root = existing_folder(name, path)
    if images is not None:
        folder = require_subfolder(root, images, "scene.images")
    else:
        folder = root / "images" if (root / "images").is_dir() else root
    mask_folder, names = _masks_and_images(root, folder, masks)
    names = photographs_among(folder, names)
    formats = ", ".join(sorted(suffix[1:] for suffix in IMAGE_SUFFIXES))
    _require_enough(len(names), folder, f"({formats})")
    return _make_capture(
        name,
        folder,
        names,
        root=root,
        max_images=max_images,
        split=split,
        mask_folder=mask_folder,
    )


def _masks_and_images(root: Path, folder: Path, masks: str | None) -> tuple[Path | None, list[str]]:
    """The folder of the masks, if any, and the images in ``folder`` outside it."""
    if masks is None:
        return None, list_images(folder)
    mask_folder = require_subfolder(root, masks, "scene.masks")
    resolved = mask_folder.resolve()
    if resolved == folder.resolve():
        raise InputError(
            f"scene.masks: {mask_folder} is the folder of the images: put the masks into one of "
            "their own"
        )
    paths = {name: (folder / name).resolve() for name in list_images(folder)}
    return mask_folder, [name for name in paths if not paths[name].is_relative_to(resolved)]


def existing_folder(name: str, path: Path | str) -> Path:
    """The folder ``path`` of the scene ``name``; raises `InputError` if missing or not set."""
    if path is None or str(path) == "":
        raise InputError(f"scene {name}: scene.path is not set: give the folder of the photos")
    root = Path(path).expanduser()
    if not root.is_dir():
        raise InputError(f"{missing_folder(name, root)}: {how_to_get([(name, root)])}")
    return root


def missing_folder(name: str, root: Path) -> str:
    """The message that the folder ``root`` of the scene ``name`` does not exist."""
    return f"scene {name}: the folder {root} {'is a file' if root.exists() else 'does not exist'}"


def fingerprint(
    folder: Path,
    names: Iterable[str],
    model_files: Iterable[Path] = (),
    masks: Mapping[str, Path] = MappingProxyType({}),
) -> str:
    """sha256 over names and contents of images, model files and masks, wherever they lie."""
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


def _make_capture(
    name: str,
    folder: Path,
    names: list[str],
    *,
    root: Path,
    max_images: int,
    split: SplitRule,
    mask_folder: Path | None,
    model: Path | None = None,
    exact_poses: bool = False,
    cameras: CamerasByName | None = None,
    own_split: tuple[list[str], list[str]] | None = None,
) -> Capture:
    # Listed files are used first, so that no twin takes their place.
    lists = own_split if own_split and split.asks_the_capture else _read_lists(root, split)
    left_out = copies_by_name(names, set(chain.from_iterable(filter(None, lists))))
    report_left_out(folder, left_out, "of the same name")
    names = [name for name in names if name not in left_out]
    train, test = (_resolve(wanted, names, folder) for wanted in lists)
    if train is not None and test is not None:
        names = sorted({*train, *test})
    held_out = hold_out(select_images(names, max_images), split, (train, test), cameras)
    # A test view that is trained on under another name would measure memory.
    copies = copies_of_test_views(folder, held_out.train, held_out.test)
    report_left_out(folder, copies, "with the content of a test view")
    kept = tuple(sorted({*held_out.train, *held_out.test} - set(copies)))
    check_picture_names(held_out.test, folder)
    _require_enough(
        len(kept), folder, "in the split lists" if split.by_lists else "left by the split"
    )
    masks = {} if mask_folder is None else find_masks(mask_folder, folder, kept)
    files = [] if model is None else model_files(model)
    return Capture(
        name=name,
        images=folder,
        image_names=kept,
        test_names=held_out.test,
        model=model,
        exact_poses=exact_poses,
        fingerprint=fingerprint(folder, kept, files, masks),
        held_out=held_out.description,
        masks=masks,
        left_out=left_out | copies,
    )


def _resolve(wanted: Sequence[str] | None, names: Sequence[str], folder: Path) -> list[str] | None:
    """The image files that a split list names; extensions may be missing or differ."""
    if wanted is None:
        return None
    matches = match_names(wanted, names)
    if unknown := [name for name in wanted if name not in matches]:
        raise InputError(
            f"the split lists name {some_of(unknown)}, not among the usable images of {folder}: "
            "correct the lists"
        )
    return sorted(matches.values())


def _read_lists(root: Path, split: SplitRule) -> tuple[list[str] | None, list[str] | None]:
    """The training and the test list; ``split=list`` without files reads those of nerfbaselines."""
    train, test = split.train_list, split.test_list
    if split.split == "list" and train is None and test is None:
        train = TRAIN_LIST if (root / TRAIN_LIST).is_file() else None
        test = TEST_LIST if (root / TEST_LIST).is_file() else None
        if train is None and test is None:
            raise InputError(
                f"scene.split=list: neither {TRAIN_LIST} nor {TEST_LIST} is in {root}: name the "
                "files with scene.train_list and scene.test_list"
            )
    return _read_list(root, train, "scene.train_list"), _read_list(root, test, "scene.test_list")


def _read_list(root: Path, file: str | None, key: str) -> list[str] | None:
    if file is None:
        return None
    path = root / file  # an absolute path stays as it is
    require_regular(path)
    try:
        lines = text_of(path.read_bytes()).splitlines()
    except InputError as error:
        raise InputError(f"{key}: {path}: {error}") from error
    except OSError as error:
        raise InputError(
            f"{key}: {path} cannot be read ({error.strerror}): name a text file of image names"
        ) from error
    return [line.strip() for line in lines if line.strip() and not line.startswith("#")]


def _require_enough(count: int, folder: Path, which: str, remedy: str = "") -> None:
    if count < MIN_IMAGES:
        raise InputError(
            f"{folder}: {counted(count, 'image')} {which}, but at least {MIN_IMAGES} are needed"
            + (f": {remedy}" if remedy else "")
        )
