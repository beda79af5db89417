"""What a user's metric may return, and the errors for one that does something else."""

import sys

import numpy as np
import pytest
import torch

from gsbench.eval.evaluator import Evaluator
from gsbench.eval.protocol import get_protocol
from tests.helpers import refusal

IMAGE = np.zeros((16, 16, 3), np.uint8)


class Own:
    """A metric whose value is that of a function."""

    def __init__(self, of):
        self.of = of

    def measure(self, image, truth):
        return self.of()


def measured(of):
    evaluator = Evaluator(get_protocol("paper"), lpips=(), flip=False, extra={"own": Own(of)})
    return evaluator.evaluate_view(IMAGE, IMAGE)


@pytest.mark.parametrize(
    "value",
    [
        2,
        2.0,
        np.float32(2),
        np.int64(2),
        np.array(2.0),
        np.array([2.0]),
        torch.tensor(2.0),
        torch.tensor([2]),
    ],
)
def test_a_users_metric_may_return_a_number_of_any_type(value):
    assert measured(lambda: value)["own"] == 2.0


@pytest.mark.parametrize(
    "value",
    ["2.0", "good", b"2", True, None, 2j, [2.0], {}, np.zeros(2), torch.zeros(2), np.array("2")],
)
def test_a_users_metric_that_returns_no_number_is_refused(value):
    with refusal(r"eval\.extra\.own must return a number for each view, got "):
        measured(lambda: value)


def endless():
    return endless()


def failing():
    raise RuntimeError("two\nlines")


@pytest.mark.parametrize(
    "fall, said",
    [
        (
            failing,
            r"eval\.extra\.own raised RuntimeError two lines \(.*test_own_metric\.py, line "
            rf"{failing.__code__.co_firstlineno + 1}\)",
        ),
        (lambda: sys.exit(0), r"eval\.extra\.own ended the process \(exit code 0\)"),
        (endless, r"eval\.extra\.own raised RecursionError .*test_own_metric\.py"),
        (
            lambda: 10**400,
            r"eval\.extra\.own must return a number for each view, got one that is too large",
        ),
        (
            lambda: 10**5000,
            r"eval\.extra\.own must return a number for each view, got one that is too large",
        ),
    ],
)
def test_a_users_metric_that_fails_is_named_in_one_line(fall, said):
    with refusal(said):
        measured(fall)
