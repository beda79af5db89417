"""The schema of the configuration, its checks, and where ``conf/`` lies. Loads neither torch nor the library
packages.

What a key may be stands at its field (see `gsbench.settings`), rules between the keys of a group in its
``__post_init__``. Hydra gets the names and the defaults alone, so that one mechanism checks every value.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Interval, Predicate, doc
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.eval.facts import FLICKER, GEOMETRY, LPIPS, MORE, find, further_keys, known_keys, lpips_variants
from gsbench.eval.protocol import PROTOCOLS
from gsbench.external.placeholders import program_of
from gsbench.raster import executors
from gsbench.runs.layout import IN_RUNS
from gsbench.scene.sizes import MIN_SIZE, check_final_size
from gsbench.settings import Fraction, PathName, check_settings, checked
from gsbench.words import closest

ALLOWED_TARGETS = ("gsbench.",)  # a ``_target_`` is code: only these prefixes, and those in ``allow_targets``
NO_DENSIFIER = "gsbench.densify.NoDensifier"
EXTERNAL = "gsbench.densify.External"  # another program trains
MAX_SIZE = 16_384  # px, of a picture of the courtyard
MAX_SEED = 2**63 - 1  # torch's generators take no larger one
MAX_NAME_BYTES = 100  # of a name: folders are made of two, and file systems end at 255
METRIC_NAME = re.compile(r"[a-z][a-z0-9_]*")
TAKEN_NAMES = (*known_keys(), "view", "lpips")  # of metrics, and what else a table of views or a list of metrics means


def is_folder_name(value: str) -> bool:
    """Whether a text can name a folder, on any system and in the address of a trial (``x:scene:arm:0``)."""
    is_plain = value.isprintable() and not set(value) & set('/\\:*?"<>|') and value == value.strip()
    return is_plain and value[:1] not in ("", ".", "-") and len(value.encode()) <= MAX_NAME_BYTES


def is_address(value: str) -> bool:
    """Whether a text can be the address of a tracker."""
    return re.fullmatch(r"[a-z][a-z0-9+.-]*://\S*", value) is not None and value.isprintable()


def are_different(values: list[Any]) -> bool:
    """Whether no value stands twice in a list."""
    return len(set(values)) == len(values)


FolderName = Annotated[str, Predicate(is_folder_name), doc("a plain folder name")]
ExperimentName = Annotated[
    str,
    Predicate(lambda name: is_folder_name(name) and name not in IN_RUNS),
    doc(f"a plain folder name, and none of {', '.join(IN_RUNS)}"),
]
Address = Annotated[str, Predicate(is_address), doc("an address such as http://HOST:PORT")]
TargetName = Annotated[
    str,
    Predicate(lambda name: "." in name and all(part.isidentifier() for part in name.split("."))),
    doc("the import path of a class, such as mine.MyClass"),
]
ProtocolName = Annotated[
    str, Predicate(lambda name: name in PROTOCOLS), doc(" or ".join(f"'{name}'" for name in PROTOCOLS))
]
AT_RULE = "a list of different iterations, at which the test views are measured beside the last"
LPIPS_RULE = f"a list of {', '.join(lpips_variants())}, each at most once"
LpipsVariant = Annotated[str, Predicate(lambda name: name in lpips_variants())]
MORE_RULE = f"a list of {', '.join(further_keys())}, each at most once"
FurtherMetric = Annotated[str, Predicate(lambda name: name in further_keys())]
DeviceName = Annotated[
    str,
    Predicate(lambda name: re.fullmatch(r"auto|cpu|cuda(:\d{1,3})?", name) is not None),
    doc("auto, cpu, cuda or cuda:1"),
]


@dataclass
class SceneConfig:
    name: FolderName = MISSING
    kind: Literal["colmap", "photos", "courtyard"] = MISSING
    path: PathName | None = None  # folder of the capture
    images: PathName | None = None  # image folder below path; null: images
    sparse: PathName | None = None  # model folder below path; null: sparse/0 or sparse
    downscale: PositiveInt = 1  # divide both sides by it
    max_size: Annotated[int, Ge(MIN_SIZE)] | None = None  # longest side, px; never enlarges
    resample: Literal["lanczos", "area"] = "lanczos"
    max_images: Annotated[int, Ge(3)] = 200  # evenly spaced over the sorted names
    test_every: Annotated[int, Ge(2)] = 8  # every 8th sorted name is held out
    train_list: PathName | None = None  # file of names, one a line
    test_list: PathName | None = None
    principal_point: Literal["used", "centred"] = "used"  # 3DGS ignores it
    views: Annotated[int, Interval(ge=3, le=9999)] = 48  # courtyard only, as are the next three
    width: Annotated[int, Interval(ge=MIN_SIZE, le=MAX_SIZE)] = 400
    height: Annotated[int, Interval(ge=MIN_SIZE, le=MAX_SIZE)] = 300
    seed: Annotated[int, Interval(ge=0, le=2**31 - 1)] = 0

    def __post_init__(self) -> None:
        check_settings(self, "scene")
        if self.kind != "courtyard" and not self.path:
            raise InputError("scene.path is not set: say where the capture lies, for example scene.path=/my/photos")
        if self.kind == "courtyard":
            check_final_size((self.width, self.height), self.downscale, self.max_size, "the courtyard")


@dataclass
class RasterConfig:
    name: str = MISSING  # auto, or an executor of gsbench.raster.executors
    _target_: TargetName | None = None  # a class of your own, instead; its options are further keys

    def __post_init__(self) -> None:
        check_settings(self, "raster")
        if self._target_ is None and self.name not in executors.names():
            choices = ", ".join(executors.names())
            raise InputError(
                f"raster must be one of {choices}, got {self.name!r}{closest(self.name, executors.names())}"
            )


@dataclass
class TrainConfig:
    name: str = MISSING
    iterations: NonNegativeInt = 30_000  # 0: what the initialiser gives is evaluated as it is
    sh_interval: PositiveInt = 1000  # spherical harmonics gain a degree so often
    ssim_weight: Fraction = 0.2  # loss = 0.8 L1 + 0.2 (1 - SSIM)
    background: tuple[Fraction, Fraction, Fraction] = (0.0, 0.0, 0.0)
    position_initial: PositiveFloat = 1.6e-4  # learning rates; positions times the scene extent
    position_final: PositiveFloat = 1.6e-6
    position_steps: PositiveInt = 30_000
    sh_dc: PositiveFloat = 2.5e-3
    sh_rest: PositiveFloat = 1.25e-4
    opacity: PositiveFloat = 0.05  # 2023 code; 0.025 in late-2024 code
    scale: PositiveFloat = 5e-3
    rotation: PositiveFloat = 1e-3
    densify_start: NonNegativeInt = 500  # the window of the densifiers, which read it from here
    densify_stop: NonNegativeInt = 15_000
    densify_interval: PositiveInt = 100
    opacity_reset_interval: PositiveInt = 3000
    mcmc_stop: NonNegativeInt = 25_000  # 3DGS-MCMC refines for longer
    step_after_refine: bool = False  # True: gsplat's order, the optimiser steps before a refinement and loses no step
    visible_adam: bool = False  # update visible Gaussians only; a departure from the baseline
    max_seconds: PositiveFloat | None = None  # a budget of training time; the run ends at the first iteration past it
    volume_histogram: list[NonNegativeInt] = field(default_factory=lambda: [4000, 8000, 12_000])  # iterations (Fig. 5)
    log_every: PositiveInt = 10
    checkpoint_every: PositiveInt = 1000  # iterations; a killed trial goes on from the last one
    checkpoint_minutes: PositiveFloat = 10.0  # and after so many minutes, whichever is first

    def __post_init__(self) -> None:
        check_settings(self, "train")


@dataclass
class EvalConfig:
    name: str = MISSING
    protocol: ProtocolName = MISSING
    lpips: Annotated[list[LpipsVariant], Predicate(are_different), doc(LPIPS_RULE)] = field(
        default_factory=lambda: list(lpips_variants())
    )
    flip: bool = True
    more: Annotated[list[FurtherMetric], Predicate(are_different), doc(MORE_RULE)] = field(default_factory=list)
    extra: dict[str, Any] = field(default_factory=dict)  # metrics of your own: {name: {_target_: mine.MyMetric}}
    at: Annotated[list[PositiveInt], Predicate(are_different), doc(AT_RULE)] = field(default_factory=list)
    primary: str | None = None  # the metric of the verdict, declared before results are seen; null: none was
    maps: bool = False  # keep maps of depth, volume and distance to the initial cloud: where an arm helps
    geometry: bool = False  # measure depths and surfaces of the model, and what floats in front of them
    flicker: bool = False  # measure how neighbouring renders of a camera path differ
    weights: PathName | None = None  # folder; null: $GSBENCH_WEIGHTS, then the torch hub cache
    download: bool = True  # fetch missing weights, checked by checksum

    def __post_init__(self) -> None:
        check_settings(self, "eval")
        for name, options in self.extra.items():
            if not METRIC_NAME.fullmatch(name) or name in TAKEN_NAMES:
                raise InputError(
                    f"eval.extra.{name}: name your metric in small letters, digits and underscores, and none of "
                    f"{', '.join(TAKEN_NAMES)}"
                )
            if not isinstance(options, Mapping) or "_target_" not in options:
                raise InputError(f"eval.extra.{name} must name a class, as eval.extra.{name}._target_=mine.MyMetric")
        if self.primary is not None and self.primary not in self.extra:
            self._check_primary(self.primary)

    def _check_primary(self, key: str) -> None:
        """Raise InputError unless one of gsbench's own metrics, which these settings ask for, has this key."""
        facts = find(key)
        if facts is None:
            known = [*known_keys(), *self.extra]
            raise InputError(
                f"eval.primary={key} is no metric{closest(key, known)} (known are {', '.join(known)}; a metric of your "
                "own by the name that it has under eval.extra)"
            )
        if facts.setting == "eval.flip" and not self.flip:
            raise InputError("eval.primary=flip is not measured with eval.flip=false")
        for setting, asked in ((GEOMETRY, self.geometry), (FLICKER, self.flicker)):
            if facts.setting == setting and not asked:
                raise InputError(f"eval.primary={key} is not measured: add {setting}=true")
        if facts.setting == MORE and key not in self.more:
            raise InputError(f"eval.primary={key} is not measured: add {key} to eval.more")
        if facts.setting == "eval.lpips" and key.removeprefix(LPIPS) not in self.lpips:
            raise InputError(f"eval.primary={key} is not measured: add {key.removeprefix(LPIPS)} to eval.lpips")


