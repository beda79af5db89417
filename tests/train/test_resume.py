"""A training that is stopped anywhere, any number of times, ends with the same bits."""

import json
import random
import signal
import subprocess
import sys

import pytest

from gsbench.densify import EdgeAware, PixelGS, ResGS, Taming, Volumetric
from gsbench.system.stopping import Stopped, stop_on_signals
from gsbench.train.records import drop_after
from tests.train.lab import EVENTS, METRICS, STATEFUL, StopError, same, small

ITERATIONS = 120
OTHERS = {
    "volumetric": lambda: small(Volumetric, volume_threshold=0.01),
    "capped": lambda: small(max_gaussians=120, cap="hard"),
    "pixelgs": lambda: small(PixelGS, max_gaussians=150, cap="hard"),
    "edgeaware": lambda: small(EdgeAware, gradient="absolute", max_gaussians=150, cap="curve"),
    "resgs": lambda: small(ResGS, phase_ends=[0.3, 0.6], fade_interval=15, fade_stop=100),
    "taming": lambda: small(Taming, max_gaussians=150),
}


@pytest.mark.parametrize(
    "name", [*STATEFUL, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)]
)
def test_crashes_and_signals_at_random_iterations_do_not_change_the_result(name, lab):
    make = (STATEFUL | OTHERS)[name]
    whole = lab.train(make(), "whole", log_every=1)
    rng = random.Random(name)
    crashes = stops = 0
    for attempt in range(12):
        moment = rng.randrange(20, 60)
        crash = attempt % 2 == 0
        seen = []

        def interrupt(status, moment=moment, crash=crash, seen=seen):
            seen.append(status.step)
            if len(seen) == moment:
                if crash:
                    raise StopError
                signal.raise_signal(signal.SIGTERM)

        try:
            with stop_on_signals():
                broken_result = lab.train(
                    make(), "broken", interrupt, checkpoint_every=13, log_every=1
                )
            break
        except StopError:
            crashes += 1
        except Stopped:
            stops += 1
            assert seen[-1] in lab.checkpoints("broken")
    else:
        broken_result = lab.train(make(), "broken", log_every=1)
    assert crashes >= 1
    assert stops >= 1
    assert same(whole, broken_result)
    for file in (EVENTS, "volume_histograms.jsonl"):
        assert lab.text(file, "broken") == lab.text(file, "whole")
    timeless = [
        [record | {"seconds": 0} for record in lab.records(METRICS, folder)]
        for folder in ("broken", "whole")
    ]
    assert timeless[0] == timeless[1]


def test_a_stop_in_the_last_iteration_loses_nothing(lab):
    whole = lab.train(small(), "whole")

    def stop(status):
        if status.step == ITERATIONS:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Stopped), stop_on_signals():
        lab.train(small(), "broken", stop)
    assert same(whole, lab.train(small(), "broken"))


def test_records_after_the_checkpoint_and_an_incomplete_line_are_removed(tmp_path):
    file = tmp_path / "metrics.jsonl"
    lines = [json.dumps({"step": step}) + "\n" for step in range(1, 8)]
    for torn in ("", '{"step": 3, "lo', '{"loss": 1}\n', "5\n"):
        file.write_text("".join([*lines, torn]))
        drop_after(file, 5)
        assert file.read_text() == "".join(lines[:5])
    drop_after(tmp_path / "absent.jsonl", 5)
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.jsonl"]


@pytest.mark.skipif(
    not hasattr(signal, "SIGXFSZ"), reason="needs a signal that comes in the middle of a write"
)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
@pytest.mark.slow
def test_a_kill_while_records_are_removed_loses_no_record(share, tmp_path):
    """The system kills the process as soon as it has written ``share`` of the file."""
    file = tmp_path / "events.jsonl"
    lines = [json.dumps({"step": step, "cloned": step}) + "\n" for step in range(1, 5001)]
    file.write_text("".join(lines))
    kept = len("".join(lines[:4000]))
    code = (
        "import resource, signal, sys\nfrom pathlib import Path\nfrom gsbench.train.records "
        "import drop_after\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_DFL)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)\n"
        "resource.setrlimit(resource.RLIMIT_CORE, (0, 0))\ndrop_after(Path(sys.argv[1]), 4000)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(file), str(int(share * kept))], check=False
    )
    assert done.returncode == -signal.SIGXFSZ
    assert file.read_text() == "".join(lines)
    drop_after(file, 4000)  # the next attempt
    assert file.read_text() == "".join(lines[:4000])
