"""A training that is stopped anywhere, any number of times, ends in the same bits."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from gsbench.densify import ADC, MCMC, Densifier, EdgeAware, PixelGS, Taming, Volumetric
from gsbench.gaussians.model import Gaussians
from gsbench.raster import create_rasterizer
from gsbench.scene.types import Scene
from gsbench.system.stopping import Stopped, stop_on_signals
from gsbench.train.trainer import Status, Trainer, drop_after
from tests.train.test_trainer import cloud, options, records, same

ITERATIONS = 120
MAKERS: dict[str, Callable[[], Densifier]] = {
    "adc": lambda: ADC(start=20, stop=110, interval=20, opacity_reset_interval=60),
    "volumetric": lambda: Volumetric(
        start=20, stop=110, interval=20, opacity_reset_interval=60, volume_threshold=0.01
    ),
    "capped": lambda: ADC(
        start=20, stop=110, interval=20, opacity_reset_interval=60, max_gaussians=120, cap="hard"
    ),
    "pixelgs": lambda: PixelGS(
        start=20, stop=110, interval=20, opacity_reset_interval=60, max_gaussians=150, cap="hard"
    ),
    "edgeaware": lambda: EdgeAware(
        start=20,
        stop=110,
        interval=20,
        gradient="absolute",
        opacity_reset_interval=60,
        max_gaussians=150,
        cap="curve",
    ),
    "taming": lambda: Taming(
        start=20, stop=110, interval=20, opacity_reset_interval=60, max_gaussians=150
    ),
    "mcmc": lambda: MCMC(start=20, stop=110, interval=20),
}


def run(
    scene: Scene,
    truth: Gaussians,
    folder: Path,
    name: str,
    on_status: Callable[[Status], None] = lambda s: None,
    **changes: object,
) -> Gaussians:
    folder.mkdir(exist_ok=True)
    settings = options(log_every=1, iterations=ITERATIONS, **changes)
    rasterizer = create_rasterizer("cpu", torch.device("cpu"), threads=1)
    return Trainer(scene, cloud(truth), MAKERS[name](), rasterizer, settings, 0).run(
        folder, on_status
    )


class CrashError(Exception):
    """Stands for a kill: nothing is saved on the way out."""


@pytest.mark.parametrize("name", list(MAKERS))
def test_crashes_and_signals_at_random_iterations(
    name: str, tiny_scene: Scene, truth: Gaussians, tmp_path: Path
) -> None:
    whole = run(tiny_scene, truth, tmp_path / "whole", name)
    rng = random.Random(name)
    broken = tmp_path / "broken"
    crashes = stops = 0
    for _ in range(12):
        moment = rng.randrange(1, 45)
        crash = rng.random() < 0.5
        seen: list[int] = []

        def interrupt(
            status: Status, moment: int = moment, crash: bool = crash, seen: list[int] = seen
        ) -> None:
            seen.append(status.step)
            if len(seen) == moment:
                if crash:
                    raise CrashError
                signal.raise_signal(signal.SIGTERM)

        try:
            with stop_on_signals():
                broken_result = run(tiny_scene, truth, broken, name, interrupt, checkpoint_every=13)
            break
        except CrashError:
            crashes += 1
        except Stopped:
            stops += 1
            assert (broken / f"checkpoint-{seen[-1]:08d}.pt").exists()
    else:
        broken_result = run(tiny_scene, truth, broken, name)
    assert crashes >= 1
    assert stops >= 1
    assert same(whole, broken_result)
    for file in ("events.jsonl", "volume_histograms.jsonl"):
        assert (broken / file).read_text() == (tmp_path / "whole" / file).read_text()
    timeless = [
        [{k: v for k, v in r.items() if k != "seconds"} for r in records(f / "metrics.jsonl")]
        for f in (broken, tmp_path / "whole")
    ]
    assert timeless[0] == timeless[1]


def test_checkpoints_come_by_the_clock_too(
    tiny_scene: Scene, truth: Gaussians, tmp_path: Path
) -> None:
    def crash(status: Status) -> None:
        if status.step == 5:
            raise CrashError

    with pytest.raises(CrashError):
        run(
            tiny_scene,
            truth,
            tmp_path,
            "adc",
            crash,
            checkpoint_every=10**6,
            checkpoint_minutes=1e-9,
        )
    assert sorted(path.name for path in tmp_path.glob("*.pt")) == [
        "checkpoint-00000003.pt",
        "checkpoint-00000004.pt",
    ]


def test_a_stop_in_the_last_iteration_loses_nothing(
    tiny_scene: Scene, truth: Gaussians, tmp_path: Path
) -> None:
    whole = run(tiny_scene, truth, tmp_path / "whole", "adc")

    def stop(status: Status) -> None:
        if status.step == ITERATIONS:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Stopped), stop_on_signals():
        run(tiny_scene, truth, tmp_path / "broken", "adc", stop)
    assert same(whole, run(tiny_scene, truth, tmp_path / "broken", "adc"))


def test_records_later_than_the_checkpoint_and_a_torn_line_are_dropped(tmp_path: Path) -> None:
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
def test_a_kill_while_a_resumed_training_tidies_its_records_loses_none(
    share: float, tmp_path: Path
) -> None:
    """The system ends the process as soon as it has written ``share`` of the file."""
    file = tmp_path / "events.jsonl"
    lines = [json.dumps({"step": step, "cloned": step}) + "\n" for step in range(1, 5001)]
    file.write_text("".join(lines))
    kept = len("".join(lines[:4000]))
    code = (
        "import resource, signal, sys\nfrom pathlib import Path\nfrom gsbench.train.trainer "
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
