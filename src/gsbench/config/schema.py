"""The schema of the configuration and its checks. Loads neither torch nor the library packages.

Each field's annotation says what values its key takes (see `gsbench.settings`). Rules between the
keys of a group are in its ``__post_init__``. Hydra gets only names and defaults, so that one
mechanism checks every value.
"""

import dataclasses
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

from annotated_types import Interval, Predicate, doc
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from gsbench.config.trust import is_external
from gsbench.errors import InputError
from gsbench.eval.options import EvalConfig
from gsbench.raster.executors import RasterConfig
from gsbench.runs.configuration import GSBENCH, entries_of
from gsbench.runs.layout import IN_RUNS
from gsbench.scene.options import SceneConfig
from gsbench.settings import (
    FOLDER_RULE,
    MAX_INTEGER,
    MISSING,
    Address,
    FolderName,
    PathName,
    TargetName,
    Threads,
    check_values,
    is_folder_name,
)
from gsbench.system.resources import trials_at_once
from gsbench.train.options import BY_AUTOGRAD, IDEAS, TrainConfig, scale_steps

NO_DENSIFIER = "gsbench.densify.NoDensifier"
TUNE = "hydra.sweeper.tune"
# the options of the classes of densifiers and initialisers, which only torch could tell; written by
# scripts/class_defaults.py
CLASS_DEFAULTS = Path(__file__).with_name("class_defaults.json")

ExperimentName = Annotated[
    str,
    Predicate(lambda name: is_folder_name(name) and name.casefold() not in IN_RUNS),
    doc(f"{FOLDER_RULE}, and none of {', '.join(IN_RUNS)}"),
]
DeviceName = Annotated[
    str,
    Predicate(lambda name: re.fullmatch(r"auto|cpu|cuda(:\d{1,3})?", name) is not None),
    doc("auto, cpu, cuda or cuda:1"),
]


@dataclass
class ComponentConfig:
    """The keys that ``init`` and ``densify`` have in common.

    Their other keys are the options of the class.
    """

    name: FolderName
    _target_: TargetName


@dataclass
class TrackingConfig:
    name: str = MISSING
    enabled: bool = True
    # the tracker; further keys are options of a class of your own (`gsbench.tracking.Sink`)
    _target_: TargetName = "gsbench.tracking.MLflow"
    # null: $MLFLOW_TRACKING_URI, else sqlite in the runs folder; W&B: $WANDB_BASE_URL
    uri: Address | None = None
    flush_seconds: PositiveFloat = 60.0  # between two sendings while trials run
    # waiting for a slow tracker at the end; `gsbench sync` sends the rest
    patience_seconds: NonNegativeFloat = 30.0
    images: NonNegativeInt = 4  # test renders mirrored per trial
    model: bool = False  # keep the PLY as an artifact (MLflow, W&B)


@dataclass
class LaunchConfig:
    name: Literal["serial", "local", "slurm"] = MISSING
    # trials at once; auto: as this machine's cores, memory and GPUs allow
    parallel: PositiveInt | Literal["auto"] = 1
    # minutes until a trial is stopped with a checkpoint and queued again
    timeout_min: PositiveInt | None = None
    # look at eval.primary seed by seed; decided pairs of arms get no further seeds
    stop_when_decided: bool = False
    # least difference of eval.primary that matters; null: the usual one
    least_difference: PositiveFloat | None = None
    # Slurm, as all below: wait until all trials have ended; false: submit them and leave
    wait: bool = True
    max_requeues: NonNegativeInt = 20  # how often a trial that ran out of time is queued again
    # a trial is told this long before its time limit to save a checkpoint
    signal_seconds: PositiveInt = 120
    cpus_per_trial: PositiveInt | None = None
    gpus_per_trial: NonNegativeInt = 0
    mem_gb: PositiveInt | None = None  # null: the cluster's default
    partition: str | None = None
    account: str | None = None
    qos: str | None = None
    # shell lines before the trial, such as "module load cuda"
    setup: list[str] = field(default_factory=list)
    # further options of sbatch, such as {constraint: a100}
    sbatch: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.name != "slurm" and not self.wait:
            raise InputError(
                "launch.wait=false leaves the trials to Slurm, so it needs launch=slurm, not "
                f"{self.name}"
            )
        if self.stop_when_decided and not self.wait:
            raise InputError(
                "launch.stop_when_decided looks at results between seeds, so launch.wait must be "
                "true"
            )
        if (
            self.name == "slurm"
            and self.timeout_min is not None
            and self.signal_seconds >= 60 * self.timeout_min
        ):
            raise InputError(
                f"launch.signal_seconds must be below launch.timeout_min ({self.timeout_min} "
                "minutes), "
                f"got {self.signal_seconds}: a trial would be told to stop as soon as it starts"
            )


