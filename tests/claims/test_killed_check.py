"""A check that is killed, by the strongest signal, goes on with the same command and ends with the same page."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from tests.claims.test_sweep import content
from tests.launch.test_declare import TINY

pytestmark = pytest.mark.slow

PATIENCE = 240.0  # seconds for a trial of two iterations, on a machine that is busy with other things


def command(claims: Path) -> list[str]:
    return [sys.executable, "-m", "gsbench.cli", "check", str(claims)]


def page(runs: Path) -> list[str]:
    """The page without the minute in which its plan was declared, and without what is measured of a machine."""
    lines = (runs / "check_it" / "claims.md").read_text().splitlines()
    assert sum(" was declared " in line for line in lines) == 1
    measured = (" was declared ", "| seconds of training |", "| memory (MB) |")
    assert all(sum(words in line for line in lines) == 1 for words in measured)
    return [line for line in lines if not any(words in line for words in measured)]


def done(runs: Path) -> int:
    return len(list(runs.glob("check_it/*/*/*/results.json")))


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_a_killed_check_goes_on_and_ends_with_the_same_page(tmp_path: Path) -> None:
    words = dict(word.split("=", 1) for word in TINY)
    settings = {key: yaml.safe_load(value) for key, value in words.items()}
    claim = content()["claims"][0] | {"baseline": "few", "arm": "many"}
    arms = {"few": {"init.count": 200}, "many": {"init.count": 300}}
    claims = tmp_path / "claims.yaml"
    claims.write_text(json.dumps(content() | {"settings": settings, "arms": arms, "claims": [claim], "seeds": 2}))
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run(command(claims), env=os.environ | {"GSBENCH_RUNS": str(whole)}, check=True, timeout=2 * PATIENCE)

    for trials in (1, 3):  # in the middle of the first look, and once more before its last trial
        process = subprocess.Popen(command(claims), env=os.environ | {"GSBENCH_RUNS": str(killed)})
        until = time.monotonic() + PATIENCE
        while done(killed) < trials and time.monotonic() < until and process.poll() is None:
            time.sleep(0.02)
        process.kill()
        assert process.wait() == -signal.SIGKILL
        assert done(killed) >= trials
        assert not (killed / "check_it" / "claims.md").exists()
    before = {path: path.read_bytes() for path in killed.glob("check_it/*/*/*/results.json")}
    subprocess.run(command(claims), env=os.environ | {"GSBENCH_RUNS": str(killed)}, check=True, timeout=2 * PATIENCE)
    assert page(killed) == page(whole)
    assert all(path.read_bytes() == content for path, content in before.items())  # done once
    assert len((killed / "check_it" / "declared.jsonl").read_text().splitlines()) == 1
