"""Install into the environment of this Python by uv, ten times as quick as pip, else by pip.

    python scripts/install.py -e . --group dev

The arguments are those of ``pip install``. uv reads none of pip's settings, so those that say where
packages lie are passed to it. If uv cannot be installed, or fails, pip installs. Neither compiles
modules to byte code: Python does that for the modules that are used.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
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
    what = " ".join(words)
    uv = find_uv()
    if uv is not None:
        print(f"installing {what} by uv", flush=True)
        # unsafe-best-match: like pip, the best version of all indexes, not only of the first that
        # has the package.
        environment = {"UV_INDEX_STRATEGY": "unsafe-best-match"} | uv_settings() | dict(os.environ)
        command = [
            uv,
            "pip",
            "install",
            "--quiet",
            "--python",
            sys.executable,
            *CONSTRAINTS,
            *words,
        ]
        if subprocess.run(command, env=environment, check=False).returncode == 0:
            return 0
    print(f"installing {what} by pip, some minutes", flush=True)
    install = [*PIP, "install", "--quiet", "--no-compile"]
    subprocess.run([*install, "pip>=25.1"], check=False)  # 25.1 is the first version with --group
    return subprocess.run([*install, *CONSTRAINTS, *words], check=False).returncode


def find_uv() -> str | None:
    """The program uv on the PATH or in this environment; None if pip cannot install it here."""
    own = Path(sys.executable).with_name("uv")
    if found := shutil.which("uv") or shutil.which(own):
        return found
    subprocess.run(
        [*PIP, "install", "--quiet", *CONSTRAINTS, "uv"], stderr=subprocess.DEVNULL, check=False
    )
    return shutil.which(own)


def uv_settings() -> dict[str, str]:
    """The variables for uv with the values of pip's settings.

    If pip lists a setting twice, the later one counts.
    """
    listing = subprocess.run(
        [*PIP, "config", "list"], capture_output=True, text=True, check=False
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
