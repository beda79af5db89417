"""Whole trials in a folder with a module of every name that is imported: none may be loaded."""

import importlib.metadata
import os
import sys

import pytest

from tests.end_to_end.test_hydra import TINY
from tests.processes import completed

pytestmark = pytest.mark.slow
SECONDS = 900
BOMB = "with open({mark!r}, 'a') as stream:\n    stream.write(__name__ + '\\n')\n"


@pytest.fixture
def capture(tmp_path):
    """A folder with modules that leave a mark, named like the standard and the installed ones."""
    folder, mark = tmp_path / "capture", tmp_path / "exploded"
    folder.mkdir()
    names = {
        *sys.stdlib_module_names,
        *importlib.metadata.packages_distributions(),
        "plyfile",
        "sitecustomize",
    }
    for name in names:
        if name.isidentifier():
            (folder / f"{name}.py").write_text(BOMB.format(mark=str(mark)))
    (folder / "hydra_plugins.py").unlink(missing_ok=True)
    (folder / "hydra_plugins").mkdir()  # a namespace, which Hydra imports as a whole
    (folder / "hydra_plugins/extra.py").write_text(BOMB.format(mark=str(mark)))
    # the console script, as pip writes it
    (tmp_path / "gsbench").write_text("from gsbench.cli import main\nmain()\n")
    return folder


def gsbench(folder, *words, code=0, start=("../gsbench",)):
    kept = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("GSBENCH_", "MLFLOW_", "PYTHON"))
    }
    environment = kept | {
        "GSBENCH_RUNS": str(folder.parent / "runs"),
        "TORCH_HOME": str(folder.parent / "hub"),
    }
    command = [sys.executable, *start, *words]
    return completed(command, code, cwd=folder, env=environment, timeout=SECONDS)


def test_no_module_of_the_current_folder_is_imported(capture):
    own = "from gsbench.densify import NoDensifier\nclass Own(NoDensifier):\n    pass\n"
    (capture / "own.py").write_text(own)
    # an installed yaml comes before the one in this folder
    allowed = ["densify._target_=own.Own", "allow_targets=[own,yaml]"]
    tracked = [word for word in TINY if word != "tracking=none"]
    for words in (
        ["--help"],
        ["--cfg", "job"],
        ["-m", *tracked, *allowed, "name=one", "seed=0,1", "launch=local", "launch.parallel=2"],
        ["tables", "one"],
        ["status", "one"],
    ):
        gsbench(capture, *words)
        assert not (capture.parent / "exploded").exists(), (
            words,
            (capture.parent / "exploded").read_text(),
        )
    assert len(list((capture.parent / "runs/one").rglob("results.json"))) == 2


def test_an_isolated_process_imports_no_module_of_the_current_folder(capture):
    imports = "import posixpath; from gsbench.system.isolate import run_isolated"
    code = f"{imports}; print(run_isolated(posixpath.basename, 'a/b'))"
    done = gsbench(capture, start=("-P", "-c", code))
    assert (done.stdout, done.stderr) == ("b\n", "")
    assert not (capture.parent / "exploded").exists(), (capture.parent / "exploded").read_text()


def test_python_m_gsbench_imports_no_module_of_the_current_folder(capture):
    code = "import runpy, sys; print(*sys.modules)"
    before = completed([sys.executable, "-P", "-c", code]).stdout
    for name in {name.split(".")[0] for name in before.split()} | {"gsbench"}:
        (capture / f"{name}.py").unlink(missing_ok=True)
    for words in (["--help"], ["--cfg", "job"], ["seed=1", "--dry-run"]):
        gsbench(capture, *words, start=("-m", "gsbench"))
    assert not (capture.parent / "exploded").exists(), (capture.parent / "exploded").read_text()


def test_a_version_command_imports_no_module_of_the_current_folder(capture):
    """``python -c`` imports from its folder, so the command runs in an empty one."""
    (capture.parent / "train.py").write_text(
        "import beside, sys; sys.exit('Error: trained ' + beside.WHAT)"
    )
    # many trainers import modules that lie beside them
    (capture.parent / "beside.py").write_text("WHAT = 'with what lies beside it'")
    words = [
        "densify=external/program",
        f"densify.command=['{sys.executable}','{capture.parent / 'train.py'}','{{data}}']",
        f"densify.version_command=['{sys.executable}','-c','import plyfile_absent as p']",
        "densify.version=plyfile_absent",
        "densify.result=x.ply",
        f"allow_targets=['{sys.executable}']",
    ]
    (capture / "plyfile_absent.py").write_text(BOMB.format(mark=str(capture.parent / "exploded")))
    small = [word for word in TINY if not word.startswith("densify")]
    done = gsbench(capture, *small, *words, "name=three", code=1)
    assert "Error: trained with what lies beside it" in done.stderr
    assert not (capture.parent / "exploded").exists()
