"""Checkpoints of a training: written so that a kill at any moment leaves a readable one."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import torch

log = logging.getLogger(__name__)

KEPT = 2  # the newest, and the one before in case the newest is damaged
PATTERN = "checkpoint-*.pt"


def save_checkpoint(folder: Path, step: int, state: dict[str, Any]) -> None:
    """Write ``state`` (tensors and plain values) as the checkpoint of ``step``, then drop all but the last two."""
    path = folder / f"checkpoint-{step:08d}.pt"
    temporary = folder / f".{path.name}.tmp"
    with temporary.open("wb") as stream:
        torch.save(state, stream)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(temporary, path)
    for old in sorted(folder.glob(PATTERN))[:-KEPT]:
        old.unlink()


def load_checkpoint(folder: Path, device: torch.device) -> dict[str, Any] | None:
    """The newest readable checkpoint, or None. A damaged one is named and passed over; nothing in it is run as code."""
    for path in sorted(folder.glob(PATTERN), reverse=True):
        try:
            return torch.load(path, map_location=device, weights_only=True)
        except Exception as error:  # noqa: BLE001 - torch.load raises many kinds on damaged files
            log.warning("checkpoint %s is damaged (%s) and is passed over", path, str(error).splitlines()[0])
            path.unlink()
    return None


def remove_checkpoints(folder: Path) -> None:
    """Drop all checkpoints, when the training is finished."""
    for path in folder.glob(PATTERN):
        path.unlink()
