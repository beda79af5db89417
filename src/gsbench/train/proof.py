"""The proof of a rasterizer: on a GPU, it must agree with the reference before it trains.

Kernels are compiled on the user's machine, by its versions of driver, torch and Triton, for its
GPU. Tests on other machines say little about that. So the first process that uses an executor with
such a combination compares it with the float64 reference, which takes about ten seconds, and keeps
the result in the user's cache folder. Executors on the CPU are tested by gsbench's own tests;
``gsbench doctor --prove`` proves them on request.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import math
import os
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.files import user_cache, write_json
from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.parsing import read_if_sound
from gsbench.raster import Rasterizer, create_rasterizer
from gsbench.raster.contract import Case, Error, measure, render_with_gradients
from gsbench.raster.executors import AUTO, automatic, find_executor, resolve
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.runs.trial_record import RasterProof
from gsbench.system.install import version_of
from gsbench.system.isolate import CrashError, run_isolated
from gsbench.system.locks import hold
from gsbench.system.machine import cpu_name
from gsbench.system.resources import nvidia_smi
from gsbench.train.loss import Loss, PhotometricLoss, torch_photometric_loss

log = logging.getLogger(__name__)

PACKAGE = Path(__file__).resolve().parents[1]
# A change of these files and folders requires a new proof: kernels, code that they share, and the
# proof itself.
SOURCES = (
    "raster",
    "eval/images.py",
    "eval/ssim.py",
    "gaussians/model.py",
    "gaussians/trainable.py",
    "train/loss.py",
    "train/loss_triton.py",
    "train/adam_triton.py",
    "train/direct.py",
    "train/direct_proof.py",
    "train/proof.py",
)
SCENES = (
    Case(33, 49, 50, sh_degree=3),  # tiles of one pixel; Gaussians outside the image
    # large Gaussians, some of them behind the camera
    Case(48, 37, 120, sh_degree=2, log_scale=-1.0, depth=1.0),
    # a block's list has several segments
    Case(20, 17, 700, sh_degree=1, log_scale=-1.5, logit=-3.0, spread=0.3),
    Case(7, 5, 20, sh_degree=0, log_scale=-3.0),  # smaller than a tile; tiny Gaussians
)
STEPS = 10
LOSS_TOLERANCE = 1e-4  # relative, at each step; the error of the CPU kernels is 5e-8
TRAINED_TOLERANCE = 2e-3  # of the image after the steps; the error of the CPU kernels is 1e-6


def prove(
    rasterizer: Rasterizer,
    device: torch.device,
    scenes: tuple[Case, ...] = SCENES,
    loss: Loss | None = None,
) -> RasterProof:
    """Compare ``rasterizer`` on ``device`` with the reference.

    All ``scenes`` are rendered, with gradients; rendered again, if the same bits are promised; and
    the first is trained for ten steps with ``loss``, by default that of a training on ``device``. A
    departure ends the proof, since the next comparison would only repeat it. It takes seconds,
    besides the compilation of the kernels.
    """
    started = time.perf_counter()
    errors: list[Error] = []
    failures: list[str] = []
    try:
        for found in _comparisons(rasterizer, device, scenes, loss or PhotometricLoss()):
            errors += found
            failures += [str(error) for error in found if error.is_departure]
            if failures:
                break
    except (torch.OutOfMemoryError, InputError):
        raise
    except Exception as raised:  # noqa: BLE001
        # Whatever a compiler or a driver raises is the result of the proof.
        reason, *_ = str(raised).strip().splitlines() or [""]
        failures.append(f"{type(raised).__name__}: {reason}")
    largest: dict[str, float] = {}
    for error in errors:
        if math.isfinite(error.off):
            largest[error.quantity] = max(largest.get(error.quantity, 0.0), error.off)
    direct_fault = ""
    if rasterizer.name == "triton" and not failures:
        from gsbench.train import direct_proof  # it imports Triton

        direct_fault = direct_proof.direct_fault(rasterizer, device, scenes[-1])
    return RasterProof(
        raster=rasterizer.name,
        device=_device_name(device),
        versions=versions_on(device),
        errors=largest,
        failures=failures,
        seconds=round(time.perf_counter() - started, 1),
        direct_fault=direct_fault,
    )


def _comparisons(
    rasterizer: Rasterizer, device: torch.device, scenes: tuple[Case, ...], loss: Loss
) -> Iterator[list[Error]]:
    """The errors of each comparison of `prove`, one comparison after the other."""
    yield [error for case in scenes for error in measure(rasterizer, case, str(device))]
    if find_executor(rasterizer.name).same_bits:
        # The second run is after all scenes, so that it reuses memory.
        first, again = ([_bits(rasterizer, case, str(device)) for case in scenes] for _ in range(2))
        errors = []
        for case, bits, other in zip(scenes, first, again, strict=True):
            unequal = [name for name in bits if bits[name] != other[name]]
            count, names = float(len(unequal)), ", ".join(unequal)
            errors.append(Error(str(case), "bits of a second run", count, 0.5, names, " tensors"))
        yield errors
    yield _training_errors(rasterizer, device, scenes[0], loss)


def _bits(rasterizer: Rasterizer, case: Case, device: str) -> dict[str, bytes]:
    output, gradients = render_with_gradients(rasterizer, case, torch.float32, device)
    tensors = {"image": output.image, "alpha": output.alpha, "radii": output.radii, **gradients}
    if output.footprint is not None:
        tensors |= {
            f"footprint ({name})": values for name, values in vars(output.footprint()).items()
        }
    return {name: tensor.detach().cpu().numpy().tobytes() for name, tensor in tensors.items()}


def _training_errors(
    rasterizer: Rasterizer, device: torch.device, case: Case, loss: Loss
) -> list[Error]:
    """Train ten steps with ``loss`` and Adam; return the errors against torch in float64."""
    other = dataclasses.replace(case, count=case.count + 1)  # another random scene, the target
    reference, black = ReferenceRasterizer(), torch.zeros(3, dtype=torch.float64)
    with torch.no_grad():
        drawn = reference.render(other.gaussians(), case.camera(), case.sh_degree, black)
    target = drawn.image.clamp(0, 1)
    expected, image = _train(reference, case, target, torch_photometric_loss)
    found, own_image = _train(rasterizer, case, target.to(device, torch.float32), loss)
    steps = [f"training step {step}" for step in range(1, STEPS + 1)]
    errors = [
        Error(str(case), "loss", abs(value / wanted - 1), LOSS_TOLERANCE, step, " of itself")
        for step, value, wanted in zip(steps, found, expected, strict=True)
    ]
    off = float((own_image.double().cpu() - image).abs().max())
    return [*errors, Error(str(case), "trained image", off, TRAINED_TOLERANCE, steps[-1])]


def _train(
    rasterizer: Rasterizer, case: Case, target: Tensor, loss: Loss
) -> tuple[list[float], Tensor]:
    """Train ten steps towards ``target`` [H, W, 3]; return the losses and the last image.

    The training has the device and dtype of ``target``.
    """
    model = TrainableGaussians(
        case.gaussians().map(lambda tensor: tensor.to(target)), LearningRates(), 1.0
    )
    black = target.new_zeros(3)
    losses = []
    for step in range(1, STEPS + 1):
        model.set_step(step)
        image = rasterizer.render(model.values, case.camera(), case.sh_degree, black).image
        value, _, _ = loss(image, target)
        value.backward()
        model.optimizer_step(case.sh_degree)
        losses.append(float(value.detach()))
    return losses, image.detach()


def versions_on(device: torch.device) -> dict[str, str]:
    """Versions of everything that determines the kernels on ``device``, and a digest of `SOURCES`.

    If one changes, a new proof is needed.
    """
    digest = hashlib.sha256()
    for source in SOURCES:
        root = PACKAGE / source
        for path in sorted(root.rglob("*.py")) if root.is_dir() else [root]:
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    found = {name: version_of(name) or "" for name in ("torch", "triton", "numba")}
    found |= {"cuda": torch.version.cuda or "", "hip": torch.version.hip or "", "driver": _driver()}
    found |= {"kernels": digest.hexdigest()[:16]}
    return {name: version for name, version in found.items() if version}


def _driver() -> str:
    """The version of NVIDIA's driver, "" if there is none. In WSL only nvidia-smi knows it."""
    try:
        return Path("/sys/module/nvidia/version").read_text(encoding="utf-8").strip()
    except OSError:
        return next(iter(nvidia_smi("driver_version")), "") if torch.cuda.is_available() else ""


