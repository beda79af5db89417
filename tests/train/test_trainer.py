"""The training loop: it learns, follows the schedule, is repeatable, and can be resumed."""

import itertools
import math
import time
from dataclasses import asdict
from types import SimpleNamespace

import pytest
import torch

from gsbench.densify import ADC, NoDensifier, SteepGS, Volumetric
from gsbench.errors import TrainingError
from gsbench.gaussians.ply import read_ply
from gsbench.raster.staged import Readback
from gsbench.train import loss, trainer
from gsbench.train.checkpoint import CheckpointWriter
from gsbench.train.options import TrainConfig
from gsbench.train.trainer import snapshot_file
from gsbench.train.views import CameraOrder, generators
from tests.helpers import refusal
from tests.train.lab import EVENTS, METRICS, STATEFUL, StopError, same, small, stop_at


def test_training_learns_the_scene(lab):
    lab.train(NoDensifier(), iterations=500, position_steps=500)
    metrics = lab.records(METRICS)
    first = sum(r["l1"] for r in metrics[:3]) / 3
    assert sum(r["l1"] for r in metrics[-3:]) / 3 < 0.5 * first
    assert metrics[-1]["step"] == 500
    degrees = {r["step"]: r["sh_degree"] for r in metrics}
    assert [degrees[step] for step in (30, 40, 80, 120, 500)] == [0, 1, 2, 3, 3]


