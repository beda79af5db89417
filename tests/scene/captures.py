"""Captures read as a trial reads them."""

from functools import partial
from pathlib import Path

from gsbench.pipeline.steps.scene import CaptureSource
from gsbench.runs.store import Store
from gsbench.scene.load import load_scene
from gsbench.scene.options import SceneConfig
from gsbench.scene.pipe import read_capture


def read(kind, path, **settings):
    """The capture in ``path``, by the reader of its ``kind``."""
    return read_capture(SceneConfig(kind=kind, name="toy", path=str(path), **settings))


read_colmap, read_photos = partial(read, "colmap"), partial(read, "photos")


def read_with_step(folder, work, reader=None, **settings):
    """The capture whose cameras a step writes below ``work``."""
    source = CaptureSource(SceneConfig(path=str(folder), **settings), reader)
    Path(work).mkdir(exist_ok=True)
    source.step.build(work)
    return source.read(work)


def loaded(capture, folder, *args, **options):
    """The scene of a capture with its own cameras; views are prepared below ``folder``."""
    return load_scene(capture, capture.model, Store(folder / "cache"), *args, **options)
