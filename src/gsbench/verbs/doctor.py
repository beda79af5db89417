"""``gsbench doctor``: what this machine has, what is missing, and how to mend it."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import math
import random
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from pathlib import Path
from typing import Literal

from gsbench.datasets.catalog import DATA_VARIABLE, data_dir, read_catalog
from gsbench.errors import InputError
from gsbench.raster.executors import EXECUTORS, find, resolve
from gsbench.runs.layout import DATABASE, STORE
from gsbench.system.install import install_command
from gsbench.system.resources import available_threads, installed_gpus
from gsbench.verbs.arguments import ArgumentParser
from gsbench.words import counted, readable_bytes

Verdict = Literal["ok", "note", "bad"]
LITTLE_SPACE_GB = 5.0
TRITON_CAPABILITY = (8, 0)  # "NVIDIA GPUs (Compute Capability 8.0+)", in Triton's README
OPTIONAL = {  # module -> what needs it, and the extra that brings it
    "transformers": ("init=dim", "dim"),
    "gsplat": ("raster=gsplat", "gsplat"),
    "optuna": ("searches (hydra.sweeper.tune)", "search"),
    "tensorboard": ("tracking=tensorboard", "tensorboard"),
    "viser": ("gsbench view", "view"),
    "cv2": ("gsbench video to .mp4", "video"),
    "wandb": ("tracking=wandb", "wandb"),
}


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at: ``ok``, worth a ``note``, or ``bad`` (gsbench will not work)."""

    verdict: Verdict
    topic: str
    text: str


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 1 if something is bad."""
    parser = ArgumentParser(prog="gsbench doctor", description="Check this machine and say what is missing.")
    parser.add_argument(
        "--store", action="store_true", help="also read every stored result whole and name damaged ones"
    )
    parser.add_argument(
        "--sample", type=_percent, metavar="PERCENT", help="with --store: only so many of the results, chosen by chance"
    )
    options = parser.parse_args(argv)
    if options.sample is not None and not options.store:
        raise InputError("--sample says how much of the store is read: give --store too")
    checks: list[Callable[[], Iterator[Finding]]] = [
        check_python,
        check_torch,
        check_gpu,
        check_torchvision,
        check_packages,
        check_triton,
        check_kernels,
        check_executors,
        check_data,
        lambda: check_runs(runs),
        lambda: check_tracking(runs),
        check_weights,
    ]
    if options.store:
        checks.append(lambda: check_store(runs, options.sample or 100.0))
    bad = 0
    for check in checks:
        for finding in check():
            print(f"{finding.verdict:<5} {finding.topic:<12} {finding.text}")
            bad += finding.verdict == "bad"
    return 1 if bad else 0


def check_python() -> Iterator[Finding]:
    from gsbench import __version__

    yield Finding("ok", "gsbench", f"{__version__} in {Path(__file__).resolve().parents[1]}")
    yield Finding("ok", "python", f"{sys.version.split()[0]} ({sys.executable}), {available_threads()} cores to use")


def check_torch() -> Iterator[Finding]:
    try:
        import torch
    except (ImportError, OSError) as error:
        yield Finding("bad", "torch", f"cannot be imported ({_first_line(error)}): pip install torch")
        return
    yield Finding("ok", "torch", str(torch.__version__))


def check_gpu() -> Iterator[Finding]:
    """The GPUs that torch can use, or what keeps it from one that is there."""
    import torch

    for index in range(torch.cuda.device_count() if torch.cuda.is_available() else 0):
        free, total = torch.cuda.mem_get_info(index)
        text = f"{torch.cuda.get_device_name(index)}, {readable_bytes(free)} of {readable_bytes(total)} free"
        if torch.version.hip is not None:
            yield Finding("note", "gpu", f"{text}: an AMD GPU, on which gsbench was never tested")
        elif torch.cuda.get_device_capability(index) < TRITON_CAPABILITY:
            yield Finding("note", "gpu", f"{text}: older than Triton supports; if raster=triton fails, take gsplat")
        else:
            yield Finding("ok", "gpu", text)
    if torch.cuda.is_available():
        return
    listed = len(installed_gpus())
    if torch.version.cuda is None and listed:
        text = (
            f"{counted(listed, 'NVIDIA GPU')} here, but this torch is a build for CPUs: install one for CUDA, "
            "see pytorch.org/get-started"
        )
    elif torch.version.cuda is None:
        text = "none (this torch is a build for CPUs): raster=auto uses the CPU"
    else:
        text = "none (torch finds no usable NVIDIA driver; does nvidia-smi run?): raster=auto uses the CPU"
    yield Finding("note", "gpu", text)


def check_torchvision() -> Iterator[Finding]:
    """A torchvision of another torch makes other packages fail in odd ways; gsbench itself does not need it."""
    if importlib.util.find_spec("torchvision") is None:
        return
    try:
        importlib.import_module("torchvision")
    except Exception as error:  # noqa: BLE001 - a mismatched build raises RuntimeError, OSError, ImportError …
        text = f"{_version('torchvision')} does not fit this torch ({_first_line(error)}): pip uninstall torchvision"
        yield Finding("bad", "torchvision", text)
    else:
        yield Finding("ok", "torchvision", f"{_version('torchvision')} (not needed)")


def check_packages() -> Iterator[Finding]:
    for name in ("pycolmap", "kornia", "numba", "mlflow"):
        installed = _version(name)
        verdict: Verdict = "bad" if installed is None else "ok"
        yield Finding(verdict, name, installed or f"missing: {install_command()}")
    distributions = packages_distributions()  # cv2 comes in several
    for name, (purpose, extra) in OPTIONAL.items():
        installed = _version(distributions.get(name, [name])[0])
        text = installed or f"not installed; needed for {purpose}: {install_command(extra)}"
        yield Finding("ok" if installed else "note", name, text)


def check_triton() -> Iterator[Finding]:
    """Check the compiler that raster=triton needs at its first run on a GPU."""
    from gsbench.raster.triton.launch import missing_tools

    installed = _version("triton")
    if installed is None:  # torch for CUDA would have brought it along
        return
    if old := find("triton").too_old():
        yield Finding("note", "triton", f"raster=triton {old}")
    elif missing := missing_tools():
        yield Finding("note", "triton", f"{installed}; at its first run on a GPU it needs {' and '.join(missing)}")
    else:
        text = f"{installed}; the C compiler and Python.h that it needs at its first run on a GPU are here"
        yield Finding("ok", "triton", text)


def check_kernels() -> Iterator[Finding]:
    """Check the place of the CPU's compiled kernels; without one every start compiles anew."""
    from gsbench.system.jit import TEMPORARY_PREFIX, cache_base

    place = cache_base()
    if place.name.startswith(TEMPORARY_PREFIX):
        text = "the user's cache cannot be written to, so every start compiles anew: set NUMBA_CACHE_DIR to a folder"
        yield Finding("note", "kernels", text)
    else:
        yield Finding("ok", "kernels", f"those for the CPU are kept in {place}")


