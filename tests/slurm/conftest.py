"""The environment of the program, as in the end-to-end tests."""

from tests.end_to_end.conftest import environment

__all__ = ["environment"]
