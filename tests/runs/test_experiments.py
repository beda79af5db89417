"""The records of an experiment: its folder, and the search for settings."""

import pytest

from gsbench.parsing import DamagedError, read_typed
from gsbench.runs.experiments import (
    TuningRecord,
    experiment_home,
    list_experiments,
    make_home,
    trial_folders,
)
from tests.helpers import refusal, write
from tests.trials import search_record

POINTS = [{"settings": {"x": 0.5}, "value": 2.0}, {"settings": {"x": 1}, "value": 4.0}]
TUNING = search_record([*POINTS, {"settings": {}, "value": None}])
TUNING |= {"ranges": {"x": "0,1"}, "log": ["x"]}


def test_experiments_are_folders_that_are_not_hidden(tmp_path):
    assert list_experiments(tmp_path / "nowhere") == []
    for name in ("b", "a/scene/arm/trial", ".hidden", "store", "a/scene/.hidden/trial"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "file").touch()
    (tmp_path / "a/scene/file").touch()
    assert list_experiments(tmp_path) == ["a", "b"]
    assert list(trial_folders(tmp_path / "a")) == [str(tmp_path / "a/scene/arm/trial")]
    assert experiment_home(tmp_path, "b") == tmp_path / "b"
    with refusal(r"no experiment 'c' in .*; there: a, b"):
        experiment_home(tmp_path, "c")


def test_the_folder_of_an_experiment_is_made_unless_it_is_a_link(tmp_path):
    make_home(tmp_path / "runs/x")
    make_home(tmp_path / "runs/x")
    assert (tmp_path / "runs/x").is_dir()
    (tmp_path / "runs/link").symlink_to(tmp_path / "runs/x")
    with refusal("follows no links"):
        make_home(tmp_path / "runs/link")


def tuning(tmp_path, **changes):
    write(tmp_path / "tuning.json", TUNING | changes)
    return read_typed(tmp_path / "tuning.json", TuningRecord)


def test_the_best_point_is_the_one_with_the_best_value(tmp_path):
    assert tuning(tmp_path).best.value == 4.0
    assert tuning(tmp_path, direction=-1).best.value == 2.0
    more = [*POINTS, {"settings": {"x": 2.0}, "value": 0.0}]
    assert tuning(tmp_path, direction=-1, points=more).best.value == 0.0
    assert tuning(tmp_path, points=[{"settings": {}, "value": None}]).best is None


@pytest.mark.parametrize(
    "points, fault",
    [
        ([*POINTS, {"settings": {"y": 1.0}, "value": 1.0}], "different settings"),
        ([{"settings": {"x": 0.0}, "value": 1.0}], "not above 0"),
        ([{"settings": {"x": -1}, "value": 1.0}], "not above 0"),
    ],
)
def test_a_record_of_an_impossible_search_is_damaged(tmp_path, points, fault):
    with pytest.raises(DamagedError, match=fault):
        tuning(tmp_path, points=points)
    if "above" in fault:
        assert tuning(tmp_path, points=points, log=[]).points
