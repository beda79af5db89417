"""Small results of a device on their way to the host, without making the host wait for the device."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor


class Readback:
    """The values of a small tensor, copied to the host behind the device's back.

    On a CUDA device the copy is put into the stream and the host goes on; ``values`` waits for it, which costs nothing
    once the device has come so far, for example an iteration later. On any other device the values are there at once.
    ``waits`` counts, over all of them, how often that was too early.
    """

    waits: ClassVar[int] = 0

    def __init__(self, source: Tensor) -> None:
        self._event: torch.cuda.Event | None = None
        source = source.detach()
        if source.device.type == "cuda":
            self._host = torch.empty(source.shape, dtype=source.dtype, pin_memory=True)
            self._host.copy_(source, non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(source.device))
        else:
            self._host = source.cpu()

    @property
    def arrived(self) -> bool:
        """Return whether ``values`` would not wait."""
        return self._event is None or self._event.query()

    def values(self) -> Tensor:
        """The values as a tensor on the CPU."""
        if not self.arrived:
            Readback.waits += 1
        if self._event is not None:
            self._event.synchronize()
            self._event = None
        return self._host
