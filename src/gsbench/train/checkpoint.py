"""Checkpoints of a training. After a kill at any moment, a readable one remains.

A checkpoint file is the output of ``torch.save`` followed by its sha256, which reveals damage.
``torch.load`` ignores the sha256.
"""

import hashlib
import logging
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from gsbench.files import CHUNK, atomic, file_sha256, sync_to_disk

log = logging.getLogger(__name__)

KEPT = 2  # the newest, and the previous one in case the newest is damaged
PATTERN = "checkpoint-*.pt"
DIGEST_BYTES = hashlib.sha256().digest_size


def save_checkpoint(folder: Path, step: int, state: dict[str, Any]) -> None:
    """Write ``state`` (tensors, plain values) as the checkpoint of ``step``; keep the last two."""
    path = folder / f"checkpoint-{step:08d}.pt"
    with atomic(path) as temporary, temporary.open("wb") as stream:
        torch.save(state, stream)
        # In the same file, so that one rename publishes state and digest together.
        stream.flush()
        stream.write(bytes.fromhex(file_sha256(temporary)))
    sync_to_disk(folder)
    # Only now that the new one is on disk: a kill before this line leaves the earlier ones.
    for old in sorted(folder.glob(PATTERN))[:-KEPT]:
        old.unlink()


class CheckpointWriter:
    """Writes checkpoints into ``folder``; after `finish`, all of them are completely on disk.

    With ``background``, `save` copies the state to the CPU, and a thread writes and hashes it while
    training continues; the next `save` waits for the thread. Use it for models on a GPU. For a
    model on the CPU, the copy would take longer than the write, so `save` writes at once.
    """

    def __init__(self, folder: Path, background: bool) -> None:
        self.folder, self.background = folder, background
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="gsbench-checkpoint")
        self._pending: Future[None] | None = None

    def save(self, step: int, state: dict[str, Any]) -> None:
        """Save the state of ``step``. Raises the error of the previous save if it failed."""
        if not self.background:
            save_checkpoint(self.folder, step, state)
            return
        self.finish()
        self._pending = self._executor.submit(save_checkpoint, self.folder, step, to_host(state))

    def finish(self) -> None:
        """Wait until the last checkpoint is on disk. Raises its error if it failed."""
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def close(self) -> None:
        """Call `finish`, then end the thread."""
        try:
            self.finish()
        finally:
            self._executor.shutdown()


def to_host(state: Any) -> Any:
    """Copy nested ``state``, with every tensor in new memory on the CPU."""
    if isinstance(state, torch.Tensor):
        return state.detach().to("cpu", copy=True)
    if isinstance(state, dict):
        return {key: to_host(value) for key, value in state.items()}
    return [to_host(value) for value in state] if isinstance(state, list) else state


def load_checkpoint(folder: Path) -> dict[str, Any] | None:
    """Load the newest undamaged checkpoint, all tensors on the CPU; None if there is none.

    Damaged checkpoints are deleted with a warning. Loading a checkpoint runs no code from it.
    """
    for path in sorted(folder.glob(PATTERN), reverse=True):
        try:
            _check_digest(path)
            return torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # noqa: BLE001 - torch.load raises many kinds on damaged files
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            log.warning("checkpoint %s is damaged (%s) and is deleted", path, reason)
            path.unlink()
    return None


def _check_digest(path: Path) -> None:
    """Raise ValueError unless the last bytes of the file are the sha256 of the rest."""
    end = path.stat().st_size - DIGEST_BYTES
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while chunk := stream.read(min(CHUNK, max(end - stream.tell(), 0))):
            digest.update(chunk)
        if stream.read() != digest.digest():
            raise ValueError("its checksum differs")
