"""The ledger's file: what is read back, and which changes of the file are found."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsbench.errors import InputError
from gsbench.runs.layout import LEDGER
from gsbench.runs.ledger import (
    FAILED,
    KEPT,
    Confirmed,
    Confirming,
    Difference,
    Ended,
    Entry,
    Ledger,
    Opened,
    Started,
    append,
    begin_ledger,
    read_ledger,
)

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


def started(idea: str, against: str = "baseline") -> Started:
    return Started(
        time=TIME,
        idea=idea,
        against=against,
        level=0.03,
        identity=idea,
        words=("densify=x",),
        keys={"garden": f"garden/sfm-{idea}/11111111"},
    )


def ended(idea: str, result: str) -> Ended:
    difference = Difference(mean=1.0, low=0.5, high=1.5)
    return Ended(
        time=TIME,
        idea=idea,
        result=result,
        reason="better",
        seeds=3,
        difference=difference,  # type: ignore[arg-type]
    )


ENTRIES: list[Entry] = [
    started("a"),
    ended("a", KEPT),
    started("b", "a"),
    ended("b", FAILED),
    Confirming(
        time=TIME,
        seeds=(0, 1),
        keys={"baseline": {"park": "park/x/1"}, "a": {"park": "park/y/2"}},
    ),
    Confirmed(time=TIME, number=0, results={"a": KEPT}, differences={}),
]


@pytest.fixture
def home(tmp_path: Path) -> Path:
    home = tmp_path / "runs" / "night"
    home.mkdir(parents=True)
    begin_ledger(home, OPENED)
    for entry in ENTRIES:
        append(home, lambda ledger, entry=entry: entry)  # type: ignore[misc]
    return home


def test_a_ledger_is_read_back_as_it_was_written(home: Path) -> None:
    ledger = read_ledger(home)
    assert list(ledger.entries) == [OPENED, *ENTRIES]
    assert (ledger.kept, ledger.tried) == (["a"], 1)  # "b" ended without any result
    assert ledger.words_of("baseline") == ("densify=adc",)
    assert ledger.words_of("b") == ("densify=x",)
    assert ledger.confirmations == [(ENTRIES[4], ENTRIES[5])]
    assert ledger.all_keys() == {
        "garden/sfm-adc/00000000",
        "garden/sfm-a/11111111",
        "garden/sfm-b/11111111",
        "park/x/1",
        "park/y/2",
    }


def test_an_idea_that_failed_and_was_tried_again_has_its_last_result(home: Path) -> None:
    ledger = append(home, lambda ledger: ended("b", KEPT))
    assert (ledger.kept, ledger.tried) == (["a", "b"], 2)


def test_beginning_again_keeps_the_ledger(home: Path) -> None:
    assert len(begin_ledger(home, OPENED).entries) == 7


@pytest.mark.parametrize("number", range(6))
@pytest.mark.parametrize("change", ["edit", "drop", "swap", "repeat", "space"])
def test_a_line_that_was_changed_is_found(home: Path, number: int, change: str) -> None:
    path = home / LEDGER
    lines = path.read_text().splitlines(keepends=True)
    line = lines[number]
    changes = {
        "edit": [line.replace(TIME, "2026-11-27T05:00:00Z")],
        "drop": [],
        "swap": [lines[number + 1], line],
        "repeat": [line, line],
        "space": [line.replace(": ", ":  ", 1)],
    }
    after = number + (2 if change == "swap" else 1)
    path.write_text("".join([*lines[:number], *changes[change], *lines[after:]]))
    with pytest.raises(InputError, match=r"line \d .*bring back the file|is empty"):
        read_ledger(home)


@pytest.mark.parametrize("text", ["", "{}\n", "not JSON\n", "[1]\n", "\x00\n", "null\n"])
def test_a_damaged_ledger_is_refused_in_one_line(home: Path, text: str) -> None:
    (home / LEDGER).write_text(text)
    with pytest.raises(InputError, match="bring back the file"):
        read_ledger(home)


def test_without_a_ledger_the_command_that_begins_one_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="gsbench ledger new night"):
        read_ledger(tmp_path / "night")


def test_nothing_is_appended_if_there_is_no_entry(home: Path) -> None:
    before = (home / LEDGER).read_bytes()
    assert isinstance(append(home, lambda ledger: None), Ledger)
    assert (home / LEDGER).read_bytes() == before