def check_executors() -> Iterator[Finding]:
    """Check which rasterizers run here, and which is taken if none is chosen."""
    import torch

    here = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    for executor in EXECUTORS:
        obstacles = {device: executor.obstacle(device) for device in here}
        usable = [device for device, obstacle in obstacles.items() if obstacle is None]
        if usable:
            text = f"raster={executor.name} on {' and '.join(usable)}: {executor.text}"
            yield Finding("ok", "rasterizer", text)
        elif executor.runs_on(here[-1]):
            yield Finding("note", "rasterizer", f"raster={executor.name} {obstacles[here[-1]]}")
        else:
            needed = " or ".join(executor.devices)
            yield Finding("note", "rasterizer", f"raster={executor.name} needs a {needed} device, and there is none")
    chosen = [f"{resolve('auto', device).name} on {device}" for device in here]
    yield Finding("ok", "rasterizer", f"raster=auto is {' and '.join(chosen)}")


def check_data() -> Iterator[Finding]:
    """The public scenes that are at hand."""
    for dataset in read_catalog().values():
        places = {scene: folder for archive in dataset.archives for scene, folder in archive.scenes.items()}
        found = [scene for scene, folder in sorted(places.items()) if (data_dir() / folder).is_dir()]
        text = f"{len(found)} of {counted(len(places), 'scene')} of {dataset.title} in {data_dir().absolute()}"
        if len(found) < len(places):
            text += f"; `gsbench fetch {dataset.name}` brings what is missing (or set {DATA_VARIABLE})"
        yield Finding("ok" if found else "note", "data", text)


