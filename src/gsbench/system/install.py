"""Installation of gsbench, and the command that adds to it what is missing."""

from __future__ import annotations

from pathlib import Path

DISTRIBUTION = "gsbench-3dgs"  # on the package index, where plain "gsbench" is another project


def install_command(extra: str = "") -> str:
    """The shell command that installs gsbench with an extra such as ``view``; from a checkout, that checkout."""
    wanted = f"[{extra}]" if extra else ""
    root = checkout()
    if root is None:
        return f"pip install '{DISTRIBUTION}{wanted}'"
    return f"pip install -e '{'.' if root == Path.cwd() else root}{wanted}'"


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
