"""The state of every densifier: statistics that follow edits, lineage, saving, and causes."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from gsbench.densify import (
    ADC,
    Cause,
    Densifier,
    DensifyContext,
    RefineEvent,
    Refinement,
    Volumetric,
)
from gsbench.densify.scores import standard_normal
from gsbench.raster.base import RenderOutput
from tests.densify.helpers import generator, rendered, trained
from tests.gaussians.helpers import random_gaussians


class Gathering(Densifier):
    STATISTICS = {"sum": torch.float64, "seen": torch.bool}  # noqa: RUF012


def started(densifier, count):
    gaussians = trained(random_gaussians(count), 1.0)
    densifier.begin(gaussians.values.detach(), DensifyContext(1.0))
    return Refinement(7, gaussians, generator(0), RefineEvent(7, count))


@pytest.mark.parametrize("seed", range(5))
def test_statistics_and_lineage_follow_every_edit(seed):
    """The test edits a list of rows in the same way, one Gaussian at a time."""
    draw = np.random.default_rng(seed)
    densifier = Gathering()
    refinement = started(densifier, 12)
    values = torch.from_numpy(draw.normal(size=12))
    densifier.statistics["sum"] += values
    densifier.statistics["seen"] |= values > 0
    rows = [(i, float(v), bool(v > 0)) for i, v in enumerate(values)]  # identity, statistics
    parent_of = dict.fromkeys(range(12), -1)
    for _ in range(6):
        n = len(rows)
        keep = torch.from_numpy(draw.random(n) < 0.7)
        parents = torch.from_numpy(draw.integers(0, n, draw.integers(0, 5)))
        append = refinement.gaussians.values.detach().select(parents)
        densifier.edit(refinement, keep, append, parents, Cause.CLONE)
        born = [len(parent_of) + k for k in range(len(parents))]
        parent_of |= {child: rows[int(p)][0] for child, p in zip(born, parents, strict=True)}
        rows = [row for row, kept in zip(rows, keep.tolist(), strict=True) if kept]
        rows += [(child, 0.0, False) for child in born]
        assert densifier.lineage.ids.tolist() == [row[0] for row in rows]
        assert densifier.statistics["sum"].tolist() == [row[1] for row in rows]
        assert densifier.statistics["seen"].tolist() == [row[2] for row in rows]
    saved = densifier.lineage.state_dict()
    assert saved["parents"].tolist() == list(parent_of.values())
    born = len(parent_of) - 12
    assert saved["causes"].tolist() == [Cause.INITIAL] * 12 + [Cause.CLONE] * born
    assert saved["steps"].tolist() == [0] * 12 + [7] * born
    assert sum(densifier.lineage.causes_of_living().values()) == len(rows)
    assert densifier.lineage.causes_of_living()[Cause.CLONE.key] == sum(
        row[0] >= 12 for row in rows
    )
    assert len(refinement.gaussians) == len(rows)


def test_statistics_are_saved_and_reset():
    densifier = Gathering()
    refinement = started(densifier, 5)
    densifier.statistics["sum"] += 3.0
    saved = densifier.state_dict()
    densifier.reset_statistics(refinement)
    assert not densifier.statistics["sum"].any()
    again = Gathering()
    again.load_state_dict(saved, DensifyContext(1.0))
    assert again.statistics["sum"].tolist() == [3.0] * 5
    again.statistics["sum"] += 1.0
    assert saved["statistics"]["sum"].tolist() == [3.0] * 5  # a copy


def test_a_subclass_adds_to_the_statistics_of_its_base():
    @dataclass
    class Own(Volumetric):
        STATISTICS = {"hits": torch.int64}  # noqa: RUF012

    assert list(Own.STATISTICS) == [*ADC.STATISTICS, "hits"]
    assert Volumetric.STATISTICS == ADC.STATISTICS


def test_a_subclass_may_have_its_own_length_of_gradients():
    class Doubled(ADC):
        def screen_gradient(self, render):
            return 2 * super().screen_gradient(render)

    points = torch.zeros(2, 2, requires_grad=True)
    points.grad = torch.tensor([[3.0, 4.0], [1.0, 0.0]])
    for make, factor in (ADC, 1), (Doubled, 2):
        densifier = make()
        densifier.begin(random_gaussians(2).map(torch.Tensor.float), DensifyContext(1.0))
        densifier.observe(1, replace(rendered(points.grad, [1, 0]), screen_points=points))
        assert densifier.statistics["gradient_sum"].tolist() == [5 * factor, 0]


def test_an_event_balances_only_if_its_counts_add_up():
    grown = {"cloned": 2, "split_gradient": 2, "added": 1}
    event = RefineEvent(600, before=10, after=13, **grown, pruned_opacity=1, pruned_size=1)
    assert event.balances()
    event.cloned += 1
    assert not event.balances()


def test_normal_draws_on_another_device_are_seeded_by_the_generator(monkeypatch):
    rng, again = (generator(3) for _ in range(2))
    seeds = []

    class There:
        def __init__(self, device):
            assert device.type == "meta"

        def manual_seed(self, seed):
            seeds.append(seed)
            return self

    monkeypatch.setattr(torch, "Generator", There)
    monkeypatch.setattr(
        torch, "randn", lambda shape, generator, dtype, device: (shape, dtype, device.type)
    )
    drawn = standard_normal((4, 3), rng, torch.zeros(1, device="meta", dtype=torch.float64))
    assert drawn == ((4, 3), torch.float64, "meta")
    assert seeds == [int(torch.randint(2**62, (1,), generator=again))]


def test_statistics_of_a_view_are_those_of_torch_for_visible_gaussians_alone():
    random = torch.Generator().manual_seed(0)
    count, scales = 50_000, torch.logspace(-18, 4, 50_000).unsqueeze(-1)
    gradient = torch.randn(count, 2, generator=random) * scales
    radii = torch.randint(0, 4, (count,), generator=random, dtype=torch.int32)
    gradient[radii == 0] = math.nan  # of Gaussians that the view does not show
    sums = torch.rand(count, generator=random)
    seen, largest = (torch.full((count,), 2, dtype=torch.int32) for _ in range(2))
    length = torch.where(radii > 0, gradient.norm(dim=-1), 0.0)
    expected = sums + length, seen + (radii > 0).int(), torch.maximum(largest, radii)
    densifier, points = ADC(), torch.zeros(count, 2, requires_grad=True)
    densifier.statistics = dict(zip(ADC.STATISTICS, (sums, seen, largest), strict=True))
    points.grad = gradient
    densifier.gather(RenderOutput(torch.empty(0), torch.empty(0), radii, points))
    found = [*densifier.statistics.values()]
    # torch rounds the second square, too, where the processor has no fused instruction
    assert_allclose(found[0], expected[0], rtol=2.4e-7)
    assert torch.equal(found[1], expected[1])
    assert torch.equal(found[2], expected[2])
