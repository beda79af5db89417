"""The sources of pictures: renders, perhaps in an archive of nerfbaselines, and their photographs.

Predictions of nerfbaselines are a folder, a .tar.gz, or the zip of a published result. ``color/``
has the renders and ``gt-color/`` the photographs, each as ``<name of the photograph>.png``, beside
``info.json`` (`save_predictions` of nerfbaselines 1.2). A published zip has them in
``predictions/``.
"""

import shutil
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, Any

from gsbench.analysis.results import TrialResult, read_views
from gsbench.config.compose import compose_one
from gsbench.config.groups import options
from gsbench.errors import InputError
from gsbench.files import DAMAGE, GIT_LFS, LFS_REMEDY, is_safe_member, require_regular
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.trial import TrialSteps
from gsbench.runs import keys
from gsbench.runs.layout import GROUND_TRUTH, MASKS, RENDERS, RESULTS, STORE
from gsbench.runs.store import Store
from gsbench.runs.trial_folder import TrialFolder
from gsbench.scene.images import image_size, list_images, png_name
from gsbench.scene.pipe import fingerprint
from gsbench.view.trials import find_trial
from gsbench.words import did_you_mean, readable_bytes, some_of

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


RENDERED, PHOTOGRAPHS = "color", "gt-color"
# Archives may come from strangers: this stops one that unpacks to far more than test views need.
MAX_TOTAL_BYTES = 20 << 30
PNG = ".png"


@contextmanager
def opened_renders(place: Path) -> Iterator[tuple[Path, Path | None]]:
    """Yield the folders of renders and, from nerfbaselines, of photographs; unpacks an archive.

    Raises InputError if ``place`` is neither a folder nor such an archive.
    """
    if place.is_dir():
        for home in (place, place / "predictions"):
            if all((home / folder).is_dir() for folder in (RENDERED, PHOTOGRAPHS)):
                yield home / RENDERED, home / PHOTOGRAPHS
                return
        yield place, None
        return
    if not place.exists():
        raise InputError(f"{place} is not a folder of renders")
    require_regular(place)
    with place.open("rb") as file:
        start = file.read(len(GIT_LFS))
    for first, kind in OTHERS.items():
        if start.startswith(first):
            raise InputError(f"{place} is {kind}")
    with tempfile.TemporaryDirectory(prefix="gsbench-") as scratch:
        try:
            _unpack(place, Path(scratch))
        except InputError:
            raise
        except DAMAGE as error:  # of a damaged, encrypted or foreign archive
            raise InputError(
                f"{place} cannot be unpacked ({error}): give a folder, a .zip or a .tar.gz"
            ) from None
        yield Path(scratch) / RENDERED, Path(scratch) / PHOTOGRAPHS


MODEL = "a model: gsbench scene=SCENE init=ply init.path=FILE train=none densify=none measures it"
PICTURE = "one picture: give its folder"
# By the first bytes of a file that is no archive: what it is, and what to do.
OTHERS = {GIT_LFS: LFS_REMEDY, b"ply": MODEL, b"\x89PNG": PICTURE, b"\xff\xd8": PICTURE}


def _unpack(archive: Path, scratch: Path) -> None:
    """Write the renders and photographs of an archive below ``scratch``, and no other member."""
    with ExitStack() as opened:
        # each file's size and what opens it, by its name
        files: dict[str, tuple[int, Callable[[], IO[bytes] | None]]]
        if zipfile.is_zipfile(archive):
            zipped = opened.enter_context(zipfile.ZipFile(archive))
            files = {
                member.filename: (member.file_size, partial(zipped.open, member))
                for member in zipped.infolist()
                if not member.is_dir()
            }
        else:
            tar = opened.enter_context(tarfile.open(archive))
            files = {
                member.name: (member.size, partial(tar.extractfile, member))
                for member in tar
                if member.isfile()
            }
        for name, place in _wanted(archive, {key: files[key][0] for key in files}).items():
            (scratch / place).parent.mkdir(parents=True, exist_ok=True)
            content = files[name][1]()
            assert content is not None  # of a regular file
            # At most the size that the archive says is unpacked.
            with content, (scratch / place).open("wb") as file:
                shutil.copyfileobj(content, file)
                if file.tell() != files[name][0]:
                    raise ValueError(f"{place.name} has another size than the archive says")


def _wanted(archive: Path, sizes: dict[str, int]) -> dict[str, Path]:
    """The members that are renders or photographs, with the places to write them to.

    Names are checked before the layout is looked at. Raises `InputError` for a picture whose name
    leads out of the archive, and unless one folder of the archive has both kinds of pictures.
    """
    homes: dict[Path, dict[str, Path]] = {}  # by the folder that has both: members and places
    for name in sizes:
        path = Path(name.removeprefix("./"))
        kind = next((part for part in path.parts if part in (RENDERED, PHOTOGRAPHS)), None)
        if kind is None or path.suffix != PNG:
            continue
        if not is_safe_member(name):
            raise InputError(f"{archive}: {name!r} leads out of the archive, or is no file's name")
        home = Path(*path.parts[: path.parts.index(kind)])
        homes.setdefault(home, {})[name] = path.relative_to(home)
    both = [own for own in homes.values() if len({place.parts[0] for place in own.values()}) == 2]
    if len(both) != 1:
        raise InputError(
            f"{archive} must have one folder with {RENDERED}/ and {PHOTOGRAPHS}/, as nerfbaselines "
            f"writes it, and has {len(both) or 'none'}"
        )
    total = sum(sizes[name] for name in both[0])
    if total > MAX_TOTAL_BYTES:
        raise InputError(
            f"{archive} unpacks to {readable_bytes(total)}, more than the limit of "
            f"{readable_bytes(MAX_TOTAL_BYTES)}"
        )
    return both[0]
