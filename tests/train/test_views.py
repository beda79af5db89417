"""What densifiers get of the training views."""

import torch
from torch.testing import assert_close

from gsbench.densify import NoDensifier
from gsbench.densify.scores import blended_sums
from gsbench.eval.ssim import ssim_map
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.train.loss import photometric_loss


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
