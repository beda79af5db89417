"""``gsbench doctor``: what this machine has, what is missing, and how to get it."""

import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from gsbench.raster.executors import EXECUTORS, find_executor, resolve
from gsbench.runs.made_of import version_of
from gsbench.system.install import install_command
from gsbench.system.resources import available_threads, installed_gpus
from gsbench.verbs.arguments import ArgumentParser
from gsbench.words import counted, readable_bytes

LITTLE_SPACE = 5_000_000_000  # bytes
REQUIRED = ("pycolmap", "kornia", "numba", "mlflow")
OPTIONAL = {  # module -> what needs it, and the extra that brings it
    "transformers": ("init=dim", "dim"),
    "gsplat": ("raster=gsplat", "gsplat"),
    "optuna": ("searches (hydra.sweeper.tune)", "search"),
    "tensorboard": ("tracking=tensorboard", "tensorboard"),
    "viser": ("gsbench view", "view"),
    "wandb": ("tracking=wandb", "wandb"),
}


class Finding(NamedTuple):
    """The result of one check: ``ok``, worth a ``note``, or ``bad`` (gsbench will not work)."""

    verdict: Literal["ok", "note", "bad"]
    topic: str
    text: str


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 1 if something is bad."""
    parser = ArgumentParser(prog="gsbench doctor", description="Check this machine and say what is missing.")
    parser.parse_args(argv)
    bad = 0
    for findings in (check_packages(), check_devices(), check_weights(), check_runs(runs)):
        for verdict, topic, text in findings:
            print(f"{verdict:<5} {topic:<12} {text}")
            bad += verdict == "bad"
    return 1 if bad else 0


def check_packages() -> Iterator[Finding]:
    """The versions of gsbench, Python and the packages that gsbench imports."""
    from gsbench import __version__

    yield Finding("ok", "gsbench", f"{__version__} in {Path(__file__).resolve().parents[1]}")
    yield Finding("ok", "python", f"{sys.version.split()[0]} ({sys.executable}), {available_threads()} cores to use")
    for name in REQUIRED:
        installed = version_of(name)
        yield Finding("bad" if installed is None else "ok", name, installed or f"missing: {install_command()}")
    for name, (purpose, extra) in OPTIONAL.items():
        installed = version_of(name)
        text = installed or f"not installed; needed for {purpose}: {install_command(extra)}"
        yield Finding("ok" if installed else "note", name, text)


def check_devices() -> Iterator[Finding]:
    """Findings about torch, the GPUs that it can or cannot use and why, and the rasterizers on each device."""
    try:
        import torch
    except (ImportError, OSError) as error:
        yield Finding("bad", "torch", f"cannot be imported ({str(error).partition(chr(10))[0]}): pip install torch")
        return
    yield Finding("ok", "torch", str(torch.__version__))
    usable = torch.cuda.is_available()
    for index in range(torch.cuda.device_count() if usable else 0):
        free, total = torch.cuda.mem_get_info(index)
        text = f"{torch.cuda.get_device_name(index)}, {readable_bytes(free)} of {readable_bytes(total)} free"
        untested = torch.version.hip is not None
        yield Finding("note" if untested else "ok", "gpu", f"{text}{': AMD, never tested' if untested else ''}")
    if not usable:
        listed = len(installed_gpus())
        if torch.version.cuda is not None:
            cause = "torch finds no usable NVIDIA driver; does nvidia-smi run?"
        elif listed:
            cause = f"{counted(listed, 'NVIDIA GPU')} here, but this torch is a build for CPUs: see pytorch.org"
        else:
            cause = "this torch is a build for CPUs"
        yield Finding("note", "gpu", f"none ({cause}): raster=auto uses the CPU")
    devices = ["cpu", *(["cuda"] if usable else [])]
    for executor in EXECUTORS:
        usable_on = [device for device in devices if executor.obstacle(device) is None]
        if usable_on:
            yield Finding("ok", "rasterizer", f"raster={executor.name} on {' and '.join(usable_on)}: {executor.text}")
        else:
            yield Finding("note", "rasterizer", f"raster={executor.name} {executor.obstacle(devices[-1])}")
    chosen = " and ".join(f"{resolve('auto', device).name} on {device}" for device in devices)
    yield Finding("ok", "rasterizer", f"raster=auto is {chosen}")
    yield from check_triton()


def check_triton() -> Iterator[Finding]:
    """Findings about the compiler that raster=triton needs at its first run on a GPU."""
    from gsbench.raster.executors import missing_tools

    if version_of("triton") is None:  # it comes with torch for CUDA, so there is no GPU to run it on
        return
    if fault := find_executor("triton").too_old():
        yield Finding("note", "triton", f"raster=triton {fault}")
    elif missing := missing_tools():
        yield Finding("note", "triton", f"at its first run on a GPU it needs {' and '.join(missing)}")


def check_weights() -> Iterator[Finding]:
    """Findings about the weights of networks that are here; nothing is downloaded."""
    from gsbench.eval.lpips import BACKBONES, find_first_weights
    from gsbench.init.dim import EXTRACTOR_WEIGHTS, LIGHTGLUE_WEIGHTS
    from gsbench.weights import WEIGHTS_VARIABLE, MissingWeightsError, hub_cache

    wanted = {f"LPIPS {name}": backbone.features for name, backbone in BACKBONES.items()}
    wanted |= {f"LPIPS {name} heads": (backbone.heads,) for name, backbone in BACKBONES.items()}
    wanted |= {f"init=dim {name}": (spec,) for name, spec in EXTRACTOR_WEIGHTS.items()}
    wanted |= {f"LightGlue for {name}": (spec,) for name, spec in LIGHTGLUE_WEIGHTS.items()}
    for purpose, specs in wanted.items():
        try:
            yield Finding("ok", "weights", f"{purpose}: {find_first_weights(specs, None, download=False)}")
        except MissingWeightsError as error:
            origin = specs[0].url or specs[0].source
            missing = f"{specs[0].names[0]} is not here; gsbench downloads it when needed from {origin}"
            place = f"or put it into ${WEIGHTS_VARIABLE} or {hub_cache()}"
            text = f"{missing}; {place}" if "not found" in str(error) else str(error)
            yield Finding("note", "weights", f"{purpose}: {text}")


def check_runs(runs: Path) -> Iterator[Finding]:
    """Finding about the runs folder: whether it can be written to, and its free space."""
    place = next(folder for folder in (runs, *runs.absolute().parents) if folder.exists())
    try:
        with tempfile.TemporaryFile(dir=place):
            free = shutil.disk_usage(place).free
    except OSError:
        yield Finding("bad", "runs", f"{runs} cannot be written to: set GSBENCH_RUNS")
    else:
        yield Finding("note" if free < LITTLE_SPACE else "ok", "runs", f"{runs}, {readable_bytes(free)} free")
