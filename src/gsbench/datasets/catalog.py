"""The data file of public data sets (``catalog.yaml``): where scenes lie, and which files of them are wanted."""

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from gsbench.errors import InputError
from gsbench.system.install import conf_dir

DATA_VARIABLE = "GSBENCH_DATA"
SCENE_PATH = re.compile(r"\$\{oc\.env:GSBENCH_DATA,data\}/(?P<folder>.+)")
CATALOG_FILE = Path(__file__).with_name("catalog.yaml")


@dataclass(frozen=True)
class Archive:
    """One zip file: its address, its approximate size in words ("" where it is not known), and the folder of each of
    its scenes in it.
    """

    url: str
    size: str
    scenes: Mapping[str, str]

    @property
    def name(self) -> str:
        return self.url.rpartition("/")[2]


@dataclass(frozen=True)
class Dataset:
    """A published set of scenes, whose licence and citation are shown to who fetches it."""

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
    """Files that conf/scene/<scene>.yaml asks for: its folder below the data folder, and the folders in it."""

    scene: str
    folder: str
    parts: tuple[str, ...]  # images before the model: a model alone is no scene


def wanted_files(scene: str, images: str | None = None) -> SceneFiles:
    """The files that a scene file asks for; ``images`` names another image folder than it does."""
    settings = yaml.safe_load((conf_dir() / "scene" / f"{scene}.yaml").read_text(encoding="utf-8"))
    match = SCENE_PATH.fullmatch(settings["path"])
    if match is None:
        raise InputError(f"conf/scene/{scene}.yaml does not lie below ${DATA_VARIABLE}: it cannot be fetched")
    parts = (images or settings.get("images") or "images", settings.get("sparse") or "sparse/0")
    return SceneFiles(scene, match["folder"], parts)


def read_catalog() -> dict[str, Dataset]:
    """The data sets of gsbench's catalogue by name."""
    content: dict[str, Any] = yaml.safe_load(CATALOG_FILE.read_text(encoding="utf-8"))
    return {name: _dataset(name, entry) for name, entry in content.items()}


def _dataset(name: str, entry: Mapping[str, Any]) -> Dataset:
    texts = {key: entry[key] for key in ("title", "page", "licence", "citation")}
    archives = tuple(Archive(one["url"], one.get("size", ""), one["scenes"]) for one in entry["archives"])
    return Dataset(name=name, archives=archives, **texts)


def data_dir() -> Path:
    """The folder in which the scene files look for public data: ``$GSBENCH_DATA``, else ``data`` here."""
    return Path(os.environ.get(DATA_VARIABLE, "data")).expanduser()


@cache
def _known() -> dict[str, tuple[str, str]]:
    """Of each scene in the catalogue: its data set, and its folder."""
    return {
        scene: (dataset.name, folder)
        for dataset in read_catalog().values()
        for archive in dataset.archives
        for scene, folder in archive.scenes.items()
    }


def how_to_get(scenes: Iterable[tuple[str, Path]]) -> str:
    """The mend for scenes whose folders ``(scene, folder)`` are not there: the commands that fetch them, if any do."""
    wanted = defaultdict(list)
    for scene, folder in scenes:
        dataset, place = _known().get(scene, ("", ""))
        if dataset and folder.expanduser().absolute() == (data_dir() / place).absolute():
            wanted[dataset].append(scene)
    commands = [f"`gsbench fetch {dataset} {' '.join(sorted(names))}`" for dataset, names in sorted(wanted.items())]
    if not commands:
        return f"set scene.path, or {DATA_VARIABLE} for a known scene"
    return f"{' and '.join(commands)} {'brings' if len(commands) == 1 else 'bring'} what is missing"