def test_only_the_same_seed_gives_the_same_bits(lab):
    runs = [lab.train(small(), str(i), seed=i // 2) for i in range(3)]
    assert same(runs[0], runs[1])
    assert not same(runs[0], runs[2])


def test_counts_in_events_add_up_to_the_trained_gaussians(lab):
    densifier = small(Volumetric, volume_threshold=0.01)
    trained = lab.train(densifier)
    events = lab.records(EVENTS)
    assert lab.steps(EVENTS) == [40, 60, 80, 100]
    count = len(lab.truth)
    for event in events:
        assert event["before"] == count
        count = event["after"]
    assert count == len(trained) > len(lab.truth)
    living = densifier.lineage.causes_of_living()
    assert sum(living.values()) == count
    assert living["split_volume"] > 0


def test_nothing_is_refined_in_the_last_iteration(lab):
    """3DGS saves its model before it refines and steps."""
    lab.train(small(), iterations=100)
    assert lab.steps(EVENTS) == [40, 60, 80]


class Explode(NoDensifier):
    def __init__(self, at):
        self.left = at

    def regularizer(self, gaussians):
        self.left -= 1
        return None if self.left else torch.tensor(float("inf"))


def test_a_loss_that_is_not_finite_is_an_error_with_the_iteration(lab):
    with pytest.raises(TrainingError, match=r"iteration 57.*last good state"):
        lab.train(Explode(57))
    assert lab.checkpoints() == [50]


def test_no_checkpoint_is_written_after_a_loss_that_is_not_finite(lab, monkeypatch):
    """On a device that is behind, a loss arrives only when the host waits for it."""

    monkeypatch.setattr(Readback, "arrived", property(lambda self: False))
    with pytest.raises(TrainingError, match="iteration 3;"):
        lab.train(Explode(3), iterations=9, checkpoint_every=1)
    assert lab.checkpoints()[-1] == 2


def test_the_error_of_a_full_device_names_the_checkpoint_and_a_remedy(lab):
    class Full(NoDensifier):
        def observe(self, step, render):
            if step == 57:
                raise torch.OutOfMemoryError(
                    "CUDA out of memory. Tried to allocate 2 GiB\nand more"
                )

    with pytest.raises(TrainingError) as caught:
        lab.train(Full())
    assert str(caught.value).startswith(
        f"iteration 57: cpu has no memory left at {len(lab.truth)} Gaussians; "
    )
    assert "\n" not in str(caught.value)
    assert f"newest checkpoint in {lab.folder}; lower densify.max_gaussians" in str(caught.value)
    assert lab.checkpoints() == [50]


@pytest.mark.parametrize("kind", ["adc", "mcmc"])
def test_a_device_that_is_behind_gives_the_same_bits(kind, lab, monkeypatch):
    """Losses arrive late, images do not fit on the device, and a thread writes checkpoints."""

    make = STATEFUL[kind]
    whole = lab.train(make(), "whole")
    monkeypatch.setattr(Readback, "arrived", property(lambda self: False))
    monkeypatch.setattr(trainer, "free_bytes", lambda _: 0)
    monkeypatch.setattr(
        trainer, "CheckpointWriter", lambda folder, background: CheckpointWriter(folder, True)
    )
    with pytest.raises(StopError):
        lab.train(make(), "broken", stop_at(70))
    assert lab.checkpoints("broken") == [50]
    assert same(whole, lab.train(make(), "broken"))
    assert lab.text(EVENTS, "broken") == lab.text(EVENTS, "whole")


def test_every_view_is_used_once_before_any_is_used_again():
    order = CameraOrder(7, generators(0)["cameras"])
    drawn = [order.next() for _ in range(21)]
    assert [sorted(drawn[i : i + 7]) for i in (0, 7, 14)] == [list(range(7))] * 3
    assert drawn[:7] != drawn[7:14]


def test_a_rasterizer_without_an_output_that_the_densifier_needs_is_refused_at_once(lab):
    class Plain:
        name = "plain"

    lab.rasterizer = Plain()
    with refusal("SteepGS needs the extra output splitting_matrix, which"):
        lab.new(SteepGS())


def test_too_few_rounds_of_a_densifier_cause_a_warning(lab, caplog):
    lab.train(ADC(start=500), "adc", iterations=15)
    assert "ADC: 0 rounds of refinement in 15 iterations, too few" in caplog.text
    caplog.clear()
    lab.train(NoDensifier(), "none", iterations=15)
    assert "refinement" not in caplog.text


def test_a_snapshot_equals_the_model_of_a_training_that_ends_there(lab):
    """Iteration 60 is due for a refinement and an opacity reset: 3DGS saves before both."""
    lab.train(small(), "long", snapshot_at=[60])
    short = lab.train(small(), "short", iterations=60)
    assert same(read_ply(lab.folder / "long" / snapshot_file(60)), short)


def test_defaults_are_those_of_3dgs():
    """The source is ``arguments/__init__.py`` of the 2023 code of 3DGS."""
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
        "background": (0.0, 0.0, 0.0),
        "densify_interval": 100,
        "opacity_reset_interval": 3000,
        "densify_start": 500,
        "densify_stop": 15_000,
        "sh_interval": 1000,
    }
    assert published.items() <= asdict(TrainConfig(name="paper")).items()


@pytest.mark.parametrize("before", [False, True])
def test_the_optimiser_steps_after_or_before_a_refinement(before, lab):
    seen = []

    class Watching(NoDensifier):
        def refine(self, step, gaussians, rng):
            seen.append(gaussians.values.means.detach().clone())

        after_step = refine

    training = lab.new(Watching(), step_after_refine=before)
    first = training.gaussians.values.means.detach().clone()
    training.iterate(lab.folder)
    assert torch.equal(seen[0], first) is not before
    assert torch.equal(training.gaussians.values.means, seen[0]) is before
    assert torch.equal(training.gaussians.values.means, seen[1])
    rate = training.options.position(1) * lab.scene.extent
    assert training.gaussians.position_rate == pytest.approx(rate, rel=1e-9)


@pytest.mark.parametrize("visible_adam", [False, True])
def test_visible_adam_updates_only_visible_gaussians(visible_adam, lab):
    training = lab.new(NoDensifier(), visible_adam=visible_adam, sh_interval=1)
    training.fast, given = None, []
    training.gaussians.optimizer_step = lambda *arguments: given.append(arguments)
    training.iterate(lab.folder)
    ((degree, visible),) = given
    assert degree == 1
    assert (visible is not None) is visible_adam


@pytest.mark.parametrize(
    "own, proven, kernels, used",
    [
        (False, True, True, True),
        (True, True, True, False),
        (False, False, True, False),
        (False, True, False, False),
    ],
)
def test_direct_steps_need_our_rasterizer_its_proof_and_our_loss(
    own, proven, kernels, used, monkeypatch
):
    pytest.importorskip("triton")
    from gsbench.raster.triton.executor import TritonRasterizer

    class Subclass(TritonRasterizer):
        """May render otherwise."""

    for module in (trainer, loss):
        monkeypatch.setattr(
            module, "find_executor", lambda _: SimpleNamespace(obstacle=lambda _: None)
        )
    monkeypatch.setattr(loss, "HAS_KERNELS", kernels)
    rasterizer = (Subclass if own else TritonRasterizer)()
    rasterizer.direct_steps = proven
    options = TrainConfig(name="test", visible_adam=True)
    place = SimpleNamespace(device=torch.device("cuda"))
    direct, adam = trainer.fast_steps(rasterizer, loss.PhotometricLoss(), options, place)
    assert adam is not None
    assert (direct is not None) == used
    assert direct is None or direct.visible_only


@pytest.mark.parametrize("background, white", [([1.0, 1.0, 1.0], True), ([1.0, 1.0, 0.9], False)])
def test_the_context_of_a_densifier_knows_a_white_background(background, white, lab):
    context = lab.new(NoDensifier(), background=background).context
    assert context.white_background is white
    assert context.extent == lab.scene.extent


@pytest.mark.parametrize("spare, resident", [(0, True), (-2, False)])
def test_images_may_use_half_of_the_free_memory(spare, resident, lab, monkeypatch):
    size = sum(view.image.size for view in lab.scene.train)
    monkeypatch.setattr(trainer, "free_bytes", lambda _: 2 * size + spare)
    assert lab.new(NoDensifier()).targets.resident is resident


def clocked(monkeypatch):
    """Give the trainer a clock that advances by a second each time it is read."""
    seconds = itertools.count(0.0, 1.00004)  # the last digit is not written
    monkeypatch.setattr(
        trainer,
        "time",
        SimpleNamespace(perf_counter=lambda: next(seconds), monotonic=time.monotonic),
    )


def test_seconds_and_rates_continue_from_a_checkpoint(lab, monkeypatch):
    """The trainer reads the clock twice in an iteration that is logged."""
    settings, shown = {"iterations": 5, "log_every": 1, "checkpoint_every": 2}, []

    def look(status):
        shown.append((status.step, status.num_gaussians, status.iterations_per_second))
        if len(shown) == 3:
            raise KeyboardInterrupt

    clocked(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        lab.new(NoDensifier(), **settings).run(lab.folder, look)
    clocked(monkeypatch)
    lab.new(NoDensifier(), **settings).run(lab.folder, look)
    metrics = lab.records(METRICS)
    assert [(r["step"], r["seconds"], r["num_gaussians"]) for r in metrics] == [
        (k, 2 * k, 80) for k in range(1, 6)
    ]
    assert shown == [(k, 80, pytest.approx(0.5, rel=1e-3)) for k in (1, 2, 3, 3, 4, 5)]


def test_a_checkpoint_is_written_some_minutes_after_the_last(lab, monkeypatch):
    """The clock advances by half a minute each time it is read.

    The trainer reads it at the start, in each iteration, and after each checkpoint.
    """
    looks, clock = itertools.count(), SimpleNamespace(perf_counter=time.perf_counter)
    clock.monotonic = lambda: 30.0 * next(looks)
    monkeypatch.setattr(trainer, "time", clock)
    settings = {"iterations": 8, "checkpoint_every": 100, "checkpoint_minutes": 1.5}
    lab.train(NoDensifier(), **settings)
    assert lab.checkpoints() == [3, 6]


def test_a_training_ends_with_the_iteration_that_reaches_the_time_budget_and_logs_it(
    lab, monkeypatch
):
    clocked(monkeypatch)
    lab.train(NoDensifier(), max_seconds=3.0, log_every=100)
    assert lab.steps(METRICS) == [3]


def test_the_last_iteration_is_always_logged(lab):
    lab.train(NoDensifier(), iterations=7, log_every=3)
    assert lab.steps(METRICS) == [3, 6, 7]


def test_a_model_without_gaussians_or_with_invalid_values_is_an_error(lab):
    class Emptying(NoDensifier):
        left = 0

        def rules(self, refinement):
            return [
                lambda refinement: self.remove(
                    refinement, torch.arange(len(lab.truth)) >= self.left
                )
            ]

    last = Emptying()
    last.left = 1
    assert lab.new(last).iterate(lab.folder).after == 1
    with pytest.raises(TrainingError, match="no Gaussian was left after iteration 1"):
        lab.new(Emptying()).iterate(lab.folder)
    broken = lab.new(NoDensifier())
    broken.gaussians.values.log_scales.data[0] = math.inf
    with pytest.raises(
        TrainingError, match=r"^iteration 1: .*; the last good state is the newest checkpoint in "
    ):
        broken.iterate(lab.folder)
