"""The sizes of images before and after they are made smaller. Loads nothing, so that settings can be checked by it."""

from __future__ import annotations

import math

from gsbench.errors import InputError

MIN_SIZE = 16  # px: the least side of an image that is worth training on


def downscaled_size(width: int, height: int, downscale: int = 1, max_size: int | None = None) -> tuple[int, int]:
    """The size after dividing by ``downscale`` and then, if need be, shrinking the longest side to ``max_size``.

    Sides are rounded half up, and never below 1; the size never grows.

    Examples:
        >>> downscaled_size(4946, 3286, downscale=4)
        (1237, 822)
        >>> downscaled_size(4946, 3286, max_size=1600)
        (1600, 1063)
    """
    if downscale < 1:
        raise InputError(f"scene.downscale must be at least 1, got {downscale}")
    if max_size is not None and max_size < 1:
        raise InputError(f"scene.max_size must be at least 1 px, got {max_size}")
    longest = max(width, height)
    # one fraction, so that the longest side comes out as exactly max_size
    numerator, denominator = (max_size, longest) if max_size and max_size * downscale < longest else (1, downscale)
    return tuple(max(1, math.floor(side * numerator / denominator + 0.5)) for side in (width, height))  # type: ignore[return-value]


def check_final_size(size: tuple[int, int], downscale: int, max_size: int | None, what: str) -> None:
    """Raise InputError where ``what``, of ``size`` (width, height) px, would be trained on with a side below 16 px."""
    width, height = downscaled_size(*size, downscale, max_size)
    if min(width, height) < MIN_SIZE:
        cause = f"scene.downscale={downscale}" + ("" if max_size is None else f" with scene.max_size={max_size}")
        raise InputError(
            f"{cause} leaves {width}x{height} px of {what} ({size[0]}x{size[1]} px): at least {MIN_SIZE} px are needed"
        )
