"""Random draws of a training: a stream for each purpose, and the order of the cameras."""

from __future__ import annotations

import numpy as np
import torch

STREAMS = ("cameras", "densify")  # every random draw of a training belongs to one


def generators(seed: int) -> dict[str, torch.Generator]:
    """A CPU generator for each of `STREAMS`; streams of all seeds are independent."""
    return {name: generator(seed, stream) for stream, name in enumerate(STREAMS)}


def generator(seed: int, stream: int) -> torch.Generator:
    """A CPU generator for one stream of a trial's randomness; streams of all seeds are independent."""
    state = np.random.SeedSequence([seed, stream]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


class CameraOrder:
    """Training views in random order without replacement, drawn anew when all were used."""

    def __init__(self, num_views: int, rng: torch.Generator) -> None:
        self.num_views = num_views
        self.rng = rng
        self.remaining: list[int] = []

    def next(self) -> int:
        if not self.remaining:
            self.remaining = torch.randperm(self.num_views, generator=self.rng).tolist()
        return self.remaining.pop()

    @property
    def following(self) -> int | None:
        """The camera that `next` will give, or None where that is not drawn yet."""
        return self.remaining[-1] if self.remaining else None
