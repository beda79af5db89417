"""Progress in a log: some lines, and always the last one."""

from __future__ import annotations

import logging

import pytest

from gsbench.logs import progress


def test_a_log_gets_the_first_line_of_a_phase_and_the_last(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "gsbench")
    with progress("train") as report:
        for done in range(1, 5):
            report("iteration", done, 4)
        report("iteration", 4, 4)  # logged already
        report("export", 1, 1)
    assert [record.getMessage().rstrip() for record in caplog.records] == [
        "train: iteration 1/4",
        "train: iteration 4/4",
        "train: export 1/1",
    ]
