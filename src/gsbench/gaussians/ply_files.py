"""Read PLY files of other programs, and recognise formats of Gaussians that are not plain PLY."""

import codecs
import io
import re
from pathlib import Path

from plyfile import PlyData

MAX_HEADER = 1 << 16  # bytes
END = b"end_header"
NOT_ASCII = re.compile(rb"[^\x00-\x7f]")
# Formats that are not PLY, by the first bytes of a file. Sources: Niantic's repository "spz" (files
# are compressed by gzip until version 3, later they start with NGSP); PlayCanvas's page on SOG (a
# ZIP archive, or meta.json next to WebP images).
MAGIC = {b"\x1f\x8b": "SPZ", b"NGSP": "SPZ", b"PK\x03\x04": "SOG", b"{": "SOG"}
# the first two have no magic number
SUFFIXES = {".splat": "splat", ".ksplat": "ksplat", ".spz": "SPZ", ".sog": "SOG"}


def read_header(path: Path) -> bytes:
    """Return the header of a PLY without its last line.

    Raises ValueError if there is none; the message names other formats of Gaussians.
    """
    with path.open("rb") as stream:
        start = stream.read(MAX_HEADER)
    start = start.removeprefix(codecs.BOM_UTF8)
    if not start.startswith(b"ply"):
        found = SUFFIXES.get(path.suffix.lower()) or next(
            (MAGIC[key] for key in MAGIC if start.startswith(key)), None
        )
        if found is not None:
            raise ValueError(f"it is in the format {found}: {_how_to_unpack(path)}")
    header, end, _ = start.partition(END)
    if not end:
        raise ValueError("it has no header")
    if b"element chunk" in header and b"packed_position" in header:
        raise ValueError(f"it is a compressed PLY, as SuperSplat writes it: {_how_to_unpack(path)}")
    return header


def _how_to_unpack(path: Path) -> str:
    return f"unpack it with npx @playcanvas/splat-transform {path.name} out.ply"


def read_ply_data(path: Path) -> PlyData:
    """Return the content of a PLY file.

    Unlike plyfile, it accepts a byte order mark and comments with characters beyond ASCII. Raises
    ValueError as `read_header` does, and plyfile's errors.
    """
    header = read_header(path)
    with path.open("rb") as stream:
        marked = stream.read(len(codecs.BOM_UTF8)) == codecs.BOM_UTF8
    if header.isascii() and not marked:
        return PlyData.read(str(path))
    content = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    return PlyData.read(io.BytesIO(NOT_ASCII.sub(b"?", header) + content[len(header) :]))
