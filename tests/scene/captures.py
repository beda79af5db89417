"""Captures read as a trial reads them."""

from pathlib import Path

from gsbench.pipeline.steps.scene import CaptureSource
from gsbench.scene.options import SceneConfig
from gsbench.scene.pipe import read_capture


def read(kind, name, path, **settings):
    """The capture in ``path``, by the reader of its ``kind``."""
    return read_capture(SceneConfig(kind=kind, name=name, path=str(path), **settings))


def read_colmap(name, path, **settings):
    return read("colmap", name, path, **settings)


def read_photos(name, path, **settings):
    return read("photos", name, path, **settings)


def read_with_step(folder, work, reader=None, **settings):
    """The capture whose cameras a step writes below ``work``."""
    source = CaptureSource(SceneConfig(path=str(folder), **settings), reader)
    Path(work).mkdir(exist_ok=True)
    source.step.build(work)
    return source.read(work)
