"""The adapter for gsplat against the float64 reference, without a GPU.

It runs on a stand-in with gsplat's signatures.
"""

import gc
import weakref

import pytest
import torch

from benchmarks.gsplat_raster import GsplatRasterizer, _reaches_image, _square_radii
from gsbench.raster.contract import Case, departures, render_with_gradients
from gsbench.raster.reference import ReferenceRasterizer, project, tile_rectangles
from tests.gaussians.helpers import front_camera, random_gaussians
from tests.gaussians.helpers import leaves as of_gaussians
from tests.raster.promises import leaves

# no alpha reaches a clamp
FAINT = Case(50, 37, 60, sh_degree=3, log_scale=-2.0, logit=-3.0, principal=(3.0, -2.0))
PLAIN = FAINT.gaussians().map(torch.Tensor.float)


@pytest.fixture
def library():
    pytest.importorskip("gsplat", reason="the stand-in is made of gsplat's torch definitions")
    from tests.bench import stand_in_gsplat

    stand_in_gsplat.calls.clear()
    stand_in_gsplat.graphs.clear()
    return stand_in_gsplat


@pytest.fixture
def rasterizer(library):
    return GsplatRasterizer(library=library)


def test_values_and_gradients_match_the_reference(rasterizer):
    expected, references = render_with_gradients(ReferenceRasterizer(), FAINT, torch.float64)
    output, gradients = render_with_gradients(rasterizer, FAINT, torch.float32)
    assert (output.image.double() - expected.image).abs().max() < 1e-4
    assert (output.alpha.double() - expected.alpha).abs().max() < 1e-4
    # gsplat gives no splitting matrices
    assert references.keys() - gradients.keys() == {"splitting_matrix"}
    for name, gradient in gradients.items():
        reference = references[name]
        assert (gradient - reference).abs().max() < 1e-3 * reference.abs().max(), name
    both = output.visible & expected.visible
    assert both.sum() > 0.9 * expected.visible.sum()
    assert not (output.visible & ~expected.visible).any()  # gsplat's box culls more, never less
    assert (output.radii - expected.radii)[both].abs().max() <= 1  # rounding may change the ceil


def test_the_two_versions_of_gsplat_give_the_same_results(library):
    (image, gradients), (expected, references) = (
        render_with_gradients(GsplatRasterizer(library=version), FAINT, torch.float32)
        for version in (library.head(), library)
    )
    for called in ("spherical_harmonics of 1.6", "spherical_harmonics"):
        assert library.calls.count(called) == 1
    assert (image.image - expected.image).abs().max() < 1e-6
    for name, reference in references.items():
        assert (gradients[name] - reference).abs().max() <= 1e-5 * reference.abs().max(), name


def test_backward_may_run_late_and_twice_without_the_absolute_gradient(rasterizer):
    own = leaves(FAINT)
    background = torch.tensor([0.1, 0.2, 0.3], requires_grad=True)
    outputs = [rasterizer.render(own, FAINT.camera(), 3, background) for _ in range(2)]
    assert outputs[0].screen_gradient_abs is None
    outputs[0].image.square().sum().backward(retain_graph=True)
    once = own.means.grad.clone()
    assert once.abs().max() > 0
    through = 2 * outputs[0].image[..., 0] * (1 - outputs[0].alpha)
    assert background.grad[0].item() == pytest.approx(through.sum().item(), rel=1e-5)
    outputs[0].image.square().sum().backward()
    outputs[1].alpha.sum().backward()
    assert torch.equal(outputs[0].screen_points.grad[:, 0] != 0, once.abs().sum(-1) != 0)


def test_screen_points_have_a_gradient_even_if_no_parameter_requires_one(rasterizer):
    _, expected = render_with_gradients(rasterizer, FAINT, torch.float32)
    background = torch.tensor([0.2, 0.5, 0.9])
    output = rasterizer.render(PLAIN, FAINT.camera(), 3, background)
    rng = torch.Generator().manual_seed(7)
    weights = torch.randn(37, 50, 4, generator=rng, dtype=torch.float64).float()
    ((output.image * weights[..., :3]).sum() + (output.alpha * weights[..., 3]).sum()).backward()
    assert torch.equal(output.screen_points.grad.double(), expected["screen_points"])