def _device_name(device: torch.device) -> str:
    if device.type != "cuda":
        return cpu_name()
    major, minor = torch.cuda.get_device_capability(device)
    return f"{torch.cuda.get_device_name(device)} ({major}.{minor})"


# ---- stamps: the files that keep results


def stamp_of(raster: str, device: torch.device) -> Path:
    """The file of the last proof of ``raster`` on ``device`` with the installed versions.

    It is in the user's cache.
    """
    versions = [f"{name} {version}" for name, version in versions_on(device).items()]
    parts = json.dumps([raster, _device_name(device), *versions])
    digest = hashlib.sha256(parts.encode()).hexdigest()
    return user_cache("proofs") / f"{raster}-{digest[:16]}.json"


def prove_apart(raster: str, device: str) -> RasterProof:
    """`prove` the executor ``raster`` in a process of its own, so that a crash does no harm here.

    A crash is a failure of the proof. Raises InputError if the device has too little memory.
    """
    try:
        return run_isolated(_prove_by_name, raster, device, what=f"the proof of raster={raster}")
    except torch.OutOfMemoryError as error:
        raise InputError(
            f"device={device} has no memory left to prove raster={raster}: end other programs there"
        ) from error
    except CrashError as error:
        place = torch.device(device)
        return RasterProof(
            raster=raster,
            device=_device_name(place),
            versions=versions_on(place),
            errors={},
            failures=[str(error)],
            seconds=0.0,
        )


