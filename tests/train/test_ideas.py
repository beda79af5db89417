"""Loss, terms, schedule and optimiser of the user's: what they read, what they change, errors."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from gsbench.densify import NoDensifier, Volumetric
from gsbench.errors import TrainingError
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.contract import Case
from gsbench.raster.depth import render_depth
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.train.ideas import Ideas, weighted
from tests.conftest import script
from tests.train.lab import (
    EVENTS,
    METRICS,
    STATEFUL,
    StopError,
    cloud,
    same,
    small,
    stop_at,
)

ideas = script("ideas", "examples")


def own(terms=(), **parts):
    return Ideas(terms=weighted(terms), **parts)


def trained(lab, name="", densifier=None, on_status=lambda status: None, parts=None, **changes):
    changes["ideas"] = own(**(parts or {}))
    return lab.train(densifier or NoDensifier(), name, on_status, **changes)


# ---- depth


@pytest.fixture(params=["few", "many"])
def case(request):
    return Case(24, 18, 5 if request.param == "few" else 40, sh_degree=0)


def z_of(gaussians, camera):
    axis = gaussians.means.new_tensor(camera.rotation[2])
    return gaussians.means @ axis + float(camera.translation[2])


def test_depth_is_the_sum_of_weights_times_z_over_alpha():
    """One opaque Gaussian has its own z everywhere it is seen."""
    case = Case(24, 18, 1, sh_degree=0)
    gaussians = case.gaussians()
    depth, render = render_depth(ReferenceRasterizer(), gaussians, case.camera())
    camera = case.camera()
    seen = render.alpha > 0
    assert torch.allclose(depth[seen], z_of(gaussians, camera).expand(int(seen.sum())))
    assert not depth[~seen].any()


def test_the_gradient_of_depth_is_that_of_finite_differences():
    case = Case(12, 9, 6, sh_degree=0)
    gaussians, camera = case.gaussians(), case.camera()
    weights = torch.rand(9, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def value(means):
        moved = Gaussians(**{**gaussians.tensors(), "means": means})
        return (render_depth(ReferenceRasterizer(), moved, camera)[0] * weights).sum()

    means = gaussians.means.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(value(means), means)
    for row in range(2):
        for axis in range(3):
            step = torch.zeros_like(gaussians.means)
            step[row, axis] = 1e-6
            with torch.no_grad():
                slope = (value(gaussians.means + step) - value(gaussians.means - step)) / 2e-6
            assert float(gradient[row, axis]) == pytest.approx(float(slope), rel=1e-4, abs=1e-6)


# ---- terms and losses


@dataclass
class Mean:
    """Pulls the mean of all centres to a place: a term with a gradient that is known by hand."""

    def __call__(self, step):
        return step.gaussians.means[:, 0].mean()


def test_a_term_of_weight_zero_changes_no_bit(lab):
    plain = trained(lab, "plain", small(Volumetric))
    with_term = trained(lab, "term", small(Volumetric), parts={"terms": [(Mean(), 0.0)]})
    assert same(plain, with_term)


def test_the_gradient_of_a_term_is_its_weight_times_its_own(lab):
    made = [lab.new(NoDensifier(), ideas=own(terms)) for terms in ((), [(Mean(), 3.0)])]
    for trainer in made:
        trainer.step, trainer.fast = 1, None
        trainer._differentiate(0)
    plain, moved = (trainer.gaussians.values.means.grad for trainer in made)
    expected = torch.zeros_like(plain)
    expected[:, 0] = 3.0 / len(plain)
    assert torch.allclose(moved - plain, expected, atol=1e-6)


@dataclass
class L2:
    needs_depth = True

    def __call__(self, step):
        assert step.render.depth.shape == step.render.alpha.shape
        assert step.view.name
        assert step.photograph.max() <= 1
        return (step.render.image - step.photograph).square().mean()


def test_a_loss_of_the_users_is_minimised_and_recorded_alone(lab):
    trained(lab, "l2", parts={"loss": L2()})
    records = lab.records(METRICS, "l2")
    assert records[-1]["loss"] < 0.8 * records[0]["loss"]
    assert "ssim" not in records[0]


def test_each_term_has_a_column(lab):
    term = ideas.LowOpacity()
    trained(lab, "two", parts={"terms": [(term, 0.1), (term, 0.2)]})
    assert {"term_LowOpacity", "term_LowOpacity_2", "l1"} <= lab.records(METRICS, "two")[0].keys()


def test_terms_on_depth_enter_the_gradient_that_densifiers_see(lab):
    seen = {}

    @dataclass
    class Watching(NoDensifier):
        name: str = ""

        def observe(self, step, render, view):
            assert render.depth is not None
            assert view.camera.width == render.image.shape[1]
            seen.setdefault(self.name, render.screen_points.grad.clone())

        needs_depth = True

    for name, weight in (("without", 0.0), ("with", 5.0)):
        terms = [(ideas.SmoothDepth(), weight)]
        trained(lab, name, Watching(name), parts={"terms": terms}, iterations=2)
    assert not torch.allclose(seen["with"], seen["without"])


@pytest.mark.parametrize(
    "value,words",
    [
        (lambda step: step.render.image, "shape ()"),
        (lambda step: 3.0, "shape ()"),
        (lambda step: step.gaussians.means.mean() / 0.0, "became"),
        (lambda step: step.gaussians.means.detach().mean() + 1, "without a gradient"),
        (lambda step: torch.tensor(float("nan")), "became nan"),
    ],
)
def test_a_bad_value_ends_the_training_with_the_name_of_the_term(lab, value, words):
    class Bad:
        def __call__(self, step):
            return value(step)

    with pytest.raises(TrainingError, match="Bad") as error:
        trained(lab, "bad", parts={"terms": [(Bad(), 1.0)]}, log_every=1)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_a_term_may_begin_later(lab):
    class Late:
        def __call__(self, step):
            return Mean()(step) if step.iteration > 60 else torch.zeros(())

    trained(lab, "late", parts={"terms": [(Late(), 0.1)]})
    values = [record["term_Late"] for record in lab.records(METRICS, "late")]
    assert values[0] == 0
    assert values[-1] != 0


# ---- schedule


def test_a_schedule_sets_the_rates_it_names_and_keeps_the_others(lab):
    rates = []

    def schedule(iteration, base):
        rates.append(base)
        return {"sh_dc": 0.0}

    model = trained(lab, "own", parts={"schedule": schedule}, iterations=30)
    assert torch.equal(model.sh_dc, cloud(lab.truth).sh_dc)
    assert not torch.equal(model.means, cloud(lab.truth).means)
    assert rates[0]["means"] > rates[-1]["means"]


@pytest.mark.parametrize("rates", [{"colour": 1.0}, {"means": -1.0}, {"means": float("nan")}])
def test_a_wrong_rate_is_refused_by_name(lab, rates):
    with pytest.raises(TrainingError, match=r"iteration 1: train\.schedule gives .*(colour|means)"):
        trained(lab, "bad", parts={"schedule": lambda iteration, base: rates})


# ---- optimiser


@dataclass
class Plain:
    """Gradient descent with as many moments as asked for; the first ones do nothing."""

    moments: int = 0

    def init(self, parameter):
        return {f"m{k}": torch.zeros_like(parameter) for k in range(self.moments)}

    def step(self, parameter, gradient, state, rate, count):
        for moment in state.values():
            assert moment.shape == parameter.shape
            moment += gradient
        parameter -= rate * gradient


@pytest.mark.parametrize(
    "densifier, moments", [("adc", 0), ("adc", 2), *((densifier, 1) for densifier in STATEFUL)]
)
def test_the_state_of_an_optimiser_follows_the_edits_of_each_densifier(lab, densifier, moments):
    name = f"{densifier}{moments}"
    trained(lab, name, STATEFUL[densifier](), parts={"optimizer": Plain(moments)})
    events = lab.records(EVENTS, name)
    assert any(event["after"] != event["before"] for event in events) or densifier == "mcmc"


def test_rows_of_a_state_are_kept_removed_and_zero_when_new():
    gaussians = Case(12, 9, 6, sh_degree=0).gaussians()
    trainable = TrainableGaussians(gaussians, LearningRates(), 1.0, optimizer=Plain(1))
    state = trainable.adam["means"].tensors
    state["m0"] = torch.arange(18.0, dtype=torch.float64).reshape(6, 3)
    state["total"] = torch.tensor(7.0)
    keep = torch.tensor([True, False, True, True, False, True])
    trainable.edit(keep, gaussians.select(torch.tensor([0, 1])))
    rows = state["m0"][:, 0].tolist()
    assert rows == [0.0, 6.0, 9.0, 15.0, 0.0, 0.0]
    assert float(state["total"]) == 7.0


def test_groups_limit_an_optimiser_to_some_parameters(lab):
    sign = trained(lab, "sign", parts={"optimizer": ideas.SignMomentum()}, iterations=30)
    plain = trained(lab, "adam", iterations=30)
    assert not torch.equal(sign.opacity_logits, plain.opacity_logits)
    trainer = lab.new(NoDensifier())
    assert set(trainer.gaussians.adam["means"].tensors) == {"first", "second"}


# ---- resuming


@dataclass
class Learned:
    """A term with a parameter and noise of its own: gain of the picture, against the photograph."""

    def __post_init__(self):
        self.gain = torch.ones((), requires_grad=True)

    def __call__(self, step):
        noise = torch.rand((), generator=step.rng)
        image = step.render.image * self.gain
        return (image - step.photograph).square().mean() * (0.5 + noise)

    def optimize(self):
        with torch.no_grad():
            self.gain -= 0.1 * self.gain.grad
            self.gain.grad = None

    def state_dict(self):
        return {"gain": self.gain.detach().clone()}

    def load_state_dict(self, state):
        self.gain = state["gain"].clone().requires_grad_(True)


def all_parts():
    return {
        "terms": [(Learned(), 0.5), (ideas.SmoothDepth(), 0.1)],
        "schedule": ideas.WarmUp(30),
        "optimizer": ideas.SignMomentum(),
    }


def test_a_resumed_training_with_parts_of_the_users_gives_the_same_bits(lab):
    whole = trained(lab, "whole", small(), parts=all_parts())
    with pytest.raises(StopError):
        trained(lab, "killed", small(), stop_at(70), parts=all_parts())
    assert lab.checkpoints("killed") == [50]
    again = trained(lab, "killed", small(), parts=all_parts())
    assert same(whole, again)
    assert lab.steps(METRICS, "killed") == lab.steps(METRICS, "whole")


# ---- pictures beside the photographs


def with_beside(lab):
    """The lab with a depth and normals beside each training view, of its own size."""
    views = []
    for number, view in enumerate(lab.scene.train, 1):
        size = view.image.shape[:2]
        depth = np.full(size, number, np.float32)
        normals = np.full((*size, 3), number, np.uint8)
        views.append(replace(view, beside={"depth": depth, "normals": normals}))
    return lab.with_views(train=tuple(views))


def test_a_term_reads_the_pictures_beside_the_photograph(lab):
    seen = []

    class Beside:
        def __call__(self, step):
            view = step.view
            assert view.depth.shape == view.photograph.shape[:2]
            assert view.more["normals"].shape == view.photograph.shape
            names = [one.name for one in lab.scene.train]
            assert view.depth.unique().tolist() == [names.index(view.name) + 1]
            assert (view.more["normals"] == view.depth[..., None]).all()
            seen.append(view.name)
            return 0 * step.render.image.mean()

    ideas = own([(Beside(), 1.0)])
    with_beside(lab).new(NoDensifier(), ideas=ideas, iterations=12).run(lab.folder)
    assert len(seen) == 12


def test_an_error_of_a_term_names_it_and_says_how_to_ask_for_depth(lab):
    class Careless:
        def __call__(self, step):
            return step.render.depth.mean()

    words = (
        "iteration 1: the term Careless of train.terms raised AttributeError .*needs_depth = True"
    )
    with pytest.raises(TrainingError, match=words):
        trained(lab, parts={"terms": [(Careless(), 1.0)]}, iterations=2)
