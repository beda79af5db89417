"""Checkpoints of a training: written so that a kill at any moment leaves a readable one, and damage is noticed.

A checkpoint is what ``torch.save`` writes, which ``torch.load`` reads, and after it the sha256 of that.
"""

import hashlib
import logging
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from gsbench.files import CHUNK, atomic, file_sha256, sync_to_disk

log = logging.getLogger(__name__)

KEPT = 2  # the newest, and the one before in case the newest is damaged
PATTERN = "checkpoint-*.pt"
DIGEST_BYTES = hashlib.sha256().digest_size


def save_checkpoint(folder: Path, step: int, state: dict[str, Any]) -> None:
    """Write ``state`` (tensors and plain values) as the checkpoint of ``step``, then drop all but the last two."""
    path = folder / f"checkpoint-{step:08d}.pt"
    with atomic(path) as temporary, temporary.open("wb") as stream:
        torch.save(state, stream)
        stream.flush()
        stream.write(bytes.fromhex(file_sha256(temporary)))
    sync_to_disk(folder)
    for old in sorted(folder.glob(PATTERN))[:-KEPT]:
        old.unlink()


class CheckpointWriter:
    """Writes checkpoints into ``folder``; the last that was handed over is whole on disk after `finish`.

    In the background, the state is copied to the host first, and a thread writes and hashes it while training goes on;
    a second waits for the first. That is for models on a GPU: where the model is in this machine's memory anyway,
    another copy would cost more than the wait.
    """

    def __init__(self, folder: Path, background: bool) -> None:
        self.folder = folder
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="gsbench-checkpoint") if background else None
        self._under_way: Future[None] | None = None

    def save(self, step: int, state: dict[str, Any]) -> None:
        """Hand over the state of ``step``. Raises what went wrong with the one before."""
        self.finish()
        if self._executor is None:
            save_checkpoint(self.folder, step, state)
        else:
            self._under_way = self._executor.submit(save_checkpoint, self.folder, step, to_host(state))

    def finish(self) -> None:
        """Wait until what was handed over is on disk, and raise what went wrong."""
        under_way, self._under_way = self._under_way, None
        if under_way is not None:
            under_way.result()

    def close(self) -> None:
        """Close the writer: `finish`, and end its thread."""
        try:
            self.finish()
        finally:
            if self._executor is not None:
                self._executor.shutdown()


def to_host(state: Any) -> Any:
    """A copy of nested ``state`` in which every tensor is in memory of its own on the CPU."""
    if isinstance(state, torch.Tensor):
        return state.detach().to("cpu", copy=True)
    if isinstance(state, dict):
        return {key: to_host(value) for key, value in state.items()}
    return [to_host(value) for value in state] if isinstance(state, list) else state


def load_checkpoint(folder: Path) -> dict[str, Any] | None:
    """The newest sound checkpoint, all tensors on the CPU, or None.

    A damaged one is named and removed; nothing in it is run as code.
    """
    for path in sorted(folder.glob(PATTERN), reverse=True):
        try:
            _check_digest(path)
            return torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # noqa: BLE001 - torch.load raises many kinds on damaged files
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            log.warning("checkpoint %s is damaged (%s) and is passed over", path, reason)
            path.unlink()
    return None


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
