"""The file of an experiment's commands: its lines, their links, and what is known by them."""

from dataclasses import replace

import pytest

from gsbench.runs.commands import (
    Command,
    Finished,
    PlannedTrial,
    Question,
    append,
    chained,
    code_digest,
    drop,
    read_history,
    read_lines,
    remember_result,
)
from gsbench.runs.experiments import Arm
from tests.helpers import refusal

FOLDER = "garden/sfm-mine/c0ffee00-seed0"
MINE = "sfm-mine/c0ffee00"
QUESTION = Question(
    idea=Arm("sfm", "mine"),
    baseline=Arm("sfm", "adc"),
    metric="psnr",
    digests={"garden": ("sfm-adc/c0ffee00", MINE)},
    seeds={"garden": (0, 1)},
).with_id(0)


def command(name="first", **more):
    trials = {FOLDER: PlannedTrial(words=(name,), digest=MINE)}
    given = {"words": (name,), "cwd": "/here", "time": 5.0, "trials": trials}
    return Command(**given | more)


@pytest.fixture
def home(tmp_path):
    return tmp_path / "runs" / "exp"


@pytest.fixture
def file(home):
    append(home, lambda history: command(questions=(QUESTION,)))
    append(home, lambda history: command("second"))
    return home / "commands.jsonl"


def test_commands_are_read_in_order_with_their_questions_and_plan(home, file):
    history = read_history(home)
    assert [one.words for one in history.commands] == [("first",), ("second",)]
    assert history.questions == (QUESTION,)
    planned = history.planned[home / FOLDER]
    assert (planned.words, planned.cwd, planned.time) == (("second",), "/here", 5.0)
    assert not history.faults


def test_no_line_is_added_without_a_command(home, file):
    before = file.read_bytes()
    assert append(home, lambda history: None) is None
    assert file.read_bytes() == before


def test_a_torn_tail_is_closed_first_and_later_lines_stay_valid(home, file):
    with file.open("ab") as stream:
        stream.write(b'{"words": ["torn')
    append(home, lambda history: command("third"))
    history = read_history(home)
    assert [one.words[0] for one in history.commands] == ["first", "second", "third"]
    assert len(history.faults) == 1
    assert "line 3 of commands.jsonl" in history.faults[0]


@pytest.mark.parametrize("edit", ["changed", "removed"])
def test_a_broken_link_is_named_and_later_lines_stay_valid(home, file, edit):
    lines = file.read_text().splitlines()
    lines = [lines[0].replace("first", "other"), lines[1]] if edit == "changed" else lines[1:]
    file.write_text("".join(f"{line}\n" for line in lines))
    history = read_history(home)
    assert history.commands[-1].words == ("second",)
    number = len(lines) if edit == "changed" else 1
    (fault,) = history.faults
    assert f"line {number} of commands.jsonl does not follow the one before it" in fault


def test_a_result_is_remembered_once_even_if_its_folder_goes(home, file):
    for _ in range(2):
        remember_result(home, home / FOLDER, MINE)
    drop(home, [home / FOLDER])
    history = read_history(home)
    assert history.results == {(MINE, ("garden", 0))}
    assert not history.planned
    assert [type(line) for line in read_lines(home)] == [Command, Command, Finished, Command]
    assert not history.faults


def test_lines_are_linked_anew_for_others(home, file):
    lines = [replace(line, cwd="") for line in read_lines(home)]
    file.write_text(chained(lines))
    history = read_history(home)
    assert (history.faults, history.commands[0].cwd) == ((), "")


def test_a_link_in_place_of_the_file_is_refused(home, file, tmp_path):
    file.rename(tmp_path / "elsewhere")
    file.symlink_to(tmp_path / "elsewhere")
    with refusal("link"):
        append(home, lambda history: command())


def test_a_repeated_question_is_the_newest(home, file):
    other = replace(QUESTION, metric="ssim", id="").with_id(1)
    append(home, lambda history: command("third", questions=(other,)))
    assert read_history(home).questions == (QUESTION, other)
    append(home, lambda history: command("fourth", shows=(QUESTION.id,)))
    assert read_history(home).questions == (other, QUESTION)


def test_an_awaited_baseline_has_the_digest_of_the_first_later_command(home):
    awaited = replace(QUESTION, digests={"garden": ("", MINE)})
    append(home, lambda history: command(questions=(awaited,)))
    assert read_history(home).questions[0].digests["garden"][0] == ""
    for seed, digest in enumerate(("sfm-adc/first", "sfm-adc/second")):
        trials = {f"garden/sfm-adc/0{seed}-seed0": PlannedTrial(words=(), digest=digest)}
        append(home, lambda history, trials=trials: command(trials=trials))
    assert read_history(home).questions[0].digests["garden"] == ("sfm-adc/first", MINE)


def test_questions_cover_what_lies_within_them(home, file):
    history = read_history(home)
    assert history.covering(MINE, "garden", 1) == [QUESTION]
    assert history.covering("sfm-adc/c0ffee00", "garden", 0) == [QUESTION]
    for place in (("garden", 2), ("room", 0)):
        assert history.covering(MINE, *place) == []
    within = replace(QUESTION, seeds={"garden": (1,)})
    assert QUESTION.covers(within)
    assert not within.covers(QUESTION)
    for changed in ({"metric": "ssim"}, {"digests": {"garden": ("sfm-adc/c0ffee00", "x")}}):
        assert not QUESTION.covers(replace(within, **changed))


def test_code_as_released_has_no_digest():
    assert code_digest({}, {"scene": "released"}) == ""
    digests = {
        code_digest({"mine": "1"}, {}),
        code_digest({"mine": "2"}, {}),
        code_digest({}, {"train": "edited"}),
    }
    assert len(digests - {""}) == 3
