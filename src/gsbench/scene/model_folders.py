"""Finding the folder of a COLMAP model in a capture."""

from pathlib import Path

from gsbench.errors import InputError
from gsbench.scene.colmap_files import count_images, model_files
from gsbench.words import counted

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
        if len(found) == 1:
            return found[0], []  # not counted: a damaged one gets a better message later
        if found:
            counts = {folder: count_images(folder) for folder in found}
            largest = max(found, key=counts.__getitem__)
            del counts[largest]
            return largest, [
                f"{path.relative_to(root)}: {counted(count, 'image')}"
                for path, count in counts.items()
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
