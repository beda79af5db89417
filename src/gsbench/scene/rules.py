"""The table of rules: what is odd about a capture, its cameras, its model and its points.

A rule measures something, and has two ranges of values: outside ``fine`` a line says so, outside
``usable`` the capture is refused, unless ``scene.accept`` has the rule's id. A new trouble is a row
and its measure. The site shows the table (scripts/reference.py).
"""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from gsbench.errors import InputError
from gsbench.parsing import MAX_NUMBER
from gsbench.runs.trial_record import Oddity
from gsbench.scene.types import Array, Camera, Scene
from gsbench.words import FORM, did_you_mean, listed

log = logging.getLogger(__name__)

MIN_IMAGES = 3  # with two views, no third one can reveal a wrong geometry
MIN_SIZE = 16  # px: the smallest side of an image that is trained on

Range = tuple[float, float]  # the ends belong to it
ANY: Range = (-math.inf, math.inf)


def at_most(limit: float) -> Range:
    return -math.inf, limit


def at_least(limit: float) -> Range:
    return limit, math.inf


ABOVE_ZERO = at_least(math.nextafter(0, 1))


class Finding(NamedTuple):
    """A measured value, the images that have it, and facts for the sentence."""

    value: float
    names: Sequence[str] = ()
    facts: Mapping[str, Any] = {}


# file: one file, by `given` · read: a folder with photographs · capture: as it is used
# lens: cameras with distortion · views: that have a pose · scene: views as they are trained on
# model: of the initialisation · cloud: before training · pictures: renders (eval/pictures.py)
Stage = Literal["file", "read", "capture", "lens", "views", "scene", "model", "cloud", "pictures"]


@dataclass(frozen=True)
class Rule:
    """One row. ``say`` and ``mend`` are formatted with the finding (`gsbench.words.FORM`).

    ``measure`` is a function of the subject, or the name of its attribute, a number, None if it is
    not known, or a list of names, which are counted. A subject that is a mapping has its findings
    by the ids of rules. ``it`` is the subject in sentences. A ``fixed`` rule is one of arithmetic
    or safety, and cannot be accepted.
    """

    id: str
    stage: Stage
    measure: str | Callable[[Any], Iterable[Finding]]
    fine: Range
    say: str
    mend: str
    usable: Range = ANY
    fixed: bool = False

    def judge(self, subject: Any) -> Oddity | None:
        """The oddity of a subject, told by its worst finding; None if all is fine."""
        odd = [found for found in self._findings(subject) if not _within(found.value, self.fine)]
        if not odd:
            return None
        worst = max(odd, key=lambda found: _beyond(found.value, self.fine))
        names = list(dict.fromkeys(name for found in odd for name in found.names))
        facts = {"count": len(names), **worst.facts, "value": worst.value, "names": names}
        value = min(max(worst.value, -MAX_NUMBER), MAX_NUMBER) if worst.value == worst.value else -1
        return Oddity(
            rule=self.id,
            line=FORM.format(f"{self.say}: {self.mend}", it=subject, **facts),
            value=value,
            refused=not all(_within(found.value, self.usable) for found in odd),
        )

    def _findings(self, subject: Any) -> Iterable[Finding]:
        if callable(self.measure):
            return self.measure(subject)
        if isinstance(subject, Mapping):
            return subject.get(self.id, ())
        value = getattr(subject, self.measure)
        if isinstance(value, Sequence):
            return [Finding(len(value), value)]
        return [] if value is None else [Finding(value)]


def _within(value: float, limits: Range) -> bool:
    return limits[0] <= value <= limits[1]  # NaN is within nothing


def _beyond(value: float, limits: Range) -> float:
    return max(limits[0] - value, value - limits[1]) if value == value else math.inf


def inspect(
    stage: Stage, subject: Any, where: str, accept: Sequence[str] = ()
) -> tuple[Oddity, ...]:
    """Judge a subject by all rules of a stage; returns what is odd, and logs each line.

    Raises InputError for what is not usable, unless its rule is in ``accept``.
    """
    judged = (rule.judge(subject) for rule in RULES if rule.stage == stage)
    return settle([found for found in judged if found is not None], where, accept)


def settle(found: Sequence[Oddity], where: str, accept: Sequence[str] = ()) -> tuple[Oddity, ...]:
    """Log oddities, here or earlier found, and refuse those that are not usable nor accepted."""
    # Lines come first, because they may explain an error.
    for odd in sorted(found, key=lambda odd: odd.refused):
        if not odd.refused:
            log.warning("%s: %s", where, odd.line)
        elif odd.rule in accept:
            log.warning("%s: %s (accepted: %s)", where, odd.line, odd.rule)
        else:
            way = "" if BY_ID[odd.rule].fixed else f" (or scene.accept=[{odd.rule}])"
            raise InputError(f"{where}: {odd.line}{way}")
    return tuple(found)


