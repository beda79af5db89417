"""Read PLY files of other programs, and recognise formats of Gaussians that are not plain PLY."""

import codecs
import io
import re
import zipfile
import zlib
from pathlib import Path

from plyfile import PlyData, PlyParseError

from gsbench.files import DAMAGE, GIT_LFS, LFS_REMEDY

MAX_HEADER = 1 << 16  # bytes
END = b"end_header"
NOT_ASCII = re.compile(rb"[^\x00-\x7f]")
# Formats that are not PLY, by the first bytes of a file. Sources: Niantic's repository "spz" (files
# are compressed by gzip until version 3, later they start with NGSP); PlayCanvas's page on SOG (a
# ZIP archive, or meta.json next to WebP images).
SPZ, SOG = "SPZ", "SOG"
# the first two have no magic number
SUFFIXES = {".splat": "splat", ".ksplat": "ksplat", ".spz": SPZ, ".sog": SOG}
GZIP, ZIP, PICKLE = b"\x1f\x8b", b"PK\x03\x04", b"\x80"
CHECKPOINT = "a checkpoint of PyTorch: give the PLY that its trainer wrote or exports"
CHECKPOINT_SUFFIXES = (".pth", ".pt", ".ckpt")


def read_header(path: Path) -> bytes:
    """Return the header of a PLY without its last line.

    Raises ValueError if there is none; the message names other formats of Gaussians.
    """
    with path.open("rb") as stream:
        start = stream.read(MAX_HEADER)
    start = start.removeprefix(codecs.BOM_UTF8)
    if not start.startswith(b"ply") and (kind := _other_format(path, start)):
        raise ValueError(f"it is {kind}")
    header, end, _ = start.partition(END)
    if not end:
        raise ValueError("it has no header")
    if b"element chunk" in header and b"packed_position" in header:
        raise ValueError(f"it is a compressed PLY, as SuperSplat writes it: {_how_to_unpack(path)}")
    return header


def recognised_format(path: Path) -> str:
    """Describe the file of a format that is no PLY, and what to do; else ""."""
    with path.open("rb") as stream:
        return _other_format(path, stream.read(MAX_HEADER))


def _other_format(path: Path, start: bytes) -> str:
    """Describe a file that is no PLY by its first bytes and its name, and what to do; else ""."""
    if start.startswith(GIT_LFS):
        return LFS_REMEDY
    suffix = path.suffix.lower()
    if suffix in CHECKPOINT_SUFFIXES or start.startswith(PICKLE):
        return CHECKPOINT
    packed = SUFFIXES.get(suffix, "")
    if start.startswith(ZIP) and not packed:
        names = _names_in_zip(path)
        if "data.pkl" in names:
            return CHECKPOINT
        if "meta.json" not in names:
            return "a ZIP archive: unpack it, and give the PLY in it"
        packed = SOG
    elif start.startswith(GZIP) and not packed:
        if _gunzipped(start).startswith(b"ply"):
            return f"a PLY compressed by gzip: gunzip {path.name}"
        packed = SPZ
    elif start.startswith(b"{") and not packed:
        if path.name != "meta.json" and b'"means"' not in start:
            return "JSON: give the PLY of a model"
        packed = SOG
    if start.startswith(b"NGSP"):
        packed = SPZ
    return f"in the format {packed}: {_how_to_unpack(path)}" if packed else ""


def _names_in_zip(path: Path) -> set[str]:
    """The names of the files in a ZIP archive, without their folders; none if it is damaged."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {name.rpartition("/")[2] for name in archive.namelist()}
    except DAMAGE:
        return set()


def _gunzipped(start: bytes) -> bytes:
    """The first bytes of gzip's data."""
    try:
        return zlib.decompressobj(wbits=31).decompress(start, 16)
    except zlib.error:
        return b""


def _how_to_unpack(path: Path) -> str:
    return f"unpack it with npx @playcanvas/splat-transform {path.name} out.ply"


def read_ply_data(path: Path) -> PlyData:
    """Return the content of a PLY file.

    Unlike plyfile, it accepts a byte order mark and comments with characters beyond ASCII. Raises
    ValueError as `read_header` does, and other errors of `gsbench.files.DAMAGE`.
    """
    header = read_header(path)
    with path.open("rb") as stream:
        marked = stream.read(len(codecs.BOM_UTF8)) == codecs.BOM_UTF8
    try:
        if header.isascii() and not marked:
            return PlyData.read(str(path))
        content = path.read_bytes().removeprefix(codecs.BOM_UTF8)
        return PlyData.read(io.BytesIO(NOT_ASCII.sub(b"?", header) + content[len(header) :]))
    except PlyParseError as error:
        raise ValueError(str(error)) from error
