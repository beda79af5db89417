"""The training loop.

It learns, it follows the schedule, it is repeatable, and it goes on where it was stopped.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsbench.densify import (
    ADC,
    GNS,
    MCMC,
    MRNF,
    Densifier,
    FastGS,
    NoDensifier,
    ResGS,
    SteepGS,
    Volumetric,
)
from gsbench.errors import TrainingError
from gsbench.gaussians.initial import gaussians_from_cloud
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.ply import read_ply
from gsbench.raster import create_rasterizer
from gsbench.raster.base import Rasterizer, RenderOutput
from gsbench.raster.staged import Readback
from gsbench.scene.types import Scene
from gsbench.train import trainer
from gsbench.train.checkpoint import CheckpointWriter
from gsbench.train.options import TrainConfig
from gsbench.train.trainer import Status, Trainer, snapshot_file
from gsbench.train.views import STREAMS, CameraOrder, generators

CPU = torch.device("cpu")


def cloud(truth: Gaussians) -> Gaussians:
    colors = torch.full((len(truth), 3), 127, dtype=torch.uint8)
    return gaussians_from_cloud(truth.means.double().numpy(), colors.numpy())


def options(**changes: object) -> TrainConfig:
    values = {
        "name": "test",
        "iterations": 120,
        "sh_interval": 40,
        "position_steps": 120,
        "checkpoint_every": 50,
        "volume_histogram": [60],
    }
    return TrainConfig(**(values | changes))  # type: ignore[arg-type]


def small(kind: type[ADC] = ADC, **changes: object) -> ADC:
    return kind(start=20, stop=110, interval=20, opacity_reset_interval=60, **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def rasterizer() -> Rasterizer:
    return create_rasterizer("cpu", CPU, threads=1)


def train(
    scene: Scene,
    truth: Gaussians,
    rasterizer: Rasterizer,
    folder: Path,
    densifier: Densifier,
    seed: int = 0,
    **changes: object,
) -> Gaussians:
    folder.mkdir(parents=True, exist_ok=True)
    return Trainer(scene, cloud(truth), densifier, rasterizer, options(**changes), seed).run(folder)


def same(a: Gaussians, b: Gaussians) -> bool:
    return len(a) == len(b) and all(
        torch.equal(x, y) for x, y in zip(a.tensors().values(), b.tensors().values(), strict=True)
    )


def records(path: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_training_learns_the_scene(
    tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    train(
        tiny_scene, truth, rasterizer, tmp_path, NoDensifier(), iterations=500, position_steps=500
    )
    metrics = records(tmp_path / "metrics.jsonl")
    first = sum(r["l1"] for r in metrics[:3]) / 3
    last = sum(r["l1"] for r in metrics[-3:]) / 3
    assert last < 0.5 * first
    assert metrics[-1]["step"] == 500
    assert [r["sh_degree"] for r in metrics if r["step"] in (30, 40, 80, 120, 500)] == [
        0,
        1,
        2,
        3,
        3,
    ]


def test_same_seed_same_bits_other_seed_not(
    tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    runs = [
        train(tiny_scene, truth, rasterizer, tmp_path / str(i), small(), seed=i // 2)
        for i in range(3)
    ]
    assert same(runs[0], runs[1])
    assert not same(runs[0], runs[2])


@pytest.mark.parametrize(
    "make",
    [
        small,
        lambda: small(Volumetric, volume_threshold=0.01),
        lambda: MCMC(start=20, stop=110, interval=20),
        lambda: MRNF(start=0, stop=110, interval=20, decay_until=120),
        lambda: GNS(
            start=20, stop=60, interval=20, max_gaussians=90, pressure_length=1.0, overgrowth=2.0
        ),
        lambda: small(ResGS, phase_ends=[0.3, 0.6], fade_interval=15, fade_stop=100),
        lambda: small(FastGS, error_threshold=0.05, least_count=0.0, max_gaussians=200),
        lambda: small(SteepGS),
    ],
    ids=["adc", "volumetric", "mcmc", "mrnf", "gns", "resgs", "fastgs", "steepgs"],
)
def test_interrupted_training_ends_in_the_same_bits(
    make, tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:  # type: ignore[no-untyped-def]
    whole = train(tiny_scene, truth, rasterizer, tmp_path / "whole", make())
    broken = tmp_path / "broken"

    class StopError(Exception):
        pass

    def stop_at_70(status: Status) -> None:
        if status.step == 70:
            raise StopError

    broken.mkdir()
    with pytest.raises(StopError):
        Trainer(tiny_scene, cloud(truth), make(), rasterizer, options(), 0).run(broken, stop_at_70)
    assert sorted(path.name for path in broken.glob("*.pt")) == ["checkpoint-00000050.pt"]
    assert same(whole, train(tiny_scene, truth, rasterizer, broken, make()))
    for name in ("events.jsonl", "volume_histograms.jsonl"):
        assert (broken / name).read_text() == (tmp_path / "whole" / name).read_text()
    steps = [r["step"] for r in records(broken / "metrics.jsonl")]
    assert steps == list(range(10, 121, 10))
    assert sorted(path.name for path in broken.glob("*.pt")) == [
        "checkpoint-00000050.pt",
        "checkpoint-00000100.pt",
    ]


def test_events_add_up_to_the_gaussians(
    tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    densifier = small(Volumetric, volume_threshold=0.01)
    trained = train(tiny_scene, truth, rasterizer, tmp_path, densifier)
    events = records(tmp_path / "events.jsonl")
    assert [event["step"] for event in events] == [40, 60, 80, 100]
    count = len(truth)
    for event in events:
        assert event["before"] == count
        count = event["after"]
    assert count == len(trained) > len(truth)
    living = densifier.lineage.causes_of_living()
    assert sum(living.values()) == count
    assert living["split_volume"] > 0


def test_nothing_is_refined_in_the_last_iteration(
    tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    """3DGS saves its model before it would refine or step."""
    train(tiny_scene, truth, rasterizer, tmp_path, small(), iterations=100)
    assert [event["step"] for event in records(tmp_path / "events.jsonl")] == [40, 60, 80]


def test_time_budget_ends_a_training(
    tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    train(tiny_scene, truth, rasterizer, tmp_path, NoDensifier(), iterations=10**6, max_seconds=0.3)
    last = records(tmp_path / "metrics.jsonl")[-1]
    assert last["seconds"] >= 0.3
    assert last["step"] < 10**6


def test_visible_adam_trains_too(
    tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    train(tiny_scene, truth, rasterizer, tmp_path, small(), visible_adam=True)
    metrics = records(tmp_path / "metrics.jsonl")
    assert metrics[-1]["l1"] < metrics[0]["l1"]


def test_non_finite_loss_names_the_iteration(
    tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    class Explode(NoDensifier):
        def regularizer(self, gaussians: Gaussians) -> torch.Tensor | None:
            self.calls = getattr(self, "calls", 0) + 1
            return torch.tensor(float("inf")) if self.calls == 57 else None

    with pytest.raises(TrainingError, match=r"iteration 57.*last good state"):
        train(tiny_scene, truth, rasterizer, tmp_path, Explode())
    assert (tmp_path / "checkpoint-00000050.pt").exists()


def test_no_checkpoint_holds_a_state_after_a_loss_that_was_not_finite(
    tiny_scene: Scene,
    truth: Gaussians,
    rasterizer: Rasterizer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a device that is behind, a loss arrives only when it is waited for."""

    class Explode(NoDensifier):
        def regularizer(self, gaussians: Gaussians) -> torch.Tensor | None:
            self.calls = getattr(self, "calls", 0) + 1
            return torch.tensor(float("inf")) if self.calls == 3 else None

    monkeypatch.setattr(Readback, "arrived", property(lambda self: False))
    with pytest.raises(TrainingError, match="iteration 3;"):
        train(tiny_scene, truth, rasterizer, tmp_path, Explode(), iterations=9, checkpoint_every=1)
    assert max(path.name for path in tmp_path.glob("*.pt")) == "checkpoint-00000002.pt"


