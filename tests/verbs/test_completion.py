"""What the Tab key offers: asked for in Python, and typed into real shells."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gsbench.verbs.completion import SCRIPTS, complete
from gsbench.verbs.table import VERBS
from tests.conftest import ROOT

SECONDS = 120  # within which what never comes is told from a slow machine
TRIALS = (
    "demo/courtyard/sfm-adc/0123abcd-seed0",
    "demo/courtyard/sfm-volumetric/4567abcd-seed1",
    "mine/yard/dim-adc/0-seed0",
)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for trial in TRIALS:
        (tmp_path / "runs" / trial).mkdir(parents=True)
    (tmp_path / "runs" / "store").mkdir()
    return tmp_path / "runs"


# ---- what may come


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("gsbench st", ["status"]),
        ("gsbench tables ", ["demo", "mine"]),
        ("gsbench tables demo ", []),
        ("gsbench tables --out", ["--out"]),
        ("gsbench tables demo --format ", ["csv", "html", "latex", "md", "trials"]),
        ("gsbench tables demo --out ", []),  # a path: the shell knows
        ("gsbench view d", ["demo:"]),
        ("gsbench view demo:courtyard:", ["demo:courtyard:sfm-adc:", "demo:courtyard:sfm-volumetric:"]),
        ("gsbench export demo:courtyard:sfm-volumetric:", ["demo:courtyard:sfm-volumetric:1"]),
        ("gsbench explain demo:courtyard:flip:sfm-a", ["demo:courtyard:flip:sfm-adc"]),
        ("gsbench explain demo:courtyard:ps", ["demo:courtyard:psnr:"]),
        ("gsbench fetch mip", ["mipnerf360"]),
        ("gsbench fetch mipnerf360 gar", ["garden"]),
        ("gsbench evaluate renders --as mi", ["mine:"]),
        ("gsbench evaluate renders --prot", ["--protocol"]),
        ("gsbench retry demo launch=s", ["launch=serial", "launch=slurm"]),
        ("gsbench completion ", ["bash", "fish", "zsh"]),
        ("gsbench --v", ["--version"]),
        ("gsbench +exp", ["+experiment="]),
        ("gsbench +experiment=table1", ["+experiment=table1", "+experiment=table1_own"]),
        ("gsbench -m densify=adc,edge", ["densify=adc,edgeaware"]),
        ("gsbench densify=volumetric seed=1 densify.volume_th", ["densify.volume_threshold="]),
        ("gsbench -m densify=mcmc,adc densify.noi", ["densify.noise_rate="]),  # a key of the first
        ("gsbench nosuch=1 x", []),
        ("gsbench 'half", []),
    ],
)
def test_offers(line: str, offered: list[str], runs: Path) -> None:
    assert complete(line, runs) == offered


def test_the_first_word_is_a_verb_or_a_setting(runs: Path) -> None:
    (runs / "x$(touch${IFS}exploded)").mkdir()
    assert not any("$" in word for word in complete("gsbench tables ", runs))  # a shell would run it
    offered = complete("gsbench ", runs)
    assert set(VERBS) <= set(offered)
    assert {"scene=", "init=", "densify.", "seed=", "+experiment="} <= set(offered)
    assert not {"experiment=", "hydra", "schema/"} & set(offered)


def test_own_folder_of_choices_is_searched(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "own" / "experiment").mkdir(parents=True)
    (tmp_path / "own" / "experiment" / "mysweep.yaml").write_text("# @package _global_\n")
    line = f"gsbench --config-dir={tmp_path / 'own'} +experiment=my"
    assert complete(line, runs) == ["+experiment=mysweep"]


def test_no_answer_loads_torch() -> None:
    lines = ["gsbench ", "gsbench scene.", *(f"gsbench {verb} --" for verb in VERBS), "gsbench tables x "]
    code = (
        "import sys, gsbench.cli as c\n"
        f"for line in {lines!r}:\n    assert c.run(['completion', 'query', line]) == 0\n"
        "print(*[name for name in ('torch', 'mlflow', 'numba', 'pycolmap') if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=SECONDS, check=True)
    assert done.stderr.strip() == ""
    assert "--help" in done.stdout


# ---- real shells


class Shell:
    """An interactive shell on a terminal of its own, in which ``gsbench`` also notes what it was called with."""

    def __init__(self, name: str, home: Path, runs: Path) -> None:
        pty = pytest.importorskip("pty", reason="needs terminals as Unix has them")
        self.log, program = home / "calls", home / "bin" / "gsbench"
        program.parent.mkdir(parents=True)
        self.log.touch()
        program.write_text(
            f'#!/bin/sh\n[ "$1" = completion ] || printf "%s\\n" "$*" >>"{self.log}"\n'
            f'[ "$1" != completion ] || exec "{sys.executable}" -m gsbench.cli "$@"\n'
        )
        program.chmod(0o755)
        start = {"bash": ["--norc", "--noprofile", "-i"], "zsh": ["-f", "-i"], "fish": ["--private", "-i"]}[name]
        environment = {
            "HOME": str(home),
            "PATH": f"{program.parent}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT / "src"),
            "GSBENCH_RUNS": str(runs),
            "TERM": "xterm",
            "LC_ALL": "C.UTF-8",
        }
        self.pid, self.terminal = pty.fork()
        if not self.pid:
            os.chdir(home)
            os.execvpe(name, [name, *start], environment)
        self.shown = b""
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()
        self.call("gsbench ready\n")
        install = "gsbench completion fish | source" if name == "fish" else f'eval "$(gsbench completion {name})"'
        self.call(f"{install}; gsbench installed\n")

    def _read(self) -> None:
        try:
            while piece := os.read(self.terminal, 1 << 16):
                self.shown += piece
        except OSError:  # Linux: the shell has gone
            return

    def call(self, keys: str) -> str:
        """Type ``keys``; returns what gsbench is then called with."""
        before = len(self.log.read_text().splitlines())
        deadline = time.monotonic() + SECONDS
        time.sleep(0.5)  # the prompt
        os.write(self.terminal, keys.encode())
        while len(calls := self.log.read_text().splitlines()) == before:
            assert time.monotonic() < deadline, self.shown.decode(errors="replace")
            time.sleep(0.05)
        return calls[-1]

    def close(self) -> None:
        os.write(self.terminal, b"exit\n")
        self.reader.join(timeout=SECONDS)
        os.close(self.terminal)
        os.waitpid(self.pid, 0)


@pytest.fixture(params=list(SCRIPTS))
def shell(request: pytest.FixtureRequest, tmp_path: Path, runs: Path) -> Iterator[Shell]:
    if shutil.which(request.param) is None:
        pytest.skip(f"needs the shell {request.param}")
    shell = Shell(request.param, tmp_path / "home", runs)
    yield shell
    shell.close()


@pytest.mark.slow
def test_tab_completes(shell: Shell) -> None:
    (shell.log.parent / "photos").mkdir()
    assert shell.call("gsbench tab\tde\t\n") == "tables demo"
    assert shell.call("gsbench vie\tdem\tcour\tsfm-v\t1 x\n") == "view demo:courtyard:sfm-volumetric:1 x"
    assert shell.call("gsbench +experiment=thr\tseed=3\n") == "+experiment=threshold seed=3"
    assert shell.call("gsbench -m densify=adc,edge\tseed=0,1\n") == "-m densify=adc,edgeaware seed=0,1"
    assert shell.call("gsbench train.iter\t7\n") == "train.iterations=7"
    assert shell.call("gsbench scene.path=pho\t\n").rstrip("/") == "scene.path=photos"
