"""Adam on the CPU: against torch's, and the same bits if the backward pass applies it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.optim.adam import adam

from gsbench.densify import NoDensifier, Volumetric
from gsbench.gaussians.trainable import ParameterState, Update
from gsbench.raster.cpu.layout import CHUNK
from gsbench.train.adam_cpu import CpuAdam, FusedStep
from tests.train.lab import EVENTS, STATEFUL, same, small


def moments(rate, shape):
    return ParameterState(rate, 1, {"first": torch.zeros(shape), "second": torch.zeros(shape)})


@pytest.mark.parametrize("shape", [(1, 3), (37,), (50, 4), (700, 15, 3)])
def test_steps_are_those_of_adam_in_float64(shape):
    draw = torch.Generator().manual_seed(1)
    parameter = torch.randn(shape, generator=draw)
    state = moments(0.01, shape)
    expected, first, second = (t.double().clone() for t in (parameter, state.first, state.second))
    count = torch.zeros(())
    for step in range(1, 6):
        gradient = torch.randn(shape, generator=draw) * 10.0 ** (step - 3)
        state.step = step
        CpuAdam(2)([Update(parameter, gradient, state)])
        options = {"amsgrad": False, "beta1": 0.9, "beta2": 0.999, "lr": 0.01, "maximize": False}
        gradients = [gradient.double()]
        adam([expected], gradients, [first], [second], [], [count], weight_decay=0.0, eps=1e-15,
             **options)  # fmt: skip
    assert (parameter - expected).abs().max() < 1e-6
    assert ((state.second - second).abs() / second).max() < 1e-5


@pytest.mark.parametrize("active", [0, 9, 24])
def test_numbers_without_a_gradient_yet_keep_their_bits(active):
    gradient = torch.randn(33, 15, 3)
    gradient.view(33, 45)[:, active:] = 0
    results = []
    for columns in (active, None):
        parameter = torch.arange(33 * 45.0).view(33, 15, 3).clone()
        state = moments(0.1, (33, 15, 3))
        CpuAdam(1)([Update(parameter, gradient, state, columns)])
        results.append((parameter, state.first, state.second))
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize(
    "kind",
    [
        *("none", "volumetric", "mcmc"),
        *(pytest.param(kind, marks=pytest.mark.slow) for kind in STATEFUL if kind != "mcmc"),
    ],
)
def test_a_fused_training_has_the_bits_of_one_by_autograd(kind, lab, monkeypatch):
    more = {"none": NoDensifier, "volumetric": lambda: small(Volumetric, volume_threshold=0.01)}
    make, calls = (more | STATEFUL)[kind], []
    call = FusedStep.step
    monkeypatch.setattr(FusedStep, "step", lambda *a: calls.append(1) or call(*a))
    fused = lab.train(make(), "fused")
    if kind not in (
        "mcmc",
        "mrnf",
        "gns",
        "fastgs",
        "steepgs",
    ):  # others look at the model in some steps
        assert len(calls) > 100
    calls.clear()
    plain = lab.train(make(), "plain", by_autograd=True)
    assert not calls
    assert same(fused, plain)
    assert lab.text(EVENTS, "fused") == lab.text(EVENTS, "plain")


def test_chunks_have_the_bits_of_the_whole(lab, monkeypatch):
    """More Gaussians than a chunk, on several threads, with masks and without."""
    results = []
    many = lab.truth.select(torch.arange(len(lab.truth)).repeat(-(-3 * CHUNK // len(lab.truth))))
    monkeypatch.setattr(lab, "truth", many)
    for plain in (False, True):
        results.append(lab.train(NoDensifier(), str(plain), iterations=6, by_autograd=plain))
    assert len(results[0]) > 2 * CHUNK
    assert same(*results)


class Curious(NoDensifier):
    """A user's own densifier, which may look at the model whenever it is called."""


def test_a_densifier_of_the_users_sees_the_model_before_adam(lab, monkeypatch):
    monkeypatch.setattr(FusedStep, "step", lambda *a: pytest.fail("fused"))
    lab.train(Curious(), iterations=3)


def test_masked_and_last_steps_are_not_fused(lab, monkeypatch):
    steps, call = [], FusedStep.step

    def noted(self, model, *given):
        steps.append(model.adam["means"].step + 1)
        return call(self, model, *given)

    monkeypatch.setattr(FusedStep, "step", noted)
    lab.train(NoDensifier(), "plain", iterations=5)
    assert steps == [1, 2, 3, 4]
    steps.clear()
    whole = [np.ones(view.image.shape[:2], bool) for view in lab.scene.train]
    pairs = zip(lab.scene.train, whole, strict=True)
    own = lab.with_views(train=tuple(replace(view, mask=mask) for view, mask in pairs))
    training = own.new(NoDensifier(), iterations=5)
    (lab.folder / "masked").mkdir()
    training.run(lab.folder / "masked")
    assert steps == []
