"""The one place that changes a capture: steps from what was read to what a trial uses."""

import hashlib
import logging
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from gsbench.errors import InputError
from gsbench.files import file_sha256, require_regular
from gsbench.normalization import IDENTITY, find_normalization
from gsbench.parsing import text_of
from gsbench.scene.beside import DEPTH, check_masks, find_masks
from gsbench.scene.colmap_files import model_files, require_subfolder
from gsbench.scene.hold_out import SplitLists, hold_out, resolve, select_images
from gsbench.scene.images import check_picture_names
from gsbench.scene.options import (
    LISTS,
    SceneConfig,
    check_final_size,
    require_enough,
)
from gsbench.scene.readers import existing_folder, read_raw
from gsbench.scene.record import RawCapture, Role
from gsbench.scene.rules import inspect
from gsbench.scene.twins import copies_by_name, copies_of_test_views
from gsbench.scene.types import Capture

log = logging.getLogger(__name__)


def hold_out_views(raw: RawCapture, options: SceneConfig, lists: SplitLists) -> RawCapture:
    """Choose the photographs that are used, and give each its role."""
    names, by_name = raw.names, {row.name: row for row in raw.photographs}
    train, test = (resolve(wanted, names) for wanted in lists)
    if train is not None and test is not None:
        names = sorted({*train, *test})
    names = select_images(names, options.max_images)
    for_training, for_testing, description = hold_out(names, options, (train, test), by_name)
    roles: dict[str, Role] = dict.fromkeys(for_training, "train")
    roles |= dict.fromkeys(for_testing, "test")
    kept = [replace(by_name[name], role=roles[name]) for name in sorted(roles)]
    return replace(raw, photographs=tuple(kept), held_out=description)


def match_masks(raw: RawCapture, root: Path, masks: str | None) -> RawCapture:
    """Give each photograph its mask from the folder ``scene.masks``, and check all masks."""
    rows = raw.photographs
    if masks is not None:
        found = find_masks(require_subfolder(root, masks, "scene.masks"), raw.names)
        rows = tuple(replace(row, mask=found[row.name]) for row in rows)
    check_masks(rows)
    return replace(raw, photographs=rows)


def read_capture(options: SceneConfig) -> Capture:
    """The capture in the folder ``scene.path``, of a kind that needs no cameras written."""
    root = existing_folder(str(options.name), options.path)
    raw = read_raw(root, options)
    return prepare(raw, options, root, raw.model)


def prepare(raw: RawCapture, options: SceneConfig, root: Path, model: Path | None) -> Capture:
    """The capture that a trial uses, with its cameras in the COLMAP ``model``, if it has any.

    Paths of ``options`` start from ``root``. Raises InputError if fewer than three photographs are
    left, or a file, a list or a mask cannot be used.
    """
    has_own = any(row.role for row in raw.photographs)
    if has_own and options.split == "list" and not any(options.lists):
        lists: SplitLists = raw.named("train"), raw.named("test")
    else:
        if has_own and not options.by_lists:
            log.warning("%s has its own split: scene.split=list uses it", [*raw.files, root][0])
        lists = _read_lists(root, options)
    centers = raw.centers
    if centers is None and raw.has_cameras:
        centers = np.array([row.center for row in raw.photographs])
    accept = tuple(options.accept)
    oddities = inspect("read", raw.noted, str(raw.folder), accept)
    # of photographs of one name that differ in the extension, listed ones are kept
    wanted = set(chain.from_iterable(filter(None, lists)))
    raw = _without(raw, copies_by_name(raw.names, wanted))
    raw = hold_out_views(raw, options, lists)
    # trained on, a photograph with the content of a test view would measure memory
    copies = copies_of_test_views(raw.folder, raw.named("train"), raw.named("test"))
    raw = _without(raw, copies)
    which = "in the split lists" if options.by_lists else "left by the split"
    require_enough(len(raw.photographs), raw.folder, which)
    raw = match_masks(raw, root, options.masks)
    check_picture_names(raw.named("test"), raw.folder)
    for row in raw.photographs:
        check_final_size(row.size, options.max_size, str(row.file))
    oddities += inspect("capture", raw, str(raw.folder), accept)
    # Only the courtyard has exact poses, and its units fit the paper's threshold.
    exact = options.kind == "courtyard"
    masks = {row.name: row.mask for row in raw.photographs if row.mask is not None}
    beside: dict[str, dict[str, Path]] = defaultdict(dict)
    for row in raw.photographs:
        for kind, file in {**row.more, DEPTH: row.depth}.items():
            if file is not None:
                beside[kind][row.name] = file
    return Capture(
        name=str(options.name),
        images=raw.folder,
        image_names=tuple(raw.names),
        test_names=tuple(raw.named("test")),
        model=model,
        exact_poses=exact,
        fingerprint=fingerprint(
            raw.folder, raw.names, [] if model is None else model_files(model), masks
        ),
        held_out=raw.held_out,
        masks=masks,
        beside=beside,
        read_from=raw.files,
        left_out=raw.left_out,
        oddities=oddities,
        accept=accept,
        advised_normalization=(
            IDENTITY if exact or centers is None else find_normalization(centers)
        ),
    )


def fingerprint(
    folder: Path,
    names: Iterable[str],
    model_files: Iterable[Path] = (),
    masks: Mapping[str, Path] = {},
) -> str:
    """sha256 over names and contents of images, model files and masks, wherever they lie."""
    digest = hashlib.sha256()
    entries = [(f"image/{name}", folder / name) for name in sorted(names)]
    entries += [(f"model/{file.name}", file) for file in sorted(model_files)]
    entries += [(f"mask/{name}", file) for name, file in sorted(masks.items())]
    for label, file in entries:
        require_regular(file)
        try:
            content = file_sha256(file)
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from error
        digest.update(f"{label}\0{content}\n".encode())
    return digest.hexdigest()


def _without(raw: RawCapture, copies: Mapping[str, str]) -> RawCapture:
    """The capture without ``copies``, each mapped to the photograph that is used instead."""
    kept = tuple(row for row in raw.photographs if row.name not in copies)
    return replace(raw, photographs=kept, left_out={**raw.left_out, **copies})


def _read_lists(root: Path, options: SceneConfig) -> SplitLists:
    """The training and the test list; ``split=list`` without files reads those of nerfbaselines."""
    files = options.lists
    if options.split == "list" and not any(files):
        files = tuple(name if (root / name).is_file() else None for name in LISTS)
        if not any(files):
            raise InputError(
                f"scene.split=list: neither {' nor '.join(LISTS)} is in {root}: name the "
                "files with scene.train_list and scene.test_list"
            )
    keys = "scene.train_list", "scene.test_list"
    return tuple(_read_list(root, file, key) for file, key in zip(files, keys, strict=True))


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
