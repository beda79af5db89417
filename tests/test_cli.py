"""The command line and its small verbs, without a training."""

import errno
import importlib
import os
import sys
from shlex import split

import pytest

from gsbench import __version__, cli
from gsbench.errors import GsbenchError, InputError
from gsbench.system.stopping import Stopped
from gsbench.verbs import VERBS, load_verb
from tests.helpers import table
from tests.processes import completed

pytestmark = pytest.mark.usefixtures("runs")

# ---- the frame


@pytest.mark.parametrize("verb", list(VERBS))
def test_every_verb_has_help_without_torch(verb, tmp_path):
    with pytest.raises(SystemExit) as done:
        load_verb(verb)(["--help"], tmp_path)
    assert done.value.code == 0


def test_help_and_reading_verbs_load_no_torch(runs):
    (runs / "x").mkdir(parents=True)
    code = (
        "import sys, gsbench.cli as c\n"
        "c.run(['--help']); c.run(['status']); c.run(['status', 'x']); c.run(['retry', 'x'])\n"
        "c.run(['-m', 'seed=0,1', '--dry-run'])\n"
        "slow = 'torch', 'mlflow', 'numba', 'pycolmap', 'scipy.special'\n"
        "sys.exit(any(name in sys.modules for name in slow))"
    )
    done = completed([sys.executable, "-c", code])
    assert "volumetric" in done.stdout
    assert "2 trials: 2 missing" in done.stdout


@pytest.mark.parametrize(
    "error, code, text",
    [
        (InputError("bad photo"), 2, "gsbench: bad photo\n"),
        (GsbenchError("went wrong"), 1, "gsbench: went wrong\n"),
        (
            Stopped(15),
            143,
            "gsbench: stopped by SIGTERM; to continue, give the same command again\n",
        ),
        (KeyboardInterrupt(), 130, "gsbench: stopped; to continue, give the same command again\n"),
    ],
)
def test_errors_become_a_line_and_an_exit_code(error, code, text, monkeypatch, capsys):
    def fail(argv):
        raise error

    monkeypatch.setattr("gsbench.app.command.launch", fail)
    assert cli.run(["seed=1"]) == code
    assert capsys.readouterr().err == text


@pytest.mark.parametrize(
    "words, asked",
    table(__file__, "first"),
)
def test_the_first_word_tells_what_is_asked(words, asked, monkeypatch):
    found = []
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    monkeypatch.setattr(
        "gsbench.verbs.load_verb",
        lambda name: lambda argv, runs: found.append(("verb", argv, runs.name)) or 7,
    )
    monkeypatch.setattr(cli, "_help", lambda argv: found.append(("help", argv)) or 7)
    monkeypatch.setattr(cli, "_trials", lambda argv: found.append(("trials", argv)) or 7)
    assert cli.run(words.split()) == 7
    assert [list(one) for one in found] == [asked]
    assert os.environ["PYTHONSAFEPATH"] == "gsbench"


def test_the_rest_of_an_output_is_dropped_once_nobody_reads_it(monkeypatch, tmp_path):
    def write(argv):
        raise BrokenPipeError

    monkeypatch.setattr(cli, "_trials", write)
    with (tmp_path / "out").open("w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        assert cli.run(["seed=1"]) == 0
        print("the rest", file=stream, flush=True)
    assert (tmp_path / "out").read_text() == ""


def test_an_error_stays_a_line_whatever_it_quotes(monkeypatch, capfd):
    def fail(argv):
        raise InputError("no\n  file \udcff")

    monkeypatch.setattr(cli, "_trials", fail)
    assert cli.run(["seed=1"]) == 2
    assert capfd.readouterr().err == "gsbench: no file \\udcff\n"

    def write(argv, runs):
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr("gsbench.verbs.load_verb", lambda name: write)
    assert cli.run(["status"]) == 1
    assert " is full: free some space" in capfd.readouterr().err


COMMANDS = (
    "status",
    "tables x",
    "seed=1",
    "-m seed=0,1 --dry-run",
    "--cfg job",
    "doctor",
    "nosuch",
)


@pytest.mark.parametrize("command", COMMANDS)
def test_without_its_current_folder_a_command_says_so_in_one_line(
    command, tmp_path, monkeypatch, refused
):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    monkeypatch.setenv("PYTHONPATH", "here")
    assert "the current folder cannot be used" in refused(command)
    for words in (["--version"], ["--help"]):
        assert cli.run(words) == 0


def test_help_lists_verbs_and_choices_also_of_the_users_folders(tmp_path, said):
    (tmp_path / "own/densify").mkdir(parents=True)
    (tmp_path / "own/densify/calm.yaml").touch()
    shown = said("--config-dir own --help")
    assert shown.startswith(cli.USAGE)
    assert [name for name in VERBS if f"\n  {name} " not in shown] == []
    assert "calm" in shown


def test_unknown_verb_names_the_nearest(refused):
    assert "did you mean status?" in refused("statsu")


def test_hydra_shows_the_configuration(capfd):
    assert cli.run(split("--cfg job train.iterations=77")) == 0
    assert "iterations: 77" in capfd.readouterr().out


def test_ctrl_c_while_a_native_module_is_imported_is_reported_as_a_stop(monkeypatch, capsys):
    def stopped(argv):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:  # as pybind11 and numpy do
            failed = ImportError("initialization failed")
            if argv == ["seed=1"]:
                raise failed from error
            raise failed  # noqa: B904 - the interrupt is its context only

    monkeypatch.setattr(cli, "_trials", stopped)
    for word in ("seed=1", "seed=2"):
        assert cli.run([word]) == 130
        said = capsys.readouterr().err
        assert said == "gsbench: stopped; to continue, give the same command again\n"
    monkeypatch.setattr(cli, "_trials", lambda argv: importlib.import_module("nosuch_module"))
    with pytest.raises(ModuleNotFoundError):
        cli.run(["seed=1"])


def test_ctrl_c_while_the_first_modules_load_is_one_line(tmp_path):
    module = "gsbench.words"
    program = (
        "import sys\n"
        "class Interrupt:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}: raise KeyboardInterrupt\n"
        f"sys.modules.pop({module!r}, None)\n"
        "sys.meta_path.insert(0, Interrupt())\n"
        "from gsbench.cli import main\nmain()\n"
    )
    done = completed([sys.executable, "-c", program], code=130, cwd=tmp_path)
    assert done.stderr == "gsbench: stopped before it began\n"


def test_the_version_is_printed(said):
    assert said("--version") == f"gsbench {__version__}\n"
