"""Work trees of a stranger's repository: its programs do not run, its checkout does not change."""

from shlex import split

import pytest

from gsbench.errors import InputError
from gsbench.system.install import WorkTrees
from tests.helpers import refusal
from tests.processes import completed


@pytest.fixture
def git(plain_git, tmp_path):
    """git in the folder ``theirs``, which is a repository with three commits of a file."""
    folder = tmp_path / "theirs"
    (folder / "inner").mkdir(parents=True)

    def run(*words):
        command = [*split(f"git -C {folder} -c user.name=x -c user.email=x@y"), *words]
        return completed(command).stdout.strip()

    run("init", "-q", "-b", "main")
    (folder / ".gitattributes").write_text("*.py filter=theirs\n")
    for step in range(3):
        (folder / "inner" / "a.py").write_text(f"{step}\n")
        run("add", ".")
        run("commit", "-qm", f"Step {step}\tand \x1b[31mmore")
    return run


def trees(tmp_path, name="place"):
    (tmp_path / name).mkdir()
    return WorkTrees(tmp_path / "theirs" / "inner", tmp_path / name)


def test_commits_and_their_trees(tmp_path, git):
    found = trees(tmp_path)
    assert found.prefix == "inner/"
    commits = found.commits("HEAD~2", "main")
    assert [commit for commit, _, _ in commits] == git("rev-list", "--reverse", "main").splitlines()
    assert commits[1][2] == "Step 1\tand \x1b[31mmore"
    for step, (commit, _, _) in enumerate(commits):
        assert (found.tree(commit) / "inner" / "a.py").read_text() == f"{step}\n"
    assert found.tree(commits[0][0]) == found.tree(commits[0][0])
    assert git("worktree", "list").count("\n") == 0
    assert git("status", "--porcelain") == ""


def test_neither_hooks_nor_filters_of_the_repository_run(tmp_path, git):
    ran = tmp_path / "ran"
    program = tmp_path / "program"
    program.write_text(f"#!/bin/sh\ntouch {ran}\ncat\n")
    program.chmod(0o755)
    for key in (
        "filter.theirs.smudge",
        "filter.theirs.process",
        "core.fsmonitor",
        "core.sshCommand",
        "core.pager",
    ):
        git("config", key, str(program))
    git("config", "log.showSignature", "true")
    git("config", "gpg.program", str(program))
    git("config", "core.hooksPath", str(tmp_path / "hooks"))
    (tmp_path / "hooks").mkdir()
    for hook in ("post-checkout", "reference-transaction", "post-index-change"):
        (tmp_path / "hooks" / hook).symlink_to(program)
    ran.unlink(missing_ok=True)  # git, called by the test, may have run it
    found = trees(tmp_path)
    for commit, _, _ in found.commits("HEAD~2", "HEAD"):
        assert (found.tree(commit) / "inner" / "a.py").is_file()
    assert not ran.exists()


def test_wrong_and_reversed_commits_are_refused(tmp_path, git):
    found = trees(tmp_path)
    for first, last, message in (
        ("nosuch", "HEAD", "rev-parse"),
        ("HEAD", "--output=x", "rev-parse"),
        ("HEAD", "HEAD~1", "does not come after"),
        ("HEAD", "HEAD", "does not come after"),
        ("HEAD^{tree}", "HEAD", "rev-parse"),
    ):
        with pytest.raises(InputError, match=message):  # git's message has its own lines
            found.commits(first, last)
    (tmp_path / "empty").mkdir()
    with refusal(r"git rev-parse: .*not a git repository"):
        WorkTrees(tmp_path / "empty", tmp_path)


def test_git_variables_of_a_hook_are_ignored(tmp_path, git, monkeypatch):
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "nowhere"))  # as in a hook
    assert len(trees(tmp_path).commits("HEAD~1", "HEAD")) == 2
