"""What the Triton rasterizer promises beyond the contract, in Triton's interpreter.

``test_triton.py`` runs these tests.
"""

import gc
import json
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves
from triton import language as tl
from triton.runtime.interpreter import interpreter_builder

from gsbench.densify import ADC
from gsbench.gaussians.initial import gaussians_from_cloud
from gsbench.gaussians.trainable import ParameterState, Update
from gsbench.raster import staged
from gsbench.raster.contract import Case, render_with_gradients
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.raster.triton import composite, executor, layout, lists
from gsbench.raster.triton.executor import TritonRasterizer
from gsbench.raster.triton.launch import Workspace
from gsbench.scene.types import Camera, Scene, View
from gsbench.train.adam_triton import TritonAdam
from gsbench.train.direct import MOST_SIZES, DirectStep
from gsbench.train.direct_proof import direct_fault
from gsbench.train.loss_triton import TritonLoss
from gsbench.train.options import TrainConfig
from gsbench.train.trainer import Trainer
from tests.gaussians.helpers import random_gaussians
from tests.raster.promises import BLACK, PROMISES, Subject, bits, bits_of, leaves
from tests.train.conftest import orbit_camera
from tests.train.test_loss import check_equal_images, check_loss, images

pytestmark = pytest.mark.slow

TINY = Case(7, 5, 20, sh_degree=3)
SMALL = Case(33, 49, 50, sh_degree=3)
SUBJECT = Subject(TritonRasterizer, TINY, SMALL, 1e-4)


@pytest.mark.parametrize("promise", PROMISES)
def test_it_keeps_the_promise_that(promise):
    PROMISES[promise](SUBJECT)


def test_the_same_bits_on_every_run():
    rasterizer = TritonRasterizer()
    expected = bits_of(rasterizer, SMALL)
    assert bits_of(rasterizer, SMALL) == expected  # memory that was used before
    assert bits_of(TritonRasterizer(), SMALL) == expected


def shorten_segments(monkeypatch):
    """Make segments so short that the lists of the tests' scenes have many."""
    for module in (layout, composite):
        monkeypatch.setattr(module, "SEGMENT", tl.constexpr(8))
    monkeypatch.setattr(composite, "BATCH", tl.constexpr(8))


def ends_of(frame):
    """The end of the entries of each block that compositing reached."""
    return frame.last.view(frame.blocks, -1).amax(1)


