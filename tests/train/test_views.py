"""The training views: small pictures first, and what densifiers get of the views."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from gsbench.analysis.differences import ingredients
from gsbench.densify import NoDensifier
from gsbench.densify.scores import blended_sums
from gsbench.eval.ssim import ssim_map
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.runs.code import config_hash
from gsbench.scene.types import View
from gsbench.train.loss import photometric_loss
from gsbench.train.views import (
    Resolution,
    ScaledViews,
    ScaleSchedule,
    Targets,
    scale_schedule,
)
from tests.config.test_schema import composed
from tests.train.conftest import orbit_camera
from tests.train.lab import CPU, options, same, small

SHORT = {"densify_start": 20, "densify_stop": 100, "densify_interval": 20}


def soft_pictures(count, height, width, seed):
    """Noise whose amplitude falls with the frequency, as in photographs."""
    rng = np.random.default_rng(seed)
    frequency = (
        np.hypot(np.fft.fftfreq(height)[:, None] * height, np.fft.fftfreq(width)[None] * width) + 1
    )
    pictures = []
    for k in range(count):
        noise = np.fft.fft2(rng.normal(size=(height, width, 3)), axes=(0, 1)) / frequency[
            ..., None
        ] ** (1.3 + 0.1 * k)
        wave = np.fft.ifft2(noise, axes=(0, 1)).real
        pictures.append((255 * (wave - wave.min()) / np.ptp(wave)).astype(np.uint8))
    return pictures


def stated_again(pictures, until):
    """The scales where the schedule bends, and that of each iteration from 0 to ``until``.

    They are found by bisection.
    """
    height, width, _ = pictures[0].shape

    def window(spectrum, scale):
        tall, wide = int(height / scale) // 2, int(width / scale) // 2
        return float(
            spectrum[height // 2 - tall :, width // 2 - wide :][: 2 * tall, : 2 * wide].sum()
        )

    def solve(spectrum, share):
        low, high = 0.0, 1.0
        for _ in range(64):
            middle = (low + high) / 2
            low, high = (middle, high) if window(spectrum, 1 / middle) < share else (low, middle)
        return 1 / high

    spectra = []
    for picture in pictures:
        channels = [np.abs(np.fft.fftshift(np.fft.fft2(picture[..., c] / 255.0))) for c in range(3)]
        spectra.append(sum(channels[1:], channels[0]))
    largest = min([8.0] + [solve(spectrum, spectrum.sum() / 4) for spectrum in spectra])
    mean = sum(spectra[1:], spectra[0]) / len(spectra)
    first, whole = window(mean, largest), float(mean.sum())
    shares = [first + (whole - first) * i / 31 for i in range(32)]
    scales = [largest, *(solve(mean, share) for share in shares[1:-1]), 1.0]
    begins = [
        int(until * math.log(share / first) / math.log(whole / first)) for share in shares[:-1]
    ] + [until]
    answers = []
    for step in range(until):
        i = max(k for k in range(32) if begins[k] <= step)
        way = (step - begins[i]) / (begins[i + 1] - begins[i])
        answers.append(
            int((scales[i] ** -2 + way * (scales[i + 1] ** -2 - scales[i] ** -2)) ** -0.5 + 1e-9)
        )
    return scales, [*answers, 1]


@pytest.mark.parametrize("height, width, until", [(48, 64, 1000), (90, 60, 15_000), (47, 33, 300)])
def test_the_schedule_of_sizes_matches_a_restatement(height, width, until):
    pictures = soft_pictures(3, height, width, height)
    found = scale_schedule(pictures, until)
    scales, expected = stated_again(pictures, until)
    assert found.scales == pytest.approx(scales, rel=1e-9)
    assert [found.at(step) for step in range(until + 1)] == expected
    assert expected[0] > 2  # the pictures start small
    assert expected == sorted(expected, reverse=True)
    assert found.at(10 * until) == 1


def test_pictures_of_several_shapes_and_without_content_have_a_schedule():
    mixed = [*soft_pictures(2, 47, 63, 1), *soft_pictures(1, 64, 31, 2)]
    found = scale_schedule(mixed, 500)
    assert found.scales[-1] == 1
    assert list(found.begins) == sorted(set(found.begins))
    assert list(found.scales) == sorted(found.scales, reverse=True)
    black = scale_schedule([*mixed, np.zeros((8, 8, 3), np.uint8)], 500)
    assert {black.at(step) for step in range(501)} == {1}
    # a constant picture has energy only at frequency zero, which is in every window
    assert scale_schedule([np.full((8, 8, 3), 99, np.uint8)], 500).at(500) == 1


def weights(size, smaller):
    """Weights [smaller, size] of a triangular filter, one small pixel wide on each side."""
    scale = size / smaller
    centres = (np.arange(smaller) + 0.5) * scale
    triangle = np.maximum(0, 1 - np.abs(np.arange(size) + 0.5 - centres[:, None]) / scale)
    return triangle / triangle.sum(1, keepdims=True)


def reduced(view, scale):
    """The camera and the picture of a view with sides divided by ``scale``."""
    cameras, targets = ScaledViews([view], Targets([view], CPU), CPU, None).at(scale)
    return cameras[0], targets.get(0)


@pytest.mark.parametrize("scale, height, width", [(2, 16, 20), (3, 10, 13), (8, 4, 5)])
def test_a_small_picture_is_filtered_and_its_camera_is_resized(scale, height, width):
    camera = orbit_camera(0.3)
    (image,) = soft_pictures(1, camera.height, camera.width, 5)
    small, picture = reduced(View("a.png", camera, image), scale)
    assert (small.width, small.height) == (width, height)
    rows, columns = weights(camera.height, height), weights(camera.width, width)
    expected = np.einsum("ih,hwc,jw->ijc", rows, image / 1.0, columns)
    assert np.abs(picture.numpy() - expected).max() <= 0.5 + 1e-4
    x, y, z = camera.rotation @ np.array([0.1, -0.2, 0.3]) + camera.translation
    across = (camera.fx * x / z + camera.cx) / camera.width
    down = (camera.fy * y / z + camera.cy) / camera.height
    assert (small.fx * x / z + small.cx) / width == pytest.approx(across)
    assert (small.fy * y / z + small.cy) / height == pytest.approx(down)


def test_a_picture_keeps_at_least_one_pixel():
    view = View("a.png", orbit_camera(0.0, 5, 3), np.full((3, 5, 3), 7, np.uint8))
    camera, picture = reduced(view, 8)
    assert (camera.width, camera.height) == (1, 1)
    assert picture.tolist() == [[[7, 7, 7]]]


def scheduled(scene):
    return Resolution(options(resolution_schedule="pictures", **SHORT), scene.train)


def test_sizes_change_after_rounds_and_position_rates_wait_for_full_size(tiny_scene):
    resolution = scheduled(tiny_scene)
    scales = [resolution.scale(step) for step in range(1, 121)]
    assert scales[0] >= 2
    assert set(scales[:40]) == {scales[0]}  # the first round is at 40
    for i in range(0, 100, 20):
        assert len(set(scales[i : i + 20])) == 1
    assert set(scales[100:]) == {1}
    wait = resolution.schedule.full_from
    assert 0 < wait < 100
    assert resolution.position_step(wait) == resolution.position_step(1) == 0
    assert resolution.position_step(120) == 120
    assert resolution.position_step((120 + wait) / 2) == pytest.approx(60)
    resolution.options.position_steps = wait  # no iteration is left for the schedule
    assert resolution.position_step(wait + 1) == wait


def test_masks_are_as_small_as_their_pictures(lab):
    """In small pictures, too, the content of ignored pixels does not change the training."""
    trained = []
    for value in (0, 255):
        views = []
        for view in lab.scene.train:
            counts = np.ones(view.image.shape[:2], bool)
            counts[:24, :28] = False
            image = view.image.copy()
            image[:3, :3] = value  # at half size, two windows of SSIM do not reach it from outside
            views.append(replace(view, image=image, mask=counts))
        own = lab.with_views(train=tuple(views))
        training = own.new(
            small(), resolution_schedule="pictures", iterations=30, position_steps=30, **SHORT
        )
        training.resolution.schedule = ScaleSchedule((0, 100), (2.0, 1.0))
        assert training.scaled_views.at(2)[1].mask(0).shape == (16, 20, 1)
        (lab.folder / str(value)).mkdir()
        trained.append(training.run(lab.folder / str(value)))
    assert same(*trained)


def test_the_schedule_is_an_ingredient_and_part_of_the_hash():
    without, with_it = composed(), composed("train.resolution_schedule=pictures")
    assert config_hash(without) != config_hash(with_it)
    plain = {"densify._target_": "gsbench.densify.ADC", "train.resolution_schedule": "none"}
    assert ingredients(plain, plain | {"train.resolution_schedule": "pictures"}) == (
        "resolution schedule",
    )


@pytest.mark.parametrize(
    "scales, full",
    [
        ((8.0, 4.0, 2.0, 1.0), 200),
        ((8.0, 2.5, 1.9, 1.0), 100),
        ((1.9, 1.5, 1.2, 1.0), 0),
        ((3.0, 1.0, 1.0, 1.0), 0),
    ],
)
def test_full_size_begins_at_the_last_point_with_a_scale_of_two_or_more(scales, full):
    assert ScaleSchedule((0, 100, 200, 300), scales).full_from == full


def test_views_are_rendered_and_measured_as_in_training(lab):
    lab.rasterizer, views_of_scene = ReferenceRasterizer(), lab.scene.train
    trainer = lab.new(NoDensifier(), background=[0.2, 0.4, 0.6])
    views, gaussians = trainer.context.training_views, trainer.gaussians.values
    gaussians.sh_rest.data += 0.1
    assert len(views) == len(views_of_scene)
    for index, view in enumerate(views_of_scene[:2]):
        assert torch.equal(views.image(index), torch.from_numpy(view.image))
        for step, degree in ((39, 0), (40, 1), (120, 3), (400, 3)):  # a degree every 40 iterations
            image = views.render(index, gaussians, step).image
            own = trainer.rasterizer.render(
                gaussians, view.camera, degree, torch.tensor([0.2, 0.4, 0.6])
            ).image
            assert torch.equal(image, own)
        expected, _, _ = photometric_loss(own.detach(), torch.from_numpy(view.image))
        assert views.loss(index, own) == expected
        assert not views.loss(index, own).requires_grad
        photograph = torch.from_numpy(view.image) / 255
        dissimilar = views.dissimilarity(index, own.detach())
        assert_close(dissimilar, (1 - ssim_map(own.detach(), photograph).mean(0)).clamp_min(0))
        assert dissimilar.shape == view.image.shape[:2]
        assert float(views.dissimilarity(index, photograph).abs().max()) < 1e-6


def test_rendering_a_view_for_scores_leaves_no_gradient(lab):
    lab.rasterizer = ReferenceRasterizer()
    trainer = lab.new(NoDensifier())
    views, gaussians = trainer.context.training_views, trainer.gaussians.values
    with torch.no_grad():
        sums, render = blended_sums(views, 0, gaussians, 100, torch.ones(*views.image(0).shape))
    assert torch.equal(sums[:, 0], sums[:, 2])
    # the sum of all blending weights
    assert_close(sums[:, 0].sum(), render.alpha.sum())
    assert all(tensor.grad is None for tensor in gaussians.tensors().values())
