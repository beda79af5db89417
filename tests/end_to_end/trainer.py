"""A minimal trainer that knows nothing of gsbench.

It reads its COLMAP folder with pycolmap, makes a Gaussian of every point, and writes a 3DGS PLY.
The option ``--mode`` says how it fails.
"""

import argparse
import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from shlex import split

import numpy as np
import pycolmap
from PIL import Image

SH_DC = 0.28209479177387814  # of the constant harmonic, 1 / (2 sqrt(pi))
COLUMNS = split(
    "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
)


def write_model(path, points, colors, mode):
    """Write a 3DGS PLY of harmonics of degree 0, without gsbench's code."""
    table = np.zeros((len(points), len(COLUMNS)), "<f4")
    table[:, :3], table[:, 3:6], table[:, 6] = points, (colors - 0.5) / SH_DC, 2.0
    table[:, 7:10], table[:, 10] = np.log(0.1), 1.0
    if mode == "nan":
        table[1, 4] = np.nan
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property float {name}" for name in COLUMNS] + ["end_header", ""]
    body = table.tobytes()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes("\n".join(header).encode() + body)


def confess(folder):
    """Print every visible file below ``folder``, with a hash of the pixels of a picture."""
    for place, _, files in os.walk(folder, followlinks=True):
        for name in files:
            path = Path(place, name)
            pixels = "-"
            if name.endswith(".png"):
                pixels = hashlib.sha256(np.asarray(Image.open(path)).tobytes()).hexdigest()
            print("saw", path.relative_to(folder).as_posix(), pixels)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--version", action="version", version="painter 1.2.3")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--mode", default="good")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--iterations", type=int, required=True)
    options = parser.parse_args()
    confess(options.data.parent)
    own = sorted(name for name in os.environ if name.startswith("GSBENCH"))
    print("environment", own, os.environ.get("PAINTER"))
    model = pycolmap.Reconstruction(options.data / "sparse/0")
    print("observations", sum(len(point.track.elements) for point in model.points3D.values()))
    if options.mode == "exit":
        sys.exit("Error: the painter has no paint")
    if options.mode == "hang":  # with a child, and deaf to SIGTERM
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        print("pids", os.getpid(), child.pid, flush=True)
        time.sleep(600)
    if options.mode == "nothing":
        (options.output / "notes.txt").write_text("I was here")
        return
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        size = Image.open(options.data / f"images/{image.name}").size
        assert (camera.model_name, size) == ("PINHOLE", (camera.width, camera.height))
    points = np.array([point.xyz for _, point in sorted(model.points3D.items())])
    colors = np.array([point.color for _, point in sorted(model.points3D.items())]) / 255
    points = points + np.random.default_rng(options.seed).normal(0, 1e-3, points.shape)
    place = options.output / f"point_cloud/iteration_{options.iterations}/point_cloud.ply"
    write_model(place, points, colors, options.mode)


if __name__ == "__main__":
    main()
