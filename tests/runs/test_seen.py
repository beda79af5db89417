"""The record of all results that were ever measured in an experiment."""

from dataclasses import replace

import pytest

from gsbench.runs.config_hash import arm_hash
from gsbench.runs.seen import SeenResult, read_seen, remember, seen_path
from gsbench.runs.trial_record import Code
from tests.helpers import refusal, write
from tests.trials import record_of, trial_values

TIMES = "2026-01-02T00:00:00Z", "2026-01-05T00:00:00Z"


def result(runs, psnr=20.0, time=TIMES[0], **changes):
    return record_of(trial_values(runs), metrics={"psnr": psnr}, measured=time, **changes)


def test_each_result_is_recorded_once_with_its_first_time(tmp_path):
    home = tmp_path / "exp"
    for one in (result(home), result(home, time=TIMES[1]), result(home, 21.0, TIMES[1])):
        remember(home, one)
    assert [(one.metrics["psnr"], one.time) for one in read_seen(home)] == [
        (20.0, TIMES[0]),
        (21.0, TIMES[1]),
    ]
    assert not home.exists()  # the record is beside it
    assert read_seen(tmp_path / "other") == ()


@pytest.mark.parametrize(
    "code, version",
    [
        ({"sources": {"mine": "a"}, "stages": {"train": 2}}, {"code of mine": "a"}),
        ({"packages": {"eval": "released", "densify": "b"}}, {"gsbench's densify": "b"}),
    ],
)
def test_a_version_is_of_what_a_user_may_edit(tmp_path, code, version):
    remember(tmp_path / "exp", result(tmp_path, code=Code(**code)))
    (one,) = read_seen(tmp_path / "exp")
    assert one.version == frozenset(version.items())


@pytest.mark.parametrize(
    "metrics, count, equal",
    [
        ({"psnr": 20.0, "ssim": 0.5}, 10, True),  # another metric was added
        ({"psnr": 20.1}, 10, False),
        ({"psnr": 20.0}, 11, False),
    ],
)
def test_equal_results_have_the_same_bits_in_what_both_measured(tmp_path, metrics, count, equal):
    other = replace(result(tmp_path), metrics=metrics, num_gaussians=count)
    assert SeenResult.of(result(tmp_path)).has_bits_of(SeenResult.of(other)) == equal


@pytest.mark.parametrize(
    "changes, same",
    [
        ({"densify": {"name": "better"}, "eval": {"primary": "flip"}, "seed": 5}, True),
        ({"scene": {"path": "/there"}, "train": {"log_every": 7}}, True),
        ({"densify": {"_target_": "mine.Other"}}, False),
        ({"densify": {"views": 8}}, False),
        ({"train": {"iterations": 200}}, False),
    ],
)
def test_an_arm_is_what_it_is_made_of_and_not_its_name(tmp_path, changes, same):
    values = trial_values(tmp_path) | {"eval": {}, "scene": {"name": "a", "path": "/here"}}
    values["densify"] |= {"_target_": "mine.Mine", "views": 5}
    other = {
        key: value | changes.get(key, {}) if isinstance(value, dict) else changes.get(key, value)
        for key, value in values.items()
    }
    assert (arm_hash(values) == arm_hash(other)) == same


def test_a_link_is_refused_and_a_damaged_line_costs_itself_alone(tmp_path):
    home, elsewhere = tmp_path / "exp", write(tmp_path / "elsewhere", "")
    write(seen_path(home), b"\xff {")
    for _ in range(2):
        remember(home, result(home))
    assert len(read_seen(home)) == 1
    seen_path(home).unlink()
    seen_path(home).symlink_to(elsewhere)
    with refusal("is a link"):
        remember(home, result(home))
    assert elsewhere.read_text() == ""
