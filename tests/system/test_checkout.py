"""The state of a checkout."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from gsbench.system.install import checkout_of


def test_a_folder_that_the_repository_does_not_follow_is_no_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"GIT_CONFIG_GLOBAL": "/dev/null", "GIT_CONFIG_NOSYSTEM": "1", "HOME": str(tmp_path)}.items():
        monkeypatch.setenv(name, value)

    def git(*words: str) -> str:
        command = ["git", "-C", str(tmp_path), "-c", "user.name=x", "-c", "user.email=x@y", *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "-q")
    (tmp_path / "a.py").write_text("one")
    git("add", "a.py")
    git("commit", "-qm", "one")
    inner = tmp_path / ".venv" / "site-packages"
    inner.mkdir(parents=True)
    (inner / "b.py").touch()
    assert checkout_of(inner, "b.py") == {}
    commit = git("rev-parse", "HEAD")
    assert checkout_of(tmp_path, "a.py") == {"commit": commit, "edited": False}
    (tmp_path / "a.py").write_text("two")
    assert checkout_of(tmp_path, "a.py") == {"commit": commit, "edited": True}
