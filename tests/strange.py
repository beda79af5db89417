"""A working folder with a stranger's files: modules that leave a mark when they are imported."""

import sys
from pathlib import Path
from shlex import split

import pytest
import yaml

from gsbench import cli
from gsbench.errors import InputError
from gsbench.system.programs import allowed_modules
from tests.helpers import write

BOMB = "from pathlib import Path\nPath('exploded').touch()\nclass Bomb:\n    pass\n"
MINE = """
import os
from subprocess import Popen

from gsbench.densify import ADC
from hydra.experimental.callback import Callback

class Mine(ADC):
    pass

class Calls(Callback):
    def __init__(self, **rest):
        self.rest = rest
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The working folder of a command, with modules that were never allowed, and ``mine``."""
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    (tmp_path / "bomb.py").write_text(BOMB)
    write(tmp_path / "bombs/__init__.py", BOMB)
    (tmp_path / "bombs/one.yaml").write_text("name: one\n")
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "hydra_plugins").mkdir()  # Hydra imports whatever it finds below this name
    (tmp_path / "hydra_plugins/bomb.py").write_text(BOMB)
    yield tmp_path
    for module in split("bomb bombs mine helper"):
        sys.modules.pop(module, None)
    allowed_modules().clear()


def no_trial(trials):
    """Stand in for a function that runs trials."""
    raise InputError("the trials began")


def ask(words, capsys, monkeypatch):
    """The one line with which a command is refused."""
    monkeypatch.setattr("gsbench.app.command.run_batch", no_trial)
    monkeypatch.setattr("gsbench.app.command.list_trials", no_trial)
    assert cli.run(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def nested(settings, values=None):
    """The ``values`` with settings by their dotted keys."""
    values = {} if values is None else values
    for key, value in settings.items():
        *groups, last = key.lstrip("+").split(".")
        node = values
        for group in groups:
            node = node.setdefault(group, {})
        node[last] = value
    return values


def experiment(settings, group="experiment"):
    """The words that run an experiment from a stranger's file, which has settings with dots."""
    text = "# @package _global_\n" + yaml.safe_dump(nested(settings))
    write(Path(f"conf/{group}/strange.yaml"), text)
    return split("--config-dir conf +experiment=strange")
