"""What one training step costs with each rasterizer: times, their split, and peak memory.

A step is what training does: render, photometric loss, backward, Adam on all parameters, spherical harmonics of
degree 3. The synthetic scene is meant to resemble a trained model (many small flat Gaussians, few large ones,
opacities of all kinds) without being fitted to one, and is the same for one count on every machine. torch is imported
inside functions, as everywhere near the command line.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.arguments import ArgumentParser
from gsbench.errors import InputError
from gsbench.memory import peak_memory_mb

if TYPE_CHECKING:
    import torch

    from gsbench.gaussians.model import Gaussians
    from gsbench.scene.camera import Camera

PEER = "gsplat-torch"
PEER_NOTE = "projection and colour only, no compositing: gsplat's torch reference needs CUDA for the rest"
SH_DEGREE = 3
WARM_UP_STEPS = 2  # compile, and let memory pools grow
SEED = 0
FOCAL = 0.9  # of the image width
FIRST_DEPTH, DEPTH_RATIO = 2.0, 12.0
# Standard deviation of the median Gaussian of 100,000, in units of depth: 1.6 px in an image 500 px wide.
MEDIAN_SIGMA = 1.6 / (FOCAL * 500)
SIGMA_EXPONENT = 0.4  # more Gaussians are smaller ones: sigma falls as count^-0.4
SIGMA_SPREAD = 0.7  # of log sigma


def run_bench(
    rasters: list[str],
    sizes: list[tuple[int, int]],
    counts: list[int],
    ply: Path | None = None,
    repeats: int = 5,
    threads: int | None = None,
    memory: bool = True,
) -> list[dict[str, Any]]:
    """Time one training step of each of ``rasters`` for each image size (width, height) and count of Gaussians.

    The rasters take turns, step by step; all times are medians over ``repeats``, in ms. ``forward_ms`` is the render,
    ``backward_ms`` the backward pass of loss and render, ``step_ms`` everything; ``loss_ms`` and ``adam_ms`` are the
    rest, and ``cpu_ms`` is the processor time of the step on all threads. ``peak_memory_mb`` is that of a fresh process
    that makes the same steps (on a GPU: of torch's allocations there), None if ``memory`` is false. With ``ply`` that
    model is timed instead of ``counts``. Raises InputError for a raster that cannot run here.
    """
    results = []
    for width, height in sizes:
        for count in counts if ply is None else [0]:
            steppers = {raster: _Stepper(raster, width, height, count, ply, threads) for raster in rasters}
            samples: dict[str, list[dict[str, float]]] = {raster: [] for raster in rasters}
            for repeat in range(WARM_UP_STEPS + repeats):
                for raster, stepper in steppers.items():
                    sample = stepper.step()
                    if repeat >= WARM_UP_STEPS:
                        samples[raster].append(sample)
            for raster, stepper in steppers.items():
                row: dict[str, Any] = {"raster": raster, "size": f"{width}x{height}", "count": stepper.count}
                row |= {
                    key: round(statistics.median(sample[key] for sample in samples[raster]), 3)
                    for key in samples[raster][0]
                }
                row["peak_memory_mb"] = _measure_memory(raster, width, height, count, ply, threads) if memory else None
                row["threads"] = stepper.threads
                row["device"] = stepper.device.type
                if raster == PEER:
                    row["note"] = PEER_NOTE
                results.append(row)
    return results


class _Stepper:
    """One rasterizer with its own copy of the scene and an optimiser."""

    def __init__(self, raster: str, width: int, height: int, count: int, ply: Path | None, threads: int | None) -> None:
        import torch

        from gsbench.gaussians.ply import read_ply
        from gsbench.pipeline.loss import PhotometricLoss
        from gsbench.raster.executors import find

        self.threads = threads or torch.get_num_threads()
        torch.set_num_threads(self.threads)
        self.device = torch.device("cpu" if raster == PEER or find(raster).runs_on("cpu") else "cuda")
        scene = trained_like_gaussians(count) if ply is None else read_ply(ply)
        self.count = len(scene)
        self.gaussians = scene.map(lambda tensor: tensor.detach().to(self.device).requires_grad_())
        self.camera = frontal_camera(width, height) if ply is None else camera_before(scene, width, height)
        self.background = torch.zeros(3, device=self.device)
        self.render = _renderer(raster, self.device, self.threads)
        generator = torch.Generator().manual_seed(SEED)
        target = (torch.rand(height, width, 3, generator=generator) * 255).to(torch.uint8)
        self.target = target.to(self.device)
        # A rate of zero: the work of Adam on a scene that stays as it is.
        self.optimizer = torch.optim.Adam(list(self.gaussians.tensors().values()), lr=0.0, eps=1e-15, fused=True)
        self.loss = PhotometricLoss(threads=self.threads)

    def step(self) -> dict[str, float]:
        """One training step; ms of its parts."""
        self.optimizer.zero_grad(set_to_none=True)
        cpu = time.process_time()
        marks = [self._now()]
        image = self.render(self.gaussians, self.camera, self.background)
        marks.append(self._now())
        # The peer gives no image; its colours stand in, so that something flows back.
        loss = self.loss(image, self.target)[0] if image.dim() == 3 else image.square().sum()
        marks.append(self._now())
        loss.backward()
        marks.append(self._now())
        self.optimizer.step()
        marks.append(self._now())
        forward, loss_time, backward, adam = (1e3 * (b - a) for a, b in itertools.pairwise(marks))
        return {
            "forward_ms": forward,
            "backward_ms": backward,
            "step_ms": 1e3 * (marks[-1] - marks[0]),
            "loss_ms": loss_time,
            "adam_ms": adam,
            "cpu_ms": 1e3 * (time.process_time() - cpu),
        }

    def _now(self) -> float:
        if self.device.type == "cuda":
            import torch

            torch.cuda.synchronize()
        return time.perf_counter()


Render = Callable[["Gaussians", "Camera", "torch.Tensor"], "torch.Tensor"]


def _renderer(raster: str, device: torch.device, threads: int) -> Render:
    if raster == PEER:
        return _peer_renderer()
    from gsbench.raster import create_rasterizer

    rasterizer = create_rasterizer(raster, device, threads)
    return lambda gaussians, camera, background: rasterizer.render(gaussians, camera, SH_DEGREE, background).image


def _peer_renderer() -> Render:
    """What gsplat's pure-torch reference can do without CUDA: projection and colours, as one tensor [N, 9]."""
    try:
        from gsplat.cuda import _torch_impl as peer
    except ImportError as error:
        raise InputError(f"raster={PEER} needs gsplat: pip install gsplat==1.5.3 ({error})") from error
    import torch

    def render(gaussians: Gaussians, camera: Camera, background: torch.Tensor) -> torch.Tensor:
        pose = torch.eye(4)
        pose[:3, :3], pose[:3, 3] = torch.tensor(camera.rotation), torch.tensor(camera.translation)
        intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        covariances, _ = peer._quat_scale_to_covar_preci(gaussians.quaternions, gaussians.scales, True, False)
        _, means, _, conics, _ = peer._fully_fused_projection(
            gaussians.means, covariances, pose[None], intrinsics[None], camera.width, camera.height
        )
        coefficients = torch.cat([gaussians.sh_dc[:, None], gaussians.sh_rest], 1)  # [N, 16, 3]
        directions = gaussians.means - torch.tensor(camera.center, dtype=torch.float32)
        colors = (peer._spherical_harmonics(SH_DEGREE, directions, coefficients) + 0.5).clamp_min(0)
        return torch.cat([means[0], conics[0], colors, gaussians.opacities[:, None]], -1)

    return render


def trained_like_gaussians(count: int, seed: int = SEED) -> Gaussians:
    """``count`` float32 Gaussians that fill the view of ``frontal_camera`` and a margin, a few of them outside."""
    import torch

    from gsbench.gaussians.model import NUM_SH_REST, Gaussians

    if count < 1:
        raise InputError(f"count must be at least 1, got {count}")
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    depth = FIRST_DEPTH * torch.exp(torch.rand(count, generator=generator) * math.log(DEPTH_RATIO))  # [N]
    slopes = (torch.rand(count, 2, generator=generator) - 0.5) * torch.tensor([1.4, 1.05])  # [N, 2] x/z, y/z
    sigma = MEDIAN_SIGMA * (100_000 / count) ** SIGMA_EXPONENT * torch.exp(SIGMA_SPREAD * normal(count)) * depth
    shape = 0.5 * normal(count, 3) - torch.tensor([0.0, 0.0, 1.5])  # [N, 3] flat
    return Gaussians(
        means=torch.cat([slopes * depth[:, None], depth[:, None]], 1),
        log_scales=sigma.log()[:, None] + shape,
        quaternions=normal(count, 4),
        opacity_logits=2.2 * normal(count) - 0.5,
        sh_dc=0.6 * normal(count, 3),
        sh_rest=0.1 * normal(count, NUM_SH_REST, 3),
    )


def frontal_camera(width: int, height: int) -> Camera:
    """A camera at the origin that looks along z."""
    import numpy as np

    from gsbench.scene.camera import Camera

    focal = FOCAL * width
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(3), np.zeros(3))