def check_accept(accept: Sequence[str]) -> None:
    """Raise InputError for an id that is no rule's, or whose rule cannot be accepted."""
    for name in accept:
        if name not in BY_ID:
            known = [rule.id for rule in RULES if not rule.fixed and rule.usable != ANY]
            raise InputError(
                f"scene.accept={name} is no rule: {listed(known)} can be accepted"
                f"{did_you_mean(name, known)}"
            )
        if BY_ID[name].fixed:
            raise InputError(f"scene.accept={name}: this rule cannot be accepted: leave it out")


# ---- measures


def camera_distances(cameras: Sequence[Camera]) -> tuple[Array, Array]:
    """The median position [3] of cameras, and the distance of each from it [V]."""
    centers = np.stack([camera.center for camera in cameras])  # [V, 3]
    middle = np.median(centers, axis=0)
    return middle, np.linalg.norm(centers - middle, axis=1)


def _far_cameras(scene: Scene) -> Iterable[Finding]:
    _, distances = camera_distances([view.camera for view in scene.train])
    typical = float(np.median(distances))
    for view, distance in zip(scene.train, distances, strict=True):
        if typical > 0:
            yield Finding(float(distance) / typical, [view.name])


def _each_camera(value: Callable[[Camera], float]) -> Callable[[Scene], Iterable[Finding]]:
    """A measure of each training camera."""

    def measure(scene: Scene) -> Iterable[Finding]:
        for view in scene.train:
            yield Finding(value(view.camera), [view.name], {"camera": view.camera})

    return measure


def _field_of_view(camera: Camera) -> float:
    return math.degrees(2 * math.atan(camera.width / (2 * camera.fx)))


def _off_center(camera: Camera) -> float:
    """The distance of the principal point from the middle, in shares of a side."""
    return max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))


def _brightest(scene: Scene) -> Iterable[Finding]:
    yield Finding(max(int(view.image.max()) for view in scene.train))


def _near_twins(scene: Scene) -> Iterable[Finding]:
    names = [f"{name} ({twin})" for name, twin in scene.twins.near.items()]
    yield Finding(len(names), names, {"tested": len(scene.test)})


def _left_out(subject: Any) -> Iterable[Finding]:
    """The photographs left out of a capture or a scene as copies of others."""
    twins = getattr(subject, "twins", subject).left_out
    yield Finding(len(twins), [f"{name} ({other} is used)" for name, other in twins.items()])


def given(rule: str, value: float, where: str, **facts: Any) -> None:
    """Judge a value that the caller measured by one rule that cannot be accepted."""
    found = BY_ID[rule].judge({rule: [Finding(value, (), facts)]})
    settle([] if found is None else [found], where)


def _panoramas(raw: Any) -> Iterable[Finding]:
    names = [row.name for row in raw.photographs if row.camera is None and row.is_panorama]
    yield Finding(len(names), names)


def _fixed(*row: Any) -> Rule:
    """A rule that refuses what is not fine, and cannot be accepted."""
    return replace(Rule(*row), usable=row[3], fixed=True)


