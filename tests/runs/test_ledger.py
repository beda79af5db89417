"""The ledger's file: what is read back, and which changes of the file are found."""

from dataclasses import replace

import pytest

from gsbench.runs.layout import LEDGER
from gsbench.runs.ledger import (
    FAILED,
    KEPT,
    Confirmed,
    Confirming,
    Difference,
    Ended,
    Ledger,
    Opened,
    Promoted,
    Started,
    append,
    as_json,
    begin_ledger,
    chained,
    read_ledger,
)
from tests.helpers import refusal

TIME = "2026-11-27T06:00:00Z"
OPENED = Opened(
    time=TIME,
    metric="psnr",
    sign=1,
    least=0.1,
    ideas=3,
    rate=0.1,
    seeds=(0, 1, 2),
    words=("densify=adc",),
    keys={"garden": "garden/sfm-adc/00000000"},
)


def started(idea, against="baseline"):
    own = {"words": ("densify=x",), "keys": {"garden": f"garden/sfm-{idea}/11111111"}}
    return Started(time=TIME, idea=idea, against=against, identity=idea, **own)


def promoted(idea, *seeds):
    return Promoted(time=TIME, idea=idea, level=0.03, seeds=seeds)


def ended(idea, result):
    found = {"reason": "better", "difference": Difference(mean=1.0, low=0.5, high=1.5)}
    return Ended(time=TIME, idea=idea, result=result, seeds=3, **found)


def confirming(**keys):
    return Confirming(time=TIME, seeds=(0, 1), keys=keys)


def confirmed(number=0, **results):
    return Confirmed(time=TIME, number=number, results=results, differences={})


ENTRIES = [
    started("a"),
    promoted("a", 7, 8, 9),
    ended("a", KEPT),
    started("b", "a"),
    ended("b", FAILED),
    confirming(baseline={"park": "park/x/1"}, a={"park": "park/y/2"}),
    confirmed(a=KEPT),
]


@pytest.fixture
def home(tmp_path):
    home = tmp_path / "runs/night"
    home.mkdir(parents=True)
    begin_ledger(home, OPENED)
    for entry in ENTRIES:
        append(home, lambda ledger, entry=entry: entry)
    return home


def test_a_ledger_is_read_back_as_it_was_written(home):
    ledger = read_ledger(home)
    assert list(ledger.entries) == [OPENED, *ENTRIES]
    assert (ledger.kept, ledger.tried) == (["a"], 1)  # "b" ended without any result
    assert ledger.words_of("baseline") == ("densify=adc",)
    assert ledger.words_of("b") == ("densify=x",)
    assert ledger.confirmations == [(ENTRIES[5], ENTRIES[6])]
    assert ledger.all_keys() == {
        "garden/sfm-adc/00000000",
        "garden/sfm-a/11111111",
        "garden/sfm-b/11111111",
        "park/x/1",
        "park/y/2",
    }


def test_an_idea_that_failed_and_was_tried_again_has_its_last_result(home):
    append(home, lambda ledger: promoted("b", 10, 11))
    ledger = append(home, lambda ledger: ended("b", KEPT))
    assert (ledger.kept, ledger.tried) == (["a", "b"], 2)


def test_beginning_again_keeps_the_ledger(home):
    assert len(begin_ledger(home, OPENED).entries) == 8


LAST = 7
CHANGES = ("edit", "drop", "swap", "repeat", "space")


@pytest.mark.parametrize(
    "number, change",
    [(number, change) for number in range(LAST) for change in CHANGES]
    + [(LAST, change) for change in ("edit", "repeat", "space")],
)
def test_a_line_that_was_changed_is_found(home, number, change):
    path = home / LEDGER
    lines = path.read_text().splitlines(keepends=True)
    line = lines[number]
    changes = {
        "edit": [line.replace(TIME, "2026-11-27T05:00:00Z")],
        "drop": [],
        "swap": [*lines[number + 1 : number + 2], line],
        "repeat": [line, line],
        "space": [line.replace(": ", ":  ", 1)],
    }
    after = number + (2 if change == "swap" else 1)
    path.write_text("".join([*lines[:number], *changes[change], *lines[after:]]))
    with refusal(r"line \d .*bring back the file|is empty"):
        read_ledger(home)


@pytest.mark.parametrize("text", ["", "{}\n", "not JSON\n", "[1]\n", "\x00\n", "null\n"])
def test_a_damaged_ledger_is_refused_in_one_line(home, text):
    (home / LEDGER).write_text(text)
    with refusal("bring back the file"):
        read_ledger(home)


def test_without_a_ledger_the_command_that_begins_one_is_named(tmp_path):
    with refusal("gsbench ledger new night"):
        read_ledger(tmp_path / "night")


def test_nothing_is_appended_if_there_is_no_entry(home):
    before = (home / LEDGER).read_bytes()
    assert isinstance(append(home, lambda ledger: None), Ledger)
    assert (home / LEDGER).read_bytes() == before


def test_a_lost_last_line_break_destroys_nothing(home):
    path = home / LEDGER
    path.write_bytes(path.read_bytes().rstrip(b"\n"))
    append(home, lambda ledger: started("c"))
    assert list(read_ledger(home).entries) == [OPENED, *ENTRIES, started("c")]


AFTER_ALL = {
    "begins 'a' a second time": started("a"),
    "compares with 'b', which was not kept": started("c", "b"),
    "ends 'c', which was not begun": ended("c", KEPT),
    "decides 'a' a second time": ended("a", FAILED),
    "keeps 'b' without a test": ended("b", KEPT),
    "tests 'c', which was not begun": promoted("c", 20, 21),
    "tests with seeds that ideas have seen": promoted("b", 9, 10),
    "tests with seeds that ideas have": promoted("b", 2, 3),
    "tests on other seeds than the ideas before": replace(started("c"), level=0.1),
    "has other captures": replace(started("c"), keys={"park": "park/x/1"}),
    "lacks the baseline": confirming(),
    "on none": confirming(baseline={}, a={}),
    "were not kept": confirming(baseline={}, b={}),
    "was not begun": confirmed(1),
    "or was ended before": confirmed(a=KEPT),
}


@pytest.mark.parametrize("fault", AFTER_ALL)
def test_an_entry_that_cannot_follow_is_refused(home, fault):
    entries = [*read_ledger(home).entries, AFTER_ALL[fault]]
    (home / LEDGER).write_text(chained(map(as_json, entries)))
    with refusal(f"line 9 .*{fault}.*bring back"):
        read_ledger(home)


@pytest.mark.parametrize("place", ["ended", "confirmed"])
def test_a_relative_difference_that_no_number_holds_is_refused(home, place):
    huge = Difference(mean=1e30, low=0.0, high=0.0)
    entries = [replace(OPENED, relative=True), *ENTRIES[:2]]
    if place == "confirmed":
        confirmed = replace(ENTRIES[6], differences={"a": huge})
        entries += [ENTRIES[2], ENTRIES[5], confirmed]
    else:
        entries.append(replace(ended("a", KEPT), difference=huge))
    (home / LEDGER).write_text(chained(map(as_json, entries)))
    with refusal("difference that cannot be"):
        read_ledger(home)


def test_results_of_ideas_that_were_not_asked_are_refused(home):
    other = replace(ENTRIES[6], results={"a": KEPT, "x": KEPT})
    (home / LEDGER).write_text(chained(map(as_json, [OPENED, *ENTRIES[:6], other])))
    with refusal("results of other ideas"):
        read_ledger(home)
