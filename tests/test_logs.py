"""Printed and logged text has no characters that control a terminal, whoever wrote it."""

import io
import logging
import sys
import unicodedata
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsbench import cli
from gsbench.errors import InputError
from gsbench.logs import (
    LOGGER,
    PrintableStream,
    _QuietHandler,
    begin_command,
    log_to,
    printable_output,
    set_up_logging,
)
from gsbench.words import printable

CONTROL_CHARACTERS = [
    "\x1b[2J",
    "\x1b]0;title\x07",
    "\x9b31m",
    "\x07",
    "\x08",
    "\x7f",
    "safe\rfake",
    "\u202egnp.exe",
    "\u2066x",
    "\x90q",
]

TURNING = set("LRE RLE LRO RLO PDF LRI RLI FSI PDI".split())  # noqa: SIM905


@pytest.mark.parametrize("text", CONTROL_CHARACTERS)
def test_control_characters_are_escaped(text):
    shown = printable(f"a {text} b")
    assert shown.isprintable()
    assert shown.encode("ascii").decode("unicode_escape") == f"a {text} b"


@given(st.text(st.characters(exclude_categories=[])))
def test_all_characters_that_control_a_terminal_are_escaped_and_no_others(text):
    shown = printable(text)
    assert not [
        c for c in shown if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") and c not in "\n\t"
    ]
    assert not [c for c in shown if unicodedata.bidirectional(c) in TURNING]
    assert printable(shown) == shown
    if all(c.isprintable() or c in "\n\t" for c in text) and not set(text) & set(
        "\u061c\u200e\u200f"
    ):
        assert shown == text
    shown.encode()  # fails for surrogates, which names of files may have


def test_text_in_any_language_is_unchanged():
    for text in ("größe 大きさ حجم 🏔️👩‍🔬", "a\tb\nc"):
        assert printable(text) == text