def camera_before(scene: Gaussians, width: int, height: int) -> Camera:
    """A camera that looks along z at the middle of ``scene`` from twice the median distance of its Gaussians."""
    import numpy as np

    from gsbench.scene.camera import Camera

    middle = scene.means.median(0).values  # [3]
    distance = (scene.means - middle).norm(dim=-1).median().item()
    translation = -middle.double().numpy() + np.array([0.0, 0.0, 2 * distance])
    focal = FOCAL * width
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(3), translation)


def _measure_memory(raster: str, width: int, height: int, count: int, ply: Path | None, threads: int | None) -> float:
    """Peak memory in MB of a fresh process that makes the warm-up steps and one more."""
    command = [
        sys.executable,
        "-m",
        "gsbench.bench",
        "--peak-memory",
        "--raster",
        raster,
        "--size",
        f"{width}x{height}",
    ]
    command += ["--ply", str(ply)] if ply is not None else ["--count", str(count)]
    command += ["--threads", str(threads)] if threads else []
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    if run.returncode != 0:
        raise InputError(f"raster={raster}: the memory measurement failed: {run.stderr.strip().splitlines()[-1:]}")
    return float(run.stdout)


def _peak_memory(stepper: _Stepper) -> float:
    for _ in range(WARM_UP_STEPS + 1):
        stepper.step()
    return peak_memory_mb(stepper.device)