def test_neither_old_memory_nor_the_order_of_programs_changes_a_bit(monkeypatch):
    """No kernel reads memory before it is written, and the order of programs does not matter.

    The second run starts with memory full of NaN and of places far outside, shuffles the programs,
    and composites most blocks by four programs each, which stop at different entries. The Gaussians are opaque, so compositing does not reach many entries of the lists.
    """
    shorten_segments(monkeypatch)
    case = Case(20, 17, 80, sh_degree=1, log_scale=-0.5, logit=4.0)
    values = torch.rand(case.height, case.width, generator=torch.Generator().manual_seed(1))

    def run():
        output, gradients = render_with_gradients(TritonRasterizer(), case, torch.float32)
        footprint = output.footprint(values)
        frame = output.footprint.args[0]
        skipped.append(int((frame.lists.starts[1:] - ends_of(frame)).sum()))
        return bits(output, gradients) + [
            tensor.numpy().tobytes() for tensor in vars(footprint).values()
        ]

    skipped = []
    monkeypatch.setattr(executor, "SPLIT_BLOCKS", 0)
    expected = run()
    monkeypatch.setattr(executor, "SPLIT_BLOCKS", 5)
    original, place, builder = Workspace.take, interpreter_builder.set_grid_idx, interpreter_builder

    def poisoned(self, name, count, dtype):
        view = original(self, name, count, dtype)
        return view.fill_(torch.nan if dtype.is_floating_point else torch.iinfo(dtype).max // 2)

    def shuffled(x, y, z):
        count = builder.grid_dim[0]
        order = torch.randperm(count, generator=torch.Generator().manual_seed(count))
        place(int(order[x]), y, z)

    monkeypatch.setattr(Workspace, "take", poisoned)
    monkeypatch.setattr(builder, "set_grid_idx", shuffled)
    assert run() == expected
    assert skipped[0] == skipped[1] > 50


def misses(case, gaussians):
    """The largest errors against the reference, each relative to the largest value; the output."""
    results = []
    for rasterizer, dtype in (
        (TritonRasterizer(), torch.float32),
        (ReferenceRasterizer(), torch.float64),
    ):
        copy = gaussians.map(
            lambda tensor, dtype=dtype: tensor.detach().clone().to(dtype).requires_grad_()
        )
        background = torch.tensor([0.2, 0.5, 0.9], dtype=dtype)
        output = rasterizer.render(
            copy, case.camera(), case.sh_degree, background, absolute_gradient=True
        )
        loss = output.image.square().sum() + 0.3 * output.alpha.square().sum()
        loss.backward()
        found = {name: tensor.grad for name, tensor in copy.tensors().items()}
        found |= {
            "image": output.image,
            "screen": output.screen_points.grad,
            "absolute": output.screen_gradient_abs,
        }
        results.append((output, {name: tensor.detach().double() for name, tensor in found.items()}))
    (output, found), (_, expected) = results
    errors = {
        name: (found[name] - wanted).abs().max() / wanted.abs().max()
        for name, wanted in expected.items()
    }
    return {name: float(error) for name, error in errors.items()}, output


def test_the_backward_pass_of_a_long_list_runs_in_segments():
    """One block has a list of about 600 faint Gaussians, which are three segments.

    Some opaque Gaussians among them stop some of the pixels.
    """
    case = Case(16, 8, 620, sh_degree=1)
    gaussians = case.gaussians()
    gaussians.means[:, :2] *= 0.3
    gaussians.log_scales[:] = torch.tensor([0.2, 0.0, -0.2])
    gaussians.opacity_logits[:] = -4.5
    gaussians.log_scales[::40] = torch.tensor([-1.6, -2.0, -2.4])
    gaussians.opacity_logits[::40] = 6.0
    errors, output = misses(case, gaussians)
    frame = output.footprint.args[0]
    assert int(ends_of(frame)[0]) > 2 * layout.SEGMENT.value > int(frame.last.min()) > 0
    assert len(frame.borders) == 2 * layout.BORDER.value
    assert max(errors.values()) < 1e-5


@pytest.mark.parametrize("logit", [0.0, 4.0])
def test_lists_with_short_segments_match_the_reference(monkeypatch, logit):
    """Six blocks have lists of about 60 entries, in segments of eight.

    All pixels of a block have stopped before some of the segments.
    """
    case = Case(20, 17, 80, sh_degree=1, log_scale=-0.5, logit=logit)
    shorten_segments(monkeypatch)
    errors, output = misses(case, case.gaussians())
    frame = output.footprint.args[0]
    crossed = (ends_of(frame) - frame.lists.starts[:-1] - 1) // 8
    assert int(crossed.sum()) > 15
    assert bool(((frame.lists.starts[1:] - frame.lists.starts[:-1] - 1) // 8 > crossed).any())
    assert max(errors.values()) < 1e-5


def test_a_scene_far_from_the_origin_gives_the_same_image():
    """Scene and camera are moved by about 1,000 units, a distance that is exact in float32."""
    shift = torch.tensor([1024.0, -512.0, 256.0])
    here, camera = TINY.gaussians(), TINY.camera()
    here.means = (here.means * 2**10).round() / 2**10
    there = here.map(Tensor.clone)
    there.means += shift
    moved = Camera(
        camera.width,
        camera.height,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        camera.rotation,
        camera.translation - camera.rotation @ shift.double().numpy(),
    )
    images = [
        TritonRasterizer().render(gaussians.map(Tensor.float), view, 0, BLACK).image
        for gaussians, view in ((here, camera), (there, moved))
    ]
    assert (images[0] - images[1]).abs().max() < 1e-4
    assert images[0].std() > 0.01


def test_memory_of_a_render_in_inference_mode_can_be_reused_for_training():
    rasterizer = TritonRasterizer()
    with torch.inference_mode():
        image = rasterizer.render(leaves(TINY), TINY.camera(), 3, BLACK).image
    _, expected = render_with_gradients(TritonRasterizer(), TINY, torch.float32)
    output, gradients = render_with_gradients(rasterizer, TINY, torch.float32)
    assert image.shape == output.image.shape
    assert torch.equal(gradients["means"], expected["means"])


def test_nothing_stays_alive_after_a_step():
    """All memory is freed without the garbage collector."""
    rasterizer, loss = TritonRasterizer(), TritonLoss(0.2)
    parameters = leaves(TINY)
    target = torch.zeros(TINY.height, TINY.width, 3, dtype=torch.uint8)
    alive = []
    collecting = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        for _ in range(3):
            output = rasterizer.render(parameters, TINY.camera(), 3, BLACK, absolute_gradient=True)
            value = loss(output.image, target)[0]
            value.backward()
            kept = [
                output.image,
                output.alpha,
                output.radii,
                output.screen_points,
                output.screen_gradient_abs,
                value,
            ]
            alive += [
                weakref.ref(tensor) for tensor in [*kept, output.image.grad_fn, value.grad_fn]
            ]
            del output, value, kept
        assert [reference() for reference in alive if reference() is not None] == []
        assert [
            len(free) for pool in (rasterizer._frames, loss.pool) for free in pool._free.values()
        ] == [1, 1]
    finally:
        if collecting:
            gc.enable()


def test_memory_grows_if_there_are_more_units_than_expected():
    """The Gaussians are as large as the image. A second render gives the same image."""
    gaussians = random_gaussians(6, seed=1, log_scale=(0.5, 1.0)).map(Tensor.float)
    camera = Camera(90, 120, 90, 90, 45, 60, np.eye(3), np.zeros(3))
    rasterizer = TritonRasterizer()
    first = rasterizer.render(gaussians, camera, 0, BLACK)
    second = rasterizer.render(gaussians, camera, 0, BLACK)
    reference = ReferenceRasterizer().render(
        gaussians.map(Tensor.double), camera, 0, BLACK.double()
    )
    assert (reference.radii > 60).any()
    assert torch.equal(first.image, second.image)
    assert (first.image - reference.image).abs().max() < 1e-5


def test_32_bit_numbers_of_blocks_give_the_same_bits(monkeypatch):
    expected = bits_of(TritonRasterizer(), TINY)
    monkeypatch.setattr(lists, "MAX_INT16", 0)
    assert bits_of(TritonRasterizer(), TINY) == expected


@pytest.mark.parametrize(
    "case", [TINY, SMALL, Case(20, 17, 80, sh_degree=1, log_scale=-0.5)], ids=str
)
def test_the_memory_of_a_render_is_the_documented_one(case):
    rasterizer = TritonRasterizer()
    output = rasterizer.render(leaves(case), case.camera(), case.sh_degree, BLACK)
    frame = output.footprint.args[0]
    output.image.sum().backward()
    count, pairs, blocks = case.count, frame.lists.room.pairs, frame.blocks
    del output, frame
    free = [
        workspace
        for pool in (rasterizer._frames, rasterizer._scratch)
        for workspace in pool._free.values()
    ]
    buffers = [tensor for (workspace,) in free for tensor in workspace._buffers.values()]
    room = next(
        len(tensor)
        for (workspace,) in free
        for name, tensor in workspace._buffers.items()
        if name == "pair_ends"
    )
    assert room >= 2 * count
    assert pairs > count / 2
    borders = (pairs - 1) // layout.SEGMENT.value * layout.BORDER.value * 4
    # bytes per Gaussian, unit, pair and block, as docs/gpu.md says; and once per render: the
    # invisible record, the end of the lists, flags and status
    stated = 136 * count + 20 * room + 84 * pairs + 1048 * blocks + borders + (64 + 4 + 4 + 3 * 8)
    assert sum(tensor.nbytes for tensor in buffers) == stated


def test_more_pairs_than_can_be_sorted_are_refused(monkeypatch):
    monkeypatch.setattr(lists, "MAX_INT32", 3)
    with pytest.raises(ValueError, match="more than 3"):
        TritonRasterizer().render(leaves(TINY), TINY.camera(), 0, BLACK)


def test_a_background_that_is_not_finite_is_named(monkeypatch):
    """On a device, only the kernels read it."""
    monkeypatch.setattr(staged, "check_settings", lambda *_: None)
    with pytest.raises(ValueError, match="background"):
        TritonRasterizer().render(
            leaves(TINY), TINY.camera(), 0, torch.tensor([0.0, torch.nan, 0.0])
        )


def tiny_scene(truth):
    views = []
    for i, angle in enumerate((-0.4, 0.0, 0.4)):
        camera = replace(orbit_camera(angle, 18, 14), fx=18.0, fy=18.0)
        image = ReferenceRasterizer().render(truth, camera, 0, BLACK).image
        views.append(
            View(f"{i}.png", camera, (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
        )
    return Scene("tiny", tuple(views), tuple(views[:1]))


def test_training_matches_that_of_the_reference(tmp_path):
    """Thirty iterations; the densifier changes the Gaussians once, after the twentieth.

    The initial Gaussians are spheres. If rounding errors gave their rotations a gradient, Adam
    would turn them. It would show when a split places the halves along the rotated axes.
    """
    truth = random_gaussians(10, seed=2, log_scale=(-2.0, -1.0)).map(Tensor.float)
    truth.opacity_logits += 2
    scene = tiny_scene(truth)
    options = TrainConfig(
        name="test",
        iterations=30,
        sh_interval=10,
        position_steps=30,
        checkpoint_every=100,
        log_every=1,
    )
    colors = torch.full((len(truth), 3), 127, dtype=torch.uint8)

    def train(rasterizer):
        folder = tmp_path / rasterizer.name
        folder.mkdir()
        cloud = gaussians_from_cloud(truth.means.double().numpy(), colors.numpy())
        densifier = ADC(start=15, stop=29, interval=20, opacity_reset_interval=1000)
        gaussians = Trainer(scene, cloud, densifier, rasterizer, options, 0).run(folder)
        return gaussians, [
            json.loads(line)["loss"] for line in (folder / "metrics.jsonl").read_text().splitlines()
        ]

    gaussians, losses = train(TritonRasterizer())
    expected, expected_losses = train(ReferenceRasterizer())
    assert len(losses) == 30
    assert losses[:20] == pytest.approx(expected_losses[:20], rel=2e-5)
    assert losses[20:] == pytest.approx(expected_losses[20:], rel=5e-3)
    assert losses[-1] < 0.8 * losses[0]
    assert len(gaussians) == len(expected) > len(truth)


@pytest.mark.parametrize(
    "size, weight", [((3, 4), 0.2), ((11, 16), 0.0), ((11, 16), 1.0), ((37, 53), 0.2)], ids=str
)
def test_the_loss_matches_float64(size, weight):
    """The last size is wider than one strip and higher than one program."""
    for _, *terms in check_loss(TritonLoss(weight), *images(*size), weight):
        assert not any(term.requires_grad for term in terms)


def test_equal_images_have_no_loss_and_an_image_without_gradient_has_the_same_loss():
    image, target = images(11, 16)
    check_equal_images(TritonLoss(0.2), image)
    transposed = image.transpose(0, 1).contiguous().transpose(0, 1)
    value = TritonLoss(0.2)(transposed, target)[0]
    assert not value.requires_grad
    assert value == TritonLoss(0.2)(image.clone().requires_grad_(), target)[0]


class Regularized(ADC):
    """ADC with terms of the loss: every second step, by one or several paths, or without gradient."""

    def regularizer(self, gaussians):
        opacities, scales = gaussians.opacities, gaussians.scales
        crowded = (gaussians.opacity_logits / (1 - opacities)).mean().square()
        terms = [
            0.1 * opacities.mean() + 0.2 * scales.mean(),
            None,
            crowded + gaussians.sh_rest.sum(),
        ]
        self.asked = getattr(self, "asked", -1) + 1
        return [*terms, None, torch.tensor(2.0)][self.asked % 5]


class FixedViews:
    """Trains a small scene from two cameras, by steps with autograd or by direct ones."""

    def __init__(self, direct, absolute=False, masks=(), regularized=False, visible_only=False):
        """``masks`` are the views with a mask."""
        generator = torch.Generator().manual_seed(5)
        views = tuple(
            View(
                f"{k}.png",
                orbit_camera(angle, width=20, height=17),
                torch.randint(0, 256, (17, 20, 3), dtype=torch.uint8, generator=generator).numpy(),
                np.arange(17 * 20).reshape(17, 20) % 7 < 5 if k in masks else None,
            )
            for k, angle in enumerate((0.0, 0.4))
        )
        densifier = (Regularized if regularized else ADC)(
            start=1,
            stop=9,
            interval=3,
            opacity_reset_interval=4,
            gradient_threshold=1e-7,
            gradient="absolute" if absolute else "signed",
        )
        options = TrainConfig(
            name="test",
            iterations=100,
            sh_interval=2,
            densify_start=1,
            visible_adam=visible_only,
        )
        scene = Scene("test", views, ())
        initial = random_gaussians(25, seed=3).map(lambda tensor: tensor.float())
        initial.means[::4, 2] -= 20  # never seen
        self.trainer = Trainer(scene, initial, densifier, TritonRasterizer(), options, seed=0)
        trainer = self.trainer
        trainer.gaussians.step_all = TritonAdam()
        trainer.loss = TritonLoss(options.ssim_weight)
        self.direct = DirectStep(
            trainer.rasterizer, TritonLoss(options.ssim_weight), BLACK, False, visible_only
        )
        if direct:
            trainer.fast = self.direct

    def iterate(self, steps):
        for _ in range(steps):
            self.trainer.iterate(Path("/nonexistent"))

    def state(self):
        state = self.trainer._state()
        return list(tree_leaves([state["gaussians"], state["densifier"]]))


@pytest.mark.parametrize(
    "settings, room",
    [
        ({}, lists.Room(1, 10**4)),
        ({"absolute": True}, lists.Room(10**4, 1)),
        ({"masks": (1,), "regularized": True, "visible_only": True}, lists.Room(1, 1)),
        ({"masks": (0, 1), "regularized": True}, lists.Room(1, 1)),
    ],
    ids=str,
)
def test_direct_steps_have_the_bits_of_steps_with_autograd(settings, room):
    """Statistics, moments and step counts, too.

    Between the steps are refinements, an opacity reset, and lists that keep only ``room``.
    """
    expected, found = (FixedViews(direct, **settings) for direct in (False, True))
    expected.iterate(7)
    found.iterate(4)
    before = found.direct.repeats
    found.direct.limit_room(room)
    found.iterate(3)
    assert found.direct.repeats > before
    for own, theirs in zip(found.state(), expected.state(), strict=True):
        same = torch.equal(own, theirs) if isinstance(own, Tensor) else own == theirs
        assert same
    assert found.trainer.losses.wait() == expected.trainer.losses.wait()


def test_the_footprint_of_a_direct_step_is_that_of_its_own_view():
    steps = FixedViews(True)
    model, cameras = steps.trainer.gaussians, [view.camera for view in steps.trainer.scene.train]
    target = torch.zeros(17, 20, 3, dtype=torch.uint8)
    for camera in cameras:
        render, _ = steps.direct.step(model, camera, target, 1, False, None)
        found = render.require_footprint()
        expected = TritonRasterizer().render(model.values, camera, 1, BLACK).require_footprint()
        for own, theirs in zip(vars(found).values(), vars(expected).values(), strict=True):
            assert torch.equal(own, theirs)


def test_memory_of_direct_steps_is_kept_for_few_sizes():
    steps = FixedViews(True)
    for width in range(4, 4 + MOST_SIZES + 2):
        camera = orbit_camera(0.0, width=width, height=4)
        target = torch.zeros(4, width, 3, dtype=torch.uint8)
        image = steps.direct.step(steps.trainer.gaussians, camera, target, 0, False, None)[0].image
        expected = TritonRasterizer().render(steps.trainer.gaussians.values, camera, 0, BLACK).image
        assert torch.equal(image, expected)
    assert [size[0] for size in steps.direct._memory] == [6, 7, 8, 9]
    assert set(steps.direct._plan) == set(steps.direct._memory)


def test_direct_steps_pass_their_proof_and_a_fault_of_them_is_found(monkeypatch):
    cpu = torch.device("cpu")
    assert direct_fault(TritonRasterizer(), cpu, TINY) == ""
    real = TritonAdam.launch

    def late(self, updates, factors, seen, visible):
        real(self, updates, factors, seen, visible)
        if seen is not None:  # as in direct steps alone
            for update in updates:
                update.parameter.detach().mul_(1 + 1e-6)

    monkeypatch.setattr(TritonAdam, "launch", late)
    assert "has other bits after 6 direct steps" in direct_fault(TritonRasterizer(), cpu, TINY)


@pytest.mark.parametrize("active", [None, 9])
def test_adam_matches_that_of_torch_and_reads_no_undefined_gradient(active):
    generator = torch.Generator().manual_seed(2)
    values = torch.randn(30, 15, 3, generator=generator)
    seen = (torch.rand(30, generator=generator) < 0.6).int()
    theirs = torch.nn.Parameter(values.double())
    optimizer = torch.optim.Adam([theirs], lr=0.01, eps=1e-15)
    state = ParameterState(
        0.01, 0, {name: torch.zeros_like(values) for name in ("first", "second")}
    )
    for _ in range(5):
        gradient = torch.randn(30, 15, 3, generator=generator)
        read = (seen > 0)[:, None] & (torch.arange(45) < (active or 45))
        theirs.grad = torch.where(read.view(30, 15, 3), gradient, 0.0).double()
        optimizer.step()
        state.step += 1
        undefined = torch.where(read.view(30, 15, 3), gradient, torch.nan)
        TritonAdam()([Update(values, undefined, state, active)], seen)
    assert torch.allclose(values.double(), theirs.detach(), rtol=0, atol=1e-6)
