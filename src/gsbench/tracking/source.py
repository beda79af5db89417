"""Tags by which MLflow knows who started a trial, from which program and which state of the code."""

from __future__ import annotations

import getpass
import os
import re
import subprocess
from pathlib import Path

SECONDS_FOR_GIT = 10
STARTS_NOTHING = ("core.fsmonitor=false", f"core.hooksPath={os.devnull}", "protocol.allow=never")


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
        commit = _git(folder, "rev-parse", "HEAD")
        if commit:
            changes = None
            if not _has_filters(folder):
                changes = _git(folder, "status", "--porcelain", "--untracked-files=no", "--ignore-submodules=all")
            dirty = {} if changes is None else {"mlflow.source.git.dirty": "true" if changes else "false"}
            return tags | {"mlflow.source.git.commit": commit} | dirty
    return tags


def _has_filters(folder: Path) -> bool:
    """Whether the repository itself names programs that git would run to compare files, or this cannot be told.

    A capture may come as a repository; what the user's own configuration names may run.
    """
    listed = _git(folder, "config", "--list", "--show-scope", "--name-only")
    if listed is None:
        return True
    return any(re.match(r"(local|worktree)\s+filter\.", line, re.I) for line in listed.splitlines())


def _git(folder: Path, *words: str) -> str | None:
    """What git says; None where there is no git, no repository, or no answer. It starts no other program."""
    try:
        done = subprocess.run(
            ["git", *(word for setting in STARTS_NOTHING for word in ("-c", setting)), "-C", str(folder), *words],
            env=os.environ | {"GIT_OPTIONAL_LOCKS": "0", "GIT_NO_LAZY_FETCH": "1"},  # look, and touch nothing
            capture_output=True,
            text=True,
            timeout=SECONDS_FOR_GIT,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
