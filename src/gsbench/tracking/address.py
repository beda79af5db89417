"""Addresses of trackers that results may be sent to: those that are typed, not those that files name."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

VARIABLE = "MLFLOW_TRACKING_URI"


def untyped_address(options: Mapping[str, Any], typed: str | None = None) -> str | None:
    """The tracker's address that the settings ``tracking`` of a file name; None where it may be used.

    That is so where they name none, the one that was ``typed``, or that of the environment.
    """
    address = options.get("uri")
    if not options.get("enabled", True) or not address or address in (typed, os.environ.get(VARIABLE)):
        return None
    return str(address)
