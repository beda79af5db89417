"""Predictions of nerfbaselines: a folder, a .tar.gz, or the zip of a published result.

``color/`` has the renders and ``gt-color/`` the photographs, each as ``<name of the
photograph>.png``, beside ``info.json`` (`save_predictions` of nerfbaselines 1.2). A published zip
has them in ``predictions/``.
"""

import tarfile
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO

from gsbench.errors import InputError
from gsbench.files import require_regular
from gsbench.words import readable_bytes

RENDERED, PHOTOGRAPHS = "color", "gt-color"
# Archives may come from strangers: this stops one that unpacks to far more than test views need.
MAX_TOTAL_BYTES = 20 << 30
CHUNK = 1 << 20
# raised by the two libraries for damaged, encrypted or foreign archives
DAMAGE = (tarfile.TarError, zipfile.BadZipFile, EOFError, OSError, ValueError, RuntimeError)


@contextmanager
def opened_renders(place: Path) -> Iterator[tuple[Path, Path | None]]:
    """Yield the folders of renders and, from nerfbaselines, of photographs; unpacks an archive.

    Raises InputError if ``place`` is neither a folder nor such an archive.
    """
    if place.is_dir():
        for home in (place, place / "predictions"):
            if (home / PHOTOGRAPHS).is_dir():
                yield home / RENDERED, home / PHOTOGRAPHS
                return
        yield place, None
        return
    if not place.exists():
        raise InputError(f"{place} is not a folder of renders")
    require_regular(place)
    with tempfile.TemporaryDirectory(prefix="gsbench-") as scratch:
        try:
            _unpack(place, Path(scratch))
        except DAMAGE as error:
            raise InputError(
                f"{place} cannot be unpacked ({error}): give a folder, a .zip or a .tar.gz"
            ) from None
        yield Path(scratch) / RENDERED, Path(scratch) / PHOTOGRAPHS


def _unpack(archive: Path, scratch: Path) -> None:
    """Write the renders and photographs of an archive below ``scratch``, and no other member."""
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as packed:
            files = [member for member in packed.infolist() if not member.is_dir()]
            sizes = {member.filename: member.file_size for member in files}
            for name, target in _wanted(archive, sizes).items():
                with packed.open(name) as source:
                    _write(source, scratch / target, sizes[name])
    else:
        with tarfile.open(archive) as packed_tar:
            regular = [member for member in packed_tar if member.isfile()]
            members = {member.name.removeprefix("./"): member for member in regular}
            sizes = {name: member.size for name, member in members.items()}
            for name, target in _wanted(archive, sizes).items():
                content = packed_tar.extractfile(members[name])
                assert content is not None  # of a regular file
                with content:
                    _write(content, scratch / target, sizes[name])


def _wanted(archive: Path, sizes: dict[str, int]) -> dict[str, str]:
    """The members that are renders or photographs, with the places to write them to."""
    home = _home(archive, list(sizes))
    wanted = {}
    for name in sizes:
        if not name.startswith(home):
            continue
        inside = PurePosixPath(name.removeprefix(home))
        if inside.parts[:1] in ((RENDERED,), (PHOTOGRAPHS,)) and inside.suffix == ".png":
            # a name may lead out of the folder, by dots or, on Windows, by backslashes
            if ".." in inside.parts or "\\" in name:
                raise InputError(f"{archive}: {name!r} leads out of the archive")
            wanted[name] = str(inside)
    total = sum(sizes[name] for name in wanted)
    if total > MAX_TOTAL_BYTES:
        most = readable_bytes(MAX_TOTAL_BYTES)
        raise InputError(
            f"{archive} unpacks to {readable_bytes(total)}, more than the limit of {most}"
        )
    return wanted


def _home(archive: Path, names: Sequence[str]) -> str:
    """The folder in the archive that has both, with a slash at its end; "" for its top level."""
    both = sorted(_parents(names, RENDERED) & _parents(names, PHOTOGRAPHS))
    if len(both) != 1:
        raise InputError(
            f"{archive} must have one folder with {RENDERED}/ and {PHOTOGRAPHS}/, as nerfbaselines "
            f"writes it, and has {len(both) or 'none'}"
        )
    return both[0]


def _parents(names: Sequence[str], folder: str) -> set[str]:
    """The folders that contain a ``folder`` of this name, with a slash at their ends."""
    starts = (f"/{name}".partition(f"/{folder}/") for name in names)
    return {f"{start}/".lstrip("/") for start, found, _ in starts if found}


def _write(source: IO[bytes], target: Path, size: int) -> None:
    """Copy exactly ``size`` bytes; raises ValueError for a member with more or fewer."""
    target.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    with target.open("wb") as file:
        while piece := source.read(CHUNK):
            written += len(piece)
            # A small number in the directory of an archive may hide gigabytes.
            if written > size:
                break
            file.write(piece)
    if written != size:
        raise ValueError(f"{target.name} has another size than the archive says")
