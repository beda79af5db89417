"""Rules: what is odd about a capture, its cameras, its model, its points and pictures.

A rule measures something, and has two ranges of values: outside ``fine`` a line says so, outside
``usable`` the capture is refused, unless ``scene.accept`` has the rule's id. A new trouble is a row
of ``rules.yaml`` and its measure. The site shows the table (scripts/reference.py).
"""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from gsbench.errors import InputError
from gsbench.parsing import MAX_NUMBER, table_beside
from gsbench.runs.trial_record import Oddity
from gsbench.scene.types import Array, Camera, Scene
from gsbench.words import FORM, did_you_mean, listed

log = logging.getLogger(__name__)

Range = tuple[float, float]  # the ends belong to it
ANY: Range = (-math.inf, math.inf)


class Finding(NamedTuple):
    """A measured value, the images that have it, and facts for the sentence."""

    value: float
    names: Sequence[str] = ()
    facts: Mapping[str, Any] = {}


Stage = Literal["file", "read", "capture", "lens", "views", "scene", "model", "cloud", "pictures"]


@dataclass(frozen=True)
class Rule:
    """One row. ``say`` and ``mend`` are formatted with the finding (`gsbench.words.FORM`).

    ``measure`` names one of `MEASURES`, or an attribute of the subject: a number, None if it is not
    known, or a list of names, which are counted. A subject that is a mapping has its findings by
    the ids of rules. ``it`` is the subject in sentences. A ``fixed`` rule is one of arithmetic or
    safety, and cannot be accepted.
    """

    id: str
    stage: Stage
    say: str
    mend: str
    measure: str = ""
    at_least: float = -math.inf
    at_most: float = math.inf
    usable_at_most: float | None = None
    fixed: bool = False

    @property
    def fine(self) -> Range:
        return self.at_least, self.at_most

    @property
    def usable(self) -> Range:
        if self.usable_at_most is not None:
            return -math.inf, self.usable_at_most
        return self.fine if self.fixed else ANY

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
        if isinstance(subject, Mapping):
            return subject.get(self.id, ())
        if self.measure in MEASURES:
            return MEASURES[self.measure](subject)
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
    return settle((rule.judge(subject) for rule in RULES if rule.stage == stage), where, accept)


def settle(
    judged: Iterable[Oddity | None], where: str, accept: Sequence[str] = ()
) -> tuple[Oddity, ...]:
    """Log oddities, here or earlier found, and refuse those that are not usable nor accepted."""
    found = tuple(filter(None, judged))
    # Lines come first, because they may explain an error.
    for odd in sorted(found, key=lambda odd: odd.refused):
        if not odd.refused:
            log.warning("%s: %s", where, odd.line)
        elif odd.rule in accept:
            log.warning("%s: %s (accepted: %s)", where, odd.line, odd.rule)
        else:
            way = "" if BY_ID[odd.rule].fixed else f" (or scene.accept=[{odd.rule}])"
            raise InputError(f"{where}: {odd.line}{way}")
    return found


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


def _near_twins(scene: Scene) -> Iterable[Finding]:
    names = [f"{name} ({twin})" for name, twin in scene.twins.near.items()]
    yield Finding(len(names), names, {"tested": len(scene.test)})


def _left_out(subject: Any) -> Iterable[Finding]:
    """The photographs left out of a capture or a scene as copies of others."""
    twins = getattr(subject, "twins", subject).left_out
    yield Finding(len(twins), [f"{name} ({other} is used)" for name, other in twins.items()])


def given(rule: str, value: float, where: str, **facts: Any) -> None:
    """Judge a value that the caller measured by one rule that cannot be accepted."""
    settle([BY_ID[rule].judge({rule: [Finding(value, (), facts)]})], where)


MEASURES: Mapping[str, Callable[[Any], Iterable[Finding]]] = {
    "left_out": _left_out,
    "near_twins": _near_twins,
    "far_cameras": _far_cameras,
    "field_of_view": _each_camera(
        lambda camera: math.degrees(2 * math.atan(camera.width / (2 * camera.fx)))
    ),
    "pixel_shape": _each_camera(lambda camera: camera.fy / camera.fx),
    # of the principal point from the middle, in shares of a side
    "off_center": _each_camera(
        lambda camera: max(
            abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5)
        )
    ),
    "brightest": lambda scene: [Finding(max(int(view.image.max()) for view in scene.train))],
    "fields_of_view": lambda model: model.fields_of_view,
}
BY_ID = {name: Rule(name, **row) for name, row in table_beside(__file__, "rules.yaml").items()}
RULES = tuple(BY_ID.values())
# with two views, no third one can reveal a wrong geometry; the smallest side in px
MIN_IMAGES, MIN_SIZE = (int(BY_ID[name].at_least) for name in ("too-few-images", "view-size"))