def test_a_full_device_names_the_last_checkpoint_and_what_to_lower(
    tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    class Full(NoDensifier):
        def observe(self, step: int, render: RenderOutput) -> None:
            if step == 57:
                raise torch.OutOfMemoryError(
                    "CUDA out of memory. Tried to allocate 2 GiB\nand more"
                )

    with pytest.raises(TrainingError) as caught:
        train(tiny_scene, truth, rasterizer, tmp_path, Full())
    assert str(caught.value).startswith(
        f"iteration 57: cpu has no memory left at {len(truth)} Gaussians; "
    )
    assert "\n" not in str(caught.value)
    assert f"newest checkpoint in {tmp_path}; lower densify.max_gaussians" in str(caught.value)
    assert (tmp_path / "checkpoint-00000050.pt").exists()


@pytest.mark.parametrize("kind", ["adc", "mcmc"])
def test_as_on_a_device_that_is_behind(
    kind: str,
    tiny_scene: Scene,
    truth: Gaussians,
    rasterizer: Rasterizer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Losses that arrive late, images without room, checkpoints written by a thread.

    The same bits, stopped or not.
    """

    def make() -> Densifier:
        return small() if kind == "adc" else MCMC(start=20, stop=110, interval=20)

    def stop_at_70(status: Status) -> None:
        if status.step == 70:
            raise KeyboardInterrupt

    whole = train(tiny_scene, truth, rasterizer, tmp_path / "whole", make())
    monkeypatch.setattr(Readback, "arrived", property(lambda self: False))
    monkeypatch.setattr(trainer, "free_bytes", lambda _: 0)
    monkeypatch.setattr(
        trainer, "CheckpointWriter", lambda folder, background: CheckpointWriter(folder, True)
    )
    broken = tmp_path / "broken"
    broken.mkdir()
    with pytest.raises(KeyboardInterrupt):
        Trainer(tiny_scene, cloud(truth), make(), rasterizer, options(), 0).run(broken, stop_at_70)
    assert sorted(path.name for path in broken.iterdir() if path.suffix == ".pt") == [
        "checkpoint-00000050.pt"
    ]
    assert same(whole, train(tiny_scene, truth, rasterizer, broken, make()))
    assert (broken / "events.jsonl").read_text() == (
        tmp_path / "whole" / "events.jsonl"
    ).read_text()


def test_every_view_is_used_once_before_any_is_used_again() -> None:
    order = CameraOrder(7, generators(0)["cameras"])
    drawn = [order.next() for _ in range(21)]
    assert [sorted(drawn[i : i + 7]) for i in (0, 7, 14)] == [list(range(7))] * 3
    assert drawn[:7] != drawn[7:14]


def test_learning_rate_of_the_means_is_log_linear() -> None:
    rates = TrainConfig(name="x")
    assert rates.position(0) == pytest.approx(1.6e-4)
    assert rates.position(15_000) == pytest.approx(1.6e-5)  # the geometric middle
    assert rates.position(30_000) == pytest.approx(1.6e-6)
    assert rates.position(99_000) == pytest.approx(1.6e-6)


def test_a_densifier_that_was_never_due_is_told(
    tiny_scene: Scene,
    truth: Gaussians,
    rasterizer: Rasterizer,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    train(tiny_scene, truth, rasterizer, tmp_path / "adc", ADC(start=500), iterations=15)
    assert "not one refinement was due in 15 iterations" in caplog.text
    caplog.clear()
    train(tiny_scene, truth, rasterizer, tmp_path / "none", NoDensifier(), iterations=15)
    assert "refinement" not in caplog.text


def test_a_snapshot_is_the_model_of_a_training_that_ends_there(
    tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    """Iteration 60 is due for a refinement and an opacity reset: 3DGS saves before both."""
    (tmp_path / "long").mkdir()
    Trainer(tiny_scene, cloud(truth), small(), rasterizer, options(), 0, snapshot_at=[60]).run(
        tmp_path / "long"
    )
    short = train(tiny_scene, truth, rasterizer, tmp_path / "short", small(), iterations=60)
    assert same(read_ply(tmp_path / "long" / snapshot_file(60)), short)


def test_defaults_are_those_of_3dgs() -> None:
    """As ``arguments/__init__.py`` of the 2023 code of 3DGS has them."""
    published = {
        "iterations": 30_000,
        "position_initial": 0.00016,
        "position_final": 0.0000016,
        "position_steps": 30_000,
        "sh_dc": 0.0025,
        "sh_rest": 0.0025 / 20,
        "opacity": 0.05,
        "scale": 0.005,
        "rotation": 0.001,
        "ssim_weight": 0.2,
        "densify_interval": 100,
        "opacity_reset_interval": 3000,
        "densify_start": 500,
        "densify_stop": 15_000,
        "sh_interval": 1000,
    }
    defaults = TrainConfig(name="paper")
    assert {name: getattr(defaults, name) for name in published} == published


def new(
    scene: Scene, truth: Gaussians, rasterizer: Rasterizer, densifier: Densifier, **changes: object
) -> Trainer:
    return Trainer(scene, cloud(truth), densifier, rasterizer, options(**changes), 0)


@pytest.mark.parametrize("before", [False, True])
def test_the_optimiser_steps_after_or_before_a_refinement(
    before: bool, tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    seen = []

    class Watching(NoDensifier):
        def refine(self, step: int, gaussians: object, rng: torch.Generator) -> None:
            seen.append(gaussians.values.means.detach().clone())  # type: ignore[attr-defined]

        def after_step(self, step: int, gaussians: object, rng: torch.Generator) -> None:
            seen.append(gaussians.values.means.detach().clone())  # type: ignore[attr-defined]

    training = new(tiny_scene, truth, rasterizer, Watching(), step_after_refine=before)
    first = training.gaussians.values.means.detach().clone()
    training.iterate(tmp_path)
    assert torch.equal(seen[0], first) is not before
    assert torch.equal(training.gaussians.values.means, seen[0]) is before
    assert torch.equal(training.gaussians.values.means, seen[1])
    rate = training.options.position(1) * tiny_scene.extent
    assert training.gaussians.position_rate == pytest.approx(rate, rel=1e-9)
    assert training.scale == 1  # pictures of full size


@pytest.mark.parametrize("visible_adam", [False, True])
def test_only_visible_gaussians_are_updated_if_asked(
    visible_adam: bool, tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    training = new(
        tiny_scene, truth, rasterizer, NoDensifier(), visible_adam=visible_adam, sh_interval=1
    )
    given = []
    training.gaussians.optimizer_step = lambda *arguments: given.append(arguments)  # type: ignore[method-assign]
    training.iterate(tmp_path)
    ((degree, visible),) = given
    assert degree == 1
    assert (visible is not None) is visible_adam


@pytest.mark.parametrize(
    ("background", "white"), [([1.0, 1.0, 1.0], True), ([1.0, 1.0, 0.9], False)]
)
def test_a_densifier_is_told_of_a_white_background(
    background: list[float],
    white: bool,
    tiny_scene: Scene,
    truth: Gaussians,
    rasterizer: Rasterizer,
) -> None:
    context = new(tiny_scene, truth, rasterizer, NoDensifier(), background=background).context
    assert context.white_background is white
    assert context.extent == tiny_scene.extent
    assert context.limit is None


@pytest.mark.parametrize(("spare", "resident"), [(0, True), (-2, False)])
def test_images_may_take_half_of_the_free_memory(
    spare: int,
    resident: bool,
    tiny_scene: Scene,
    truth: Gaussians,
    rasterizer: Rasterizer,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    size = sum(view.image.size for view in tiny_scene.train)
    monkeypatch.setattr(trainer, "free_bytes", lambda _: 2 * size + spare)
    assert new(tiny_scene, truth, rasterizer, NoDensifier()).targets.resident is resident


def clocked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that goes on by a second each time the trainer looks at it."""
    seconds = itertools.count(0.0, 1.00004)  # the last digit is not written
    monkeypatch.setattr(
        trainer,
        "time",
        SimpleNamespace(perf_counter=lambda: next(seconds), monotonic=time.monotonic),
    )


def test_seconds_and_rates_go_on_from_a_checkpoint(
    tiny_scene: Scene,
    truth: Gaussians,
    rasterizer: Rasterizer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The trainer looks at the clock twice in an iteration that is logged."""
    settings, shown = {"iterations": 5, "log_every": 1, "checkpoint_every": 2}, []

    def look(status: Status) -> None:
        shown.append((status.step, status.num_gaussians, status.iterations_per_second))
        if len(shown) == 3:
            raise KeyboardInterrupt

    clocked(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        new(tiny_scene, truth, rasterizer, NoDensifier(), **settings).run(tmp_path, look)
    clocked(monkeypatch)
    new(tiny_scene, truth, rasterizer, NoDensifier(), **settings).run(tmp_path, look)
    metrics = records(tmp_path / "metrics.jsonl")
    assert [(r["step"], r["seconds"], r["num_gaussians"]) for r in metrics] == [
        (k, 2 * k, 80) for k in range(1, 6)
    ]
    assert shown == [(k, 80, pytest.approx(0.5, rel=1e-3)) for k in (1, 2, 3, 3, 4, 5)]


def test_checkpoints_come_so_many_minutes_after_the_last(
    tiny_scene: Scene,
    truth: Gaussians,
    rasterizer: Rasterizer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A clock that goes on by half a minute each time.

    At the start, in each iteration, and after each checkpoint.
    """
    looks, clock = itertools.count(), SimpleNamespace(perf_counter=time.perf_counter)
    clock.monotonic = lambda: 30.0 * next(looks)
    monkeypatch.setattr(trainer, "time", clock)
    settings = {"iterations": 8, "checkpoint_every": 100, "checkpoint_minutes": 1.5}
    train(tiny_scene, truth, rasterizer, tmp_path, NoDensifier(), **settings)  # type: ignore[arg-type]
    names = sorted(path.name for path in tmp_path.glob("*.pt"))
    assert names == ["checkpoint-00000003.pt", "checkpoint-00000006.pt"]


def test_a_time_budget_ends_with_the_iteration_that_reaches_it_and_logs_it(
    tiny_scene: Scene,
    truth: Gaussians,
    rasterizer: Rasterizer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clocked(monkeypatch)
    train(tiny_scene, truth, rasterizer, tmp_path, NoDensifier(), max_seconds=3.0, log_every=100)
    assert [record["step"] for record in records(tmp_path / "metrics.jsonl")] == [3]


def test_on_a_cpu_checkpoints_are_written_without_a_thread(
    tiny_scene: Scene,
    truth: Gaussians,
    rasterizer: Rasterizer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[object] = []

    class Writer(CheckpointWriter):
        def __init__(self, folder: Path, background: bool) -> None:
            calls.append(background)
            super().__init__(folder, background)

        def close(self) -> None:
            calls.append("close")
            super().close()

    monkeypatch.setattr(trainer, "CheckpointWriter", Writer)
    train(tiny_scene, truth, rasterizer, tmp_path, NoDensifier(), iterations=1)
    assert calls == [False, "close"]


def test_the_last_iteration_is_logged_too(
    tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    train(tiny_scene, truth, rasterizer, tmp_path, NoDensifier(), iterations=7, log_every=3)
    assert [record["step"] for record in records(tmp_path / "metrics.jsonl")] == [3, 6, 7]


def test_a_model_without_gaussians_or_out_of_range_ends_the_training(
    tiny_scene: Scene, truth: Gaussians, rasterizer: Rasterizer, tmp_path: Path
) -> None:
    class Emptying(NoDensifier):
        left = 0

        def rules(self, refinement: object) -> list:
            return [
                lambda refinement: self.remove(refinement, torch.arange(len(truth)) >= self.left)
            ]

    last = Emptying()
    last.left = 1
    assert new(tiny_scene, truth, rasterizer, last).iterate(tmp_path).after == 1  # type: ignore[union-attr]
    with pytest.raises(TrainingError, match="no Gaussian was left after iteration 1"):
        new(tiny_scene, truth, rasterizer, Emptying()).iterate(tmp_path)
    broken = new(tiny_scene, truth, rasterizer, NoDensifier())
    broken.gaussians.values.log_scales.data[0] = math.inf
    with pytest.raises(
        TrainingError, match=r"^iteration 1: .*; the last good state is the newest checkpoint in "
    ):
        broken.iterate(tmp_path)


def test_every_stream_of_random_numbers_is_seeded_by_numpy() -> None:
    for stream, name in enumerate(STREAMS):
        seed = int(np.random.SeedSequence([3, stream]).generate_state(1, np.uint64)[0]) // 2
        assert generators(3)[name].initial_seed() == seed
