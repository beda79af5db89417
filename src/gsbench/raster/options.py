"""The setting of the rasterizer: an executor by name, or a class of the user's own."""

from __future__ import annotations

from dataclasses import dataclass

from gsbench.errors import InputError
from gsbench.raster import executors
from gsbench.settings import MISSING, TargetName, check_settings
from gsbench.words import closest


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
