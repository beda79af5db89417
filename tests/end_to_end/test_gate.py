"""Real trainings of versions of a densifier: the gate's exit codes, and the commit of bisect."""

import shutil
import sys
from shlex import split

import pytest

from tests.end_to_end.conftest import SMALL, program
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


@pytest.fixture(scope="module")
def good(tmp_path_factory, environment):
    """The archive of the good version, and the runs folder with its trials."""
    home = tmp_path_factory.mktemp("good")
    write_class(home, 0, worse=False)
    for words in (["-m", *WORDS, "name=good", "seed=0,1,2"], ["export --results good"]):
        program(environment, home / "runs", *words, cwd=home)
    return home


@pytest.fixture(autouse=True)
def place(good, tmp_path):
    """A folder of the test with the archive and the good version's trials."""
    shutil.copytree(good / "runs", tmp_path / "runs", symlinks=True)
    shutil.copy(good / "good.zip", tmp_path)
    write_class(tmp_path, 0, worse=False)


def test_the_gate_passes_an_equal_version_and_stops_a_worse_one(gsbench, tmp_path):
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


def test_git_bisect_finds_the_commit_with_the_gate_and_skips_what_does_not_import(
    gsbench, tmp_path, plain_git, environment
):
    own = environment | {"GSBENCH_RUNS": str(tmp_path / "runs")}

    def git(*words, code=0):
        command = ["git", "-c", "user.name=x", "-c", "user.email=x@y", *words]
        return completed(command, code, cwd=tmp_path, env=own).stdout.strip()

    (tmp_path / ".gitignore").write_text("runs/\n*.zip\n")
    git("init", "-q", "-b", "main")
    for step in range(1, 6):
        write_class(tmp_path, step, worse=step >= 4)
        if step == 3:
            (tmp_path / "mine.py").write_text("import nothing_of_this_name\n")
        git("add", ".")
        git("commit", "-qm", f"Commit {step}")
    git("bisect", "start", "HEAD", "HEAD~4")
    command = [sys.executable, "-m", "gsbench", "gate", "good.zip", *WORDS, "--least", "0.2"]
    done = git("bisect", "run", *command, "--bisect", code=None)
    # the third commit cannot be tested, so that one or the fourth is the first bad one
    assert "only 'skip'ped commits left to test" in done
    assert all(git("log", "-1", "--format=%H", f"HEAD~{k}") in done for k in (0,))
