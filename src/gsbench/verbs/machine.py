"""Verbs about this machine: ``doctor`` (what is missing, and what is odd about a capture) and
``bench`` (how fast it is)."""

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

from gsbench.errors import InputError
from gsbench.parsing import table_beside
from gsbench.raster.executors import AUTO, EXECUTORS, missing_tools, names, resolve
from gsbench.runs.trial_record import RasterProof
from gsbench.scene.rules import MIN_SIZE
from gsbench.system.install import install_command, version_of
from gsbench.system.programs import allow_modules
from gsbench.system.resources import available_threads, installed_gpus, select_device
from gsbench.verbs.arguments import comma_separated, options_of
from gsbench.words import counted, readable_bytes

LITTLE_SPACE = 5_000_000_000  # bytes
PACKAGES = table_beside(__file__, "packages.yaml")
NOT_SHOWN = ("scene", "threads", "device")  # columns that only the JSON of `bench` has
MAX_SIDE = 16_384  # px
# the errors of a proof that its line shows
SHOWN_ERRORS = ("image", "gradient of means", "gradient of log_scales", "trained image")
RASTERS = names()

Verdict = Literal["ok", "note", "bad"]


# The result of one check: it is ok, worth a note, or bad (gsbench will not work); topic, and text
Finding = tuple[Verdict, str, str]


