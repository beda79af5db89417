"""The catalogue of public data sets (``catalog.yaml``), and the files that a scene needs."""

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import yaml
from pydantic import ConfigDict, TypeAdapter

from gsbench.errors import InputError
from gsbench.parsing import table_beside
from gsbench.system.install import conf_dir

DATA_VARIABLE = "GSBENCH_DATA"
# the place of the data, as the YAML files of public scenes write it
SCENE_PATH = re.compile(r"\$\{oc\.env:GSBENCH_DATA,data\}/(?P<folder>.+)")


@dataclass(frozen=True)
class Archive:
    """One zip file of scenes."""

    url: str
    scenes: Mapping[str, str]  # the folder of each scene in the archive
    read_in: tuple[str, ...]  # sources of the address, the layout and the size
    size: str = ""  # approximate, in words; "" if unknown

    @property
    def name(self) -> str:
        return self.url.rpartition("/")[2]


@dataclass(frozen=True)
class PublicDataset:
    """A published set of scenes. Its licence and citation are shown before it is fetched."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    name: str
    title: str
    page: str
    licence: str
    citation: str
    archives: tuple[Archive, ...]

    @property
    def scenes(self) -> tuple[str, ...]:
        return tuple(sorted(scene for archive in self.archives for scene in archive.scenes))


@dataclass(frozen=True)
class SceneFiles:
    """Folders that conf/scene/<scene>.yaml needs: ``parts`` in ``folder`` below the data folder."""

    scene: str
    folder: str
    parts: tuple[str, ...]  # images before the model, because a model alone is no scene


def wanted_files(scene: str, images: str | None = None) -> SceneFiles:
    """The folders that a scene's YAML file needs; ``images`` replaces its image folder."""
    settings = yaml.safe_load((conf_dir() / "scene" / f"{scene}.yaml").read_text(encoding="utf-8"))
    match = SCENE_PATH.fullmatch(settings["path"])
    if match is None:
        raise InputError(
            f"conf/scene/{scene}.yaml does not lie below ${DATA_VARIABLE}: it cannot be fetched"
        )
    parts = (images or settings.get("images") or "images", settings.get("sparse") or "sparse/0")
    return SceneFiles(scene, match["folder"], parts)


def read_catalog() -> dict[str, PublicDataset]:
    """The data sets of gsbench's catalogue by name."""
    rows = table_beside(__file__, "catalog.yaml").items()
    reader = TypeAdapter(PublicDataset)
    return {name: reader.validate_python({"name": name, **row}) for name, row in rows}


def data_dir() -> Path:
    """The folder of public data: ``$GSBENCH_DATA``, else ``data`` in the current folder."""
    return Path(os.environ.get(DATA_VARIABLE, "data")).expanduser()


@cache
def _catalogued_scenes() -> dict[str, tuple[str, str]]:
    """The data set and the folder of each scene in the catalogue."""
    return {
        scene: (dataset.name, folder)
        for dataset in read_catalog().values()
        for archive in dataset.archives
        for scene, folder in archive.scenes.items()
    }


def how_to_get(scenes: Iterable[tuple[str, Path]]) -> str:
    """Advice for missing scenes and their folders: how to fetch those in the catalogue."""
    wanted = defaultdict(list)
    for scene, folder in scenes:
        dataset, catalogued = _catalogued_scenes().get(scene, ("", ""))
        if dataset and folder.expanduser().absolute() == (data_dir() / catalogued).absolute():
            wanted[dataset].append(scene)
    commands = [
        f"`gsbench fetch {dataset} {' '.join(sorted(names))}`"
        for dataset, names in sorted(wanted.items())
    ]
    if not commands:
        return f"scene.path must name its folder, or {DATA_VARIABLE} that of the known scenes"
    return f"{' and '.join(commands)} {'brings' if len(commands) == 1 else 'bring'} what is missing"
