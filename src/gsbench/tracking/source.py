"""Tags by which MLflow knows who started a trial, from which program and which state of the code."""

from __future__ import annotations

import getpass
from pathlib import Path

from gsbench.system.checkout import checkout_of


def user_tags() -> dict[str, str]:
    """The user's name, where the system has one."""
    try:
        return {"mlflow.user": getpass.getuser()}
    except (KeyError, OSError, ImportError):  # a container's nameless user; Windows
        return {}


def source_tags(program: str) -> dict[str, str]:
    """The name of the ``program``, and commit and dirty flag of the code: of the folder that it runs in, which holds a
    user's own classes and settings, or else of gsbench's checkout."""
    tags = {"mlflow.source.type": "LOCAL", "mlflow.source.name": program}
    for folder in (Path.cwd(), Path(__file__).resolve().parent):
        checkout = checkout_of(folder)
        if checkout is not None:
            dirty = {} if checkout.edited is None else {"mlflow.source.git.dirty": str(checkout.edited).lower()}
            return tags | {"mlflow.source.git.commit": checkout.commit} | dirty
    return tags
