"""Times in words."""

from __future__ import annotations

import pytest

from gsbench.words import readable_time


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.4, "0 s"),
        (89, "89 s"),
        (90, "2 min"),
        (89 * 60, "89 min"),
        (90 * 60, "1.5 h"),
        (35.9 * 3600, "35.9 h"),
        (36 * 3600, "1.5 days"),
    ],
)
def test_times_are_shown_in_a_readable_unit(seconds: float, text: str) -> None:
    assert readable_time(seconds) == text
