"""Install into the environment of this Python, in words for pip: by uv, which is ten times as quick, else by pip.

    python scripts/install.py -e . --group dev

uv reads none of pip's settings, so those that say where packages lie are handed on. Where uv cannot be had, or fails,
pip does the same. Neither compiles modules to byte code: Python does so for those that are used.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
CONSTRAINTS = ["-c", str(Path(__file__).resolve().parents[1] / "constraints.txt")]
# Settings of pip, and the variables by which uv takes the same.
HANDED_ON = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "cert": "SSL_CERT_FILE",
}


def main(words: list[str]) -> int:
    """Install what ``words`` name; returns the exit code of the last program that tried."""
    what = " ".join(words)
    uv = find_uv()
    if uv is not None:
        print(f"installing {what} by uv", flush=True)
        environment = {"UV_INDEX_STRATEGY": "unsafe-best-match"} | uv_settings() | dict(os.environ)  # as pip chooses
        command = [uv, "pip", "install", "--quiet", "--python", sys.executable, *CONSTRAINTS, *words]
        if subprocess.run(command, env=environment, check=False).returncode == 0:
            return 0
    print(f"installing {what} by pip, some minutes", flush=True)
    install = [*PIP, "install", "--quiet", "--no-compile"]
    subprocess.run([*install, "pip>=25.1"], check=False)  # the first that knows --group
    return subprocess.run([*install, *CONSTRAINTS, *words], check=False).returncode


def find_uv() -> str | None:
    """The program uv: on the PATH, or in this environment, into which pip can bring it; None where it cannot."""
    own = Path(sys.executable).with_name("uv")
    if found := shutil.which("uv") or shutil.which(own):
        return found
    subprocess.run([*PIP, "install", "--quiet", *CONSTRAINTS, "uv"], stderr=subprocess.DEVNULL, check=False)
    return shutil.which(own)


def uv_settings() -> dict[str, str]:
    """The variables for uv that say what pip's settings say; later lines of pip's list count."""
    listed = subprocess.run([*PIP, "config", "list"], capture_output=True, text=True, check=False).stdout
    found = {}
    for line in listed.splitlines():
        key, _, value = line.partition("=")
        name = HANDED_ON.get(key.rpartition(".")[2])
        if name is not None:
            found[name] = value.strip("'\"")
    return found


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
