"""Edge maps, sums over pixels, random draws and Taming 3DGS against restatements in numpy."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from PIL import Image, ImageFilter

from gsbench.densify import DensifyContext, Taming
from gsbench.densify.scores import blended_sums, by_mean, by_median, draw, draw_views, edge_map
from gsbench.eval.ssim import ssim_map
from gsbench.raster.reference import (
    ReferenceRasterizer,
    blending_weights,
    members_of_tiles,
    project,
    tile_rectangles,
)
from gsbench.train.loss import torch_photometric_loss
from tests.densify import restatement
from tests.densify.helpers import (
    EXTENT,
    assert_same,
    at,
    gathered,
    generator,
    to_rows,
    with_moments,
)
from tests.densify.restatement import opacity
from tests.gaussians.helpers import front_camera, random_gaussians

COUNT = 60
WIDTH, HEIGHT = 37, 21
BLACK = torch.zeros(3, dtype=torch.float64)


class Room:
    """Training views: three made-up photographs, rendered in float64."""

    def __init__(self):
        rng = np.random.default_rng(0)
        self.cameras = [front_camera(WIDTH, HEIGHT, (5.0 * k, -3.0 * k)) for k in range(3)]
        self.images = [
            torch.from_numpy(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)) for _ in range(3)
        ]

    def __len__(self):
        return len(self.images)

    def image(self, index):
        return self.images[index]

    def render(self, index, gaussians, step):
        return ReferenceRasterizer().render(gaussians, self.cameras[index], 0, BLACK)

    def shown(self, gaussians):
        """For each view its number, the render, and alpha T of every Gaussian, [N, H, W]."""
        for view, camera in enumerate(self.cameras):
            image = self.render(view, gaussians, 0).image.detach()
            yield view, image, alphas(gaussians, camera)

    def dissimilarity(self, index, image):
        return (1 - ssim_map(image, self.images[index].to(image) / 255).mean(0)).clamp_min(0)

    def loss(self, index, image):
        return torch_photometric_loss(image, self.images[index])[0]


def alphas(gaussians, camera):
    """alpha T of every Gaussian in every pixel, [N, H, W]."""
    found = np.zeros((len(gaussians), HEIGHT, WIDTH))
    projected = project(gaussians, camera)
    tiles = members_of_tiles(projected.depths, *tile_rectangles(projected, camera), camera)
    for members, (rows, columns) in tiles:
        for y in range(rows.start, rows.stop):
            for x in range(columns.start, columns.stop):
                index = projected.index[members]
                pixel = torch.tensor([[x, y]], dtype=torch.float64)
                weights = blending_weights(
                    pixel,
                    projected.means[members][None],
                    projected.conics[members],
                    gaussians.opacities[index],
                )
                found[index.numpy(), y, x] = weights[0].numpy()
    return found


def find_edges(image):
    """The edges that Pillow finds, with 0 in the outermost pixels."""
    edges = np.array(
        Image.fromarray(image.numpy()).convert("L").filter(ImageFilter.FIND_EDGES), np.float64
    )
    edges[[0, -1]], edges[:, [0, -1]] = 0, 0
    return to_unit(edges)


def to_unit(values):
    return (values - values.min()) / (values.max() - values.min())


def over_mean(values):
    return np.where(values > 0, values / values[values > 0].mean(), 0)


def over_median(values):
    positive = np.sort(values[values > 0])
    return np.where(values > 0, values / positive[(len(positive) - 1) // 2], 0)


@pytest.mark.parametrize("seed", range(3))
def test_edge_maps_match_pillow(seed):
    image = torch.from_numpy(np.random.default_rng(seed).integers(0, 256, (13, 17, 3), np.uint8))
    image[3:9, 4:12] = torch.tensor([200, 30, 90], dtype=torch.uint8)
    assert_allclose(edge_map(image), find_edges(image), atol=1e-6)
    assert not edge_map(torch.full((5, 5, 3), 90, dtype=torch.uint8)).any()
    for narrow in (image[:1], image[:2], image[:, :2], image[:, :1], image[:1, :1]):
        assert torch.equal(edge_map(narrow), torch.zeros(narrow.shape[:2]))


def test_blended_sums_are_sums_of_alpha_and_transmittance():
    gaussians, room = random_gaussians(COUNT, 3, log_scale=(-3.5, -0.5)), Room()
    gaussians.sh_dc[:] = -9.0  # all black: their own colours have no gradient
    weights = torch.rand(HEIGHT, WIDTH, 3, generator=generator(0), dtype=torch.float64)
    with torch.no_grad():  # as in a refinement
        sums, _ = blended_sums(room, 1, gaussians, 1, weights)
    expected = np.einsum("nyx,yxc->nc", alphas(gaussians, room.cameras[1]), weights.numpy())
    assert_allclose(sums, expected, atol=1e-12)
    assert (expected[:, 0] > 0).sum() > 30


def test_median_and_mean_ignore_values_that_are_not_positive():
    values = torch.tensor([0.0, -3.0, float("nan"), 4.0, 2.0, 8.0, 6.0])
    assert by_median(values).tolist() == [0, 0, 0, 1, 0.5, 2, 1.5]
    assert by_mean(values).tolist() == pytest.approx([0, 0, 0, 0.8, 0.4, 1.6, 1.2])
    assert not by_median(torch.zeros(3)).any()
    assert not by_mean(torch.zeros(3)).any()


def test_draws_are_in_proportion_and_without_replacement():
    """Two of four are drawn: first one by score, then another of the rest by score.

    So the chance of each is known.
    """
    scores = torch.tensor([9.0, 1.0, 2.0, 0.0, 3.0])
    candidates = torch.tensor([False, True, True, True, True])
    rng, counts = generator(0), np.zeros(5)
    rounds = 4000
    for _ in range(rounds):
        drawn = draw(candidates, scores, 2, rng)
        assert drawn.sum() == 2
        counts += drawn.numpy()
    weight = {1: 1 / 6, 2: 2 / 6, 4: 3 / 6}
    expected = {
        i: w + sum(v * w / (1 - v) for j, v in weight.items() if j != i) for i, w in weight.items()
    }
    assert counts[0] == counts[3] == 0
    for i, chance in expected.items():
        assert abs(counts[i] / rounds - chance) < 5 * np.sqrt(chance * (1 - chance) / rounds)
    # the candidate with score 0 comes last
    assert draw(candidates, scores, 4, rng).tolist() == candidates.tolist()
    assert draw(candidates, scores, 9, rng).tolist() == candidates.tolist()
    assert not draw(candidates, scores, 0, rng).any()
    assert not draw(candidates, scores, -1, rng).any()
    assert sorted(draw_views(Room(), 9, rng)) == [0, 1, 2]
    assert len({*draw_views(Room(), 2, rng)}) == 2


def started(densifier, seed):
    """Gaussians with moments and mean gradients, in a room with views."""
    trainable = with_moments(random_gaussians(COUNT, seed, log_scale=(-5.0, 0.3)))
    densifier.begin(trainable.values.detach(), DensifyContext(EXTENT, views=Room()))
    gradient = np.random.default_rng(seed).uniform(0, 6e-4, COUNT)
    gathered(densifier, gradient)
    return trainable, gradient


def taming_scores(trainable, gradient):
    """The score over all three views, term by term."""
    room, values = Room(), trainable.values.detach()
    scales = np.exp(values.log_scales.numpy())
    opacities = 1 / (1 + np.exp(-values.opacity_logits.numpy()))
    total = np.zeros(COUNT)
    for view, camera in enumerate(room.cameras):
        weights = alphas(values, camera)
        render = ReferenceRasterizer().render(values, camera, 0, BLACK)
        photograph = room.images[view].numpy() / 255
        error = np.abs(render.image.detach().numpy() - photograph).mean(-1)
        pixels = 50 * to_unit(error) + 50 * find_edges(room.images[view])
        local = values.means.numpy() @ camera.rotation.T + camera.translation
        x = camera.fx * local[:, 0] / local[:, 2] + camera.cx - 0.5
        y = camera.fy * local[:, 1] / local[:, 2] + camera.cy - 0.5
        columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        distance = np.hypot(columns - x[:, None, None], rows - y[:, None, None])
        hit, radii = weights > 0, render.radii.numpy()
        score = (
            25 * over_median(gradient)
            + 100 * over_median(opacities)
            + 5 * over_median(np.where(radii > 0, local[:, 2], 0))
            + 10 * over_median(radii)
            + 25 * over_median(scales.prod(-1))
            + 50 * over_median((hit * distance).sum((1, 2)))
            + 10 * over_median((hit * pixels).sum((1, 2)))
            + 0.1 * over_median(hit.sum((1, 2)))
            + 50 * over_median(weights.sum((1, 2)))
        )
        loss = float(torch_photometric_loss(render.image.detach(), room.images[view])[0])
        total += np.where(radii > 0, loss * score, 0)
    return total + 1e-6


def test_taming_scores_match_the_restatement():
    densifier = Taming(max_gaussians=COUNT)
    trainable, gradient = started(densifier, 0)
    densifier.score(at(600, trainable))
    scores = densifier.statistics["score"].detach()
    assert_allclose(scores, taming_scores(trainable, gradient), rtol=1e-4)


@pytest.mark.parametrize("seed", range(2))
def test_a_round_of_taming_matches_the_restatement(seed):
    densifier = Taming(max_gaussians=COUNT + 12, cap="hard")
    trainable, gradient = started(densifier, seed)
    rows = to_rows(trainable)
    scores = taming_scores(trainable, gradient)
    large = np.array([restatement.size(row) > 0.01 * EXTENT for row in rows])
    over = gradient >= 2e-4
    event = densifier.refine(600, trainable, generator(seed))
    small_share = 12 * (over & ~large).sum() // over.sum()
    large_share = 12 * (over & large).sum() // over.sum()
    assert (event.cloned, event.split_gradient) == (small_share, large_share)
    assert event.blocked_by_cap == over.sum() - small_share - large_share

    rng = generator(seed)
    torch.randperm(3, generator=rng)  # the views: all three
    given = torch.from_numpy(scores)
    cloned = draw(torch.from_numpy(over & ~large), given, small_share, rng).numpy()
    split = draw(torch.from_numpy(over & large), given, large_share, rng).numpy()
    noise = iter(torch.randn(2 * large_share, 3, generator=rng, dtype=torch.float64).numpy())
    grown = restatement.adc_growth(rows, cloned | split, EXTENT, noise, {})
    assert min(map(opacity, grown)) >= 0.005  # nothing to prune yet
    assert_same(trainable, grown)
    assert event.balances()


def test_taming_grows_a_single_candidate():
    densifier = Taming(max_gaussians=COUNT + 5, cap="hard", prune_opacity=0.0)
    trainable, _ = started(densifier, 0)
    densifier.statistics["gradient_sum"][1:] = 0.0
    densifier.statistics["gradient_sum"][0] = 1e-3
    event = densifier.refine(600, trainable, generator())
    assert (event.cloned + event.split_gradient, event.blocked_by_cap) == (1, 0)


def with_forty_faint():
    densifier = Taming(max_gaussians=COUNT, cap="hard")
    trainable, _ = started(densifier, 1)
    trainable.values.opacity_logits.data[:40] = -9.0
    return densifier, trainable


def test_taming_prunes_at_most_half_of_the_faint_and_only_in_its_first_rounds():
    for step in (600, 500 + 2700, 600 + 2700):
        densifier, trainable = with_forty_faint()
        event = densifier.refine(step, trainable, generator())
        last = step == 600 + 2700  # after 27 rounds no more
        assert last or 0 < event.pruned_opacity <= (20 if step == 600 else COUNT // 2)
    assert event.pruned_opacity == event.pruned_size == 0
    assert densifier.statistics["score"].shape == (COUNT,)
    assert not densifier.statistics["score"].any()


def test_taming_prunes_gaussians_with_low_scores_more_often():
    """Of forty faint Gaussians, the twenty with high scores are drawn a million times as rarely."""
    densifier, trainable = with_forty_faint()
    densifier.statistics["score"] = torch.where(torch.arange(COUNT) % 2 == 0, 1e6, 1.0)
    refinement = at(600, trainable, 0)
    before = trainable.values.means.detach().clone()
    densifier.prune(refinement)
    gone = [
        row for row in range(COUNT) if not (trainable.values.means == before[row]).all(-1).any()
    ]
    assert gone
    assert all(row % 2 == 1 and row < 40 for row in gone)
    assert refinement.event.pruned_opacity == len(gone) <= 20


def test_taming_does_not_prune_gaussians_without_a_score():
    """Children of the same round have no score."""
    densifier, trainable = with_forty_faint()
    densifier.statistics["score"] = torch.where(torch.arange(COUNT) < 40, 0.0, 1e-3)
    refinement = at(600, trainable, 0)
    densifier.prune(refinement)
    assert (refinement.event.pruned_opacity, len(trainable)) == (0, COUNT)


def test_taming_follows_its_curve_and_ends_at_the_budget():
    densifier = Taming(max_gaussians=150, gradient_threshold=1e-9, stop=1500, prune_opacity=0.0)
    trainable, _ = started(densifier, 2)
    counts, rng = [], generator(0)
    for step in range(600, 1500, 100):
        densifier.statistics["gradient_sum"] = (
            torch.rand(len(trainable), generator=rng, dtype=torch.float64) + 0.1
        )
        densifier.statistics["visible_count"][:] = 1
        counts.append(densifier.refine(step, trainable, rng).after)
    progress = np.arange(1, 10) / 10
    assert_allclose(counts, COUNT + 90 * (2 * progress - progress**2), atol=2)


def test_a_densifier_that_needs_views_names_the_missing_setting():
    densifier = Taming(max_gaussians=COUNT)
    trainable, _ = started(densifier, 0)
    densifier.context = DensifyContext(EXTENT)
    with pytest.raises(RuntimeError, match=r"DensifyContext\.views"):
        densifier.refine(600, trainable, generator())
