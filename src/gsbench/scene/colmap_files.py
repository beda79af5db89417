"""Finding COLMAP models in folders, and the files of each."""

import struct
from pathlib import Path

from gsbench.errors import InputError
from gsbench.parsing import without_byte_order_mark
from gsbench.words import counted

REQUIRED = ("cameras", "images", "points3D")
OPTIONAL = ("rigs", "frames")  # since COLMAP 3.12


def model_files(folder: Path) -> list[Path]:
    """The files of the model in ``folder``: the binary files if complete, else the text files.

    Raises `InputError` if neither set is complete.
    """
    lacking_by_suffix = {
        suffix: [
            f"{stem}{suffix}" for stem in REQUIRED if not (folder / f"{stem}{suffix}").is_file()
        ]
        for suffix in (".bin", ".txt")
    }
    suffix, lacking = min(lacking_by_suffix.items(), key=lambda item: len(item[1]))
    if not lacking:
        files = [folder / f"{stem}{suffix}" for stem in (*REQUIRED, *OPTIONAL)]
        return [file for file in files if file.is_file()]
    if len(lacking) < len(REQUIRED):
        hint = "; points3D.txt may be empty" if lacking == ["points3D.txt"] else ""
        raise InputError(
            f"{folder}: the COLMAP model is not complete: add {' and '.join(lacking)}{hint}"
        )
    raise InputError(
        f"{folder}: no COLMAP model here: expected cameras, images and points3D as .bin or .txt"
    )


def text_lines(file: Path) -> list[str]:
    """The lines of a model's text file, each without blanks around it, without comments."""
    lines = without_byte_order_mark(file.read_bytes()).decode().split("\n")
    return [line.strip() for line in lines if not line.lstrip().startswith("#")]


def count_images(folder: Path) -> int:
    """The number of posed images of the model in ``folder``; raises `InputError` if unreadable."""
    file = next(file for file in model_files(folder) if file.stem == "images")
    try:
        if file.suffix == ".txt":
            return len(image_lines(file))
        with file.open("rb") as stream:
            (count,) = struct.unpack("<Q", stream.read(8))
            return int(count)
    except (struct.error, ValueError, OSError) as error:
        raise InputError(
            f"{file}: its images cannot be counted: export it again, or set scene.sparse"
        ) from error


def image_lines(file: Path) -> list[tuple[str, str]]:
    """The two lines of each image of ``images.txt``: its numbers and name, and its 2D points."""
    lines = iter(text_lines(file))
    return [(line, next(lines, "")) for line in lines if line]


# the usual places, for messages; `find_model` searches numbered folders too
SPARSE_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")


def missing_model(name: str, root: Path, sparse: str | None) -> str:
    """The message that ``root`` of the scene ``name`` has no COLMAP model, or "" if it has one."""
    try:
        find_model(root, sparse)
    except InputError as error:
        return f"scene {name}: {error}"
    return ""


def require_subfolder(root: Path, folder: str, key: str) -> Path:
    """The folder below ``root`` that the setting ``key`` names; raises `InputError` without it."""
    path = root / folder
    if not path.is_dir():
        existing = sorted(
            entry.name
            for entry in root.iterdir()
            if entry.is_dir() and not _is_model(entry) and not _is_model(entry / "0")
        )
        raise InputError(
            f"{path}: no such folder; set {key} to one of: "
            f"{', '.join(existing) or '(there is no folder)'}"
        )
    return path


def find_model(root: Path, sparse: str | None) -> tuple[Path, list[str]]:
    """The folder of the COLMAP model, and the others found, each with its number of images.

    COLMAP writes a folder sparse/0, sparse/1, … for each part that it could not connect, in no
    order of size. The model with the most images is taken, and of equal ones the first.
    """
    if sparse is not None:
        model_files(root / sparse)
        return root / sparse, []
    for parent in (root / "sparse", root / "colmap" / "sparse"):
        numbered = [folder for folder in parent.glob("*") if folder.name.isdecimal()]
        ordered = [*sorted(numbered, key=lambda path: int(path.name)), parent]
        found = [folder for folder in ordered if _is_model(folder)]
        if found:
            # a single one is not counted: if it is damaged, it gets a better message later
            sizes = {path: count_images(path) if len(found) > 1 else 0 for path in found}
            largest = max(found, key=sizes.__getitem__)
            return largest, [
                f"{path.relative_to(root)}: {counted(sizes[path], 'image')}"
                for path in found
                if path != largest
            ]
    for folder in (root / name for name in SPARSE_FOLDERS):
        if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            model_files(folder)  # its error names what the model lacks
    raise InputError(
        f"{root}: no COLMAP model in {' or '.join(SPARSE_FOLDERS)}: {_where_a_model_is(root)}"
    )


def _where_a_model_is(root: Path) -> str:
    """The setting that finds a model near ``root``; without one, advice to make it."""
    folders = [root, *(place for pattern in ("*", "*/*", "*/*/*") for place in root.glob(pattern))]
    folders += [root.parent / name for name in SPARSE_FOLDERS]
    model = next((place for place in folders if place.is_dir() and _is_model(place)), None)
    if model is None:
        why = "a database holds no poses: " if any(root.glob("*.db")) else ""
        return f"{why}make one with COLMAP, or use scene=photos"
    base = next((place for place in model.parents if (place / "images").is_dir()), root)
    setting = f"path={base}" if base != root else f"sparse={model.relative_to(root)}"
    return f"{model} is one: set scene.{setting}"


def _is_model(folder: Path) -> bool:
    try:
        return bool(model_files(folder))
    except InputError:
        return False
