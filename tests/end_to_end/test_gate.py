"""Real trainings of versions of a densifier: the gate's exit codes, and the commit of bisect."""

import os
from shlex import split

import pytest

from tests.end_to_end.conftest import SMALL
from tests.helpers import write
from tests.processes import completed

pytestmark = pytest.mark.slow

CLASS = """\
from dataclasses import dataclass

import torch

from gsbench.densify import ADC

STEP = {step}  # each commit changes it


@dataclass
class Mine(ADC):
    def prune(self, refinement):
        super().prune(refinement)
        if {worse}:  # only the commit that is looked for, and later ones
            self.remove(refinement, torch.arange(len(refinement.gaussians)) % 2 == 0)
"""
WORDS = SMALL + split(
    "train.iterations=60 train.densify_start=10 train.densify_interval=10 train.densify_stop=55 "
    "init.count=800 scene.width=64 scene.height=48 eval.lpips=[] eval.flip=false tracking=none "
    "densify=adc densify.name=mine densify._target_=mine.Mine allow_targets=[mine] raster=cpu"
)


def write_class(folder, step, worse):
    (folder / "mine.py").write_text(CLASS.format(step=step, worse=worse))


def test_the_gate_passes_an_equal_version_and_stops_a_worse_one(gsbench, tmp_path):
    write_class(tmp_path, 0, worse=False)
    gsbench("-m", *WORDS, "name=good", "seed=0,1,2")
    gsbench("export --results good --out good.zip")
    same = gsbench("gate good.zip", *WORDS)
    assert "passed: equal to the last bit in all 2 pairs of trials" in same.stdout
    # in the same runs folder, with trials of another version
    write_class(tmp_path, 1, worse=True)
    worse = gsbench("gate good.zip", *WORDS, code=1)
    assert "worse in PSNR (dB) on this scene: −" in worse.stdout
    (tmp_path / "mine.py").write_text("raise RuntimeError('broken')\n")
    assert gsbench("gate good.zip", *WORDS, code=None).returncode in (1, 2)
    write_class(tmp_path, 0, worse=False)
    other = gsbench("gate good.zip", *WORDS, "train.iterations=61", code=2)
    assert "the arms differ in iterations" in other.stderr


def test_bisect_finds_the_commit_repeats_nothing_and_leaves_the_checkout_unchanged(
    gsbench, tmp_path, plain_git
):
    home = tmp_path / "own/densifiers"  # a folder within the repository
    home.mkdir(parents=True)

    def git(*words):
        command = ["git", "-C", home.parent, "-c", "user.name=x", "-c", "user.email=x@y", *words]
        return completed(command).stdout.strip()

    git("init", "-q", "-b", "main")
    for step in range(13):
        write_class(home, step, worse=step >= 7)
        git("add", ".")
        git("commit", "-qm", f"Commit {step}")
    ran = tmp_path / "ran"
    for hook in ("post-checkout", "reference-transaction"):
        file = home.parent / f".git/hooks/{hook}"
        write(file, f"#!/bin/sh\ntouch {ran}\n")
        file.chmod(0o755)
    write_class(home, 99, worse=False)  # an edit that was not committed

    def state():
        files = sorted(os.listdir(home.parent / ".git"))
        return git("status", "--porcelain"), git("worktree", "list"), files

    bisect = "bisect HEAD~12 HEAD", *WORDS, *split("--least 0.2 --seeds 3")
    before, done = state(), gsbench(*bisect, cwd=home, timeout=1500)
    found = git(*split("log -1 --format=%h --abbrev=10 HEAD~5"))
    assert f"It became worse with {found}" in done.stdout
    assert "Commit 7" in done.stdout.splitlines()[-1]
    # The last commit has a verdict of its own, and each step is compared with both ends.
    tried = done.stdout.count("; against the first: ")
    assert 0 < tried < 11
    assert done.stdout.count("; against the last: ") == tried
    assert done.stdout.count("not tried") == 12 - 1 - tried
    assert not ran.exists()
    assert state() == before
    again = gsbench(*bisect, cwd=home)  # nothing is trained
    assert (again.stdout, again.stderr) == (done.stdout, "")
