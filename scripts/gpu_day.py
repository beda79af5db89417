"""The Python parts of gpu_day.sh: the machine's facts, whether renders are equal bit by bit, the table of results."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

NOTHING = "-"
MODEL = "bench-model"


def machine() -> dict[str, str]:
    """The GPU and the versions on which the measurements depend."""
    from importlib.metadata import version

    import torch
    import triton

    import gsbench

    has_gpu = torch.cuda.is_available()
    return {
        "gpu": torch.cuda.get_device_name() if has_gpu else "none (Triton's interpreter)",
        "cuda": str(torch.version.cuda),
        "torch": torch.__version__,
        "triton": triton.__version__,
        "numpy": version("numpy"),
        "python": sys.version.split()[0],
        "gsbench": gsbench.__version__,
    }


def bits(device: str, width: int, height: int, count: int) -> list[str]:
    """The names of outputs that differ among three runs of render, loss and gradients.

    The runs are on new memory, on used memory, and by new objects with new memory pools.
    """
    import torch

    from gsbench.bench.scenes import make_scene
    from gsbench.raster.triton.executor import TritonRasterizer
    from gsbench.train.loss_triton import TritonLoss

    gaussians, scene = make_scene("skewed", width, height, count)
    target = torch.from_numpy(scene.train[0].image).to(device)
    background = torch.zeros(3, device=device)

    def run(rasterizer: TritonRasterizer, loss: TritonLoss) -> dict[str, torch.Tensor]:
        leaves = gaussians.map(lambda tensor: tensor.to(device).requires_grad_())
        output = rasterizer.render(leaves, scene.train[0].camera, 3, background, absolute_gradient=True)
        value = loss(output.image, target)[0]
        value.backward()
        outputs = {"image": output.image, "alpha": output.alpha, "radii": output.radii, "loss": value}
        outputs |= {"screen": output.screen_points.grad, "absolute": output.screen_gradient_abs}
        outputs |= {f"gradient of {name}": tensor.grad for name, tensor in leaves.tensors().items()}
        return {name: tensor.detach().cpu() for name, tensor in outputs.items()}

    rasterizer, loss = TritonRasterizer(), TritonLoss(0.2)
    first = run(rasterizer, loss)
    others = [run(rasterizer, loss), run(TritonRasterizer(), TritonLoss(0.2))]
    if not first["gradient of means"].abs().max() > 0:
        raise RuntimeError("nothing was seen: equal bits would say nothing")
    return sorted({name for other in others for name, tensor in first.items() if not torch.equal(tensor, other[name])})


def table(results: Path) -> str:
    """All results as Markdown."""
    return "\n\n".join(part for part in (_head(results), _speed(results), _training(results)) if part)


def _head(results: Path) -> str:
    facts = _read(results / "machine.out") or {}
    lines = [f"Measured on: {', '.join(f'{name} {value}' for name, value in facts.items()) or 'unknown'}.", ""]
    ends = _ends(results)
    contract = _last_line(results / "contract.out")
    lines += [f"- contract: {_end(ends, 'contract')}{f' ({contract})' if contract else ''}"]
    lines += [f"- the same bits, three times: {_end(ends, 'bits')}{_differing(results)}"]
    lines += [f"- memory checker: {_end(ends, 'memcheck')}"]
    failed = [f"{name} ({code})" for name, code in ends.items() if code != "0"]
    return "\n".join(lines + ([f"- **did not end well**: {', '.join(failed)}"] if failed else []))


def _differing(results: Path) -> str:
    differing = (_read(results / "bits.out") or {}).get("differing")
    return f"; different: {', '.join(differing)}" if differing else ""


def _ends(results: Path) -> dict[str, str]:
    """The exit code of each step's last run."""
    file = results / "steps.tsv"
    rows = [line.split("\t") for line in file.read_text().splitlines()] if file.is_file() else []
    return {row[0]: row[1] for row in rows}


def _end(ends: dict[str, str], name: str) -> str:
    return {"0": "yes", None: "not tried"}.get(ends.get(name), f"NO (exit {ends.get(name)})")


def _benches(results: Path) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    for file in sorted(results.glob("bench-*.out"), key=_order):
        if rows := _read(file):
            yield ("a trained bonsai" if file.stem == MODEL else rows[0]["scene"]), rows


def _order(file: Path) -> tuple[bool, str, int]:
    scene, _, count = file.stem.removeprefix("bench-").rpartition("-")
    return file.stem == MODEL, scene, int(count) if count.isdigit() else 0


def _speed(results: Path) -> str:
    columns = ("forward_ms", "loss_ms", "backward_ms", "adam_ms", "step_ms", "steps_per_second", "peak_memory_mb")
    lines = []
    for scene, rows in _benches(results):
        for row in rows:
            times = " | ".join(_number(row.get(column)) for column in columns)
            ratio = f"{row['step_ratio']:.2f}"
            lines.append(f"| {scene} | {row['count']:,} | {row['size']} | `{row['raster']}` | {times} | {ratio} |")
    names = ("forward", "loss", "backward", "Adam", "step", "steps/s", "peak MiB")
    header = "| scene | Gaussians | size | rasterizer | " + " | ".join(names) + " | of triton's step |"
    return "\n".join([header, "|" + "---|" * (5 + len(names)), *lines]) if lines else ""


def _training(results: Path) -> str:
    lines = []
    for file in sorted(results.glob("train-*.json")):
        record = _read(file) or {}
        metrics = record.get("metrics", {})
        cells = (
            f"`{record.get('raster', NOTHING)}`",
            _number(record.get("iterations"), 0),
            f"{record.get('num_gaussians', 0):,}",
            _number(record.get("seconds", {}).get("train")),
            _number(record.get("peak_memory_mb"), 0),
            _number(metrics.get("psnr"), 2),
            _number(metrics.get("ssim"), 4),
        )
        lines.append("| " + " | ".join(cells) + " |")
    header = "| training | iterations | Gaussians | seconds | peak MiB | PSNR | SSIM |\n|---|---|---|---|---|---|---|"
    return "\n".join([header, *lines]) if lines else ""


def _number(value: float | None, digits: int = 2) -> str:
    return NOTHING if value is None else f"{value:.{digits}f}"


def _read(file: Path) -> Any:
    """The JSON in ``file``; None if it is missing or damaged."""
    try:
        return json.loads(file.read_text())
    except (OSError, ValueError):
        return None


def _last_line(file: Path) -> str:
    lines = file.read_text().splitlines() if file.is_file() else []
    return lines[-1].strip("= ") if lines else ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("machine", help="GPU and versions as JSON")
    same = verbs.add_parser("bits", help="whether runs have the same bits, as JSON; 1 if they have not")
    same.add_argument("device")
    same.add_argument("size", help="WIDTHxHEIGHT")
    same.add_argument("count", type=int)
    verbs.add_parser("table", help="Markdown from a folder of results").add_argument("results", type=Path)
    options = parser.parse_args()
    if options.verb == "machine":
        print(json.dumps(machine()))
    elif options.verb == "table":
        print(table(options.results))
    else:
        width, _, height = options.size.partition("x")
        differing = bits(options.device, int(width), int(height), options.count)
        print(json.dumps({"differing": differing}))
        return 1 if differing else 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
