"""The program from outside: texts in ASCII, and the installed wheel."""

import sys
import venv
from pathlib import Path
from shlex import split

import pytest

from gsbench.verbs import VERBS
from tests.conftest import ROOT
from tests.end_to_end.conftest import SMALL
from tests.helpers import table
from tests.processes import completed

pytestmark = pytest.mark.slow


# The words of each verb that reads results or shows characters beyond ASCII, after its name.
IN_ASCII = table(__file__, "words")


def test_every_verb_speaks_where_python_knows_only_ascii(gsbench, runs, tmp_path):
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    assert IN_ASCII.keys() == VERBS.keys()
    for verb, words in IN_ASCII.items():
        done = gsbench(verb, *words.split(), code=None, **ascii_only)
        assert done.returncode in (0, 1, 2), (verb, done.stderr)
        assert "Traceback" not in done.stderr, verb
        assert done.stdout.isascii(), verb


def run_python(words):
    completed([sys.executable, *split(words)])


def test_wheel_runs_a_trial_outside_the_checkout(environment, tmp_path):
    pytest.importorskip(
        "hatchling", reason="building the wheel offline needs hatchling (group dev)"
    )
    run_python(f"-m build --wheel --no-isolation --outdir {tmp_path}/dist {ROOT}")
    (wheel,) = (tmp_path / "dist").glob("gsbench_3dgs-*.whl")
    home = tmp_path / "clean"
    venv.create(home, with_pip=False)
    python = home / "bin/python"
    packages = next((home / "lib").glob("python*/site-packages"))
    # The dependencies come from this environment, after the wheel's own files; gsbench itself from
    # the wheel alone.
    dependencies = Path(pytest.__file__).resolve().parents[1]
    (packages / "zz_dependencies.pth").write_text(f"{dependencies}\n")
    run_python(f"-m pip install --quiet --no-deps --target {packages} {wheel}")
    # not the checkout's modules
    clean = {key: value for key, value in environment.items() if key != "PYTHONPATH"}
    where = (
        "import gsbench, gsbench.system.install as c; print(gsbench.__file__); print(c.conf_dir())"
    )
    found = completed([python, "-c", where], cwd=tmp_path, env=clean)
    assert all(line.startswith(str(packages)) for line in found.stdout.split())
    hint = "from gsbench.system.install import install_command; print(install_command('view'))"
    found = completed([python, "-c", hint], cwd=tmp_path, env=clean)
    assert found.stdout == "pip install 'gsbench-3dgs[view]'\n"
    arguments = [*SMALL, "train.iterations=10", "tracking=none", f"runs={tmp_path}/runs"]
    completed([python, "-m", "gsbench.cli", *arguments], cwd=tmp_path, env=clean)
    assert len(list(tmp_path.glob("runs/**/results.json"))) == 1
