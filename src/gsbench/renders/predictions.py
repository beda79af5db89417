"""Predictions of nerfbaselines: a folder, a .tar.gz, or the zip of a published result.

``color/`` has the renders and ``gt-color/`` the photographs, each as ``<name of the
photograph>.png``, beside ``info.json`` (`save_predictions` of nerfbaselines 1.2). A published zip
has them in ``predictions/``.
"""

import shutil
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import IO

from gsbench.errors import InputError
from gsbench.files import DAMAGE, GIT_LFS, LFS_REMEDY, is_safe_member, require_regular
from gsbench.words import readable_bytes

RENDERED, PHOTOGRAPHS = "color", "gt-color"
# Archives may come from strangers: this stops one that unpacks to far more than test views need.
MAX_TOTAL_BYTES = 20 << 30
PNG = ".png"


@contextmanager
def opened_renders(place: Path) -> Iterator[tuple[Path, Path | None]]:
    """Yield the folders of renders and, from nerfbaselines, of photographs; unpacks an archive.

    Raises InputError if ``place`` is neither a folder nor such an archive.
    """
    if place.is_dir():
        for home in (place, place / "predictions"):
            if all((home / folder).is_dir() for folder in (RENDERED, PHOTOGRAPHS)):
                yield home / RENDERED, home / PHOTOGRAPHS
                return
        yield place, None
        return
    if not place.exists():
        raise InputError(f"{place} is not a folder of renders")
    require_regular(place)
    with place.open("rb") as file:
        start = file.read(len(GIT_LFS))
    for first, kind in OTHERS.items():
        if start.startswith(first):
            raise InputError(f"{place} is {kind}")
    with tempfile.TemporaryDirectory(prefix="gsbench-") as scratch:
        try:
            _unpack(place, Path(scratch))
        except InputError:
            raise
        except DAMAGE as error:  # of a damaged, encrypted or foreign archive
            raise InputError(
                f"{place} cannot be unpacked ({error}): give a folder, a .zip or a .tar.gz"
            ) from None
        yield Path(scratch) / RENDERED, Path(scratch) / PHOTOGRAPHS


MODEL = "a model: gsbench scene=SCENE init=ply init.path=FILE train=none densify=none measures it"
PICTURE = "one picture: give its folder"
# By the first bytes of a file that is no archive: what it is, and what to do.
OTHERS = {GIT_LFS: LFS_REMEDY, b"ply": MODEL, b"\x89PNG": PICTURE, b"\xff\xd8": PICTURE}


def _unpack(archive: Path, scratch: Path) -> None:
    """Write the renders and photographs of an archive below ``scratch``, and no other member."""
    with ExitStack() as opened:
        # each file's size and what opens it, by its name
        files: dict[str, tuple[int, Callable[[], IO[bytes] | None]]]
        if zipfile.is_zipfile(archive):
            zipped = opened.enter_context(zipfile.ZipFile(archive))
            files = {
                member.filename: (member.file_size, partial(zipped.open, member))
                for member in zipped.infolist()
                if not member.is_dir()
            }
        else:
            tar = opened.enter_context(tarfile.open(archive))
            files = {
                member.name: (member.size, partial(tar.extractfile, member))
                for member in tar
                if member.isfile()
            }
        for name, place in _wanted(archive, {key: files[key][0] for key in files}).items():
            (scratch / place).parent.mkdir(parents=True, exist_ok=True)
            content = files[name][1]()
            assert content is not None  # of a regular file
            # At most the size that the archive says is unpacked, and a wrong size is an error.
            with content, (scratch / place).open("wb") as file:
                shutil.copyfileobj(content, file)


def _wanted(archive: Path, sizes: dict[str, int]) -> dict[str, Path]:
    """The members that are renders or photographs, with the places to write them to.

    Names are checked before the layout is looked at. Raises `InputError` for a picture whose name
    leads out of the archive, and unless one folder of the archive has both kinds of pictures.
    """
    homes: dict[Path, dict[str, Path]] = {}  # by the folder that has both: members and places
    for name in sizes:
        path = Path(name.removeprefix("./"))
        kind = next((part for part in path.parts if part in (RENDERED, PHOTOGRAPHS)), None)
        if kind is None or path.suffix != PNG:
            continue
        if not is_safe_member(name):
            raise InputError(f"{archive}: {name!r} leads out of the archive, or is no file's name")
        home = Path(*path.parts[: path.parts.index(kind)])
        homes.setdefault(home, {})[name] = path.relative_to(home)
    both = [own for own in homes.values() if len({place.parts[0] for place in own.values()}) == 2]
    if len(both) != 1:
        raise InputError(
            f"{archive} must have one folder with {RENDERED}/ and {PHOTOGRAPHS}/, as nerfbaselines "
            f"writes it, and has {len(both) or 'none'}"
        )
    total = sum(sizes[name] for name in both[0])
    if total > MAX_TOTAL_BYTES:
        raise InputError(
            f"{archive} unpacks to {readable_bytes(total)}, more than the limit of "
            f"{readable_bytes(MAX_TOTAL_BYTES)}"
        )
    return both[0]
