"""The program with a full disk, with a read-only folder, and with a trial that raises."""

import subprocess
from shlex import split

import pytest

from tests.end_to_end.conftest import SMALL, SWEEP, results_of
from tests.helpers import read_json, write

pytestmark = pytest.mark.slow


def test_a_full_disk_ends_the_sweep_in_one_line_and_it_continues_with_more_space(
    gsbench, undisturbed, small_disk
):
    sweep = [word for word in SWEEP if word not in ("-m", "densify=adc,volumetric")]
    done = gsbench("-m", *sweep, "densify=adc", "seed=0,1", code=1, GSBENCH_RUNS=str(small_disk))
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.strip().splitlines() if line.startswith("gsbench:")]
    assert lines == [
        f"gsbench: the disk of {small_disk} is full: free some space, then give the same command "
        "again: it continues"
    ]
    subprocess.run(split(f"mount -o remount,size=200m {small_disk}"), check=True)
    done = gsbench(*sweep, "densify=adc", GSBENCH_RUNS=str(small_disk))
    ((name, results),) = results_of(small_disk, "attacked").items()
    assert results == undisturbed[name]


def test_a_failed_trial_does_not_stop_the_others_and_retry_completes_it(gsbench, tmp_path):
    """One densifier is a user's class that fails while a file is absent."""
    (tmp_path / "mine.py").write_text(
        "from dataclasses import dataclass\nfrom pathlib import Path\nfrom gsbench.densify import "
        "ADC\n\n\n@dataclass\nclass Mine(ADC):\n    def begin(self, gaussians, context):\n        "
        "if not Path('mended').exists():\n            raise RuntimeError('not yet')\n        "
        "super().begin(gaussians, context)\n"
    )
    write(
        tmp_path / "conf/densify/mine.yaml",
        "defaults: [adc, _self_]\n_target_: mine.Mine\nname: mine\n",
    )
    own = "name=own densify=mine,adc allow_targets=[mine] tracking=none train.iterations=20"
    sweep = [
        *split("--config-dir conf -m"),
        *SMALL,
        *split(own),
        "eval.lpips=[]",
        "eval.flip=false",
    ]
    done = gsbench(*sweep, code=1)
    assert "random-mine" in done.stderr
    assert "not yet" in done.stderr
    assert "1 of 2 trials done" in done.stderr
    (failed,) = (tmp_path / "runs").glob("own/*/random-mine/*/failed.json")
    assert "not yet" in read_json(failed)["traceback"]
    status = gsbench("status own", code=1)
    assert "not yet" in status.stdout
    assert "2 trials: 1 done, 1 failed" in status.stdout
    (tmp_path / "mended").touch()
    retried = gsbench("retry own allow_targets=[mine]")
    assert "1 of 1 trials done" in retried.stderr
    assert not failed.exists()
    assert gsbench("status own").stdout.strip() == "2 trials: 2 done"
