"""The program, killed by signals or run twice at once, continues and ends as if undisturbed."""

import os
import random
import re
import signal
import time
from shlex import split

import pytest

from tests.end_to_end.conftest import SMALL, SWEEP, results_of
from tests.helpers import read_json
from tests.processes import bytes_written, wait_until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL"),
]

TRIALS = 2
# seconds for a trial of two iterations, on a machine that is busy with other things
PATIENCE = 240.0


def wait_for(runs, pattern, process, seconds=120):
    wait_until(lambda: list(runs.glob(pattern)) or process.poll() is not None, seconds)
    assert list(runs.glob(pattern)), f"{pattern} did not appear"


def training_log_size(runs):
    return bytes_written(runs, "store/train/.*.partial/metrics.jsonl")


def test_a_killed_stopped_and_damaged_sweep_ends_like_an_undisturbed_one(
    start, gsbench, undisturbed, tmp_path
):
    runs = tmp_path / "runs"
    rng = random.Random(4)
    moments = [
        "store/*/.*.partial",
        "store/train/.*.partial/checkpoint-*.pt",
        "attacked/*/*/*/results.json",
    ]
    for moment in moments:
        process = start(*SWEEP)
        wait_for(runs, moment, process)
        time.sleep(rng.uniform(0, 0.8))
        process.send_signal(signal.SIGKILL)
        process.communicate()
    if len(results_of(runs, "attacked")) < TRIALS:  # the last kill may have come after the end
        before = now = training_log_size(runs)
        process = start(*SWEEP)
        # a log that begins again shrinks before it grows
        while now <= before and process.poll() is None:
            time.sleep(0.02)
            before, now = now, training_log_size(runs)
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=300)
        assert process.returncode == 128 + signal.SIGTERM, output
        last = output.strip().splitlines()[-1]
        assert last == "gsbench: stopped by SIGTERM; to continue, give the same command again"
        assert "Traceback" not in output
        assert list(runs.glob("store/train/.*.partial/checkpoint-*.pt")), output
    gsbench(*SWEEP)
    assert results_of(runs, "attacked") == undisturbed
    for path in runs.rglob("*"):
        assert ".tmp" not in path.name
        assert path.suffix not in (".partial", ".removed")

    one, other = sorted(runs.glob("attacked/*/*/*/results.json"))
    model = one.parent / "point_cloud.ply"
    content = bytearray(model.read_bytes())
    content[len(content) // 2] ^= 1
    model.write_bytes(content)
    psnr = read_json(other)["metrics"]["psnr"]
    other.write_text(other.read_text().replace(f'"psnr": {psnr}', '"psnr": 99.0'))
    assert results_of(runs, "attacked") != undisturbed
    assert "point_cloud.ply differs" in gsbench(*SWEEP).stderr
    assert results_of(runs, "attacked") == undisturbed


def test_two_sweeps_at_once_share_the_work(start, undisturbed, tmp_path):
    runs = tmp_path / "runs"
    both = [start(*SWEEP) for _ in range(2)]
    outputs = [process.communicate(timeout=300)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], outputs
    assert results_of(runs, "attacked") == undisturbed
    # said once, at the end
    trained = [len(re.findall(r"train: iteration (\d+)/\1 ", output)) for output in outputs]
    assert sum(trained) == TRIALS, outputs
    assert min(trained) >= 1


LOCAL = [
    "-m",
    *SMALL,
    *split("name=local densify=adc launch=local launch.parallel=2 tracking=none"),
]


def holders(runs):
    found = {}
    for path in runs.glob("local/*/*/*/.lock.holder"):
        try:
            found[path.parent.name] = read_json(path)["pid"]
        except (OSError, ValueError):
            continue
    return found


def test_ctrl_c_stops_trials_in_other_processes_with_checkpoints(start, tmp_path):
    """A terminal sends Ctrl-C to every process of the command."""
    runs = tmp_path / "runs"
    process = start(*LOCAL, "seed=0,1", "train.iterations=100000", new_group=True)
    wait_for(runs, "store/train/.*.partial/metrics.jsonl", process)
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 128 + signal.SIGINT, output
    assert "Traceback" not in output
    assert output.strip().splitlines()[-1].startswith("gsbench: stopped")
    wait_for(runs, "store/train/.*.partial/checkpoint-*.pt", process)


def test_a_killed_trial_harms_no_other_and_the_next_command_completes_it(start, gsbench, tmp_path):
    runs = tmp_path / "runs"
    process = start(*LOCAL, "seed=0,1,2")
    deadline = time.monotonic() + 120
    killed, most = "", 0
    while process.poll() is None and time.monotonic() < deadline:
        # the file of a killed process stays
        running = {trial: pid for trial, pid in holders(runs).items() if trial != killed}
        most = max(most, len(running))
        training = list(runs.glob("store/train/.*.partial/metrics.jsonl"))
        if not killed and training and running:
            killed, pid = next(iter(running.items()))
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.05)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 1, output
    assert most == 2
    assert "2 of 3 trials done" in output
    assert "ended without a result" in output
    assert len(results_of(runs, "local")) == 2
    done = gsbench(*LOCAL, "seed=0,1,2")
    assert len(results_of(runs, "local")) == 3
    assert done.stderr.count("already done") == 2


TUNED = [
    "+experiment=tuned",
    "seed=0",
    *SMALL,
    "train.iterations=120",
    "eval.lpips=[]",
    "tracking=none",
    "hydra.sweeper.tune.points=2",
    "name=small",
]


def views(arm):
    """The names of the views on which the trials of an arm are measured."""
    return {
        line.split(",")[0]
        for file in arm.glob("*/per_view.csv")
        for line in file.read_text().splitlines()[1:]
    }


def test_a_killed_tuning_continues_and_its_values_are_trained(gsbench, start, tmp_path):
    with start(*TUNED) as first:
        for line in first.stdout:
            if "point 1 of 2" in line:
                first.send_signal(signal.SIGKILL)
                break
        first.stdout.read()
    home = tmp_path / "runs/small"
    assert not home.exists()

    done = gsbench(*TUNED, "launch=local", "launch.parallel=2")  # by another launcher, too
    assert "trials done; the table: gsbench tables small\n" in done.stderr
    arms = sorted(
        path.name.removeprefix("small-tune-") for path in home.parent.glob("small-tune-*")
    )
    assert len(arms) == 2
    for arm in arms:
        points = read_json(home.parent / f"small-tune-{arm}/tuning.json")["points"]
        assert len(points) == 2
        best = max(points, key=lambda point: point["value"])
        (results,) = home.glob(f"courtyard/{arm}/*/results.json")
        text = results.read_text()
        assert all(str(value) in text for value in best["settings"].values())
        assert views(home / f"courtyard/{arm}")
        assert not views(home / f"courtyard/{arm}") & views(
            home.parent / f"small-tune-{arm}/courtyard/{arm}"
        )

    sheet = gsbench("tables small --layout fairness")
    assert sheet.stdout.count("the best of 2 points by psnr of validation views") == 2
    assert "tuning was unequal" not in sheet.stdout