@dataclass(frozen=True)
class TuneSettings:
    """Settings of a tuning, ``hydra.sweeper.tune`` (`gsbench.app.tuning`).

    ``points`` is the number for each arm; 0: nothing is tuned, and intervals are left out. ``seed``
    lists the seeds of a point's trials. The sweep may have none of them.
    """

    points: NonNegativeInt = 20
    at_once: PositiveInt = 1  # points of an arm that are proposed and trained together
    seed: int | str = 100


@dataclass
class Config:
    """The root of the configuration.

    ``init`` and ``densify`` take any keys, because a user's own class has its own options; so do
    other groups that name a user's class.
    """

    name: ExperimentName = "default"
    seed: Annotated[int, Interval(ge=0, le=MAX_INTEGER)] = 0
    device: DeviceName = "auto"
    threads: Threads | Literal["auto"] = "auto"
    runs: PathName = MISSING
    # names of what may run beside gsbench; only the command line sets them
    allow_targets: list[str] = field(default_factory=list)
    # other questions than each idea against eval.baseline (docs/verdict.md)
    questions: list[Any] = field(default_factory=list)
    # of a command's questions: each idea has 5 %, or all share it
    error_rate: Literal["each", "shared"] = "each"
    scene: SceneConfig = field(default_factory=SceneConfig)
    init: Any = MISSING
    densify: Any = MISSING
    raster: RasterConfig = field(default_factory=RasterConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    eval: EvalConfig = field(default_factory=EvalConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    launch: LaunchConfig = field(default_factory=LaunchConfig)


GROUP_SCHEMAS: dict[str, Any] = {
    entry.name: entry.default_factory
    for entry in dataclasses.fields(Config)
    if dataclasses.is_dataclass(entry.default_factory)
}
COMPONENTS = ("init", "densify")  # groups whose keys are the options of a class
ROOT_SETTINGS = frozenset(
    entry.name
    for entry in dataclasses.fields(Config)
    if entry.name not in (*GROUP_SCHEMAS, *COMPONENTS)
)


@cache
def class_defaults() -> dict[str, dict[str, dict[str, Any]]]:
    """The options that classes add to their base classes, by group and name of the class."""
    return json.loads(CLASS_DEFAULTS.read_text(encoding="utf-8"))


@cache
def register_schemas() -> None:
    """Register the schemas and gsbench's plug-ins with Hydra.

    The root's schema has those of the groups. They are registered by themselves, too, for files of
    users that name one (``defaults: [/schema/scene/base@_here_, _self_]``), under ``schema/``, so
    that Hydra does not offer them as choices. So are the options of classes
    (``/schema/densify/ADC``), on which the files of arms are built.
    """
    store = ConfigStore.instance()
    store.store(name="config_schema", node=_names_and_defaults(Config))
    for group, schema in GROUP_SCHEMAS.items():
        store.store(group=f"schema/{group}", name="base", node=_names_and_defaults(schema))
    for group, classes in class_defaults().items():
        for name, defaults in classes.items():
            store.store(group=f"schema/{group}", name=name, node=defaults)
    settings = {"params": {}, "grids": [], "tune": dataclasses.asdict(TuneSettings())}
    for plugin, own in (("Launcher", {}), ("Sweeper", settings)):
        target = {"_target_": f"hydra_plugins.gsbench.Gsbench{plugin}"}
        store.store(group=f"hydra/{plugin.lower()}", name="gsbench", node=target | own)


@cache
def _names_and_defaults(schema: type) -> type:
    """A dataclass for Hydra with the fields of ``schema``, untyped: `check` checks."""
    fields: list[tuple[str, Any, Any]] = []
    for entry in dataclasses.fields(schema):
        factory: Any = entry.default_factory
        if schema is Config and entry.name in GROUP_SCHEMAS:
            factory = _names_and_defaults(GROUP_SCHEMAS[entry.name])
            if hasattr(factory, "_target_"):  # takes the options of a user's class, too
                factory = partial(OmegaConf.structured, factory, flags={"struct": False})
        elif factory is dict:  # takes any key, without Hydra's plus
            factory = partial(DictConfig, {}, flags={"struct": False})
        fields.append((entry.name, Any, field(default=entry.default, default_factory=factory)))
    return dataclasses.make_dataclass(schema.__name__, fields)


def check(values: dict[str, Any]) -> dict[str, Any]:
    """Convert (``1e3``) and check the values of a configuration by all `RULES`; returns them.

    Classes that a group names check their options themselves, when they are made. Raises InputError
    naming the key.
    """
    for rule in RULES:
        rule(values)
    return values


def plain(values: Any, given: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """Settings as plain Python values of JSON's types.

    A configuration is resolved, except the root's settings that are ``given``, and Hydra's node is
    left out; its ``train`` is changed in place. Tuples, which OmegaConf 2.4 keeps, become lists.
    """
    if isinstance(values, DictConfig):
        if OmegaConf.is_dict(values.get("train")):
            # before ${train.…} is resolved, by which densifiers get their steps
            scale_steps(values.train)
        resolved = {
            str(key): given[str(key)] if key in given else values[key]
            for key in values
            if key != "hydra"
        }
        return {
            key: plain(
                OmegaConf.to_container(value, resolve=True, throw_on_missing=True, enum_to_str=True)
                if OmegaConf.is_config(value)
                else value
            )
            for key, value in resolved.items()
        }
    if isinstance(values, dict):
        return {key: plain(value) for key, value in values.items()}
    return [plain(value) for value in values] if isinstance(values, list | tuple) else values


FIXED_IN_PROGRAMS: tuple[tuple[str, str, Any, str], ...] = (
    ("eval", "at", [], "shows its model only at the end: leave eval.at empty"),
    ("train", "max_seconds", None, "cannot be stopped early: give it fewer train.iterations"),
    *(("train", name, None, f"has its own {name}: leave it out") for name in IDEAS),
)

# ---- rules: each checks the values of a configuration, or converts some in place


def whole_numbers_fit(values: dict[str, Any]) -> None:
    """Refuse a number of more than 64 bits, also among options that a class checks later."""
    for place, key, value in entries_of(values):
        if isinstance(value, int) and abs(value) > MAX_INTEGER:
            raise InputError(
                f"{'.'.join((*place, key))}={value} is not a whole number of 64 bits: give a "
                "nearer one"
            )


def groups_are_chosen(values: dict[str, Any]) -> None:
    for group in (*GROUP_SCHEMAS, *COMPONENTS):
        if not isinstance(values.get(group), dict):
            raise InputError(
                f"{group} must be chosen, as {group}=NAME (see gsbench --help), got "
                f"{values.get(group)!r}"
            )


def values_fit_their_schemas(values: dict[str, Any]) -> None:
    for group, schema in GROUP_SCHEMAS.items():
        given = values[group]
        target = given.get("_target_") or GSBENCH
        if not str(target).startswith(GSBENCH):  # keys that are no settings are its options
            known = {entry.name for entry in dataclasses.fields(schema)}
            given = {key: value for key, value in given.items() if key in known}
        settings = schema(**check_values(schema, given, group))
        values[group] |= plain({key: getattr(settings, key) for key in given})
    # A setting that came later than some results stands only where it is given, so that earlier
    # configurations keep their hashes.
    later = (
        ("scene", ("_target_", "beside", "depth_scale")),
        ("train", (*IDEAS, BY_AUTOGRAD)),
        ("eval", ("regions",)),
    )
    for group, names in later:
        for name in names:
            if not values[group].get(name):
                values[group].pop(name, None)
    root = {key: value for key, value in values.items() if key not in (*GROUP_SCHEMAS, *COMPONENTS)}
    values |= check_values(Config, root, "")
    for group in COMPONENTS:
        named = {key: values[group].get(key) for key in ("name", "_target_")}
        check_values(ComponentConfig, named, group)


def measurements_lie_in_the_training(values: dict[str, Any]) -> None:
    iterations = values["train"]["iterations"]
    if late := [step for step in values["eval"]["at"] if step > iterations]:
        raise InputError(f"eval.at names iteration {late[0]}, and train.iterations is {iterations}")


def white_pictures_have_a_white_background(values: dict[str, Any]) -> None:
    if values["scene"]["transparent"] == "white" and values["train"]["background"] != [1, 1, 1]:
        raise InputError(
            "scene.transparent=white: the model must be rendered over white, too: add "
            "train.background=[1,1,1]"
        )


def nothing_grows_untrained(values: dict[str, Any]) -> None:
    if values["train"]["iterations"] == 0 and values["densify"]["_target_"] != NO_DENSIFIER:
        raise InputError("train.iterations=0 trains nothing, so nothing grows: add densify=none")


def another_program_can_follow(values: dict[str, Any]) -> None:
    for group, key, free, why in FIXED_IN_PROGRAMS if is_external(values["densify"]) else ():
        if values[group].get(key) != free:
            raise InputError(f"{group}.{key}: another program {why}")


def machine_decides_auto(values: dict[str, Any]) -> None:
    if values["launch"]["parallel"] == "auto":
        gaussians = values["densify"].get("max_gaussians")
        values["launch"]["parallel"] = trials_at_once(gaussians, values["device"])


RULES: tuple[Callable[[dict[str, Any]], None], ...] = (
    whole_numbers_fit,
    groups_are_chosen,
    values_fit_their_schemas,
    measurements_lie_in_the_training,
    white_pictures_have_a_white_background,
    nothing_grows_untrained,
    another_program_can_follow,
    machine_decides_auto,
)
