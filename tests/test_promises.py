"""A sample of the simulations behind findings/simulations.md; ``make promises`` repeats all of them."""

import re

import numpy as np
import pytest

from gsbench.analysis.statistics import t_test
from tests.conftest import script

promises = script("promises")
habits = promises.habits
# The page names them at once: to make them takes seconds, and each worker collects all tests.
FIGURES = re.findall(
    r"^\| (.+?) \| .+ \| [\d.]+ ± [\d.]+ % \| \d+ \| (\S+) \|$",
    promises.simulations.table("promises"),
    re.MULTILINE,
)
NAMES = [name for name, _ in FIGURES]
SHARE = 0.02


@pytest.fixture(scope="module")
def every():
    return {one.name: one for one in promises.promises()}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_promise_holds_in_a_sample(every, name):
    mean, error = every[name].measure(SHARE)
    assert every[name].holds(mean, error), (mean, error)


def test_each_promise_of_the_page_has_a_figure(every):
    assert list(every) == NAMES
    assert {holds for _, holds in FIGURES} == {"yes"}


def test_a_broken_promise_is_noticed():
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


def test_statements_about_scenes_like_these_have_the_level_of_their_question():
    made = promises.arms(np.random.default_rng(0), promises.noise_of(8, 1.0), 3, [0.0] * 4)
    asked = [promises.question(f"arm{k}", 8, 3, 0.05 / 4) for k in range(4)]
    levels = [promises.judge(made, one).like_these.level for one in asked]
    assert levels == pytest.approx([0.05 / 4] * 4)


def test_habits_judge_as_the_program_does():
    """The test of many draws at once is that of one, on the same differences."""
    rng = np.random.default_rng(0)
    for scenes, seeds in ((1, 3), (3, 3), (9, 2)):
        differences = rng.standard_normal((20, scenes, seeds))
        means, p = habits.p_values(differences)
        for own, mean, value in zip(differences, means, p, strict=True):
            test = t_test(own)
            assert (mean, value) == pytest.approx((test.mean, test.p), rel=1e-9)


def test_an_idea_that_works_is_found_by_a_habit():
    """So the rates of habits are no zeros of a rule that never decides."""

    def good(rng, draws):
        search = habits.Search(rng, draws, 3, 3)
        search.idea = search.idea + 3
        search.command()
        return search.rates

    assert habits.rate(good, 500)[0] > 0.9
