"""Small archives with the layout of the real ones, and a server for them."""

import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from gsbench.datasets.catalog import read_catalog
from tests.datasets.server import serve


def archive_content(scene_folder, seed=0, photos=4):
    """The files of a scene in an archive: four sizes, a model, and files that are not wanted."""
    rng = np.random.default_rng([seed, *scene_folder.encode()])
    files = {}
    sizes = {"images": 40_000, "images_2": 20_000, "images_4": 9_000, "images_8": 3_000}
    for images, size in sizes.items():
        for index in range(photos):
            files[f"{scene_folder}/{images}/IMG_{index:04d}.JPG"] = rng.bytes(size + index)
    for name in ("cameras", "images", "points3D"):
        # the zeros compress well
        files[f"{scene_folder}/sparse/0/{name}.bin"] = rng.bytes(5_000) + bytes(20_000)
    files[f"{scene_folder}/images_4/.DS_Store"] = b"nobody wants this"
    files[f"{scene_folder}/poses_bounds.npy"] = rng.bytes(600)
    return files


def write_archive(path, content, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in content.items():
            archive.writestr(name, data)


def write_archives(folder, photos=4):
    """Write small files under the names of all archives in the catalogue; return the folder."""
    for dataset in read_catalog().values():
        for archive in dataset.archives:
            content = {}
            for place in archive.scenes.values():
                content |= archive_content(place, photos=photos)
            write_archive(folder / archive.name, content)
    return folder


@pytest.fixture(scope="session")
def made_archives(tmp_path_factory):
    return write_archives(tmp_path_factory.mktemp("archives"))


@pytest.fixture
def archives(made_archives, tmp_path):
    """A copy of `made_archives` that the test may change."""
    return Path(shutil.copytree(made_archives, tmp_path / "archives"))


@pytest.fixture
def server(archives):
    with serve(archives) as running:
        yield running
