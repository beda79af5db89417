"""Make the captures of the findings ready: cameras for each, and a thin cloud that leaves room to
grow.

    python findings/scripts/captures.py DATA OUT

``DATA`` holds a folder for each capture with ``images`` and perhaps ``sparse/0``. A capture without
a model gets that of ``init=sfm``, since sectors of cameras need cameras before initialisation. Of
each
model `MOST_POINTS` points are kept, drawn once, so that densifiers decide where the others go. What
is in ``OUT`` already is left as it is.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

# Each capture with what ``init=sfm`` needs to be told of it, where its defaults place too few
# views.
COARSE = "init.first_octave=0"
CAPTURES: dict[str, tuple[str, ...]] = {
    "bonsai": (),
    "kitchen": (),
    "flower": (),
    "fox": (),
    "monstree": (),
    "caliterra": (),
    "herz_jesus_p25": (),
    "plant": (COARSE,),
    "meadow_park": (),
    "garfield": (),
    "lewis": (COARSE,),
    "park_gate": (),
    "treehill": (),
    "rock": (COARSE,),
    "studio_room": (COARSE,),
    "horns": (COARSE,),
}
MODEL = Path("sparse", "0")
MOST_POINTS = 6000  # about what the smaller captures have


def prepare(data: Path, out: Path, names: Iterable[str] = CAPTURES) -> None:
    """Write ``OUT/CAPTURE/{images,sparse/0}`` for each of ``names``; images are a link."""
    for name in names:
        source, target = (data / name).resolve(), out / name
        if not source.is_dir() or (target / MODEL).is_dir():
            print(f"{name}: {'nothing in ' + str(data) if not source.is_dir() else 'is there'}")
            continue
        model = source / MODEL
        if not model.is_dir():
            model = _estimated(name, source, out)
        shutil.rmtree(target, ignore_errors=True)  # what a killed run left
        target.mkdir(parents=True)
        (target / "images").symlink_to(source / "images", target_is_directory=True)
        count = thin(model, target / MODEL)
        print(f"{name}: {count} points")


def thin(model: Path, out: Path, most: int = MOST_POINTS) -> int:
    """Write the COLMAP model in ``model`` with at most ``most`` of its points to ``out``; returns
    how many it has."""
    import pycolmap

    reconstruction = pycolmap.Reconstruction(model)
    points = sorted(reconstruction.points3D)
    kept = set(np.random.default_rng(0).permutation(points)[:most].tolist())
    for point in points:
        if point not in kept:
            reconstruction.delete_point3D(point)
    out.parent.mkdir(parents=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        whole = Path(folder) / "model"
        whole.mkdir()
        reconstruction.write(whole)
        whole.rename(out)
    return len(reconstruction.points3D)


def _estimated(name: str, source: Path, out: Path) -> Path:
    """Return the folder of the model that ``init=sfm`` makes of the photographs in ``source``."""
    model = out / "estimated" / name
    if not (model / MODEL).is_dir():
        words = [
            f"scene.path={source}",
            f"scene.name={name}",
            "scene=photos",
            "init=sfm",
            "train=none",
            "densify=none",
        ]
        words += CAPTURES[name]
        program = [str(Path(sys.executable).with_name("gsbench"))]
        settings = [f"runs={out / 'runs'}", "name=captures", "eval.lpips=[]", "tracking=none"]
        subprocess.run([*program, *words, *settings], check=True)
        entry = next((out / "runs" / "captures" / name).glob("*/*-seed0"))
        subprocess.run([*program, "export", "init", str(entry), "--out", str(model)], check=True)
    return model / MODEL


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    prepare(Path(sys.argv[1]), Path(sys.argv[2]))