@pytest.mark.parametrize("text", CONTROL_CHARACTERS)
def test_control_characters_in_prints_logs_and_errors_are_escaped(
    text, tmp_path, monkeypatch, capsys
):
    def fail(argv):
        LOGGER.info("said: %s", text)
        print("printed:", text)
        with log_to(tmp_path / "log.txt"):
            try:
                raise ValueError(text)
            except ValueError:
                LOGGER.warning("raised", exc_info=True)
        raise InputError(f"refused: {text}")

    monkeypatch.setattr(LOGGER, "handlers", [])
    monkeypatch.setattr("gsbench.cli._trials", fail)
    monkeypatch.setattr(sys, "argv", ["gsbench", "seed=1"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    said = capsys.readouterr()
    for shown in (said.out, said.err, (tmp_path / "log.txt").read_text()):
        assert [c for c in shown if not c.isprintable() and c != "\n"] == []
    assert "refused: " in said.err
    assert "Traceback" in (tmp_path / "log.txt").read_text()
    for handler in list(LOGGER.handlers):
        LOGGER.removeHandler(handler)


def test_streams_are_restored_and_keep_their_methods(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", stream)
    with printable_output():
        print("\x1b[31m", flush=True)
        sys.stdout.writelines(["a\x07", "b"])
        assert not sys.stdout.isatty()
    with suppress(KeyError), printable_output():
        raise KeyError
    stream.flush()
    assert sys.stdout is stream
    assert stream.buffer.getvalue() == b"\\x1b[31m\na\\x07b"
    assert logging.getLogger("gsbench") is LOGGER


def test_log_lines_go_to_the_present_stderr(monkeypatch):
    monkeypatch.setattr(LOGGER, "handlers", [])
    set_up_logging()
    closed, now = io.StringIO(), io.StringIO()
    monkeypatch.setattr(sys, "stderr", closed)
    LOGGER.warning("one")
    closed.close()
    monkeypatch.setattr(sys, "stderr", now)
    LOGGER.warning("two")
    assert now.getvalue() == "two\n"


@pytest.fixture
def said(monkeypatch, capsys):
    """What has come to stderr since the last call; the handlers of all loggers are restored."""
    monkeypatch.setattr(LOGGER, "handlers", [])
    monkeypatch.setattr(LOGGER, "propagate", True)
    monkeypatch.setattr(logging.getLogger("other"), "handlers", [])
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    return lambda: capsys.readouterr().err


@pytest.mark.parametrize(
    "verbose, shown",
    [
        (False, "INFO"),
        (True, "gsbench gsbench.eval gsbench.evaluate INFO"),
        ("gsbench.eval", "gsbench.eval INFO"),
        (["gsbench.eval", "other"], "gsbench.eval INFO other"),
        ("other", "INFO other"),
    ],
)
def test_debug_lines_are_those_asked_for(verbose, shown, said):
    set_up_logging()
    set_up_logging(verbose)  # replaces its own handlers
    assert len(LOGGER.handlers) == 1
    for name in ("gsbench", "gsbench.eval", "gsbench.evaluate"):
        logging.getLogger(name).debug(name)
    LOGGER.info("INFO")
    other = logging.getLogger("other")
    other.setLevel(logging.DEBUG)
    other.debug("other")
    assert said().split() == shown.split()


def test_lines_go_through_the_handlers_of_another_library_and_come_once(said, tmp_path):
    class Kept(logging.Handler):
        def emit(self, record):
            kept.append(record.getMessage())

    kept = []
    root = logging.getLogger()
    root.addHandler(Kept())
    set_up_logging(through_root=True)  # no console there: gsbench writes, too
    LOGGER.info("one")
    assert (kept, said()) == (["one"], "one\n")
    raw = io.StringIO()
    console = logging.StreamHandler(PrintableStream(raw))
    console.setFormatter(logging.Formatter("\x1b[32m%(message)s\x1b[0m"))
    root.addHandler(console)
    set_up_logging("gsbench.eval", through_root=True)
    logging.getLogger("gsbench.eval").debug("two \x07")
    LOGGER.debug("three")
    assert kept == ["one", "two \x07"]
    assert raw.getvalue() == "\x1b[32mtwo \\x07\x1b[0m\n"  # colours stay, the text is escaped
    assert said() == ""
    assert not LOGGER.propagate


def test_a_trials_log_is_continued_with_all_lines_and_closed(said, tmp_path):
    set_up_logging()
    for text in ("one", "two"):
        with log_to(tmp_path / "log.txt"):
            LOGGER.debug(text)
            (handler,) = set(LOGGER.handlers[1:])
        assert handler.stream.closed
    LOGGER.info("after")
    lines = (tmp_path / "log.txt").read_text().splitlines()
    assert [line.partition(" DEBUG ")[2] for line in lines] == ["gsbench: one", "gsbench: two"]
    assert said() == "after\n"
    (tmp_path / "link").symlink_to(tmp_path / "log.txt")
    with pytest.raises(InputError, match="is a link"), log_to(tmp_path / "link"):
        pass


def test_a_log_on_a_full_disk_stops_nothing(said):
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    with open("/dev/full", "w") as full:
        LOGGER.addHandler(handler := _QuietHandler(full))
        LOGGER.warning("x" * 10)
        LOGGER.removeHandler(handler)
        with suppress(OSError):
            full.close()
    assert said() == ""


@pytest.mark.parametrize(
    "encoding, shown", [("latin-1", b"\\u2191 \xe9"), ("ascii", b"\\u2191 \\xe9")]
)
def test_what_an_encoding_lacks_is_escaped(encoding, shown):
    raw = io.BytesIO()
    stream = PrintableStream(io.TextIOWrapper(raw, encoding=encoding))
    print("\u2191 \xe9", end="", file=stream, flush=True)
    assert raw.getvalue() == shown


def test_a_note_about_a_scene_is_shown_once_in_a_command_and_is_in_every_log(tmp_path, capsys):
    for _ in range(2):
        with printable_output():
            begin_command()
            for seed in range(3):
                set_up_logging()
                with log_to(tmp_path / f"{seed}.txt"):
                    logging.getLogger("gsbench.scene.load").warning("scene %s: no pose", "a")
                    logging.getLogger("gsbench.train.records").warning("growth stopped")
                    logging.getLogger("gsbench.scene.load").info("a step")
    said = capsys.readouterr().err
    assert (said.count("no pose"), said.count("growth"), said.count("step")) == (2, 6, 6)
    assert [(tmp_path / f"{k}.txt").read_text().count("no pose") for k in range(3)] == [2, 2, 2]
