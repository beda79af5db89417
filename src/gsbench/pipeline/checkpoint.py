"""Checkpoints of a training: written so that a kill at any moment leaves a readable one, and damage is noticed.

A checkpoint is what ``torch.save`` writes, which ``torch.load`` reads, and after it the sha256 of that.
"""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path
from typing import Any, BinaryIO, cast

import torch

from gsbench.files import CHUNK, atomic, sync_to_disk

log = logging.getLogger(__name__)

KEPT = 2  # the newest, and the one before in case the newest is damaged
PATTERN = "checkpoint-*.pt"
DIGEST_BYTES = hashlib.sha256().digest_size


def save_checkpoint(folder: Path, step: int, state: dict[str, Any]) -> None:
    """Write ``state`` (tensors and plain values) as the checkpoint of ``step``, then drop all but the last two."""
    path = folder / f"checkpoint-{step:08d}.pt"
    with atomic(path) as temporary, temporary.open("wb") as stream:
        writer = _HashingWriter(stream)
        torch.save(state, cast("BinaryIO", writer))  # it only writes and flushes
        stream.write(writer.digest.digest())
    sync_to_disk(folder)
    for old in sorted(folder.glob(PATTERN))[:-KEPT]:
        old.unlink()


def load_checkpoint(folder: Path, device: torch.device) -> dict[str, Any] | None:
    """The newest sound checkpoint, or None. A damaged one is named and removed; nothing in it is run as code."""
    for path in sorted(folder.glob(PATTERN), reverse=True):
        try:
            _check_digest(path)
            return torch.load(path, map_location=device, weights_only=True)
        except Exception as error:  # noqa: BLE001 - torch.load raises many kinds on damaged files
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            log.warning("checkpoint %s is damaged (%s) and is passed over", path, reason)
            path.unlink()
    return None


class _HashingWriter:
    """Passes bytes on to ``stream`` and keeps their sha256."""

    def __init__(self, stream: BinaryIO) -> None:
        self.stream = stream
        self.digest = hashlib.sha256()

    def write(self, data: bytes) -> int:
        self.digest.update(data)
        return self.stream.write(data)

    def flush(self) -> None:
        self.stream.flush()


def _check_digest(path: Path) -> None:
    """Raise ValueError unless the file ends with the sha256 of what is before."""
    remaining = path.stat().st_size - DIGEST_BYTES
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while remaining > 0:
            chunk = stream.read(min(CHUNK, remaining))
            if not chunk:
                break
            digest.update(chunk)
            remaining -= len(chunk)
        if remaining != 0 or stream.read() != digest.digest():
            raise ValueError("its checksum differs")
