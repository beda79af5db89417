"""The table of metrics; attributes and values that a user's metric may have."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gsbench.eval.evaluator import Evaluator
from gsbench.eval.facts import (
    METRICS,
    facts_of,
    from_record,
    further_keys,
    known_keys,
    lpips_variants,
    to_record,
)
from gsbench.eval.metric import UnavailableError
from gsbench.eval.protocol import PAPER, PROTOCOLS, get_protocol
from tests.helpers import refusal

IMAGE = np.random.default_rng(0).integers(0, 256, (24, 30, 3), dtype=np.uint8)


def test_facts_and_protocols_load_no_torch():
    code = "import sys, gsbench.eval.facts, gsbench.eval.protocol; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_evaluator_has_exactly_the_metrics_of_the_table():
    evaluator = Evaluator(PAPER, lpips=["vgg"], more=further_keys(), download=False)
    values = evaluator.evaluate_view(IMAGE, IMAGE)
    assert values.keys() | evaluator.unavailable.keys() == set(known_keys())
    assert all(f"lpips_{protocol.lpips}" in known_keys() for protocol in PROTOCOLS.values())
    assert set(lpips_variants()) == {"vgg_raw", "vgg", "alex", "squeeze"}


class Brightness:
    label, unit, direction, decimals, worthwhile = "brightness error", "levels", -1, 1, 0.5

    def measure(self, image, truth):
        assert image.dtype == truth.dtype == torch.float32
        return float((image.mean() - truth.mean()).abs() * 255)


def test_a_users_metric_is_measured_with_the_others():
    evaluator = Evaluator(PAPER, lpips=[], flip=False, extra={"brightness": Brightness()})
    values = evaluator.evaluate_view(np.minimum(IMAGE, 245) + 10, IMAGE)
    expected = abs((np.minimum(IMAGE, 245) + 10).astype(float).mean() - IMAGE.mean())
    assert values["brightness"] == pytest.approx(expected, abs=1e-3)
    facts = evaluator.own["brightness"]
    assert (facts.name, facts.direction, facts.decimals) == ("brightness error (levels)", -1, 1)
    assert from_record("brightness", to_record(facts)) == facts


def test_a_users_metric_may_be_unavailable():
    class Never:
        def measure(self, image, truth):
            raise UnavailableError("not on\na Sunday", awaited=True)

    class Broken:
        def measure(self, image, truth):
            return float("nan")

    evaluator = Evaluator(PAPER, lpips=[], flip=False, extra={"never": Never(), "broken": Broken()})
    for _ in range(2):
        assert evaluator.evaluate_view(IMAGE, IMAGE).keys() == {"psnr", "ssim"}
    assert evaluator.unavailable["never"] == "not on a Sunday"
    assert evaluator.unavailable["broken"] == "the value of a view is nan"
    assert not evaluator.awaited  # only gsbench's own metrics can be awaited


@pytest.mark.parametrize(
    "name, value",
    [
        ("direction", 2),
        ("direction", "up"),
        ("decimals", -1),
        ("decimals", 13),
        ("decimals", True),
        ("label", " "),
        ("unit", 3),
        ("worthwhile", float("nan")),
        ("worthwhile", 0),
        ("worthwhile", True),
    ],
)
def test_wrong_attributes_of_a_users_metric_are_refused(name, value):
    metric = type("Mine", (Brightness,), {name: value})()
    with refusal(rf"Mine\.{name} must be "):
        facts_of("mine", metric)


def test_a_metric_without_attributes_has_no_direction():
    facts = facts_of("plain", object())
    assert (facts.label, facts.direction, facts.decimals, facts.worthwhile) == ("plain", 0, 3, None)
    assert from_record("plain", None) == facts


def test_the_page_on_metrics_shows_the_table():
    page = (Path(__file__).parents[2] / "docs" / "metric.md").read_text(encoding="utf-8")
    for facts in METRICS:
        better = {1: "more", -1: "less", 0: ""}[facts.direction]
        low, high = (
            "" if bound is None else f"{bound:g}" for bound in (facts.lowest, facts.highest)
        )
        cells = (f"`{facts.key}`", facts.name, better, low, high, facts.words)
        assert re.sub(r"\|  (?=\|)", "| ", f"| {' | '.join(cells)} |") in page, facts.key


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
            r"eval\.extra\.own raised RuntimeError two lines \(.*test_facts\.py, line "
            rf"{failing.__code__.co_firstlineno + 1}\)",
        ),
        (lambda: sys.exit(0), r"eval\.extra\.own ended the process \(exit code 0\)"),
        (endless, r"eval\.extra\.own raised RecursionError .*test_facts\.py"),
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
