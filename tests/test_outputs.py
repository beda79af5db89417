"""Standard streams that are closed, or cannot be written to, as with cron or on a full disk."""

import sys
from pathlib import Path
from shlex import quote

import pytest

from tests.processes import completed

FULL = Path("/dev/full")
GSBENCH = f"{quote(sys.executable)} -m gsbench.cli"


def shell(line, folder):
    return completed(["sh", "-c", line.replace("gsbench", GSBENCH, 1)], None, cwd=folder)


@pytest.mark.parametrize(
    "line, code",
    [
        ("gsbench densify=adc --dry-run <&- >&- 2>&-", 0),
        ("gsbench tables E >&- 2>&-", 2),
    ],
)
def test_closed_streams_change_nothing_else(line, code, tmp_path):
    done = shell(line, tmp_path)
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert "NoneType" not in done.stderr


@pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")
def test_a_full_disk_of_the_output_is_not_that_of_the_runs_folder(tmp_path):
    done = shell(f"gsbench densify=adc --dry-run >{FULL}", tmp_path)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("gsbench: the output cannot be written (No space left")


@pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")
def test_log_lines_that_cannot_be_written_stop_nothing(tmp_path):
    done = shell(f"gsbench densify=adc --dry-run 2>{FULL}", tmp_path)
    assert done.returncode == 0
    assert "1 trial: 1 missing" in done.stdout
