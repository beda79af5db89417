"""A sample of the simulations behind findings/simulations.md; ``make promises`` repeats all of them."""

import re

import numpy as np
import pytest

from tests.conftest import script

promises = script("promises")
ALL = list(promises.promises())
SHARE = 0.02


@pytest.mark.slow
@pytest.mark.parametrize("promise", ALL, ids=lambda one: one.name)
def test_a_promise_holds_in_a_sample(promise):
    mean, error = promise.measure(SHARE)
    assert promise.holds(mean, error), (mean, error)


def test_each_promise_of_the_page_has_a_figure():
    table = promises.simulations.table("promises")
    rows = re.findall(r"^\| (.+?) \| .+ \| ([\d.]+) ± ([\d.]+) % \| \d+ \| (\S+) \|$", table, re.M)
    assert [name for name, *_ in rows] == [one.name for one in ALL]
    assert {holds for *_, holds in rows} == {"yes"}


def test_a_broken_promise_is_noticed():
    """Bisecting by comparisons with the first commit alone would name wrong ones."""
    promise = promises.Promise("always", "", 0.05, 1000, lambda rng: float(rng.random() < 0.2))
    assert not promise.holds(*promise.measure(1.0))
    power = promises.Promise("power", "", 0.8, 1000, lambda rng: float(rng.random() < 0.6), True)
    assert not power.holds(*power.measure(1.0))
    assert promise.holds(*promises.Promise("fair", "", 0.5, 50, lambda _: 0.0).measure(1.0))


def test_draws_of_a_sweep_have_the_stated_noise_and_correlation():
    rng = np.random.default_rng(0)
    made = promises.arms(rng, promises.noise_of(3, 4.0), 4000, [0.3], correlation=0.5)
    values = np.array([one.metrics["psnr"] for one in made]).reshape(2, 3, 4000)
    differences = values[1] - values[0]
    assert differences.mean(axis=1) == pytest.approx(0.3, abs=0.03)
    # pairs whose trainings correlate by a half vary half as much
    assert differences.std(axis=1) == pytest.approx(np.array([0.4, 0.1, 0.1]) / 2**0.5, rel=0.05)


def test_statements_about_scenes_like_these_share_the_rate_of_named_trials():
    """So do those of a ledger's confirmation and of an ablation, which name their trials."""
    made = promises.arms(np.random.default_rng(0), promises.noise_of(8, 1.0), 3, [0.0] * 4)
    asked = tuple(promises.question(f"arm{k}", 8, 3) for k in range(4))
    verdicts = promises.judge(made, promises.Declaration(time=promises.TIME, questions=asked))
    assert [one.like_these.level for one in verdicts] == pytest.approx([0.05 / 4] * 4)
