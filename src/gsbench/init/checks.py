"""Checks of settings: one line that names the key, the value and what is allowed; and what `auto` threads are."""

from __future__ import annotations

import math
from collections.abc import Sequence

from gsbench.errors import InputError


def check_choice(key: str, value: object, allowed: Sequence[str]) -> None:
    """``value`` is one of ``allowed``, else ``InputError``."""
    if value not in allowed:
        raise InputError(f"init.{key}={value}: allowed are {', '.join(allowed)}")


def check_number(key: str, value: float, low: float, high: float = math.inf, exclusive: bool = False) -> None:
    """``value`` is a finite number in [low, high] (above ``low`` if ``exclusive``), else ``InputError``."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not is_number or value > high or value < low or (exclusive and value == low):
        above = "above" if exclusive else "at least"
        limit = f" and at most {high:g}" if math.isfinite(high) else ""
        raise InputError(f"init.{key}={value}: must be a number {above} {low:g}{limit}")


def check_integer(key: str, value: int, low: int, high: float = math.inf) -> None:
    """``value`` is a whole number in [low, high], else ``InputError``."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise InputError(f"init.{key}={value}: must be a whole number")
    check_number(key, value, low, high)
