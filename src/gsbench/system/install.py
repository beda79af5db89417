"""Installation of gsbench: where it lies, the command that adds what is missing, and its code as git knows it."""

import json
import os
import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

from gsbench.errors import InputError

DISTRIBUTION = "gsbench-3dgs"  # on the package index, where plain "gsbench" is another project


def install_command(extra: str = "") -> str:
    """The shell command that installs gsbench with an extra such as ``view``, from where gsbench was installed."""
    wanted = f"[{extra}]" if extra else ""
    root = checkout()
    if root is None:
        return f"pip install '{installed_from() or DISTRIBUTION}{wanted}'"
    return f"pip install -e '{'.' if root == Path.cwd() else root}{wanted}'"


def installed_from() -> Path | None:
    """The folder that pip installed gsbench from, by pip's own record (PEP 610); None for a package index."""
    try:
        record = distribution(DISTRIBUTION).read_text("direct_url.json")
    except PackageNotFoundError:
        return None
    address = urlsplit(json.loads(record)["url"]) if record else urlsplit("")
    folder = Path(url2pathname(address.path))
    return folder if address.scheme == "file" and folder.is_dir() else None


def checkout() -> Path | None:
    """The folder of the source checkout from which gsbench runs; None where it was installed from a wheel."""
    root = Path(__file__).resolve().parents[3]
    return root if (root / "pyproject.toml").is_file() and (root / "src" / "gsbench").is_dir() else None


def conf_dir() -> Path:
    """The folder ``conf``: inside an installed wheel, else beside ``src`` of a checkout."""
    here = Path(__file__).resolve().parents[1]
    for candidate in (here / "conf", here.parents[1] / "conf"):
        if (candidate / "config.yaml").is_file():
            return candidate
    raise FileNotFoundError("gsbench's conf folder was not found; reinstall gsbench")


SECONDS_FOR_GIT = 10
SECONDS_FOR_A_TREE = 300
# Variables by which a hook of another repository, in which gsbench may run, names that repository.
OF_ANOTHER = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_PREFIX", "GIT_OBJECT_DIRECTORY", "GIT_COMMON_DIR")
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


class WorkTrees:
    """Work trees of commits of the repository that ``folder`` is in, made below the empty folder ``place``.

    They belong to a repository of their own that only borrows the objects: the user's checkout and its list of work
    trees stay as they are, and no hook, filter or other program runs that the repository's own configuration names.
    """

    def __init__(self, folder: Path, place: Path) -> None:
        self.prefix = run_git(folder, "rev-parse", "--show-prefix")  # of the folder, within the work tree
        self._folder, self._place = folder, place
        objects = run_git(folder, "rev-parse", "--path-format=absolute", "--git-path", "objects")
        run_git(place, "init", "--quiet", "--template=", "own")
        (place / "own" / ".git" / "objects" / "info").mkdir(parents=True, exist_ok=True)
        (place / "own" / ".git" / "objects" / "info" / "alternates").write_text(f"{objects}\n", encoding="utf-8")

    def commits(self, first: str, last: str) -> list[tuple[str, str, str]]:
        """(hash, date, subject) of the commit ``first`` and those up to ``last``, merges from the outside only.

        Raises InputError where one is none, and where the first does not come before the last.
        """
        names = [
            run_git(self._folder, "rev-parse", "--verify", "--end-of-options", f"{one}^{{commit}}")
            for one in (first, last)
        ]
        log = ("log", "--no-show-signature", "--no-color", "--format=%H%x09%cs%x09%s")
        found = run_git(self._folder, *log, "-1", names[0])
        between = f"{names[0]}..{names[1]}"
        later = run_git(self._folder, *log, "--first-parent", "--ancestry-path", "--reverse", between)
        if not later:
            raise InputError(f"{last} does not come after {first}: give the good commit first")
        parts = [[*line.split("\t", 2), "", ""] for line in (found, *later.split("\n"))]
        return [(commit, date, subject) for commit, date, subject, *_ in parts]

    def tree(self, commit: str) -> Path:
        """The work tree of a commit."""
        path = self._place / commit
        if not path.exists():
            run_git(self._place / "own", "worktree", "add", "--quiet", "--detach", str(path), commit)
        return path


def run_git(folder: Path, *words: str) -> str:
    """The answer of git; raises InputError with its words where it has none. It starts no other program."""
    try:
        return _answer(folder, words, SECONDS_FOR_A_TREE).stdout.strip()
    except OSError as error:
        raise InputError(f"git cannot be started ({error.strerror or error}): install it") from None
    except subprocess.TimeoutExpired:
        raise InputError(f"git {words[0]} took more than {SECONDS_FOR_A_TREE} s in {folder}") from None
    except subprocess.CalledProcessError as error:
        raise InputError(f"git {words[0]}: {(error.stderr or error.stdout).strip() or 'it failed'}") from None


def _git(folder: Path, *words: str) -> str | None:
    """Answer of git; None where there is no git, no repository, or no answer."""
    try:
        return _answer(folder, words, SECONDS_FOR_GIT).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def _answer(folder: Path, words: Sequence[str], seconds: float) -> subprocess.CompletedProcess[str]:
    """Run git in ``folder``; it starts no other program, and takes the repository from nowhere else."""
    here = {key: value for key, value in os.environ.items() if key not in OF_ANOTHER}
    return subprocess.run(
        ["git", *(word for setting in STARTS_NOTHING for word in ("-c", setting)), "-C", str(folder), *words],
        env=here | {"GIT_OPTIONAL_LOCKS": "0", "GIT_NO_LAZY_FETCH": "1"},  # look, and touch nothing
        capture_output=True,
        encoding="utf-8",
        errors="replace",  # a subject may be in any encoding
        timeout=seconds,
        check=True,
    )