def _table(rows: list[dict[str, Any]]) -> str:
    columns = ["raster", "size", "count", "forward_ms", "loss_ms", "backward_ms", "adam_ms", "step_ms", "cpu_ms"]
    columns.append("peak_memory_mb")
    cells = [columns] + [[_cell(row.get(column)) for column in columns] for row in rows]
    widths = [max(len(line[k]) for line in cells) for k in range(len(columns))]
    lines = ["  ".join(text.rjust(width) for text, width in zip(line, widths, strict=True)) for line in cells]
    notes = {f"{row['raster']}: {row['note']}" for row in rows if "note" in row}
    return "\n".join([*lines, *sorted(notes)])


def _cell(value: Any) -> str:
    return f"{value:.1f}" if isinstance(value, float) else "-" if value is None else str(value)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"a size is WIDTHxHEIGHT, for example 500x375, got {text!r}")
    return int(width), int(height)


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a number of at least 1, got {text!r}")
    return int(text)


def main(argv: list[str], _runs: Path | None = None) -> int:
    """``gsbench bench``: print the table, or with ``--json`` the list of results."""
    from gsbench.raster.executors import EXECUTORS

    known = [executor.name for executor in EXECUTORS]
    parser = ArgumentParser(prog="gsbench bench", description="Time rasterizers and the training step.")
    parser.add_argument("--raster", default="cpu", help=f"names, comma between: {', '.join(known)}, {PEER}")
    parser.add_argument("--size", default="500x375", help="image sizes, comma between")
    parser.add_argument("--count", default="100000", help="numbers of Gaussians, comma between")
    parser.add_argument("--ply", type=Path, help="time this model instead of the synthetic scene")
    parser.add_argument("--repeats", type=_count, default=5, help="steps that count (default 5)")
    parser.add_argument("--threads", type=_count, help="CPU threads (default: as many as torch takes)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--no-memory", action="store_true", help="leave out peak memory, which takes a process each")
    parser.add_argument("--peak-memory", action="store_true", help=argparse.SUPPRESS)  # the process of _measure_memory
    options = parser.parse_args(argv)
    try:
        sizes = [_size(text) for text in options.size.split(",")]
        counts = [_count(text) for text in options.count.split(",")]
    except argparse.ArgumentTypeError as error:
        raise InputError(str(error)) from error
    if options.ply is not None and not options.ply.is_file():
        raise InputError(f"--ply: {options.ply} does not exist")
    rasters = options.raster.split(",")

    if options.peak_memory:
        print(_peak_memory(_Stepper(rasters[0], *sizes[0], counts[0], options.ply, options.threads)))
        return 0
    rows = run_bench(rasters, sizes, counts, options.ply, options.repeats, options.threads, not options.no_memory)
    print(json.dumps(rows, indent=2) if options.json else _table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
