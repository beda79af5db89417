"""Times training steps of Faster-GS (Hahlbohm et al., CVPR 2026) and of a rasterizer of gsbench.

    python -m benchmarks.faster_gs compile           needs nvcc
    python -m benchmarks.faster_gs RASTER COUNT…     rows like those of `gsbench bench --json`

$FASTER_GS is the folder FasterGSCudaBackend/FasterGSCudaBackend of their repository
(nerficg-project/faster-gaussian-splatting; Apache-2.0), commit 3cb0b755. The two take turns, with
gsbench's loss and Faster-GS's own Adam.
"""

import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsbench.bench.measure import UNUSED_FOLDER, ZERO_RATE, Setting, Stepper
from gsbench.bench.scenes import make_scene

SIZE, STEPS, TURNS = (1600, 1060), 10, 7
NEAR, FAR = 0.2, 1e4
OPTIONS = ["-O3", "-std=c++17"]


def load_backend() -> Any:
    """Compile the backend, unless it is compiled already, and load it."""
    from torch.utils.cpp_extension import load

    root = Path(os.environ["FASTER_GS"])
    modules = [folder for folder in sorted(root.iterdir()) if (folder / "src").is_dir()]
    sources = [str(file) for module in modules for file in sorted((module / "src").rglob("*.cu"))]
    return load(
        "faster_gs",
        [str(root / "torch_bindings" / "bindings.cpp"), *sources],
        extra_include_paths=[str(root / "utils"), *(str(x / "include") for x in modules)],
        extra_cflags=OPTIONS,
        extra_cuda_cflags=[*OPTIONS, "-use_fast_math"],
    )


class FasterGS:
    """A training of the bench's scene with `load_backend`'s ``code``."""

    def __init__(self, code: Any, setting: Setting, loss: Callable[..., Any], target: Tensor):
        self.code, self.loss, self.target = code, loss, target
        gaussians, scene = make_scene(setting.scene, setting.width, setting.height, setting.count)
        camera, device = scene.train[0].camera, target.device
        values = gaussians.map(lambda tensor: tensor.detach().to(device))
        self.parameters = [
            values.means,
            values.log_scales,
            values.quaternions,
            values.opacity_logits.view(-1, 1),
            values.sh_dc.view(-1, 1, 3),
            values.sh_rest,
        ]
        self.moments = [(torch.zeros_like(one), torch.zeros_like(one)) for one in self.parameters]
        to_view = torch.eye(4)
        to_view[:3, :3], to_view[:3, 3] = map(
            torch.from_numpy, (camera.rotation, camera.translation)
        )
        center = torch.from_numpy(camera.center).float().to(device)
        size, focal = (camera.width, camera.height), (camera.fx, camera.fy, camera.cx, camera.cy)
        black, bases = torch.zeros(3, device=device), 16
        self.view = (to_view.to(device), center, black, bases, *size, *focal, NEAR, FAR, False)
        self.seen = torch.zeros(2, setting.count, device=device)
        self.steps = 0

    def render(self) -> Any:
        """Their image [3, H, W] and what their backward pass needs."""
        return self.code.forward(*self.parameters, *self.view)

    def step(self) -> None:
        image, *buffers, instances, buckets, selector = self.render()
        leaf = image.permute(1, 2, 0).contiguous().requires_grad_()
        self.loss(leaf, self.target)[0].backward()
        assert leaf.grad is not None
        means, scales, turns, opacities, _, rest = self.parameters
        gradients = self.code.backward(
            self.seen,
            leaf.grad.permute(2, 0, 1).contiguous(),
            image,
            *(means, scales, turns, opacities, rest),
            *buffers,
            *self.view,
            *(instances, buckets, selector),
        )
        self.steps += 1
        for parameter, gradient, moments in zip(
            self.parameters, gradients, self.moments, strict=True
        ):
            numbers = self.steps, ZERO_RATE, 0.9, 0.999, 1e-15
            self.code.adam_step(gradient, parameter, *moments, *numbers)


def time_both(code: Any, raster: str, setting: Setting) -> list[dict[str, Any]]:
    """A row for each: ms of a step, frames per second, and how far apart the two images are."""
    stepper = Stepper(raster, setting)
    trainer = stepper.trainer
    other = FasterGS(code, setting, trainer.loss, trainer.targets.get(0))
    with torch.no_grad():
        off = (trainer.render(0).image - other.render()[0].permute(1, 2, 0)).abs()
    runs: dict[str, tuple[Callable[[], Any], Callable[[], Any]]] = {
        raster: (lambda: trainer.iterate(UNUSED_FOLDER), lambda: trainer.render(0)),
        "faster_gs": (other.step, other.render),
    }
    times: dict[tuple[str, int], list[float]] = {}
    for _ in range(TURNS + 1):
        for name, both in runs.items():
            for kind, run in enumerate(both):
                begin = stepper._now()
                with torch.set_grad_enabled(kind == 0):
                    for _ in range(STEPS):
                        run()
                times.setdefault((name, kind), []).append((stepper._now() - begin) / STEPS)
    size = f"{setting.width}x{setting.height}"
    rows = []
    for name in runs:
        step, frame = (statistics.median(times[name, kind][1:]) for kind in (0, 1))
        row = {"raster": name, "scene": setting.scene, "count": setting.count, "size": size}
        rows.append(row | {"step_ms": round(1e3 * step, 3), "fps": round(1 / frame, 1)})
    rows[1] |= {"difference": [float(off.mean()), float(off.max())]}
    return rows


def main(raster: str, *counts: str) -> None:
    begin = time.perf_counter()
    code = load_backend()
    print(f"compiled in {time.perf_counter() - begin:.0f} s", file=sys.stderr)
    settings = [Setting("trained", *SIZE, int(count)) for count in counts]
    print(json.dumps([row for one in settings for row in time_both(code, raster, one)]))


if __name__ == "__main__":
    main(*sys.argv[1:])