@dataclass
class ComponentConfig:
    """What ``init`` and ``densify`` have in common; their other keys are the options of the class."""

    name: FolderName
    _target_: TargetName


@dataclass
class TrackingConfig:
    name: str = MISSING
    enabled: bool = True
    uri: Address | None = None  # null: $MLFLOW_TRACKING_URI, else sqlite in the runs folder
    flush_seconds: PositiveFloat = 10.0
    patience_seconds: NonNegativeFloat = 30.0  # with a slow tracker, at the end of a trial; `gsbench sync` mends it
    images: NonNegativeInt = 4  # test renders mirrored per trial
    model: bool = False  # keep the PLY as an artifact
    system_metrics: bool = False  # MLflow's own: processors, memory, disk, network, GPUs

    def __post_init__(self) -> None:
        check_settings(self, "tracking")


@dataclass
class LaunchConfig:
    name: Literal["serial", "local", "slurm"] = MISSING
    parallel: PositiveInt = 1  # trials at once
    timeout_min: PositiveInt | None = None  # minutes until a trial is stopped with a checkpoint and queued again
    wait: bool = True  # Slurm only, as are the next: until all trials have ended; false: submit them and leave
    max_requeues: NonNegativeInt = 20  # how often a trial may run out of time
    signal_seconds: PositiveInt = 120  # so long before the end a trial is told to save its checkpoint
    cpus_per_trial: PositiveInt | None = None
    gpus_per_trial: NonNegativeInt = 0
    mem_gb: PositiveInt | None = None  # null: the cluster's default
    partition: str | None = None
    account: str | None = None
    qos: str | None = None
    setup: list[str] = field(default_factory=list)  # shell lines before the trial, such as "module load cuda"
    sbatch: dict[str, Any] = field(default_factory=dict)  # further options of sbatch, such as {constraint: a100}

    def __post_init__(self) -> None:
        check_settings(self, "launch")
        if self.name != "slurm" and not self.wait:
            raise InputError(f"launch.wait=false leaves the trials to Slurm, so it needs launch=slurm, not {self.name}")
        if self.name == "slurm" and self.timeout_min is not None and self.signal_seconds >= 60 * self.timeout_min:
            raise InputError(
                f"launch.signal_seconds must be below launch.timeout_min ({self.timeout_min} minutes), "
                f"got {self.signal_seconds}: a trial would be told to stop as soon as it starts"
            )


