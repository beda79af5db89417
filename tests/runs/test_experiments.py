"""The records of an experiment: its folder, the search for settings, and declarations."""

import pytest

from gsbench.parsing import DamagedError, read_typed
from gsbench.runs.experiments import (
    Declaration,
    Question,
    TuningRecord,
    experiment_home,
    latest_declaration,
    list_experiments,
    make_home,
    merge_planned,
    open_question,
    read_declarations,
    record_text,
    trial_folders,
)
from gsbench.runs.trial_record import Declared
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


def declared(hour, *metrics, **values):
    questions = tuple(open_question(metric) for metric in metrics)
    return Declaration(time=f"1970-01-01T{hour:02d}:00:00Z", questions=questions, **values)


def test_a_declaration_knows_its_time_and_its_metric():
    one = declared(2, "psnr@extrapolation", "ssim")
    assert one.moment == 7200
    assert one.when == "1970-01-01 02:00 UTC"
    assert one.primary == "psnr@extrapolation"
    assert one.summary() == Declared(metric="psnr@extrapolation", time=one.time)
    asked = [(question.metric, question.sign) for question in one.questions]
    assert asked == [("psnr", 0), ("ssim", 0)]
    assert Question(metric="psnr").sign == 1
    with pytest.raises(ValueError, match="time is not a time"):
        Declaration(time="yesterday")


def test_planned_trials_are_those_of_the_declaration_and_of_its_questions():
    asked = Question(metric="psnr", scenes={"garden": ("garden/a/1", "garden/b/2")}, seeds=(1, 0))
    both = Declaration(
        time=declared(1).time, questions=(asked,), trials={"garden/a/1": (2,), "room/a/1": (0,)}
    )
    assert both.planned == {"garden/a/1": (0, 1, 2), "garden/b/2": (0, 1), "room/a/1": (0,)}
    assert merge_planned({}, both.planned) == both.planned
    named = [
        declared(1),
        declared(1, trials={}),
        declared(1, "psnr"),
        Declaration(time=both.time, questions=(asked,)),
    ]
    assert [one.names_trials for one in named] == [False, True, False, True]


def test_a_repeated_declaration_is_in_force_since_its_first_time(tmp_path):
    first, second = declared(1, "psnr"), declared(2, "psnr")
    third = declared(3, "psnr", missing={"a": ["b"]})
    other, last = declared(2, "ssim"), declared(4, "ssim")
    assert latest_declaration([first]) is first
    assert latest_declaration([first, second]) is first
    # what could not be tested does not change the questions
    assert latest_declaration([first, second, third]) is first
    assert latest_declaration([first, other, third]) is third
    assert latest_declaration([first, second, last]) is last
    assert latest_declaration([other, first, second, third]) is first


def test_declarations_are_kept_in_the_order_of_time(tmp_path):
    first, second = declared(1, "psnr"), declared(2, "ssim", looks=(2, 3))
    assert read_declarations(tmp_path) == []
    text = record_text([second, first])
    assert text.endswith("}\n")
    # a declaration without questions
    (tmp_path / "declared.jsonl").write_text(text + '{"time": "1970-01-01T03:00:00Z"}\n')
    assert read_declarations(tmp_path) == [first, second]
    repeated = [first.summary(), None, Declared(metric="lpips_vgg", time="1970-01-01T00:00:00Z")]
    assert read_declarations(tmp_path, [*repeated, Declared(metric="psnr", time="?")]) == [
        declared(0, "lpips_vgg"),
        first,
        second,
    ]
