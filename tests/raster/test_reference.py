"""The reference rasterizer against finite differences, plain loops and gsplat's torch code."""

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch.testing import assert_close

from gsbench.raster.reference import ReferenceRasterizer
from tests.gaussians.helpers import front_camera, leaves, random_gaussians


def brute_force(gaussians, camera, background):
    """Render pixel by pixel in plain Python from the published formulas, with colours of degree 0.

    Returns image, opacity and footprints [N, 3]. Over the pixels that a Gaussian is blended into, a
    footprint is their number, the sum of column + 100 row, and the sum of distances to its mean.
    """
    items = []
    for i in range(len(gaussians)):
        view = camera.rotation @ gaussians.means[i].numpy() + camera.translation
        if view[2] <= 0.2:
            continue
        w, x, y, z = (gaussians.quaternions[i] / gaussians.quaternions[i].norm()).tolist()
        matrix = np.array(
            [
                [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
            ]
        )
        sigma = matrix @ np.diag(np.exp(2 * gaussians.log_scales[i].numpy())) @ matrix.T
        right = (camera.width - camera.cx) / camera.fx + 0.3 * camera.width / (2 * camera.fx)
        left = camera.cx / camera.fx + 0.3 * camera.width / (2 * camera.fx)
        bottom = (camera.height - camera.cy) / camera.fy + 0.3 * camera.height / (2 * camera.fy)
        top = camera.cy / camera.fy + 0.3 * camera.height / (2 * camera.fy)
        tx = min(max(view[0] / view[2], -left), right) * view[2]
        ty = min(max(view[1] / view[2], -top), bottom) * view[2]
        jacobian = np.array(
            [
                [camera.fx / view[2], 0, -camera.fx * tx / view[2] ** 2],
                [0, camera.fy / view[2], -camera.fy * ty / view[2] ** 2],
            ]
        )
        turned = jacobian @ camera.rotation
        covariance = turned @ sigma @ turned.T + 0.3 * np.eye(2)
        largest = np.linalg.eigvalsh(covariance)[1]
        focal, principal = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        pixel = focal * view[:2] / view[2] + principal - 0.5
        rgb = np.maximum(0, gaussians.sh_dc[i].numpy() * 0.28209479177387814 + 0.5)
        opacity = 1 / (1 + math.exp(-float(gaussians.opacity_logits[i])))
        radius = math.ceil(3 * math.sqrt(largest))
        items.append((view[2], pixel, np.linalg.inv(covariance), radius, opacity, rgb, i))
    items.sort(key=lambda item: item[0])
    image = np.zeros((camera.height, camera.width, 3))
    alpha_image = np.zeros((camera.height, camera.width))
    covered = np.zeros((len(gaussians), 3))
    for row in range(camera.height):
        for column in range(camera.width):
            transmittance, color = 1.0, np.zeros(3)
            tile = np.array([column, row]) // 16
            for _, pixel, inverse, radius, opacity, rgb, i in items:
                first, past = ((pixel + edge) // 16 for edge in (-radius, radius + 15))
                if (tile < first).any() or (tile >= past).any():
                    continue
                offset = np.array([column, row]) - pixel
                alpha = min(0.99, opacity * math.exp(-0.5 * offset @ inverse @ offset))
                if alpha < 1 / 255:
                    continue
                if transmittance * (1 - alpha) < 1e-4:
                    break
                color += rgb * alpha * transmittance
                transmittance *= 1 - alpha
                covered[i] += 1, column + 100 * row, math.hypot(*offset)
            image[row, column] = color + transmittance * background
            alpha_image[row, column] = 1 - transmittance
    return image, alpha_image, covered


@pytest.mark.parametrize("shift", [(0.0, 0.0), (5.0, -4.0)])
def test_images_and_footprints_match_brute_force(shift):
    gaussians = random_gaussians(60, seed=3, log_scale=(-3.5, -0.5))
    # opaque ones reach both the clamp of alpha and the early stop
    gaussians.opacity_logits[:8] = 6.0
    camera = front_camera(37, 21, shift)
    background = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    out = ReferenceRasterizer().render(gaussians, camera, 0, background)
    image, alpha, covered = brute_force(gaussians, camera, background.numpy())
    assert_allclose(out.image.detach().numpy(), image, atol=1e-10)
    assert_allclose(out.alpha.detach().numpy(), alpha, atol=1e-10)
    assert alpha.max() > 0.999
    footprint = out.footprint(torch.arange(37) + 100 * torch.arange(21).unsqueeze(1))
    assert footprint.pixels.tolist() == covered[:, 0].tolist()
    assert footprint.values.tolist() == covered[:, 1].tolist()
    assert_allclose(footprint.distances, covered[:, 2], rtol=1e-12)
    depths = gaussians.means.numpy() @ camera.rotation[2] + camera.translation[2]
    assert_allclose(footprint.depths, depths)
    assert (covered[:, 0] > 0).sum() > 30


@pytest.mark.parametrize("degree", [0, 3])
def test_gradients_match_finite_differences(degree):
    gaussians = random_gaussians(6, seed=11, log_scale=(-2.2, -1.2))
    # below the clamp of alpha, whose gradient is passed on purpose
    gaussians.opacity_logits.clamp_(max=1.5)
    gaussians.sh_dc.clamp_(min=-0.5)  # above the clamp of colours
    camera, background = front_camera(20, 18), torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    rng = torch.Generator().manual_seed(0)
    weights = torch.randn(18, 20, 3, generator=rng, dtype=torch.float64)

    def loss(values):
        out = ReferenceRasterizer().render(values, camera, degree, background)
        return (out.image * weights).sum() + out.alpha.sum()

    own = leaves(gaussians)
    loss(own).backward()
    epsilon = 1e-6
    for name, tensor in own.tensors().items():
        if name == "sh_rest" and degree == 0:
            assert tensor.grad is None
            continue
        positions = list(np.ndindex(*tensor.shape))[:: 7 if name == "sh_rest" else 1]
        numeric = torch.zeros(len(positions), dtype=torch.float64)
        with torch.no_grad():
            for number, position in enumerate(positions):
                shifted = []
                for sign in (1, -1):
                    moved = gaussians.map(torch.clone)
                    getattr(moved, name)[position] += sign * epsilon
                    shifted.append(loss(moved))
                numeric[number] = (shifted[0] - shifted[1]) / (2 * epsilon)
        assert numeric.abs().max() > 0
        found = torch.stack([tensor.grad[position] for position in positions])
        assert_close(found, numeric, atol=2e-6, rtol=2e-4, msg=lambda m, n=name: f"{n}: {m}")


def test_screen_gradient_is_the_gradient_of_the_projected_mean_in_ndc():
    """A shift of the principal point shifts all projected means by the same distance.

    So the sum of the screen gradients is the derivative of the loss by the shift.
    """
    gaussians = random_gaussians(30, seed=5)
    background = torch.zeros(3, dtype=torch.float64)

    def loss(shift):
        camera = front_camera(32, 32, (shift, 0.0))
        out = ReferenceRasterizer().render(leaves(gaussians), camera, 0, background, True)
        value = (out.image**2).sum()
        value.backward()
        return value.detach(), out.screen_points.grad, out.screen_gradient_abs

    _, gradient, absolute = loss(0.0)
    # px; the clamp of the Jacobian moves with the principal point too, but no mean is near it
    epsilon = 1e-6
    numeric = (loss(epsilon)[0] - loss(-epsilon)[0]) / (2 * epsilon)
    assert gradient[:, 0].sum() / (32 / 2) == pytest.approx(float(numeric), rel=1e-4)
    assert (absolute >= gradient.abs() - 1e-12).all()
    assert (absolute > 1.01 * gradient.abs()).any()
