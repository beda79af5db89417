"""The sources of pictures: renders and their photographs."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsbench.analysis.results import TrialResult, read_views
from gsbench.config.compose import compose_one
from gsbench.config.groups import options
from gsbench.errors import InputError
from gsbench.files import GIT_LFS, LFS_REMEDY, require_regular
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.trial import TrialSteps
from gsbench.runs import keys
from gsbench.runs.layout import GROUND_TRUTH, MASKS, RENDERS, RESULTS, STORE
from gsbench.runs.store import Store
from gsbench.runs.trial_folder import TrialFolder
from gsbench.scene.images import image_size, list_images, png_name
from gsbench.scene.pipe import fingerprint
from gsbench.view.trials import find_trial
from gsbench.words import did_you_mean, some_of

CAMERAS_ONLY = ("init=random", "init.count=100")  # the fastest initialiser; its points are not used


@dataclass(frozen=True)
class ReferenceImages:
    """Photographs by the names of their views, in the order of an evaluation.

    ``what`` describes them in messages. ``data`` is the fingerprint of their capture, and
    ``resolution`` (width, height) its size in px. ``config`` is the configuration of a trial that
    is tested on them. ``scene`` is None for a plain folder of pictures, ``init`` is None if they
    come from no trial.
    """

    photographs: Mapping[str, Path]
    what: str
    data: str
    resolution: tuple[int, int]
    config: Mapping[str, Any]
    scene: str | None = None
    init: str | None = None
    # mask files of the views that ignore some pixels
    masks: Mapping[str, Path] = field(default_factory=dict)


def find_reference_images(place: str, settings: Sequence[str], runs: Path) -> ReferenceImages:
    """The photographs of a folder, a trial (folder or EXPERIMENT:SCENE:ARM), or a scene.

    ``settings`` are overrides of the configuration. Raises `InputError` if ``place`` is none of
    these.
    """
    folder = Path(place).expanduser()
    if folder.is_dir():
        home = folder.parent if folder.name in (GROUND_TRUTH, RENDERS) else folder
        if not (home / RESULTS).is_file():
            return pictures_in(folder, settings)
        return reference_images_of(find_trial(str(home), runs))
    if ":" in place:
        return reference_images_of(find_trial(place, runs))
    scenes = options("scene")
    if place not in scenes:
        raise InputError(
            f"--truth {place} is no folder, no trial EXPERIMENT:SCENE:ARM and no scene"
            f"{did_you_mean(place, scenes)} (scenes: {', '.join(scenes)})"
        )
    return _scene(place, settings)


def reference_images_of(trial: TrialResult) -> ReferenceImages:
    """The reference images of a finished trial, as its own evaluation names and orders them."""
    photographs = {view: trial.path / GROUND_TRUTH / png_name(view) for view in read_views(trial)}
    if trial.record.resolution is None or "data" not in trial.record.hashes:
        raise InputError(
            f"{trial.label} has no record of the size or hash of its test views: run it again"
        )
    what = f"the test views of {trial.label}"
    return ReferenceImages(
        photographs,
        what,
        trial.record.hashes["data"],
        trial.record.resolution,
        TrialFolder(trial.path).configuration(),
        trial.scene,
        trial.init,
        _masks(trial.path / MASKS, photographs),
    )


def scene_trial(words: Sequence[str]) -> TrialSteps:
    """A trial of the scene that ``words`` choose.

    If the scene comes with cameras, the fastest initialiser is used, unless the words choose one.
    """
    config = compose_one(words).values
    chooses = any(word.startswith("init=") for word in words)
    if not chooses and config["scene"]["kind"] != "photos":
        config = compose_one([*CAMERAS_ONLY, *words]).values
    store = Store(Path(config["runs"]).expanduser().resolve() / STORE)
    return TrialSteps(Parts(config), store)


def _scene(name: str, settings: Sequence[str]) -> ReferenceImages:
    """The test views of a scene as a trial with these settings sees them."""
    trial = scene_trial([f"scene={name}", *settings])
    wanted = (keys.CAPTURE, keys.INIT, keys.GROUND_TRUTH)
    entries = [trial.store.get(step) for step in trial.steps() if step.stage in wanted]
    folder = entries[-1].path
    config = trial.parts.values
    scene = trial.views.scene
    photographs = {view.name: folder / png_name(view.name) for view in scene.test}
    sizes = [(view.camera.width, view.camera.height) for view in [*scene.train, *scene.test]]
    masks = _masks(folder / MASKS, photographs)
    what = f"the test views of {name}"
    return ReferenceImages(
        photographs, what, trial.capture.fingerprint, max(sizes), config, name, masks=masks
    )


def _masks(folder: Path, views: Iterable[str]) -> dict[str, Path]:
    """The existing masks in ``folder``, by view."""
    files = {view: folder / png_name(view) for view in views}
    return {view: file for view, file in files.items() if file.is_file()}


def picture_names(folder: Path) -> list[str]:
    """The names of the pictures in a folder; raises `InputError` if none can be read."""
    if names := list_images(folder):
        return names
    others = sorted(path.name for path in folder.iterdir() if path.is_file())
    found = f", only {some_of(others)}" if others else ""
    raise InputError(f"{folder} holds no pictures that gsbench reads{found}: write PNG of 8 bits")


def pictures_in(folder: Path, settings: Sequence[str]) -> ReferenceImages:
    names = picture_names(folder)
    photographs = {name: folder / name for name in names}
    resolution = max(image_size(path) for path in photographs.values())
    config = compose_one(list(settings)).values
    return ReferenceImages(
        photographs, f"the pictures in {folder}", fingerprint(folder, names), resolution, config
    )


MODEL = "a model: gsbench scene=SCENE init=ply init.path=FILE train=none densify=none measures it"
PICTURE, PACKED = "one picture: give its folder", "packed: unpack it and give the folder"
# By the first bytes of a file that is no folder: what it is, and what to do.
OTHERS = {GIT_LFS: LFS_REMEDY, b"ply": MODEL, b"\x89PNG": PICTURE, b"\xff\xd8": PICTURE}
OTHERS |= {b"PK": PACKED, b"\x1f\x8b": PACKED}


def require_folder(place: Path) -> None:
    """Raise InputError that says what to do if ``place`` is no folder of renders."""
    if place.is_dir():
        return
    if place.exists():
        require_regular(place)
        with place.open("rb") as file:
            start = file.read(len(GIT_LFS))
        for first, kind in OTHERS.items():
            if start.startswith(first):
                raise InputError(f"{place} is {kind}")
    raise InputError(f"{place} is not a folder of renders")
