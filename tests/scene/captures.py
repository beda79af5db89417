"""Captures read as a trial reads them."""

from pathlib import Path

from gsbench.pipeline.steps.scene import CaptureSource
from gsbench.runs.store import Store
from gsbench.scene.load import load_scene
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


def loaded(capture, folder, *args, **options):
    """The scene of a capture with its own cameras; views are prepared below ``folder``."""
    return load_scene(capture, capture.model, Store(folder / "cache"), *args, **options)
