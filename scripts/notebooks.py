"""Run the notebooks and keep their outputs in the .ipynb files: ``make notebooks``.

A notebook's source is its .py file. A forge shows the .ipynb, so that file holds the outputs of the
cells, with small pictures and without what differs between machines: paths, execution times and
execution counts.
"""

from __future__ import annotations

import base64
import io
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import jupytext
import nbclient
import nbformat
from PIL import Image

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
MAX_BYTES = 300_000  # of a notebook
WIDTH = 640  # px, of a picture
# the temporary folder that each notebook makes
SCRATCH = re.compile(r"(/[\w.-]+)*/gsbench-\w+(?=/|\b)")


def main(names: list[str]) -> int:
    """Run the notebooks whose names begin with one of ``names``, or all.

    Returns the number of notebooks that are too large.
    """
    too_large = 0
    for source in sorted(NOTEBOOKS.glob("*.py")):
        if names and not source.name.startswith(tuple(names)):
            continue
        notebook = executed(jupytext.read(source))
        text = nbformat.writes(notebook)
        source.with_suffix(".ipynb").write_text(text + "\n", encoding="utf-8")
        print(f"{source.stem}: {len(text) // 1000} kB")
        too_large += len(text) > MAX_BYTES
    return too_large


def executed(notebook: Any) -> Any:
    """The notebook with the outputs of a run in an empty folder."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        resources = {"metadata": {"path": folder}}
        nbclient.NotebookClient(
            notebook, timeout=1800, kernel_name="python3", resources=resources
        ).execute()
    notebook.metadata.pop("language_info", None)
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.execution_count = None
            cell.outputs = [tidied(output) for output in joined(cell.outputs)]
    nbformat.validate(notebook)
    return notebook


def joined(outputs: list[Any]) -> list[Any]:
    """The outputs, with the pieces of each stream joined."""
    kept: list[Any] = []
    for output in outputs:
        streams = [
            old
            for old in kept
            if output.output_type == "stream" == old.output_type and old.name == output.name
        ]
        if streams:
            streams[0].text += output.text
        else:
            kept.append(output)
    return kept


def tidied(output: Any) -> Any:
    """An output without execution counts and paths of this machine, and with small pictures."""
    if "execution_count" in output:
        output.execution_count = None
    if output.output_type == "stream":
        output.text = SCRATCH.sub("/tmp/gsbench", output.text)
        return output
    for kind, content in list(output.get("data", {}).items()):
        if kind == "image/png":
            output.data[kind] = small(content)
        elif isinstance(content, str):
            output.data[kind] = SCRATCH.sub("/tmp/gsbench", content)
    return output


def small(png: str) -> str:
    """A picture of at most `WIDTH` px and 128 colours, as base64."""
    picture = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    if picture.width > WIDTH:
        picture = picture.resize(
            (WIDTH, round(picture.height * WIDTH / picture.width)), Image.Resampling.LANCZOS
        )
    target = io.BytesIO()
    picture.quantize(128).save(target, "PNG", optimize=True)
    return base64.b64encode(target.getvalue()).decode()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