def test_a_step_leaves_no_tensor_and_no_graph_alive(library, rasterizer):
    """All memory is freed without the garbage collector.

    A cycle through the graph would keep 60 MB per step at a million Gaussians.
    """
    camera, black, own = FAINT.camera(), torch.zeros(3), leaves(FAINT)
    alive = library.graphs
    gc.collect()
    gc.disable()
    try:
        for absolute in (False, True):
            for backward in (True, False):
                output = rasterizer.render(own, camera, 3, black, absolute_gradient=absolute)
                loss = output.image.sum()
                if backward:
                    loss.backward()
                alive += map(weakref.ref, (output.image, output.alpha, output.screen_points))
                del output, loss
        assert len(alive) == 16
        assert [ref() for ref in alive] == [None] * 16
    finally:
        gc.enable()


def test_gsplat_is_not_called_without_gaussians(library, rasterizer):
    own = of_gaussians(PLAIN.select(torch.zeros(0, dtype=torch.long)))
    background = torch.tensor([0.1, 0.2, 0.3])
    output = rasterizer.render(own, Case(20, 17, 1, 3).camera(), 3, background, True)
    assert library.calls == []
    assert torch.equal(output.image, background.expand(17, 20, 3))
    assert output.alpha.shape == (17, 20)
    assert output.radii.shape == (0,)
    (output.image.sum() + output.alpha.sum()).backward()
    assert output.screen_gradient_abs.shape == (0, 2)


def test_an_error_names_the_parameter_that_is_not_finite(rasterizer):
    for name in ("means", "opacity_logits", "sh_rest"):
        gaussians = PLAIN.map(torch.clone)
        getattr(gaussians, name).flatten()[0] = torch.nan
        with pytest.raises(ValueError, match=name):
            rasterizer.render(gaussians, FAINT.camera(), 3, torch.zeros(3))


def test_a_camera_is_uploaded_once_and_its_copy_is_freed_with_it(rasterizer):
    camera = FAINT.camera()
    for _ in range(3):
        rasterizer.render(PLAIN, camera, 3, torch.zeros(3))
    assert len(rasterizer._cameras) == 1
    del camera
    gc.collect()
    assert len(rasterizer._cameras) == 0


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_gpu_only_radii_depart_from_the_contract():
    pytest.importorskip("gsplat")
    told = departures(GsplatRasterizer(), "cuda", cases=(FAINT,))
    assert [line for line in told if "radius" not in line] == []


def test_square_radii_are_those_of_the_reference():
    projected = project(random_gaussians(300, seed=4, log_scale=(-4, 0.5)), front_camera(64, 48))
    seen = torch.ones(1, len(projected.index), dtype=torch.bool)
    radii = _square_radii(projected.conics.unsqueeze(0), seen)[0]
    # near an integer, rounding may change the ceil
    assert (radii - projected.radii).abs().max() <= 1
    assert (radii == projected.radii).double().mean() > 0.99


def test_a_gaussian_that_reaches_a_tile_of_the_reference_reaches_the_image():
    camera = front_camera(64, 48)
    projected = project(random_gaussians(300, seed=6, log_scale=(-4, 0)), camera)
    low, high = tile_rectangles(projected, camera)
    reached = ((high - low) > 0).all(-1)
    assert (_reaches_image(projected.means + 0.5, projected.radii, 64, 48) | ~reached).all()


def test_a_square_that_only_touches_the_image_does_not_reach_it():
    means = torch.tensor(
        [[-3.0, 5], [-2.9, 5], [67, 5], [66.9, 5], [5, -3], [5, -2.9], [5, 51], [5, 50.9], [5, 5]]
    )
    radii = torch.tensor([3, 3, 3, 3, 3, 3, 3, 3, 0])
    expected = [False, True, False, True, False, True, False, True, False]
    assert _reaches_image(means, radii, 64, 48).tolist() == expected
