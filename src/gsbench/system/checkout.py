"""The state of a folder of code, as git knows it."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

SECONDS_FOR_GIT = 10
STARTS_NOTHING = ("core.fsmonitor=false", f"core.hooksPath={os.devnull}", "protocol.allow=never")


@dataclass(frozen=True)
class Checkout:
    """The commit of a checkout; ``edited``: whether files that git follows have changed since, None if unknown."""

    commit: str
    edited: bool | None


def checkout_of(folder: Path, holds: str | None = None) -> Checkout | None:
    """The checkout that a folder is in; None where there is none, or where git does not follow the file ``holds``."""
    if holds is not None and not _git(folder, "ls-files", "--", holds):
        return None
    commit = _git(folder, "rev-parse", "HEAD")
    if not commit:
        return None
    changes = None
    if not _has_filters(folder):
        changes = _git(folder, "status", "--porcelain", "--untracked-files=no", "--ignore-submodules=all")
    return Checkout(commit, None if changes is None else bool(changes))


@cache
def own_checkout() -> dict[str, Any]:
    """The commit of gsbench's own checkout, and whether files that git follows had changed; empty without one."""
    found = checkout_of(Path(__file__).parent, Path(__file__).name)
    return {} if found is None else {"commit": found.commit, "edited": found.edited}


def _has_filters(folder: Path) -> bool:
    """Return whether the repository itself names programs that git would run to compare files, or this cannot be told.

    A capture may come as a repository; what the user's own configuration names may run.
    """
    listed = _git(folder, "config", "--list", "--show-scope", "--name-only")
    if listed is None:
        return True
    return any(re.match(r"(local|worktree)\s+filter\.", line, re.I) for line in listed.splitlines())


def _git(folder: Path, *words: str) -> str | None:
    """Answer of git; None where there is no git, no repository, or no answer. It starts no other program."""
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
