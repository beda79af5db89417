"""FastGS against a restatement: counts of bad pixels, growth, and the draw for pruning."""

import numpy as np
import torch

from gsbench.densify import FastGS
from gsbench.densify.scores import draw
from tests.densify.helpers import (
    EXTENT,
    around_a_reset,
    assert_same,
    at,
    gathered,
    generator,
    to_rows,
)
from tests.densify.restatement import opacity, size, with_logit
from tests.densify.test_adc_variants import absgs_growth
from tests.densify.test_scores import COUNT, Room, started, to_unit


def counted(values, threshold):
    """The count and the pruning score [N] of each Gaussian over the three views.

    The count is the mean number of bad pixels, rounded down. The score is the sum of loss times
    number, scaled to [0, 1].
    """
    room, total, weighted = Room(), np.zeros(COUNT), np.zeros(COUNT)
    for view, image, blended in room.shown(values):
        error = np.abs(image.numpy() - room.images[view].numpy() / 255).mean(-1)
        bad = to_unit(error) > threshold
        count = ((blended > 0) & bad).sum((1, 2))
        total += count
        weighted += count * float(room.loss(view, image))
    return total // 3, to_unit(weighted)


def ready(densifier, seed):
    trainable, _ = started(densifier, seed)
    trainable.values.log_scales.data[::4] -= 3.0
    draws = np.random.default_rng(seed)
    signed, absolute = draws.uniform(0, 4e-4, COUNT), draws.uniform(0, 2.4e-3, COUNT)
    gathered(densifier, signed, absolute)
    return trainable, signed, absolute


@around_a_reset
def test_a_round_of_fast_gs_matches_the_restatement(step):
    seed = 0
    densifier = FastGS(error_threshold=0.5)
    trainable, signed, absolute = ready(densifier, seed)
    trainable.values.opacity_logits.data[20:40] = -9.0
    rows, counts = to_rows(trainable), counted(trainable.values.detach(), 0.5)
    event = densifier.refine(step, trainable, generator(seed))

    rng = generator(seed)
    torch.randperm(3, generator=rng)  # the views: all three
    several = counts[0] > 5
    assert 5 < several.sum() < COUNT - 5
    splits = several & (absolute >= 1.2e-3)  # the restatement of AbsGS has 0.0004
    clones = several & (signed >= 2e-4)
    large = np.array([size(row) > 0.001 * EXTENT for row in rows])
    drawn = torch.randn(2 * (splits & large).sum(), 3, generator=rng, dtype=torch.float64)
    grown, cloned, split = absgs_growth(rows, clones, splits, iter(drawn.numpy()))
    assert (event.cloned, event.split_gradient) == (cloned, split)
    assert split > 0

    faint = np.array([opacity(row) < 0.005 for row in grown])
    huge = np.array([size(row) > 0.1 * EXTENT for row in grown]) & (step > 3000)
    scores = np.delete(counts[1].astype(np.float32), np.nonzero(splits & large)[0])
    weights = np.zeros(len(grown), np.float32)
    weights[: len(scores)] = 1 / (np.float32(1e-6) + np.float32(1) - scores)
    known = torch.arange(len(grown)) < len(scores)  # those that were there before
    some = draw(known, torch.from_numpy(weights), (faint | huge).sum() // 2, rng).numpy()
    kept = [row for row, gone in zip(grown, (faint | huge) & some, strict=True) if not gone]
    limit = np.log(0.8 / 0.2)
    assert_same(
        trainable, [with_logit(row, np.minimum(row["opacity_logits"], limit)) for row in kept]
    )
    assert event.pruned_opacity == (faint & some).sum()
    assert event.pruned_size == (huge & ~faint & some).sum()
    assert event.pruned_opacity + event.pruned_size > 0
    assert event.balances()


def test_after_the_window_low_opacities_and_high_scores_are_pruned():
    densifier = FastGS()
    trainable, _, _ = ready(densifier, 1)
    trainable.values.opacity_logits.data[:5] = -3.0  # opacity 0.047
    rows, (_, scores) = to_rows(trainable), counted(trainable.values.detach(), 0.1)
    event = densifier.refine(18_000, trainable, generator())
    opacities = np.array([opacity(row) for row in rows])
    assert_same(
        trainable, [row for i, row in enumerate(rows) if opacities[i] >= 0.1 and scores[i] <= 0.9]
    )
    assert event.pruned_opacity == (opacities < 0.1).sum() >= 5
    assert event.pruned_size == ((scores > 0.9) & (opacities >= 0.1)).sum() > 0
    assert event.balances()
    assert densifier.refine(15_000, trainable, generator()) is None
    assert densifier.refine(16_500, trainable, generator()) is None


def test_without_bad_pixels_nothing_grows():
    densifier = FastGS(error_threshold=1.0)
    trainable, _, _ = ready(densifier, 0)
    event = densifier.refine(600, trainable, generator())
    assert event.cloned == event.split_gradient == 0
    rules = " ".join(rule.__name__ for rule in densifier.rules(at(600, trainable)))
    assert rules == "score grow_by_gradient prune lower_opacity reset_statistics"
    over, _ = densifier.candidates(at(700, trainable))
    assert not over.any()