def _prove_by_name(raster: str, device: str) -> RasterProof:
    place = torch.device(device)
    return prove(create_rasterizer(raster, place), place)


def known_proof(raster: str, device: torch.device) -> RasterProof | None:
    """The last proof of ``raster`` on ``device`` with the installed versions, or None."""
    return read_if_sound(stamp_of(raster, device), RasterProof)


def proof_of(raster: str, device: torch.device, again: bool = False) -> RasterProof:
    """The proof of ``raster`` on ``device``: one that passed earlier, or a new one.

    If several processes need it, one makes it. With ``again``, it is always a new one.
    """
    stamp = stamp_of(raster, device)
    with _exclusive(stamp):
        known = None if again else known_proof(raster, device)
        if known is not None and known.passed:
            return known
        log.info(
            "raster=%s: comparing it with the reference on %s, once", raster, _device_name(device)
        )
        proof = prove_apart(raster, str(device))
        try:
            write_json(stamp, proof.to_json())
        except OSError as error:
            log.warning(
                "raster=%s: the proof cannot be kept, so each process repeats it: %s", raster, error
            )
    if proof.passed:
        log.info(
            "raster=%s: agrees with the reference on %s (%.0f s)",
            raster,
            proof.device,
            proof.seconds,
        )
    return proof


def _exclusive(stamp: Path) -> AbstractContextManager[object]:
    """The lock of ``stamp``; if its folder is not writable, no lock."""
    with suppress(OSError):
        stamp.parent.mkdir(parents=True, exist_ok=True)
        if os.access(stamp.parent, os.W_OK):
            return hold(stamp.with_suffix(".lock"), f"the proof of {stamp.stem}")
    return nullcontext()


class Proven(NamedTuple):
    """A rasterizer, its proof, and the better ones that ``raster=auto`` could not use."""

    rasterizer: Rasterizer
    proof: RasterProof | None = None  # None on a CPU
    passed_over: tuple[str, ...] = ()  # a line for each better one, with the reason


def create_proven(name: str, device: torch.device, threads: int | None = None) -> Proven:
    """Make the rasterizer ``name``; on a GPU, its proof must pass.

    Raises InputError if the named executor cannot run or fails its proof or, for ``auto``, if all
    do.
    """
    if device.type != "cuda":
        return Proven(create_rasterizer(name, device, threads))
    candidates = automatic(device.type) if name == AUTO else [resolve(name, device.type)]
    passed_over: list[str] = []
    for executor in candidates:
        try:
            proof = proof_of(executor.name, device)
            reason = "" if proof.passed else _describe(proof, stamp_of(executor.name, device))
        except InputError as error:  # the executor cannot run on this device
            proof, reason = None, str(error)
        if not reason:
            rasterizer = create_rasterizer(executor.name, device, threads)
            if proof is not None and proof.direct_fault:
                log.warning(
                    "raster=%s: steps use autograd and take longer, since %s",
                    executor.name,
                    proof.direct_fault,
                )
                rasterizer.direct_steps = False  # type: ignore[attr-defined]
            return Proven(rasterizer, proof, tuple(passed_over))
        passed_over.append(f"raster={executor.name} is not used: {reason}")
        if name == AUTO:
            log.warning("%s", passed_over[-1])
    raise InputError(f"{'; '.join(passed_over)}; device=cpu trains without a GPU")


def _describe(proof: RasterProof, stamp: Path) -> str:
    more = len(proof.failures) - 1
    versions = ", ".join(f"{name} {version}" for name, version in proof.versions.items())
    return (
        f"it departs from the reference on {proof.device}: "
        f"{proof.failures[0]}{f' (and {more} more)' if more else ''}; "
        f"{versions}; please report it with {stamp}"
    )
