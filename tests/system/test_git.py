"""The facts of a checkout, which git finds without starting programs that the repository names."""

import os
import subprocess

import pytest

from gsbench.system.install import checkout_of
from tests.helpers import write
from tests.processes import completed

MARK = "#!/bin/sh\ntouch '{mark}'\ncat\n"


@pytest.fixture
def repository(plain_git, tmp_path, monkeypatch):
    """A repository with one commit as the current folder; ``run.sh`` beside it leaves a mark."""
    folder = tmp_path / "capture"
    folder.mkdir()
    monkeypatch.chdir(folder)
    (folder / "a.txt").write_text("one")
    git("init", "-q")
    git("-c", "user.name=x", "-c", "user.email=x@y", "add", ".")
    git("-c", "user.name=x", "-c", "user.email=x@y", "commit", "-qm", "one")
    (tmp_path / "run.sh").write_text(MARK.format(mark=tmp_path / "exploded"))
    (tmp_path / "run.sh").chmod(0o755)
    return folder


def git(*words):
    return completed(["git", *words]).stdout.strip()


def test_commit_and_changes_are_reported(repository):
    assert checkout_of(repository, "a.txt") == {"commit": git("rev-parse", "HEAD"), "edited": False}
    (repository / "a.txt").write_text("two")
    assert checkout_of(repository, "a.txt") == {"commit": git("rev-parse", "HEAD"), "edited": True}


def test_an_untracked_folder_is_no_checkout(repository):
    inner = repository / ".venv" / "site-packages"
    write(inner / "b.py", b"")
    assert checkout_of(inner, "b.py") == {}


@pytest.mark.parametrize(
    "setting", ["core.fsmonitor", "filter.x.clean", "filter.x.process", "Filter.y.CLEAN"]
)
def test_programs_in_a_repositorys_configuration_are_not_started(repository, tmp_path, setting):
    name = setting.split(".")[1]
    (repository / ".gitattributes").write_text(f"*.txt filter={name}\n")
    (repository / "a.txt").write_text("two")
    os.utime(repository / "a.txt", (1, 1))
    git("config", setting, str(tmp_path / "run.sh"))
    subprocess.run(["git", "status"], capture_output=True, check=False, timeout=60)
    assert (tmp_path / "exploded").exists()  # git alone would start it
    (tmp_path / "exploded").unlink()
    os.utime(repository / "a.txt", (2, 2))
    found = checkout_of(repository, "a.txt")
    assert found["commit"] == git("rev-parse", "HEAD")
    assert not (tmp_path / "exploded").exists()


def test_hooks_of_a_repository_are_not_started(repository, tmp_path):
    hook = repository / ".git" / "hooks" / "post-index-change"
    hook.write_text(MARK.format(mark=tmp_path / "exploded"))
    hook.chmod(0o755)
    os.utime(repository / "a.txt", (3, 3))
    checkout_of(repository, "a.txt")
    assert not (tmp_path / "exploded").exists()
