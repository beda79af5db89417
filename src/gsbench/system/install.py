"""The installation of gsbench: its folder, how to install extras, and its state in git."""

import importlib.util
import json
import os
import re
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

from gsbench.errors import InputError
from gsbench.system.programs import answer_of, safe_environment

DISTRIBUTION = "gsbench-3dgs"  # the name on the package index, where "gsbench" is another project


def install_command(extra: str = "") -> str:
    """The shell command that installs gsbench with an extra such as ``view``.

    It installs from the same place as gsbench itself: a checkout, a folder or the package index.
    """
    extras = f"[{extra}]" if extra else ""
    root = checkout()
    if root is None:
        return f"pip install '{installed_from() or DISTRIBUTION}{extras}'"
    return f"pip install -e '{'.' if root == Path.cwd() else root}{extras}'"


def require_package(name: str, extra: str, what: str) -> None:
    """Raise InputError if the package ``name``, which ``what`` needs, is not installed."""
    if importlib.util.find_spec(name) is None:
        raise InputError(f"{what} needs the package {name}: {install_command(extra)}")


def installed_from() -> Path | None:
    """The folder that pip installed gsbench from, by pip's record (PEP 610), or None."""
    try:
        record = distribution(DISTRIBUTION).read_text("direct_url.json")
    except PackageNotFoundError:
        return None
    address = urlsplit(json.loads(record)["url"]) if record else urlsplit("")
    folder = Path(url2pathname(address.path))
    return folder if address.scheme == "file" and folder.is_dir() else None


def checkout() -> Path | None:
    """The folder of the source checkout that gsbench runs from; None for an installed wheel."""
    root = Path(__file__).resolve().parents[3]
    return (
        root
        if (root / "pyproject.toml").is_file() and (root / "src" / "gsbench").is_dir()
        else None
    )


def version_of(package: str) -> str | None:
    """The version of an installed package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def conf_dir() -> Path:
    """The folder ``conf``: inside the package of a wheel, beside ``src`` in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parents[1] / "conf"


SECONDS_FOR_GIT = 10
# gsbench may run in a git hook, whose environment names the repository of the hook by these
# variables.
REPOSITORY_VARIABLES = (
    "GIT_DIR",
    "GIT_WORK_TREE",
    "GIT_INDEX_FILE",
    "GIT_PREFIX",
    "GIT_OBJECT_DIRECTORY",
    "GIT_COMMON_DIR",
)
# Settings with which git runs no program that a repository names: it may come from a stranger.
SAFE_SETTINGS = ("core.fsmonitor=false", f"core.hooksPath={os.devnull}", "protocol.allow=never")


def checkout_of(folder: Path, tracked: str) -> dict[str, Any]:
    """The ``commit`` of the checkout that contains ``folder``, and whether it is ``edited``.

    ``edited`` is None if that is unknown. Returns {} if there is no checkout, or if git does not
    track the file ``tracked``.
    """
    commit = _git(folder, "rev-parse", "HEAD") if _git(folder, "ls-files", "--", tracked) else None
    if not commit:
        return {}
    changes = None
    if not _has_filters(folder):
        changes = _git(
            folder, "status", "--porcelain", "--untracked-files=no", "--ignore-submodules=all"
        )
    return {"commit": commit, "edited": None if changes is None else bool(changes)}


@cache
def own_checkout() -> dict[str, Any]:
    """`checkout_of` for gsbench's own code; {} if it does not run from a checkout."""
    return checkout_of(Path(__file__).parent, Path(__file__).name)


def _has_filters(folder: Path) -> bool:
    """Return whether git may run programs (filters) of the repository to compare files.

    A capture from a stranger may be a repository. Filters of the user's own configuration do not
    count.
    """
    listed = _git(folder, "config", "--list", "--show-scope", "--name-only")
    if listed is None:
        return True
    return any(re.match(r"(local|worktree)\s+filter\.", line, re.I) for line in listed.splitlines())


def _git(folder: Path, *words: str) -> str | None:
    """The output of git in ``folder``; None if there is no git or no repository, or if it fails.

    git gets `SAFE_SETTINGS` and no `REPOSITORY_VARIABLES`.
    """
    environment = {
        key: value for key, value in safe_environment().items() if key not in REPOSITORY_VARIABLES
    }
    settings = (word for setting in SAFE_SETTINGS for word in ("-c", setting))
    # read only: no locks, no network
    environment |= {"GIT_OPTIONAL_LOCKS": "0", "GIT_NO_LAZY_FETCH": "1"}
    command = ["git", *settings, "-C", os.path.abspath(folder), *words]
    answer = answer_of(command, SECONDS_FOR_GIT, environment)
    return None if answer is None else answer.strip()
