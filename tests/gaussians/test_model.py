"""Rotations and colours of Gaussians, compared with SciPy."""

import copy
import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.special import lpmv

from gsbench.densify import DensifyContext, RefineEvent, Refinement
from gsbench.gaussians.model import basis, colors, quaternion_to_matrix
from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster import RenderOutput
from tests.gaussians.helpers import random_gaussians
from tests.helpers import table


@pytest.mark.parametrize(
    "of, name, said",
    table(__file__, "attributes"),
)
def test_a_wrong_attribute_names_the_right_ones(of, name, said):
    gaussians = random_gaussians(3)
    training = TrainableGaussians(gaussians, LearningRates(), 1.0)
    owners = {
        "gaussians": gaussians,
        "training": training,
        "refinement": Refinement(1, training, torch.Generator(), RefineEvent(1, 3)),
        "context": DensifyContext(extent=1.0),
        "render": RenderOutput(*[torch.zeros(1)] * 4),
    }
    with pytest.raises(AttributeError) as caught:
        getattr(owners[of], name)
    assert said in str(caught.value)
    assert copy.deepcopy(owners["gaussians"]).means.equal(gaussians.means)


def unit_vectors(count):
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    return torch.from_numpy(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def harmonics(directions, degree):
    """Real harmonics [N, (degree + 1)^2] with the signs of 3DGS, from SciPy's Legendre functions."""
    x, y, z = directions.numpy().T
    azimuth, columns = np.arctan2(y, x), []
    for order in range(degree + 1):
        for m in range(-order, order + 1):
            ratio = math.factorial(order - abs(m)) / math.factorial(order + abs(m))
            factor = math.sqrt((2 * order + 1) * ratio * (2 if m else 1) / (4 * math.pi))
            wave = np.sin(-m * azimuth) if m < 0 else np.cos(m * azimuth)
            columns.append(factor * lpmv(abs(m), order, z) * wave)
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("degree", range(4))
def test_harmonics_and_colours_are_those_of_scipy(degree):
    directions, gaussians = unit_vectors(30), random_gaussians(30)
    expected = harmonics(directions, degree)
    assert_allclose(basis(directions, degree), expected, atol=1e-12)
    every = torch.cat([gaussians.sh_dc.unsqueeze(1), gaussians.sh_rest], dim=1).numpy()
    shown = np.einsum("nk,nkc->nc", expected, every[:, : expected.shape[1]]) + 0.5
    assert (shown < 0).any()
    found = colors(gaussians.sh_dc, gaussians.sh_rest, directions, degree)
    assert_allclose(found, np.maximum(shown, 0), atol=1e-12)


def test_quaternions_of_any_length_give_scipys_rotations():
    quaternions = random_gaussians(9).quaternions * 3
    expected = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]].numpy()).as_matrix()
    assert_allclose(quaternion_to_matrix(quaternions), expected, atol=1e-12)
