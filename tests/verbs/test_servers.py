"""Verbs that serve pages end all their processes and import no module of the current folder."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress

import psutil
import pytest

from gsbench.tracking import connect

pytestmark = pytest.mark.slow
SECONDS = 120


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGINT])
def test_all_processes_of_the_dashboard_end_and_none_imports_from_the_current_folder(
    tmp_path, signum
):
    (tmp_path / "runs").mkdir()
    connect(None, tmp_path / "runs")
    (tmp_path / "yaml.py").write_text(f"open({str(tmp_path / 'exploded')!r}, 'w')\n")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = os.environ | {"GSBENCH_RUNS": str(tmp_path / "runs")}
    command = [sys.executable, "-P", "-m", "gsbench.cli", "ui", "--port", str(port)]
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL
    ) as process:
        deadline = time.monotonic() + SECONDS
        while time.monotonic() < deadline:
            with (
                suppress(OSError),
                urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5) as answer,
            ):
                assert answer.status == 200
                break
            time.sleep(0.2)
        family = psutil.Process(process.pid).children(recursive=True)
        assert len(family) >= 2
        process.send_signal(signum)
        assert process.wait(timeout=30) == 0
    assert not [
        child for child in family if child.is_running() and child.status() != psutil.STATUS_ZOMBIE
    ]
    assert not (tmp_path / "exploded").exists()
