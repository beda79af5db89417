"""A ledger with real trainings: two ideas at once, a kill in the middle, and a user's class."""

import json
import signal
from functools import partial
from shlex import split

import pytest

from gsbench.claims.ledger import read_ledger
from tests.end_to_end.conftest import SMALL
from tests.processes import wait_until

pytestmark = pytest.mark.slow

TINY = SMALL + split(
    "train.iterations=60 train.densify_start=10 train.densify_interval=10 train.densify_stop=55 "
    "init.count=500 scene.width=48 scene.height=36 eval.lpips=[] eval.flip=false tracking=none "
    "raster=cpu"
)
NEW = [*split("ledger new night --metric psnr --least 0.1"), *TINY, "densify=adc"]
CLASS = """\
from gsbench.densify import ADC

class Idea(ADC):
    def grow_by_gradient(self, refinement):
        {body}
"""
OWN = split("densify._target_=mine.Idea densify.name=mine allow_targets=[mine]")


@pytest.fixture
def do(gsbench):
    return partial(gsbench, code=None)


def test_two_ideas_at_once_share_the_baseline(do, start, tmp_path):
    do(*NEW, "seed=0,1,2")
    words = (["densify=volumetric"], ["densify.split_size=0.1"])
    both = [start("ledger", "try", "night", *own) for own in words]
    ends = [process.communicate(timeout=300) for process in both]
    assert {process.returncode for process in both} <= {0, 1, 3}, ends
    ledger = read_ledger(tmp_path / "runs/night")
    assert len(ledger.questions) == 2
    seeds = {next(iter(one.seeds.values())) for one in ledger.tests.values()}
    assert len(seeds) == len(ledger.tests)
    baselines = (tmp_path / "runs/night").glob("courtyard/random-adc/*-seed0/results.json")
    assert len(list(baselines)) == 2  # that of the ledger, and that of the second idea


def test_a_killed_try_continues(do, start, tmp_path):
    do(*NEW, "seed=0,1,2")
    home = tmp_path / "runs/night"
    killed = start("ledger", "try", "night", "densify=volumetric")
    wait_until(lambda: list(home.glob("*/*/*/results.json")), 120)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    (idea,) = read_ledger(home).questions
    assert read_ledger(home).result(idea) == "begun"
    code = do("ledger try night", "densify=volumetric")
    assert code.returncode in (0, 1, 3)
    assert [*read_ledger(home).questions] == [idea]
    assert read_ledger(home).result(idea) not in ("begun", "failed")


def test_edited_code_is_another_idea_and_broken_code_does_not_count_as_tried(do, tmp_path):
    do(*NEW, "seed=0,1")
    results = []
    for body in ("raise RuntimeError('typing error')", "pass", "again = 1", "return None"):
        (tmp_path / "mine.py").write_text(CLASS.format(body=body))
        done = do("ledger try night", *OWN, "--json")
        results.append(json.loads(done.stdout))
    assert [one["result"] == "failed" for one in results] == [True, False, False, False]
    assert "typing error" in results[0]["reason"]
    assert [one["tried"] for one in results] == [0, 1, 2, 3]
    assert [one["idea"] for one in results] == split("mine mine-2 mine-3 mine-4")
