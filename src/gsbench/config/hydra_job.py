"""A trial as a job of Hydra: what ``${hydra:…}``, ``hydra.job.env_set``, Hydra's folders and callbacks belong to."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeVar

from hydra.core.utils import run_job, setup_globals
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from gsbench.config.hydra_guard import make_callbacks
from gsbench.errors import InputError
from gsbench.logs import show_details

if TYPE_CHECKING:
    from hydra._internal.callbacks import Callbacks
    from hydra.core.config_loader import ConfigLoader

CONFIG_NAME = "config"  # conf/config.yaml
OWN_NAME = ".hydra"  # of the folder of Hydra's files in the runs folder
OWN_FOLDER = f"${{runs}}/{OWN_NAME}"  # as conf/config.yaml has it
Result = TypeVar("Result")


@dataclass(frozen=True)
class HydraJob:
    """One job of a run or sweep.

    ``words`` are the job's own and ``number`` its place in the sweep; a single run has none. ``config`` is the job's
    configuration with the node ``hydra``. A job whose trial shares the composition of another has None, and is composed
    from that of the sweep, ``master``, when it begins: so every job is composed once.
    """

    config: DictConfig | None
    words: tuple[str, ...] = ()
    number: int | None = None
    master: DictConfig | None = None
    loader: ConfigLoader | None = None
    callbacks: Callbacks | None = None  # None: made anew from the configuration

    def composed(self) -> DictConfig:
        """The job's configuration with the node ``hydra``."""
        if self.config is not None:
            return start(self.config, RunMode.RUN if self.number is None else RunMode.MULTIRUN)
        assert self.loader is not None
        assert self.master is not None
        assert self.number is not None
        config = self.loader.load_sweep_config(self.master, list(self.words))
        number_job(config, self.number)
        return start(config, RunMode.MULTIRUN)

    def for_another_process(self) -> HydraJob:
        """The same job without what belongs to this process; the classes of a user's callbacks are imported there."""
        return replace(self, config=self.composed(), master=None, loader=None, callbacks=None)

    def run(self, work: Callable[[], Result], value_of: Callable[[Result], object]) -> Result:
        """Do ``work`` as Hydra runs a job; ``value_of`` its result is what callbacks are told. Raises what it raises.

        Hydra would hand an error back in place of a result, and write a line of its own on looking at it.
        """
        setup_globals()  # the resolvers, in a process where nothing was composed
        config = self.composed()
        show_details(config.hydra.verbose)
        ended: list[Result] = []
        errors: list[Exception] = []

        def task(_: DictConfig) -> object:
            try:
                ended.append(work())
            except Exception as error:
                errors.append(error)
                raise
            return value_of(ended[0])

        callbacks = self.callbacks if self.callbacks is not None else make_callbacks(config)
        folder, subfolder = (
            ("hydra.run.dir", None) if self.number is None else ("hydra.sweep.dir", "hydra.sweep.subdir")
        )
        context = HydraContext(self.loader, callbacks)  # type: ignore[arg-type] # a job asks it for callbacks alone
        run_job(task, config, folder, subfolder, hydra_context=context, configure_logging=False)
        if errors:
            raise errors[0]
        return ended[0]


def number_job(config: DictConfig, number: int) -> None:
    """Give a job its place in the sweep."""
    with read_write(config.hydra), open_dict(config.hydra):
        config.hydra.job.num = number
        config.hydra.job.id = str(number)


def begin_sweep(master: DictConfig) -> None:
    """Resolve every ``${now:…}`` of a sweep, so that its jobs, which take over what is resolved, have one time."""
    for place, value in _texts(OmegaConf.to_container(master, resolve=False)):
        if "${now:" in value:
            with suppress(OmegaConfBaseException):  # such as a part that only a job knows
                OmegaConf.select(master, place)


def record_sweep(master: DictConfig) -> None:
    """Write ``multirun.yaml``, Hydra's record of a sweep, to a ``hydra.sweep.dir`` that is not gsbench's own."""
    raw: Any = OmegaConf.to_container(master.hydra.sweep, resolve=False)
    if raw["dir"] != OWN_FOLDER:
        folder = Path(str(master.hydra.sweep.dir))
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(master, folder / "multirun.yaml")


def _texts(values: Any, place: str = "") -> Iterator[tuple[str, str]]:
    """The texts at any depth, each with the key that leads to it; keys of other forms than OmegaConf's are left out."""
    if isinstance(values, str) and place:
        yield place, values
    elif isinstance(values, dict | list):
        for key, value in values.items() if isinstance(values, dict) else enumerate(values):
            if re.fullmatch(r"[\w/-]+", str(key)):
                yield from _texts(value, f"{place}.{key}" if place else str(key))


def start(config: DictConfig, mode: RunMode) -> DictConfig:
    """``config`` with the mode it runs in, which Hydra takes from a command line as well as from a file."""
    with read_write(config.hydra), open_dict(config.hydra):
        config.hydra.mode = mode
    return config


def check_output_folder(master: DictConfig, multirun: bool) -> None:
    """Refuse a folder for Hydra's own files that cannot be made, before any work; the default is in the runs folder.

    One whose name only a job knows is left to that job.
    """
    key = "hydra.sweep.dir" if multirun else "hydra.run.dir"
    try:
        folder = Path(str(OmegaConf.select(master, key))).absolute()
    except OmegaConfBaseException:
        return
    if folder == Path(str(master.runs), OWN_NAME).absolute():
        return  # the runs folder is looked at by who fills it, or finds all done there
    try:
        existing = next(place for place in (folder, *folder.parents) if place.exists())
        with TemporaryDirectory(prefix=".probe-", dir=existing):
            pass
    except (OSError, ValueError) as error:
        raise InputError(f"{key}={folder} cannot be made ({getattr(error, 'strerror', None) or error})") from None


def words_of(overrides: Any) -> tuple[list[str], list[str]]:
    """The words for Hydra and those for gsbench of a node ``hydra.overrides``, as they were given."""
    given: Any = OmegaConf.to_container(overrides, resolve=False)
    return given["hydra"], given["task"]