def check_runs(runs: Path) -> Iterator[Finding]:
    if not _is_writable(runs):
        yield Finding("bad", "runs", f"{runs} may not be written to: set GSBENCH_RUNS")
        return
    free = shutil.disk_usage(_existing(runs)).free / 1e9
    verdict: Verdict = "ok" if free >= LITTLE_SPACE_GB else "note"
    yield Finding(verdict, "runs", f"{runs}, {free:.0f} GB free")


def check_tracking(runs: Path) -> Iterator[Finding]:
    database = runs / DATABASE
    if not database.exists():
        yield Finding("ok", "tracking", f"no {database} yet: the first trial makes it")
        return
    try:
        from gsbench.tracking import connect, default_uri

        count = len(connect(default_uri(runs), runs).search_experiments())
    except Exception as error:  # noqa: BLE001 - SQLAlchemy, alembic and MLflow each raise their own kinds
        text = f"{database} cannot be used ({_first_line(error)}): move it away, and `gsbench sync` makes it anew"
        yield Finding("note", "tracking", text)
    else:
        yield Finding("ok", "tracking", f"{database}, {count} experiments; `gsbench ui` shows them")


def check_weights() -> Iterator[Finding]:
    """Weights that are at hand; nothing is downloaded."""
    from gsbench.eval.dists import ALPHA_BETA
    from gsbench.eval.lpips import BACKBONES
    from gsbench.init.networks.weights import EXTRACTOR_WEIGHTS, LIGHTGLUE_WEIGHTS
    from gsbench.weights import WEIGHTS_VARIABLE, MissingWeights, WeightsFile, find_weights, hub_cache

    wanted: list[tuple[str, tuple[WeightsFile, ...]]] = []
    for name, backbone in BACKBONES.items():
        wanted += [(f"LPIPS {name}", backbone.features), (f"LPIPS {name} heads", (backbone.heads,))]
    wanted.append(("DISTS, with LPIPS vgg", (ALPHA_BETA,)))
    wanted += [(f"init=dim {name}", (spec,)) for name, spec in EXTRACTOR_WEIGHTS.items()]
    wanted += [(f"LightGlue for {name}", (spec,)) for name, spec in LIGHTGLUE_WEIGHTS.items()]
    for purpose, specs in wanted:
        faults = []
        for spec in specs:
            try:
                yield Finding("ok", "weights", f"{purpose}: {find_weights(spec, download=False)}")
                break
            except MissingWeights as error:
                faults.append(str(error))
        else:
            missing = specs[0]
            damaged = next((fault for fault in faults if "not found" not in fault), None)
            place = f"${WEIGHTS_VARIABLE} or {hub_cache()}"
            text = damaged or f"{missing.names[0]} is not here; it is downloaded when needed, or put it into {place}"
            yield Finding("note", "weights", f"{purpose}: {text}")


def check_store(runs: Path, percent: float = 100.0) -> Iterator[Finding]:
    """Check stored results by reading them whole: ``percent`` of them, drawn anew each time."""
    from gsbench.runs.stages import STAGES
    from gsbench.runs.store import read_manifest

    there = sorted(folder for stage in STAGES for folder in (runs / STORE / stage.name).glob("[0-9a-f]*"))
    chosen = sorted(random.sample(there, math.ceil(len(there) * percent / 100)))
    sound = 0
    for folder in chosen:
        try:
            read_manifest(folder, thorough=True)
            sound += 1
        except ValueError as error:
            yield Finding("note", "store", f"{folder}: {error}; delete the folder, and the next run builds it again")
    part = "" if len(chosen) == len(there) else f", of {len(there):,} in all"
    yield Finding("ok", "store", f"{sound:,} results are as they were written{part}")


def _percent(text: str) -> float:
    """``5%`` or ``5``: above 0, at most 100."""
    try:
        value = float(text.removesuffix("%"))
    except ValueError:
        value = math.nan
    if not 0 < value <= 100:
        raise argparse.ArgumentTypeError(f"must be a share such as 5%, got {text!r}")
    return value


def _is_writable(folder: Path) -> bool:
    try:
        with tempfile.TemporaryFile(dir=_existing(folder)):
            return True
    except OSError:
        return False


def _existing(folder: Path) -> Path:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:150] if lines else type(error).__name__
