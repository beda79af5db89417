"""The program, as in the end-to-end tests."""

from tests.end_to_end.conftest import environment, gsbench, start

__all__ = ["environment", "gsbench", "start"]
