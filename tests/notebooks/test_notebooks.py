"""The notebooks run from top to bottom, and each .ipynb agrees with its .py, with small outputs."""

import os
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.helpers import write

pytestmark = pytest.mark.slow

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
TIMEOUT = 300  # s for a cell; on a fresh machine the first one also compiles the kernels


def test_every_notebook_is_a_pair():
    assert [path.stem for path in NOTEBOOKS] == [
        path.stem for path in sorted((ROOT / "notebooks").glob("*.ipynb"))
    ]
    assert len(NOTEBOOKS) >= 4


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_both_files_of_a_notebook_agree_and_outputs_are_small(path):
    jupytext = pytest.importorskip("jupytext", reason="needs jupytext (group dev)")
    nbformat = pytest.importorskip("nbformat", reason="needs nbformat (group dev)")
    source = jupytext.read(path)
    notebook = nbformat.read(path.with_suffix(".ipynb"), as_version=4)
    nbformat.validate(notebook)
    mend = f"make notebooks, after an edit of {path.name}"
    made, written = (
        [(cell.cell_type, cell.source, cell.metadata.get("tags", [])) for cell in one.cells]
        for one in (notebook, source)
    )
    assert made == written, mend
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs), mend
    assert not [output for output in outputs if output.output_type == "error"]
    text = path.with_suffix(".ipynb").read_text(encoding="utf-8")
    assert len(text) <= 300_000
    assert all(cell.get("execution_count") is None for cell in notebook.cells)
    assert str(ROOT) not in text  # no folders of the machine where it ran
    assert str(Path.home()) not in text


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient", reason="needs nbclient and ipykernel (group dev)")
    nbformat = pytest.importorskip("nbformat", reason="needs nbformat (group dev)")
    pytest.importorskip("ipykernel", reason="needs nbclient and ipykernel (group dev)")
    for key in os.environ:
        if key.startswith(("GSBENCH_", "MLFLOW_")):
            monkeypatch.delenv(key)
    command = tmp_path / "bin" / "gsbench"  # the console script of the sources under test
    write(command, f"#!{sys.executable}\nfrom gsbench.cli import main\nmain()\n")
    command.chmod(0o755)
    monkeypatch.setenv("PATH", str(command.parent), prepend=os.pathsep)
    monkeypatch.setenv("GSBENCH_SMALL", "1")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "jupyter"))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = nbformat.read(path.with_suffix(".ipynb"), as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    client = nbclient.NotebookClient(
        notebook, timeout=TIMEOUT, kernel_name="python3", resources=resources
    )
    client.execute()
    pictures = [
        output
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if "image/png" in output.get("data", {})
    ]
    assert pictures
    keep = os.environ.get("KEEP_NOTEBOOKS")  # a folder that keeps the outputs
    if keep:
        nbformat.write(notebook, Path(keep) / path.with_suffix(".ipynb").name)
