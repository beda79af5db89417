"""``gsbench doctor``: what this machine has, what is missing, and how to mend it."""

from __future__ import annotations

import importlib
import importlib.util
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

from gsbench.arguments import ArgumentParser
from gsbench.install import install_command
from gsbench.layout import DATABASE, STORE
from gsbench.pipeline.resources import available_threads

Verdict = Literal["ok", "note", "bad"]
LITTLE_SPACE_GB = 5.0
OPTIONAL = {  # package -> what needs it, and the extra that brings it
    "transformers": ("init=dim", "dim"),
    "gsplat": ("raster=gsplat and export --to compressed", "gsplat"),
    "submitit": ("launch=local and launch=slurm", "slurm"),
    "viser": ("gsbench view", "view"),
}


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at: ``ok``, worth a ``note``, or ``bad`` (gsbench will not work)."""

    verdict: Verdict
    topic: str
    text: str


def main(argv: Sequence[str], runs: Path) -> int:
    """The verb: 1 if something is bad."""
    parser = ArgumentParser(prog="gsbench doctor", description="Check this machine and say what is missing.")
    parser.add_argument(
        "--store", action="store_true", help="also read every stored result whole and name damaged ones"
    )
    options = parser.parse_args(argv)
    checks: list[Callable[[], Iterator[Finding]]] = [
        check_python,
        check_torch,
        check_torchvision,
        check_packages,
        check_kernels,
        lambda: check_runs(runs),
        lambda: check_tracking(runs),
        check_weights,
    ]
    if options.store:
        checks.append(lambda: check_store(runs))
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
    if torch.cuda.is_available():
        names = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
        yield Finding("ok", "gpu", ", ".join(names))
    else:
        reason = "this torch has no CUDA" if torch.version.cuda is None else "torch finds no usable NVIDIA driver"
        yield Finding("note", "gpu", f"none ({reason}): raster=auto uses the CPU")


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
    for name, (purpose, extra) in OPTIONAL.items():
        installed = _version(name)
        text = installed or f"not installed; needed for {purpose}: {install_command(extra)}"
        yield Finding("ok" if installed else "note", name, text)


def check_kernels() -> Iterator[Finding]:
    """Where numba keeps compiled kernels; without such a place every start compiles anew."""
    places = [os.environ.get("NUMBA_CACHE_DIR"), Path(__file__).resolve().parents[1] / "raster" / "cpu" / "__pycache__"]
    place = next(Path(entry) for entry in places if entry)
    if _is_writable(place):
        yield Finding("ok", "kernels", f"compiled ones are kept in {place}")
    else:
        text = f"{place} may not be written to: kernels are kept in the user's cache, or set NUMBA_CACHE_DIR"
        yield Finding("note", "kernels", text)


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
    from gsbench.eval.lpips import BACKBONES
    from gsbench.init.network_weights import EXTRACTOR_WEIGHTS, LIGHTGLUE_WEIGHTS
    from gsbench.weights import WEIGHTS_VARIABLE, MissingWeights, WeightsFile, find_weights, hub_cache

    wanted: list[tuple[str, tuple[WeightsFile, ...]]] = []
    for name, backbone in BACKBONES.items():
        wanted += [(f"LPIPS {name}", backbone.features), (f"LPIPS {name} heads", (backbone.heads,))]
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


def check_store(runs: Path) -> Iterator[Finding]:
    """Every stored result, read whole."""
    from gsbench.pipeline.stages import STAGES
    from gsbench.pipeline.store import read_manifest

    sound = 0
    for stage in STAGES:
        for folder in sorted((runs / STORE / stage.name).glob("[0-9a-f]*")):
            try:
                read_manifest(folder, thorough=True)
                sound += 1
            except ValueError as error:
                yield Finding(
                    "note", "store", f"{folder}: {error}; delete the folder, and the next run builds it again"
                )
    yield Finding("ok", "store", f"{sound} results are as they were written")


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
