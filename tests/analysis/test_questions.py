"""Levels, tries and the questions that a command asks, by hand and by the issue's own examples."""

import math
from dataclasses import replace

import pytest

from gsbench.analysis.questions import (
    Asked,
    announce,
    ask,
    choose_pairs,
    count_tries,
    level_of,
    look_shares,
    place_of,
    plan_looks,
    read_least,
    unreachable,
)
from gsbench.analysis.trial_result import Planned
from gsbench.runs.commands import Command, History
from gsbench.runs.experiments import Arm
from tests.analysis.tables import TABLES
from tests.helpers import refusal

PSNR = Asked(metric="psnr", least=0.1)
HERE = "garden"


def row(densify="mine", seed=0, scene=HERE, init="sfm", code="", variant=(), **settings):
    """A trial with these settings of the densifier; its digest tells settings and code apart."""
    hashed = "".join(map(str, (*variant, *settings.values()))) or "0"
    config = {"scene.name": scene} | {f"densify.{key}": value for key, value in settings.items()}
    config |= dict(variant)
    digest = f"{init}-{densify}/{hashed}{code and '+'}{code}"
    return Planned(scene, init, densify, hashed, seed, config, digest, tuple(variant))


def sweep(*densifiers, seeds=(0, 1, 2), **how):
    return [row(densify, seed, **how) for densify in densifiers for seed in seeds]


def asked(planned, measured=(), before=None, about=PSNR):
    """The history after a command with these trials, and its questions and shown ones."""
    before = before or History(None)
    found, shown = ask(planned, about, measured, before)
    now = Command(words=(), cwd="", time=0.0, questions=tuple(found), shows=tuple(shown))
    after = replace(before, commands=(*before.commands, now))
    results = {(one.digest, place_of(one)) for one in planned}
    return replace(after, results=after.results | results), found, shown


@pytest.mark.parametrize("n, level", [(1, 5), (2, 1.667), (3, 0.8333), (4, 0.5)])
def test_the_level_of_the_nth_command_is_two_in_n_times_n_plus_one(n, level):
    assert 100 * level_of(n) == pytest.approx(level, rel=1e-3)


def test_all_levels_of_one_idea_sum_to_twice_the_rate_and_half_of_each_is_for_better():
    assert math.fsum(level_of(n) for n in range(1, 100_000)) == pytest.approx(0.1, rel=1e-4)


@pytest.mark.parametrize(
    "looks, shares",
    TABLES["shares of looks"],
)
def test_the_last_look_has_sixty_percent_and_each_earlier_one_half_of_the_rest(looks, shares):
    assert look_shares(looks) == pytest.approx(shares)
    assert sum(look_shares(looks)) == pytest.approx(1)


def test_looks_are_at_each_seed_from_the_second_on():
    assert plan_looks(2) == (2,)
    assert plan_looks(12) == tuple(range(2, 13))
    assert plan_looks(21) == (*range(2, 13), 16, 20, 21)


def test_tries_are_linked_directly_or_through_others():
    a, b, c, d = (("s", k) for k in range(4))
    assert count_tries([a], []) == 1
    assert count_tries([a], [{b}, {c}]) == 1
    assert count_tries([a], [{a, b}, {b, c}, {d}]) == 3


def test_an_idea_is_compared_with_the_baseline_of_its_cloud_and_settings():
    variants = [(("densify.cap", cap),) for cap in ("soft", "hard")]
    rows = [row(name, variant=one) for name in ("adc", "mine") for one in variants]
    pairs = choose_pairs(rows, PSNR)
    assert [str(one) for pair in pairs for one in pair] == [
        "sfm-adc[cap=soft]",
        "sfm-mine[cap=soft]",
        "sfm-adc[cap=hard]",
        "sfm-mine[cap=hard]",
    ]


def test_a_cloud_is_asked_with_each_densifier_against_the_first_cloud():
    rows = [row(name, init=init) for init in ("sfm", "dim") for name in ("adc", "mine")]
    pairs = {f"{idea} - {baseline}" for baseline, idea in choose_pairs(rows, PSNR)}
    assert pairs == {
        "sfm-mine - sfm-adc",
        "dim-mine - dim-adc",
        "dim-adc - sfm-adc",
        "dim-mine - sfm-mine",
    }


def test_another_baseline_and_controls_come_from_the_settings():
    rows = sweep("adc", "longaxis", "absgrad")
    by_setting = choose_pairs(rows, replace(PSNR, baseline="absgrad"))
    assert {str(one) for one, _ in by_setting} == {"sfm-absgrad"}
    controlled = choose_pairs(rows, replace(PSNR, controls={"longaxis": "absgrad"}))
    assert (Arm("sfm", "absgrad"), Arm("sfm", "longaxis")) in controlled


def test_questions_of_one_command_about_one_idea_share_its_level():
    settings = [(("densify.decay", str(k)),) for k in range(4)]
    rows = [*sweep("adc"), *(r for one in settings for r in sweep("mine", variant=one))]
    _, found, _ = asked(rows)
    assert [one.level for one in found] == [pytest.approx(0.05 / 4)] * 4
    _, two, _ = asked(sweep("adc", "mine", "other"))
    assert [one.level for one in two] == [0.05, 0.05]
    _, shared, _ = asked(sweep("adc", "mine", "other"), about=replace(PSNR, shared=True))
    assert [one.level for one in shared] == [0.025, 0.025]


def test_twelve_settings_one_after_another_have_ever_smaller_levels():
    before, measured, levels = None, [], []
    for k in range(12):
        planned = sweep("adc", "mine", decay=k)
        before, found, _ = asked(planned, measured, before)
        measured += planned
        levels += [one.level for one in found]
    assert levels == [pytest.approx(level_of(n)) for n in range(1, 13)]


