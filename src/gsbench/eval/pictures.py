"""Measuring pictures that some program rendered against the photographs of their views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator
from gsbench.logs import Progress, no_progress
from gsbench.scene.images import image_size, read_image
from gsbench.scene.masks import read_mask


@dataclass(frozen=True)
class Pair:
    """A view with the files of its photograph and of what was rendered for it, and of its mask, if it has one."""

    view: str
    photograph: Path
    picture: Path
    mask: Path | None = None


def check_sizes(pairs: Sequence[Pair]) -> None:
    """Raise `InputError` for a picture of another size than its photograph: none is ever resized."""
    for pair in pairs:
        (width, height), (wanted_width, wanted_height) = image_size(pair.picture), image_size(pair.photograph)
        if (width, height) != (wanted_width, wanted_height):
            raise InputError(
                f"{pair.picture} is {width}x{height} px, but its photograph {pair.photograph} "
                f"{wanted_width}x{wanted_height}: sizes are never changed here, so render at the photographs' size"
            )


def measure(pairs: Sequence[Pair], evaluator: Evaluator, report: Progress = no_progress) -> dict[str, dict[str, float]]:
    """The metrics of every view, in the pairs' order. Raises `InputError` for damaged files and unequal sizes."""
    check_sizes(pairs)
    per_view = {}
    for done, pair in enumerate(pairs, 1):
        mask = None if pair.mask is None else read_mask(pair.mask)
        per_view[pair.view] = evaluator.evaluate_view(read_image(pair.picture), read_image(pair.photograph), mask)
        report("views", done, len(pairs))
    return per_view
