"""Install into the environment of this Python by uv, ten times as quick as pip, else by pip.

    python scripts/install.py -e . --group dev

The arguments are those of ``pip install``. uv reads none of pip's settings, so those that say where
packages lie are passed to it. If uv cannot be installed, or fails, pip installs. Neither compiles
modules to byte code: Python does that for the modules that are used.

The environment needs no pip: uv brings it along, ten times as quick as ``venv`` does.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

OWN_PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
BASE = getattr(sys, "_base_executable", sys.executable)  # it made this environment
BASE_PIP = [BASE, *OWN_PIP[1:], "--python", sys.executable]
CONSTRAINTS = ["-c", str(Path(__file__).resolve().parents[1] / "constraints.txt")]
# Settings of pip, and the variables with the same meaning for uv.
PASSED_SETTINGS = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "cert": "SSL_CERT_FILE",
}


def main(words: list[str]) -> int:
    """Install the packages that ``words`` name; returns the exit code of the last program."""
    what, pip = " ".join(words), find_pip()
    uv = find_uv(pip)
    if uv is not None:
        print(f"installing {what} by uv", flush=True)
        # unsafe-best-match: like pip, the best version of all indexes, not only of the first that
        # has the package.
        strategy = {"UV_INDEX_STRATEGY": "unsafe-best-match"}
        environment = strategy | uv_settings(pip) | dict(os.environ)
        command = [
            uv,
            "pip",
            "install",
            "--quiet",
            "--python",
            sys.executable,
            *CONSTRAINTS,
            *([] if pip == OWN_PIP else ["pip"]),
            *words,
        ]
        if subprocess.run(command, env=environment, check=False).returncode == 0:
            return 0
    print(f"installing {what} by pip, some minutes", flush=True)
    install = ["install", "--quiet", "--no-compile"]
    # 25.1 is the first version with --group
    newer = subprocess.run([*pip, *install, "pip>=25.1"], check=False)
    if newer.returncode and pip != OWN_PIP:  # as without an index of packages
        make_pip()
    return subprocess.run([*OWN_PIP, *install, *CONSTRAINTS, *words], check=False).returncode


def find_pip() -> list[str]:
    """The command of a pip that installs here: this environment's, else its base's.

    If neither is there, this environment gets the one that Python brings along.
    """
    if importlib.util.find_spec("pip"):
        return OWN_PIP
    if subprocess.run([*BASE_PIP, "--version"], capture_output=True, check=False).returncode == 0:
        return BASE_PIP
    make_pip()
    return OWN_PIP


def make_pip() -> None:
    """Give this environment the pip that Python brings along."""
    subprocess.run([sys.executable, "-m", "ensurepip"], stdout=subprocess.DEVNULL, check=False)


def find_uv(pip: list[str]) -> str | None:
    """The program uv on the PATH or in this environment; None if pip cannot install it here."""
    own = Path(sys.executable).with_name("uv")
    if found := shutil.which("uv") or shutil.which(own):
        return found
    subprocess.run(
        [*pip, "install", "--quiet", *CONSTRAINTS, "uv"], stderr=subprocess.DEVNULL, check=False
    )
    return shutil.which(own)


def uv_settings(pip: list[str]) -> dict[str, str]:
    """The variables for uv with the values of pip's settings.

    If pip lists a setting twice, the later one counts.
    """
    listing = subprocess.run(
        [*pip, "config", "list"], capture_output=True, text=True, check=False
    ).stdout
    variables = {}
    for line in listing.splitlines():
        key, _, value = line.partition("=")
        name = PASSED_SETTINGS.get(key.rpartition(".")[2])
        if name is not None:
            variables[name] = value.strip("'\"")
    return variables


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
