"""The environment of the program, as the end-to-end tests have it."""

from __future__ import annotations

from tests.end_to_end.conftest import environment

__all__ = ["environment"]
