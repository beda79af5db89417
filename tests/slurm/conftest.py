"""The environment of the program, as in the end-to-end tests."""

from __future__ import annotations

from tests.end_to_end.conftest import environment

__all__ = ["environment"]