def doctor(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 1 if something is bad, or if a proof fails."""
    options = options_of("doctor", argv)
    if options.prove:
        return _prove(options.raster, options.device, options.json)
    if options.json or options.raster != AUTO or options.device != "auto":
        raise InputError("doctor: --raster, --device and --json belong to --prove")
    code = 0
    findings = check_scene(options.words) if options.words else check_machine(runs)
    for verdict, topic, text in findings:
        print(f"{verdict:<5} {topic:<12} {text}")
        if verdict == "bad":
            code = 1
    return code


def _prove(raster: str, device_name: str, as_json: bool) -> int:
    from gsbench.train.proof import proof_of, stamp_of

    device = select_device(device_name, "--device")
    name = resolve(raster, device.type).name
    proof = proof_of(name, device, again=True)
    if as_json:
        print(json.dumps(proof.to_json() | {"passed": proof.passed}, indent=2))
    else:
        print("\n  ".join([_describe(proof), *proof.failures]))
        if not proof.passed:
            versions = ", ".join(f"{name} {version}" for name, version in proof.versions.items())
            print(f"{versions}; please report it with {stamp_of(name, device)}")
    return 0 if proof.passed else 1


def _describe(proof: RasterProof) -> str:
    """A proof in one line."""
    verdict = "agrees with" if proof.passed else "departs from"
    largest = ", ".join(
        f"{quantity} {proof.errors[quantity]:.1e}"
        for quantity in SHOWN_ERRORS
        if quantity in proof.errors
    )
    return (
        f"raster={proof.raster} {verdict} the reference on {proof.device} ({proof.seconds:.0f} "
        f"s): {largest}"
        + (f"; steps use autograd, since {proof.direct_fault}" if proof.direct_fault else "")
    )


def check_scene(words: Sequence[str]) -> Iterator[Finding]:
    """The rules (docs/captures.md) that say something about a scene, before anything is trained.

    Their lines are logged; what is not usable raises InputError. Photographs without cameras get
    none here, so rules about cameras and views are left to their trial.
    """
    from gsbench.renders.sources import scene_trial
    from gsbench.runs.keys import INIT, TRAIN

    trial, views = scene_trial(words), False
    for step in trial.steps():
        if views := step.stage is TRAIN:
            break
        if step.stage is INIT and trial.capture.model is None:
            break
        trial.store.get(step)
    capture = trial.capture
    odd = [*capture.oddities, *(trial.views.scene.oddities if views else ())]
    yield (
        "note" if odd else "ok",
        str(capture.name),
        f"{counted(len(capture.image_names), 'photograph')}, {len(capture.test_names)} for testing"
        f" ({capture.held_out}); odd: {', '.join(one.rule for one in odd) or 'nothing'}",
    )


def check_machine(runs: Path) -> Iterator[Finding]:
    """Findings about all that gsbench uses on this machine."""
    yield from check_packages()
    yield from check_devices()
    yield from check_proofs()
    yield from check_weights()
    yield from check_runs(runs)


def check_proofs() -> Iterator[Finding]:
    """Findings about the proofs of rasterizers on the devices here; nothing is rendered."""
    import torch

    from gsbench.train.proof import known_proof

    for place in ("cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))):
        device = torch.device(place)
        for executor in EXECUTORS:
            if executor.obstacle(device.type) is not None:
                continue
            proof = known_proof(executor.name, device)
            if proof is not None:
                yield "ok" if proof.passed else "bad", "proof", _describe(proof)
            elif device.type == "cuda" and executor.devices:
                yield (
                    "note",
                    "proof",
                    f"raster={executor.name} on {place}: none yet; its first use makes it",
                )


def check_packages() -> Iterator[Finding]:
    """The versions of gsbench, Python and the packages that gsbench imports."""
    from gsbench import __version__

    yield "ok", "gsbench", f"{__version__} in {Path(__file__).resolve().parents[1]}"
    yield (
        "ok",
        "python",
        f"{sys.version.split()[0]} ({sys.executable}), {available_threads()} cores to use",
    )
    for name in PACKAGES["required"]:
        installed = version_of(name)
        text = installed or f"missing: {install_command()}"
        yield "ok" if installed else "bad", name, text
    for name, (purpose, extra) in PACKAGES["optional"].items():
        installed = version_of(name)
        text = installed or f"not installed; needed for {purpose}: {install_command(extra)}"
        yield "ok" if installed else "note", name, text


def check_devices() -> Iterator[Finding]:
    """Findings about torch, the GPUs that it can use or not, and each device's rasterizers."""
    try:
        import torch
    except (ImportError, OSError) as error:
        first_line = str(error).partition("\n")[0]
        yield "bad", "torch", f"cannot be imported ({first_line}): pip install torch"
        return
    yield "ok", "torch", str(torch.__version__)
    devices = ["cpu"]
    if torch.cuda.is_available():
        devices.append("cuda")
        verdict: Verdict = "ok" if torch.version.hip is None else "note"
        after = ": AMD, never tested" if torch.version.hip else ""
        for index in range(torch.cuda.device_count()):
            free, total = map(readable_bytes, torch.cuda.mem_get_info(index))
            name = torch.cuda.get_device_name(index)
            yield verdict, "gpu", f"{name}, {free} of {total} free{after}"
    else:
        listed = len(installed_gpus())
        cause = "this torch is a build for CPUs"
        if torch.version.cuda is not None:
            cause = "torch finds no usable NVIDIA driver; does nvidia-smi run?"
        elif listed:
            cause = f"{counted(listed, 'NVIDIA GPU')} here, but {cause}: see pytorch.org"
        yield "note", "gpu", f"none ({cause}): raster=auto uses the CPU"
    for executor in EXECUTORS:
        usable = [device for device in devices if executor.obstacle(device) is None]
        name = f"raster={executor.name}"
        if usable:
            yield "ok", "rasterizer", f"{name} on {' and '.join(usable)}: {executor.text}"
        else:
            yield "note", "rasterizer", f"{name} {executor.obstacle(devices[-1])}"
    chosen = " and ".join(f"{resolve('auto', device).name} on {device}" for device in devices)
    yield "ok", "rasterizer", f"raster=auto is {chosen}"
    # Triton comes with torch for CUDA: without it there is no GPU to run it on.
    if version_of("triton") and (missing := missing_tools()):
        text = f"at its first run on a GPU it needs {' and '.join(missing)}"
        yield "note", "triton", text


def check_weights() -> Iterator[Finding]:
    """Findings about the weights of networks that are here; nothing is downloaded."""
    from gsbench.eval.lpips import BACKBONES
    from gsbench.init.dim import EXTRACTOR_WEIGHTS, LIGHTGLUE_WEIGHTS
    from gsbench.weights import MissingWeightsError, find_weights

    wanted = {f"LPIPS {name}": backbone.features for name, backbone in BACKBONES.items()}
    wanted |= {f"LPIPS {name} heads": backbone.heads for name, backbone in BACKBONES.items()}
    wanted |= {f"init=dim {name}": spec for name, spec in EXTRACTOR_WEIGHTS.items()}
    wanted |= {f"LightGlue for {name}": spec for name, spec in LIGHTGLUE_WEIGHTS.items()}
    for purpose, spec in wanted.items():
        try:
            text = str(find_weights(spec, download=False))
            verdict: Verdict = "ok"
        except MissingWeightsError as error:
            verdict, text = "note", str(error)
        yield verdict, "weights", f"{purpose}: {text}"


def check_runs(runs: Path) -> Iterator[Finding]:
    """Finding about the runs folder: whether it can be written to, and its free space."""
    place = next(folder for folder in (runs, *runs.absolute().parents) if folder.exists())
    try:
        with tempfile.TemporaryFile(dir=place):
            free = shutil.disk_usage(place).free
    except OSError:
        yield "bad", "runs", f"{runs} cannot be written to: set GSBENCH_RUNS"
    else:
        verdict: Verdict = "note" if free < LITTLE_SPACE else "ok"
        yield verdict, "runs", f"{runs}, {readable_bytes(free)} free"


def bench(argv: Sequence[str], _runs: Path | None = None) -> int:
    """Print the table, or with ``--json`` the list of results."""
    options = options_of("bench", argv)
    if options.ply is not None and not options.ply.is_file():
        raise InputError(f"--ply: {options.ply} does not exist")
    rasters = options.raster.split(",")
    if AUTO in rasters:
        raise InputError(f"--raster {AUTO} is a choice among executors: name those to time")
    # the user typed them, which allows them
    allow_modules([raster for raster in rasters if "." in raster])

    from gsbench.bench.measure import Setting, run_bench

    ply = options.ply and options.ply.absolute()
    settings = [
        Setting(options.scene, width, height, count, ply, options.threads)
        for width, height in options.size
        for count in (options.count if ply is None else [0])
    ]
    found = run_bench(rasters, settings, options.repeats, not options.no_memory)
    print(json.dumps(found, indent=2) if options.json else table(found))
    return 0


def table(rows: list[dict[str, Any]]) -> str:
    """The results as aligned columns of text. Columns that no result has are left out."""
    import pandas as pd  # here, for a quick answer to --help

    used = (
        pd.DataFrame(rows)
        .drop(columns=list(NOT_SHOWN), errors="ignore")
        .dropna(axis="columns", how="all")
    )
    return used.to_string(
        index=False,
        na_rep="-",
        formatters={"step_ratio": "{:.2f}".format},
        float_format="{:.1f}".format if "raster" in used else "{:.3f}".format,
    )


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not all(
        side.isascii() and side.isdigit() and MIN_SIZE <= int(side) <= MAX_SIDE
        for side in (width, height)
    ):
        raise argparse.ArgumentTypeError(
            f"a size is WIDTHxHEIGHT, sides from {MIN_SIZE} to {MAX_SIDE} px, for example "
            f"500x375, got {text!r}"
        )
    return int(width), int(height)


sizes = comma_separated(_size)