@pytest.mark.parametrize("changed", ["code", "metric", "seeds", "scene"])
def test_whatever_is_changed_counts_alike(changed):
    first = sweep("adc", "mine")
    before, _, _ = asked(first)
    again, about = list(first), PSNR
    if changed == "code":
        again = [*sweep("adc"), *sweep("mine", code="new")]
    if changed == "metric":
        about = replace(PSNR, metric="ssim")
    if changed == "seeds":
        again = sweep("adc", "mine", seeds=(0, 1, 2, 3))
    if changed == "scene":
        again = [*first, *sweep("adc", "mine", scene="room")]
    _, (found,), _ = asked(again, first, before, about)
    assert (found.n, found.untested) == (2, "")


def test_new_seeds_or_scenes_alone_begin_at_the_whole_level():
    first = sweep("adc", "mine")
    before, _, _ = asked(first)
    for new in (sweep("adc", "mine", seeds=(3, 4, 5)), sweep("adc", "mine", scene="room")):
        assert [one.n for one in asked(new, first, before)[1]] == [1]


def test_a_command_that_an_earlier_one_covers_asks_nothing_and_shows_that_one():
    first = sweep("adc", "mine")
    before, (question,), _ = asked(first)
    for again in (first, sweep("adc", "mine", seeds=(1,)), sweep("mine", seeds=(0, 2))):
        _, found, shown = asked(again, first, before)
        assert (found, shown) == ([], [question.id])


def test_a_command_without_a_result_costs_nothing():
    before, _, _ = asked(sweep("adc", "mine"))
    _, (found,), _ = asked(sweep("adc", "mine", decay=1), [], replace(before, results=frozenset()))
    assert found.n == 1


def test_results_that_no_command_asked_for_count_as_tries():
    _, (found,), _ = asked(sweep("adc", "mine", decay=1), sweep("adc", "mine"))
    assert found.n == 2


def test_a_question_that_leaves_measured_trials_of_its_idea_out_is_not_tested():
    eight = sweep("adc", "mine", seeds=range(8))
    before, _, _ = asked(eight)
    best = replace(PSNR, metric="ssim")
    _, (found,), _ = asked(sweep("adc", "mine", seeds=(2, 5, 7)), eight, before, best)
    assert "leaves out measured trials: garden seeds 0, 1, 3, 4, 6" in found.untested
    assert "not tested" in announce(found)


def test_chosen_seeds_of_a_baseline_are_not_tested_and_its_first_ones_are():
    baseline = sweep("adc", seeds=range(12))
    _, (chosen,), _ = asked(sweep("mine", seeds=(3, 7, 11)), baseline)
    assert "leaves out measured trials of sfm-adc" in chosen.untested
    _, (first,), _ = asked(sweep("mine"), baseline)
    assert (first.untested, first.digests) == ("", {HERE: ("sfm-adc/0", "sfm-mine/0")})


def test_fresh_seeds_can_be_used_again_by_a_further_try():
    first = sweep("adc", "mine")
    before, _, _ = asked(first)
    fresh = sweep("adc", "mine", seeds=(3, 4, 5), decay=1)
    before, _, _ = asked(fresh, first, before)
    again = sweep("adc", seeds=(3, 4, 5), decay=1) + sweep("mine", seeds=(3, 4, 5), decay=2)
    _, (found,), _ = asked(again, [*first, *fresh], before)
    assert (found.n, found.untested) == (2, "")


def test_a_baseline_that_is_trained_later_is_awaited():
    _before, (question,), _ = asked(sweep("mine"))
    assert question.digests == {HERE: ("", "sfm-mine/0")}
    assert str(question.baseline) == "sfm-adc"


def test_the_number_and_the_level_are_said_before_training():
    first = sweep("adc", "mine")
    before, (one,), _ = asked(first)
    assert announce(one) == "sfm-mine against sfm-adc: first on these seeds: 5 %"
    second = sweep("adc", "mine", decay=1)
    before, _, _ = asked(second, first, before)
    _, (three,), _ = asked(sweep("adc", "mine", decay=2), [*first, *second], before)
    assert announce(three).endswith("third on these seeds: 0.83 %; new seeds have 5 %")


def test_what_cannot_be_reached_is_said_with_what_it_needs():
    """Six scenes that agree have p 2/64, so 5 % can be reached, and 1.7 % needs seven."""
    scenes = [
        row(name, seed, scene=f"s{k}")
        for name in ("adc", "mine")
        for seed in (0, 1)
        for k in range(6)
    ]
    _, (one,), _ = asked(scenes)
    assert unreachable(one) == []
    assert "need 7 scenes at 1.7 %, not 6" in unreachable(replace(one, level=level_of(2)))[0]
    _, (single,), _ = asked(sweep("adc", "mine", seeds=(0,)))
    assert "two seeds or more" in unreachable(single)[0]


def test_a_split_can_be_asked_about_alone():
    rows = [
        row(name, seed, variant=(("scene.split", split),))
        for name in ("adc", "mine")
        for seed in (0, 1)
        for split in ("every_nth", "sector")
    ]
    _, found, _ = asked(rows, about=replace(PSNR, split="sector"))
    assert [dict(one.idea.variant) for one in found] == [{"scene.split": "sector"}]


@pytest.mark.parametrize("text, size, relative", [("0.1", 0.1, False), ("10%", 0.1, True)])
def test_a_least_difference_is_a_number_or_a_part(text, size, relative):
    assert read_least(text, "x") == (size, relative)
    with refusal("above 0"):
        read_least("-1", "x")
