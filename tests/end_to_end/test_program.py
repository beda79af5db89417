"""The program from outside: bad input, quick help, and the installed wheel."""

import subprocess
import sys
import venv
from pathlib import Path
from shlex import split

import numpy as np
import pytest
from PIL import Image

from tests.conftest import ROOT
from tests.end_to_end.conftest import SMALL
from tests.processes import completed

pytestmark = pytest.mark.slow


def test_truncated_photo_is_named(gsbench, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for i in range(4):
        noise = np.random.default_rng(i).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(noise).save(folder / f"{i}.jpg")
    data = (folder / "2.jpg").read_bytes()
    (folder / "2.jpg").write_bytes(data[: len(data) // 2])
    done = gsbench(
        "scene=photos", f"scene.path={folder}", code=2, GSBENCH_RUNS=str(tmp_path / "runs")
    )
    assert "2.jpg" in done.stderr.strip().splitlines()[-1]


def test_wheel_runs_a_trial_outside_the_checkout(environment, tmp_path):
    pytest.importorskip(
        "hatchling", reason="building the wheel offline needs hatchling (group dev)"
    )
    build = [
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        str(tmp_path / "dist"),
        str(ROOT),
    ]
    subprocess.run(build, check=True, capture_output=True, timeout=300)
    (wheel,) = (tmp_path / "dist").glob("gsbench_3dgs-*.whl")
    home = tmp_path / "clean"
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    packages = next((home / "lib").glob("python*/site-packages"))
    # The dependencies come from this environment, after the wheel's own files; gsbench itself from
    # the wheel alone.
    dependencies = Path(pytest.__file__).resolve().parents[1]
    (packages / "zz_dependencies.pth").write_text(f"{dependencies}\n")
    subprocess.run(
        [sys.executable, *split(f"-m pip install --quiet --no-deps --target {packages} {wheel}")],
        check=True,
    )
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
    arguments = [*SMALL, "train.iterations=10", "tracking=none"]
    runs = tmp_path / "runs"
    completed(
        [python, "-m", "gsbench.cli", *arguments],
        cwd=tmp_path,
        env=clean | {"GSBENCH_RUNS": str(runs)},
    )
    assert len(list(runs.rglob("results.json"))) == 1