ELSEWHERE = "the cloud may lie in other coordinates, or have another scale, than the cameras"
GIVEN = ""  # the measure of a rule whose findings the subject has
RULES = (
    # ---- files
    _fixed(
        "too-few-images",
        "file",
        GIVEN,
        at_least(MIN_IMAGES),
        "{value:n image} {which}, but at least 3 are needed",
        "{mend}",
    ),
    _fixed(
        "view-size",
        "file",
        GIVEN,
        at_least(MIN_SIZE),
        "scene.downscale={downscale}{limit} leaves {size} px of {full}",
        "at least 16 px are needed",
    ),
    _fixed(
        "principal-point-of-other-size",
        "file",
        GIVEN,
        (1 / 1.5, 1.5),  # copies are halved; other points are off by few percent
        "its principal point ({cx:g}, {cy:g}) is the centre of a photograph of another size than "
        "{width}x{height} px",
        "add w and h",
    ),
    _fixed(
        "mask-of-other-size",
        "file",
        GIVEN,
        at_most(0),
        "the mask is {size} px and its image {name} {full}",
        "give masks of the images' size",
    ),
    _fixed(
        "black-mask",
        "file",
        GIVEN,
        ABOVE_ZERO,
        "the mask is black all over, so no pixel counts",
        "correct it, or leave the image out",
    ),
    _fixed(
        "grey-mask",
        "file",
        GIVEN,
        at_most(0.05),  # a photograph has far more
        "{value:.0%} of its pixels are grey, so it is not a mask",
        "make it black where pixels are ignored, else white",
    ),
    # ---- a folder with photographs
    Rule(
        "no-pose",
        "read",
        GIVEN,
        at_most(0),
        "{count:n photograph} without a pose in the model: {names:few}",
        "they are not used",
    ),
    Rule(
        "no-file",
        "read",
        GIVEN,
        at_most(0),
        "{count:n image} with a camera but without a file: {names:few}",
        "they are not used",
    ),
    Rule(
        "found-by-last-part",
        "read",
        GIVEN,
        at_most(0),
        "files found by the last part of their path: {names:few}",
        "name the photographs as the model does",
    ),
    Rule(
        "focal-length-and-field",
        "read",
        GIVEN,
        (1 / 1.05, 1.05),  # rounding, and a shift of the principal point, are far less
        "its focal length is {given:g} px, but its field of view means {meant:g} px: {names:few}",
        "the focal length is used",
    ),
    # ---- a capture as it is used
    Rule(
        "panorama",
        "capture",
        _panoramas,
        at_most(0),
        "{count:n photograph} declared as panoramas by XMP (equirectangular): {names:few}",
        "split them into pinhole views first, for example with COLMAP's panorama_sfm",
        usable=at_most(0),
    ),
    Rule(
        "copies",
        "capture",
        _left_out,
        at_most(0),
        "{count:n photograph} left out, with the name or content of another: {names:few}",
        "keep one of each",
    ),
    # ---- lenses
    Rule(
        "lens-turns-back",
        "lens",
        GIVEN,
        at_most(0.0),
        "the camera of {names:few} ({camera}) turns back inside the picture: {value:.1%} of the "
        "undistorted photograph would be a mirrored ghost",
        "correct its distortion, estimate another model (scene=photos init.camera_model=RADIAL), "
        "or give undistorted photographs",
        usable=at_most(0.01),  # fitted lenses of correct models may do so in the outermost corners
    ),
    Rule(
        "little-left",
        "lens",
        GIVEN,
        at_least(0.25),
        "the camera of {names:few} ({camera}) leaves {size} of {full} px undistorted",
        "check its lens",
    ),
    # ---- views
    _fixed(
        "no-training-view",
        "views",
        "train",
        at_least(1),
        "no training view has a pose, or all of them are copies of test views",
        "change the split or the init",
    ),
    _fixed(
        "no-test-view",
        "views",
        "test",
        at_least(1),
        "no test view has a pose, so nothing could be measured",
        "change the split or the init, or leave out photographs of another camera",
    ),
    Rule(
        "views-without-pose",
        "views",
        "unplaced",
        at_most(0),
        "{count:n view} without a pose left out: {names:few}",
        "take photographs with more overlap, or another init",
    ),
    Rule(
        "copies-in-pixels",
        "scene",
        _left_out,
        at_most(0),
        "{count:n training view} left out, with the pixels of a test view: {names:few}",
        "keep one of each",
    ),
    Rule(
        "near-twins",
        "scene",
        _near_twins,
        at_most(0),
        "{count} of {tested:n test view} with a near twin in training: {names:few}",
        "such views measure memory; scene.split=sector holds out whole parts",
    ),
    Rule(
        "far-camera",
        "scene",
        _far_cameras,
        at_most(20.0),
        "the camera of {names:few} is {value:,.0f} times as far from the others as they usually "
        "are, and sets the scene extent to {it.extent:.4g}",
        "check its pose, or leave the image out",
    ),
    Rule(
        "field-of-view",
        "scene",
        _each_camera(_field_of_view),
        (0.2, 150.0),  # satellites have 1 degree, the widest pinhole lenses 130
        "the camera of {names:few} has a focal length of {camera.fx:.4g} px for a width of "
        "{camera.width} px",
        "check its unit",
    ),
    Rule(
        "pixel-shape",
        "scene",
        _each_camera(lambda camera: camera.fy / camera.fx),
        (1 / 1.25, 1.25),  # unequal scaling of photographs gives 1.01
        "the camera of {names:few} has focal lengths of {camera.fx:.4g} and {camera.fy:.4g} px, "
        "but pixels are square",
        "check both",
    ),
    Rule(
        "principal-point",
        "scene",
        _each_camera(_off_center),
        at_most(0.4),
        "the camera of {names:few} has its principal point at ({camera.cx:.4g}, {camera.cy:.4g}) "
        "of {camera.width}x{camera.height} px, far from the middle",
        "check its unit, unless the photographs were cropped",
    ),
    Rule(
        "dark",
        "scene",
        _brightest,
        at_least(49),  # the usual cause are values of 10 or 12 bits in files of 16
        "no photograph has a value above {value} of 255",
        "scale them to their full range",
    ),
    # ---- the model of the initialisation
    Rule(
        "few-placed",
        "model",
        "placed_share",
        at_least(0.9),
        "only {it.num_registered} of {it.num_images} images have a pose (missing: "
        "{it.unregistered:few})",
        "the other photos are not used; more overlap or texture would help",
    ),
    Rule(
        "few-points",
        "model",
        "num_points",
        at_least(100),
        "only {value} points",
        "training starts from next to nothing",
    ),
    Rule(
        "reprojection-error",
        "model",
        "mean_reprojection_error",
        at_most(1.5),  # px; correct models stay below 0.7 with SIFT, 1.2 with learned features
        "mean reprojection error {value:.2f} px is large",
        "the cameras or the matches are probably wrong",
    ),
    Rule(
        "cameras-turned",
        "model",
        "rotation_error",
        at_most(2.0),  # degrees; correct models stay below 0.5, wrong ones reach 20 and more
        "the cameras are turned {value:.1f} degrees against the {it.truth} ones on average",
        "the model is wrong although its images are placed (views at most 7.5 degrees apart are "
        "safe)",
    ),
    Rule(
        "cameras-moved",
        "model",
        "center_error",
        at_most(0.05),
        "the cameras are {value:.1%} of the scene extent away from the {it.truth} ones",
        "the model is probably wrong",
    ),
    Rule(
        "estimated-field-of-view",
        "model",
        lambda model: model.fields_of_view,
        (5.0, 150.0),
        "estimated focal length {focal:.0f} px (field of view {value:.0f} degrees) is implausible",
        "give init.focal_length in px",
    ),
    # ---- the points that training starts from
    _fixed(
        "cameras-at-one-place",
        "cloud",
        "extent",
        ABOVE_ZERO,
        "all training cameras stand at one place, so no depth can be learnt",
        "take photographs from several places",
    ),
    _fixed(
        "point-beyond-range",
        "cloud",
        "farthest",
        at_most(1e7),  # squares of larger lengths leave the range in which float32 can train
        "initial point {it.number} of {it.total:,} is {value:.3g} times as far from the cameras as "
        "they are from each other, at {it.place}",
        "remove it from the cloud",
    ),
    _fixed(
        "points-out-of-view",
        "cloud",
        "seen_by_one",
        ABOVE_ZERO,
        "no training view has one of the initial points in view",
        "the cloud lies in other coordinates than the cameras; bring it into theirs",
    ),
    Rule(
        "points-share-places",
        "cloud",
        "identical",
        at_most(0.5),
        "{value:.0%} of the initial points share their place with another, such as "
        "{it.first_place}",
        "thin or rebuild the cloud",
        usable=at_most(math.nextafter(1, 0)),
        fixed=True,
    ),
    Rule(
        "points-far-off",
        "cloud",
        "far",
        at_most(0),
        "{value:n initial point} more than 10,000 times as far off as the cameras",
        "clean the cloud",
    ),
    Rule(
        "points-seen-once",
        "cloud",
        "seen",
        at_least(0.1),  # clouds by structure from motion have 0.97 and more
        "only {value:.1%} of the initial points are in view of two training views",
        ELSEWHERE,
    ),
    Rule(
        "points-in-a-heap",
        "cloud",
        "spread",
        at_least(0.02),
        "half of the initial points lie within {value:.2g} of the cameras' distances",
        ELSEWHERE,
    ),
    Rule(
        "colours-disagree",
        "cloud",
        "color_agreement",
        at_least(0.25),  # sound clouds have 0.6 to 0.9, other scales or axes -0.1 to 0.2
        "the colours of the initial points hardly agree with the photographs (agreement "
        "{value:.2f}; 0 is chance, 1 is equal)",
        ELSEWHERE,
    ),
    Rule(
        "cloud-of-one-colour",
        "cloud",
        "color_spread",
        at_least(1.0),
        "all initial points have the colour {it.first_color}",
        "export the cloud with its colours",
    ),
)
BY_ID = {rule.id: rule for rule in RULES}
