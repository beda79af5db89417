"""Progress in a log: some lines, and always the last one."""

import io
import sys

from gsbench.logs import SECONDS_BETWEEN_LINES, no_progress, progress


def test_a_log_gets_the_first_line_of_a_phase_and_the_last(logged):
    with progress("train") as report:
        for done in range(1, 5):
            report("iteration", done, 4)
        report("iteration", 4, 4)  # logged already
        report("export", 1, 1)
    assert [record.getMessage().rstrip() for record in logged.records] == [
        "train: iteration 1/4",
        "train: iteration 4/4",
        "train: export 1/1",
    ]


def test_a_log_gets_a_line_from_time_to_time(logged, monkeypatch):
    now = 1000.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    with progress("fetch") as report:
        report("a", 0, None)
        for done, now in (  # noqa: B007 - read by the clock
            (1, 1000 + 0.9 * SECONDS_BETWEEN_LINES),
            (2, 1000 + SECONDS_BETWEEN_LINES),
            (3, 1000 + 1.9 * SECONDS_BETWEEN_LINES),
            (4, 1000 + 2 * SECONDS_BETWEEN_LINES),
        ):
            report("a", done, None, f"note {done}")
        report("a", 0, 0)
    assert [message.rstrip() for message in logged.messages] == [
        "fetch: a 0/?",
        "fetch: a 2/? note 2",
        "fetch: a 4/? note 4",
        "fetch: a 0/0",
    ]
    no_progress("a", 1, 2)


def test_a_terminal_gets_a_bar_without_control_characters_of_others(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr(sys, "stderr", Terminal())
    with progress("fetch") as report:
        report("a", 1, 2)
        report("b", 1, 2, "[red]\x07 of 5")
    shown = sys.stderr.getvalue()
    assert "fetch: b" in shown
    assert "[red]\\x07 of 5" in shown
    assert "\x07" not in shown