@dataclass
class Config:
    """The root. ``init`` and ``densify`` are open, so that a user's own class brings its own keys."""

    name: ExperimentName = "default"
    seed: Annotated[int, Interval(ge=0, le=MAX_SEED)] = 0
    device: DeviceName = "auto"
    threads: PositiveInt | Literal["auto"] = "auto"
    runs: PathName = MISSING
    allow_targets: list[str] = field(default_factory=list)  # further prefixes for _target_
    scene: SceneConfig = field(default_factory=SceneConfig)
    init: Any = MISSING
    densify: Any = MISSING
    raster: RasterConfig = field(default_factory=RasterConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    eval: EvalConfig = field(default_factory=EvalConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    launch: LaunchConfig = field(default_factory=LaunchConfig)


GROUP_SCHEMAS: dict[str, type] = {
    "scene": SceneConfig,
    "raster": RasterConfig,
    "train": TrainConfig,
    "eval": EvalConfig,
    "tracking": TrackingConfig,
    "launch": LaunchConfig,
}
COMPONENTS = ("init", "densify")  # groups whose keys are the options of a class


def register_schemas() -> None:
    """Make the schemas known to Hydra, the groups' under ``schema/`` so that they are not offered as options."""
    store = ConfigStore.instance()
    store.store(name="config_schema", node=_names_and_defaults(Config))
    for group, schema in GROUP_SCHEMAS.items():
        store.store(group=f"schema/{group}", name="base", node=_names_and_defaults(schema))


@cache
def _names_and_defaults(schema: type) -> type:
    """A dataclass for Hydra with the fields of ``schema`` and no types: what values are allowed is said by `check`."""
    fields: list[tuple[str, Any, Any]] = []
    for entry in dataclasses.fields(schema):
        factory: Any = entry.default_factory
        if schema is Config and entry.name in GROUP_SCHEMAS:
            factory = _names_and_defaults(GROUP_SCHEMAS[entry.name])
        elif factory is dict:  # takes any key, without Hydra's plus
            factory = partial(DictConfig, {}, flags={"struct": False})
        fields.append((entry.name, Any, field(default=entry.default, default_factory=factory)))
    return dataclasses.make_dataclass(schema.__name__, fields)


def conf_dir() -> Path:
    """The folder ``conf``: inside an installed wheel, else beside ``src`` of a checkout."""
    here = Path(__file__).resolve().parent
    for candidate in (here / "conf", here.parents[1] / "conf"):
        if (candidate / "config.yaml").is_file():
            return candidate
    raise FileNotFoundError("gsbench's conf folder was not found; reinstall gsbench")


def check_values(config: DictConfig) -> None:
    """Hold the values of a composed configuration against their schemas, and convert them (``1e3`` to 1000).

    The classes that ``init`` and ``densify`` name check their own options when they are made. Raises InputError naming
    the key.
    """
    for group, schema in GROUP_SCHEMAS.items():
        _convert(config[group], schema, _settings_of(config, group), group)
    groups = (*GROUP_SCHEMAS, *COMPONENTS)
    _convert(config, Config, {str(key): _unwrapped(config[key]) for key in config if key not in groups}, "")


def check(config: DictConfig) -> None:
    """`check_values`, and the rules between values: whether a trial can be made of the configuration."""
    check_values(config)
    for group, schema in GROUP_SCHEMAS.items():
        schema(**_settings_of(config, group))
    for group in COMPONENTS:
        values = _group(config, group)
        checked(ComponentConfig, {key: values.get(key) for key in ("name", "_target_")}, group)
    if late := [step for step in config.eval.at if step > config.train.iterations]:
        raise InputError(f"eval.at names iteration {late[0]}, and train.iterations is {config.train.iterations}")
    if config.train.iterations == 0 and config.densify.get("_target_") != NO_DENSIFIER:
        raise InputError("train.iterations=0 trains nothing, so nothing grows: add densify=none")
    if config.densify.get("_target_") == EXTERNAL:
        check_external(config)
    for group in (*COMPONENTS, *(["raster"] if config.raster._target_ is not None else [])):
        check_target(config[group].get("_target_"), group, config.allow_targets)
    for name, options in config.eval.extra.items():
        check_target(options["_target_"], f"eval.extra.{name}", config.allow_targets)


def require_values(values: Mapping[str, Any], group: str) -> None:
    """Raise InputError for the first setting of ``group`` that must be given and is not."""
    for key, value in values.items():
        if value == MISSING:
            raise InputError(f"{group}.{key} is not set: give it a value")


def _settings_of(config: DictConfig, group: str) -> dict[str, Any]:
    """The values of a group that its schema knows: all, but for those that are options of a user's own class."""
    values = _group(config, group)
    require_values(values, group)
    return {key: values.get(key) for key in ("name", "_target_")} if values.get("_target_") is not None else values


def _group(config: DictConfig, group: str) -> dict[str, Any]:
    node = config.get(group)
    if not isinstance(node, DictConfig):
        raise InputError(f"{group} must be chosen, as {group}=NAME (see gsbench --help), got {node!r}")
    return plain(node)


def _unwrapped(value: Any) -> Any:
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


def _convert(node: DictConfig, schema: type, given: Mapping[str, Any], group: str) -> None:
    """Hold ``given``, what ``node`` has, against the fields of ``schema``, and convert it in ``node``."""
    prefix = f"{group}." if group else ""
    for name in (entry.name for entry in dataclasses.fields(schema)):
        if name not in given and name != "_target_" and name not in GROUP_SCHEMAS and name not in COMPONENTS:
            raise InputError(f"{prefix}{name} has been taken away: give it a value instead")
    for key, value in checked(schema, given, group).items():
        value = list(value) if isinstance(value, tuple) else value
        if repr(value) != repr(given[key]):
            node[key] = value


def check_target(target: str | None, group: str, allowed: list[str]) -> None:
    """Refuse a ``_target_`` outside gsbench and the prefixes that the user allowed: importing it would run its code."""
    if not target:
        raise InputError(f"{group} names no _target_: the class to use")
    if not any(
        target == prefix or target.startswith(prefix.rstrip(".") + ".") for prefix in (*ALLOWED_TARGETS, *allowed)
    ):
        prefix = target.split(".")[0]
        raise InputError(
            f"{group}._target_={target} is not gsbench's own{closest(prefix, allowed)}; if you trust that code, "
            f"add allow_targets=[{prefix}]"
        )


def check_external(config: DictConfig) -> None:
    """What another program can be asked for, and whether the user allowed it to run."""
    settings = _group(config, "densify")
    require_values(settings, "densify")
    if config.eval.at:
        raise InputError("eval.at: another program's model is seen at its end only: leave eval.at empty")
    if config.train.max_seconds is not None:
        raise InputError("train.max_seconds: another program cannot be stopped early: give it fewer train.iterations")
    program = program_of(settings["command"], settings["options"] or {})
    if program not in config.allow_targets:
        raise InputError(
            f"densify={settings['name']} runs the program {program!r}; if you trust it, add allow_targets=[{program}]"
        )


def plain(config: DictConfig) -> dict[str, Any]:
    """The resolved configuration as plain Python."""
    return OmegaConf.to_container(config, resolve=True, enum_to_str=True)  # type: ignore[return-value]
