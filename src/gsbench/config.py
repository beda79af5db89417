"""The schema of the configuration, its checks, and where ``conf/`` lies. Loads neither torch nor the library
packages."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from gsbench.errors import InputError
from gsbench.raster import executors
from gsbench.source import source_of

ALLOWED_TARGETS = ("gsbench.",)  # a ``_target_`` is code: only these prefixes, and those in ``allow_targets``


@dataclass
class SceneConfig:
    name: str = MISSING
    kind: str = MISSING  # colmap | photos | courtyard
    path: str | None = None  # folder of the capture
    images: str | None = None  # image folder below path; null: images
    sparse: str | None = None  # model folder below path; null: sparse/0 or sparse
    downscale: int = 1  # divide both sides by it
    max_size: int | None = None  # longest side, px; never enlarges
    resample: str = "lanczos"  # lanczos | area
    max_images: int = 200  # evenly spaced over the sorted names
    test_every: int = 8  # every 8th sorted name is held out
    train_list: str | None = None  # file of names, one a line
    test_list: str | None = None
    principal_point: str = "used"  # used | centred (3DGS ignores it)
    views: int = 48  # courtyard only, as are the next three
    width: int = 400
    height: int = 300
    seed: int = 0


@dataclass
class RasterConfig:
    name: str = MISSING  # auto, or an executor of gsbench.raster.executors
    _target_: str | None = None  # a class of your own, instead; its options are further keys


@dataclass
class TrainConfig:
    name: str = MISSING
    iterations: int = 30_000
    sh_interval: int = 1000  # spherical harmonics gain a degree so often
    ssim_weight: float = 0.2  # loss = 0.8 L1 + 0.2 (1 - SSIM)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    position_initial: float = 1.6e-4  # learning rates; positions times the scene extent
    position_final: float = 1.6e-6
    position_steps: int = 30_000
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    opacity: float = 0.05  # 2023 code; 0.025 in late-2024 code
    scale: float = 5e-3
    rotation: float = 1e-3
    densify_start: int = 500  # the window of the densifiers, which read it from here
    densify_stop: int = 15_000
    densify_interval: int = 100
    opacity_reset_interval: int = 3000
    mcmc_stop: int = 25_000  # 3DGS-MCMC refines for longer
    step_after_refine: bool = False  # True: gsplat's order, the optimiser steps before a refinement and loses no step
    visible_adam: bool = False  # update visible Gaussians only; a departure from the baseline
    max_seconds: float | None = None  # a budget of training time; the run ends at the first iteration past it
    volume_histogram: list[int] = field(default_factory=lambda: [4000, 8000, 12_000])  # iterations (Fig. 5)
    log_every: int = 10
    checkpoint_every: int = 1000  # iterations; a killed trial goes on from the last one
    checkpoint_minutes: float = 10.0  # and after so many minutes, whichever is first


@dataclass
class EvalConfig:
    name: str = MISSING
    protocol: str = MISSING  # paper | standard
    lpips: list[str] = field(default_factory=lambda: ["vgg_raw", "vgg", "alex", "squeeze"])
    flip: bool = True
    at: list[int] = field(default_factory=list)  # iterations at which the test views are measured beside the last
    maps: bool = False  # keep maps of depth, volume and distance to the initial cloud: where an arm helps
    weights: str | None = None  # folder; null: $GSBENCH_WEIGHTS, then the torch hub cache
    download: bool = True  # fetch missing weights, checked by checksum


@dataclass
class TrackingConfig:
    name: str = MISSING
    enabled: bool = True
    uri: str | None = None  # null: sqlite in the runs folder
    flush_seconds: float = 10.0
    patience_seconds: float = 30.0  # with a slow tracker at the end of a trial; `gsbench sync` adds what it missed
    images: int = 4  # test renders mirrored per trial


@dataclass
class LaunchConfig:
    name: str = MISSING  # serial | local | slurm
    parallel: int = 1  # trials at once
    timeout_min: int | None = None  # minutes until a trial is stopped with a checkpoint and queued again
    max_requeues: int = 20  # Slurm only, as are the next: how often a trial may run out of time
    signal_seconds: int = 120  # so long before the end a trial is told to save its checkpoint
    cpus_per_trial: int | None = None
    gpus_per_trial: int = 0
    mem_gb: int | None = None  # null: the cluster's default
    partition: str | None = None
    account: str | None = None
    qos: str | None = None
    setup: list[str] = field(default_factory=list)  # shell lines before the trial, such as "module load cuda"
    sbatch: dict[str, Any] = field(default_factory=dict)  # further options of sbatch, such as {constraint: a100}


@dataclass
class Config:
    """The root. ``init`` and ``densify`` are open, so that a user's own class brings its own keys."""

    name: str = "default"  # the experiment
    seed: int = 0
    device: str = "auto"  # auto | cpu | cuda | cuda:1
    threads: Any = "auto"  # auto | a number
    runs: str = MISSING
    allow_targets: list[str] = field(default_factory=list)  # further prefixes for _target_
    scene: SceneConfig = field(default_factory=SceneConfig)
    init: Any = MISSING
    densify: Any = MISSING
    raster: RasterConfig = field(default_factory=RasterConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    eval: EvalConfig = field(default_factory=EvalConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    launch: LaunchConfig = field(default_factory=LaunchConfig)


GROUP_SCHEMAS = {
    "scene": SceneConfig,
    "raster": RasterConfig,
    "train": TrainConfig,
    "eval": EvalConfig,
    "tracking": TrackingConfig,
    "launch": LaunchConfig,
}
WITHOUT_EFFECT = ("threads", "weights", "download")  # options of a group that cannot change its result
NOT_HASHED = ("name", "seed", "device", "threads", "runs", "allow_targets", "tracking", "launch")
# Settings that are younger than the first results, with the default at which a result is what it was before them. There
# they are left out of hashes and keys, so that nothing is computed anew for a setting that changes nothing.
ADDED_LATER: dict[str, dict[str, Any]] = {
    "raster": {"_target_": None},
    "eval": {"at": []},
}


def register_schemas() -> None:
    """Make the schemas known to Hydra, the groups' under ``schema/`` so that they are not offered as options."""
    store = ConfigStore.instance()
    store.store(name="config_schema", node=Config)
    for group, schema in GROUP_SCHEMAS.items():
        store.store(group=f"schema/{group}", name="base", node=schema)


def conf_dir() -> Path:
    """The folder ``conf``: inside an installed wheel, else beside ``src`` of a checkout."""
    here = Path(__file__).resolve().parent
    for candidate in (here / "conf", here.parents[1] / "conf"):
        if (candidate / "config.yaml").is_file():
            return candidate
    raise FileNotFoundError("gsbench's conf folder was not found; reinstall gsbench")


def check(config: DictConfig) -> None:
    """Rules between fields, before any work. Raises InputError naming the key."""
    rules = [
        ("scene.kind", config.scene.kind in ("colmap", "photos", "courtyard"), "colmap, photos or courtyard"),
        ("scene.resample", config.scene.resample in ("lanczos", "area"), "lanczos or area"),
        ("scene.principal_point", config.scene.principal_point in ("used", "centred"), "used or centred"),
        ("scene.downscale", config.scene.downscale >= 1, "at least 1"),
        ("scene.max_size", config.scene.max_size is None or config.scene.max_size >= 16, "at least 16 px"),
        ("scene.max_images", config.scene.max_images >= 3, "at least 3"),
        ("scene.test_every", config.scene.test_every >= 2, "at least 2"),
        (
            "raster",
            config.raster._target_ is not None or config.raster.name in executors.names(),
            f"one of {', '.join(executors.names())}",
        ),
        ("train.iterations", config.train.iterations >= 1, "at least 1"),
        ("train.sh_interval", config.train.sh_interval >= 1, "at least 1"),
        ("train.ssim_weight", 0 <= config.train.ssim_weight <= 1, "in [0, 1]"),
        ("train.position_steps", config.train.position_steps >= 1, "at least 1"),
        ("train.log_every", config.train.log_every >= 1, "at least 1"),
        ("train.checkpoint_every", config.train.checkpoint_every >= 1, "at least 1"),
        ("train.checkpoint_minutes", config.train.checkpoint_minutes > 0, "above 0"),
        ("train.max_seconds", config.train.max_seconds is None or config.train.max_seconds > 0, "above 0 or null"),
        ("train.background", all(0 <= c <= 1 for c in config.train.background), "three numbers in [0, 1]"),
        ("eval.protocol", config.eval.protocol in ("paper", "standard"), "paper or standard"),
        ("launch", config.launch.name in ("serial", "local", "slurm"), "serial, local or slurm"),
        (
            "launch.timeout_min",
            config.launch.timeout_min is None or config.launch.timeout_min >= 1,
            "at least 1 or null",
        ),
        ("launch.parallel", config.launch.parallel >= 1, "at least 1"),
        ("threads", config.threads == "auto" or _is_positive(config.threads), "auto or a whole number above 0"),
        ("name", _is_folder_name(config.name), "a plain folder name"),
        ("scene.name", _is_folder_name(config.scene.name), "a plain folder name"),
    ]
    rates = ("position_initial", "position_final", "sh_dc", "sh_rest", "opacity", "scale", "rotation")
    rules += [(f"train.{rate}", config.train[rate] > 0, "above 0") for rate in rates]
    for key, holds, rule in rules:
        if not holds:
            raise InputError(f"{key} must be {rule}, got {OmegaConf.select(config, key)!r}")
    if config.scene.kind != "courtyard" and not config.scene.path:
        raise InputError("scene.path is not set: say where the capture lies, for example scene.path=/my/photos")
    for group in ("init", "densify", *(["raster"] if config.raster._target_ is not None else [])):
        check_target(OmegaConf.select(config, f"{group}._target_"), group, config.allow_targets)


def check_target(target: str | None, group: str, allowed: list[str]) -> None:
    """Refuse a ``_target_`` outside gsbench and the prefixes that the user allowed: importing it would run its code."""
    if not target:
        raise InputError(f"{group} names no _target_: the class to use")
    if not any(
        target == prefix or target.startswith(prefix.rstrip(".") + ".") for prefix in (*ALLOWED_TARGETS, *allowed)
    ):
        prefix = target.split(".")[0]
        raise InputError(
            f"{group}._target_={target} is not gsbench's own; if you trust that code, add allow_targets=[{prefix}]"
        )


def plain(config: DictConfig) -> dict[str, Any]:
    """The resolved configuration as plain Python."""
    return OmegaConf.to_container(config, resolve=True, enum_to_str=True)  # type: ignore[return-value]


def config_hash(values: dict[str, Any]) -> str:
    """sha256 of what determines a result apart from the seed: not names, devices, folders, tracking or launchers."""
    kept = {key: value for key, value in values.items() if key not in NOT_HASHED}
    for key, group in kept.items():
        if isinstance(group, dict):
            kept[key] = without_later(key, {name: value for name, value in group.items() if name not in WITHOUT_EFFECT})
            if "_target_" in kept[key]:
                kept[key] |= source_of(group["_target_"])
    return sha256_of(kept)


def without_later(group: str, values: dict[str, Any]) -> dict[str, Any]:
    """``values`` of a group as they are hashed: without the settings of `ADDED_LATER` that stand at their defaults."""
    later = ADDED_LATER.get(group, {})
    return {name: value for name, value in values.items() if name not in later or value != later[name]}


def sha256_of(values: Any) -> str:
    """sha256 of canonical JSON: sorted keys, no spaces, floats by repr."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _is_positive(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


def _is_folder_name(value: str) -> bool:
    return bool(value) and value not in (".", "..") and not set(value) & set("/\\\0")
