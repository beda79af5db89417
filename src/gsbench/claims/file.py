"""The file of claims: what a paper says, and how it is tested here.

It is checked before any trial runs.

    name: check_volumetric
    paper: Refining Gaussian Splatting (arXiv 2508.05187)
    seeds: 4
    settings: {train: quick, scene.max_size: 160}
    scenes: {courtyard: {}, bonsai: {scene: bonsai}}
    arms: {adc: {}, volumetric: {}}
    claims:
      - id: lpips
        says: our approach consistently achieves lower LPIPS scores
        where: section 5, Table 1
        baseline: adc
        arm: volumetric
        metric: lpips_squeeze
        direction: lower
        least: 0.005
        refuted_if: the difference is above 0, or within 0.005 of it

Settings, scenes, arms, budgets and splits have settings as on the command line. docs/claims.md has
every key.
"""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Interval, Predicate, doc

from gsbench.analysis.looks import FIRST_LOOK, plan_looks
from gsbench.analysis.quantities import askable_names, asked_quantity
from gsbench.analysis.statistics import ALPHA
from gsbench.config.overrides import value_text
from gsbench.errors import InputError
from gsbench.parsing import read_yaml, resolved
from gsbench.runs.experiments import Arm, Question
from gsbench.runs.user_code import PERMISSIONS
from gsbench.settings import check_values
from gsbench.words import did_you_mean, least_text

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,60}")
KEY = re.compile(r"[+]?\w+([./]\w+)*")  # of a setting
GIVEN_BY_CHECK = ("name", "seed", "runs", "eval.primary")  # settings that the check sets itself
MAX_ALPHA = 0.2
MAX_SEEDS = 1000
NO_SIZE = "give a difference such as 0.005, or 10% (of the baseline's value)"
DIRECTIONS = {"higher": 1, "lower": -1, "same": 0}

Name = Annotated[
    str, Predicate(lambda name: NAME.fullmatch(name) is not None), doc("letters, digits, _ and -")
]
Sentence = Annotated[
    str, Predicate(lambda text: text.strip() != ""), doc("a text that is not empty")
]
Settings = dict[str, Any]


@dataclass(frozen=True)
class LeastEffect:
    """The least effect that matters: a difference, or (``relative``) a fraction of the baseline."""

    size: float
    relative: bool

    def __str__(self) -> str:
        return least_text(self.size, self.relative)


@dataclass(frozen=True)
class Claim:
    """One claim. Without ``scenes``, it is about all scenes of the file.

    ``not_testable`` says why this file cannot test the claim, for example because the paper's size
    is out of reach.
    """

    id: Name
    says: Sentence
    where: Sentence
    baseline: Name
    arm: Name
    metric: Name
    direction: Literal["higher", "lower", "same"]
    least: float | str
    refuted_if: Sentence
    scenes: list[Name] = field(default_factory=list)
    budget: Settings = field(default_factory=dict)
    split: Settings = field(default_factory=dict)
    not_testable: str = ""

    @property
    def sign(self) -> int:
        """The sign of the claimed difference, arm minus baseline; 0 if no difference is claimed."""
        return DIRECTIONS[self.direction]

    @property
    def effect(self) -> LeastEffect:
        return read_least(self.least, f"claim {self.id}")


@dataclass(frozen=True)
class ClaimsFile:
    """A checked file of claims.

    ``error_rate`` is the chance that any verdict is false; all tested claims share it.
    ``seeds`` is the largest number of seeds of each scene and arm. ``size`` describes the
    paper's own experiments in words.
    """

    name: Name
    paper: Sentence
    seeds: Annotated[int, Interval(ge=FIRST_LOOK, le=MAX_SEEDS)]
    scenes: dict[str, Any]  # the settings of each scene
    arms: dict[str, Any]  # the settings of each arm
    claims: list[Claim]
    settings: Settings = field(default_factory=dict)
    error_rate: Annotated[float, Interval(gt=0, le=MAX_ALPHA)] = ALPHA
    size: str = ""

    def words(self, claim: Claim, scene: str, arm: str) -> list[str]:
        """The settings of a claim on a scene with an arm, as words without seed and name."""
        chosen = self.settings | self.scenes[scene] | self.arms[arm] | claim.split | claim.budget
        return [f"{key}={value_text(value)}" for key, value in chosen.items()]

    @property
    def looks(self) -> tuple[int, ...]:
        """The numbers of seeds after which a claim may be decided."""
        return plan_looks(self.seeds)

    def question(self, claim: Claim, scenes: Mapping[str, tuple[str, str]]) -> Question:
        """The claim as a question; ``scenes`` has the trial keys of baseline and arm by scene."""
        return Question(
            metric=claim.metric,
            sign=claim.sign,
            least=claim.effect.size,
            relative=claim.effect.relative,
            baseline=self._arm(claim.baseline),
            arm=self._arm(claim.arm),
            scenes=dict(scenes),
            seeds=tuple(range(self.seeds)),
            name=claim.id,
        )

    def _arm(self, name: str) -> Arm:
        return Arm(
            "", name, tuple((key, value_text(value)) for key, value in self.arms[name].items())
        )


def read_claims(path: Path) -> ClaimsFile:
    """Read and check a file of claims.

    Raises InputError, one line that says where the fault is and how to fix it.
    """
    try:
        content = read_yaml(resolved(path))
    except FileNotFoundError:
        raise InputError(
            f"{path} cannot be read (there is no such file): give a file of claims (docs/claims.md)"
        ) from None
    try:
        return parse_claims(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def parse_claims(content: object) -> ClaimsFile:
    """Check the content of a file of claims; raises InputError as `read_claims` does."""
    if not isinstance(content, dict):
        raise InputError("it must be a mapping with name, paper, seeds, scenes, arms and claims")
    entries: dict[str, Any] = {str(key): value for key, value in content.items()}
    listed = entries.pop("claims", None)
    values = check_values(ClaimsFile, entries, "")
    _require(ClaimsFile, {*values, "claims"}, "")
    scenes = _named_settings(values["scenes"], "scenes", "scene")
    arms = _named_settings(values["arms"], "arms", "densify")
    _check_settings(values.get("settings", {}), "settings")
    if not isinstance(listed, list) or not listed:
        raise InputError("claims must be a list of at least one claim")
    claims = [_claim(entry, number) for number, entry in enumerate(listed, 1)]
    file = ClaimsFile(**(values | {"scenes": scenes, "arms": arms, "claims": claims}))
    for claim in claims:
        _check_claim(claim, file)
    ids = [claim.id for claim in claims]
    if twice := [name for name in ids if ids.count(name) > 1]:
        raise InputError(f"two claims have the id {twice[0]}: give each its own")
    return file


def read_least(value: float | str, where: str) -> LeastEffect:
    """Read ``0.005``, or ``10%`` of the baseline's value.

    Raises InputError unless it is a number above 0.
    """
    text = str(value).strip()
    relative = text.endswith("%")
    try:
        size = float(text.removesuffix("%")) / (100 if relative else 1)
    except ValueError:
        size = math.nan
    if not math.isfinite(size) or size <= 0:
        raise InputError(f"{where}: least must be a number above 0, got {value!r}: {NO_SIZE}")
    return LeastEffect(size, relative)


def _claim(entry: object, number: int) -> Claim:
    where = f"claims[{number}]"
    if not isinstance(entry, dict):
        raise InputError(f"{where} must be a mapping with id, says, where, …, got {entry!r}")
    values = check_values(Claim, {str(key): value for key, value in entry.items()}, where)
    _require(Claim, values, where)
    return Claim(**values)


def _require(cls: type, values: Iterable[str], where: str) -> None:
    """Raise InputError for the first field without a default that was not given."""
    given = set(values)
    for entry in fields(cls):
        required = entry.default is entry.default_factory  # both are dataclasses.MISSING
        if required and entry.name not in given:
            raise InputError(
                f"{where}{'.' if where else ''}{entry.name} is not given: a claim needs it "
                "(docs/claims.md)"
            )


def _named_settings(groups: Mapping[str, Any], where: str, group: str) -> dict[str, Settings]:
    """The settings of scenes or arms by name.

    A name without settings is a choice of the settings group ``group``.
    """
    if not groups:
        raise InputError(f"{where} must name at least one, as {where}: {{courtyard: {{}}}}")
    by_name = {}
    for name, settings in groups.items():
        if not NAME.fullmatch(str(name)):
            raise InputError(f"{where}: {name!r} must be a name of letters, digits, _ and -")
        if settings is not None and not isinstance(settings, dict):
            raise InputError(
                f"{where}.{name} must be a mapping of settings, as {{{group}: {name}}}, got "
                f"{settings!r}"
            )
        _check_settings(settings or {}, f"{where}.{name}")
        by_name[str(name)] = dict(settings or {group: str(name)})
    return by_name


def _check_settings(settings: Mapping[str, Any], where: str) -> None:
    for key, value in settings.items():
        if not isinstance(key, str) or not KEY.fullmatch(key):
            raise InputError(f"{where}: {key!r} is not a setting such as scene.max_size")
        if key.lstrip("+~") in GIVEN_BY_CHECK:
            raise InputError(f"{where}: {key} is set by the plan itself: leave it out")
        # A file of claims may come from a stranger, so it cannot allow the import of other code.
        if key.lstrip("+~") == PERMISSIONS:
            raise InputError(
                f"{where}: no file can allow code to run: type {PERMISSIONS}=[…] after the file's "
                "name"
            )
        if isinstance(value, dict):
            raise InputError(
                f"{where}.{key} must be one value: write nested settings with dots, as "
                f"{key}.NAME: …"
            )


def _check_claim(claim: Claim, file: ClaimsFile) -> None:
    where = f"claim {claim.id}"
    named = [("baseline", claim.baseline, file.arms), ("arm", claim.arm, file.arms)]
    named += [("scene", scene, file.scenes) for scene in claim.scenes]
    for role, name, known in named:
        if name not in known:
            raise InputError(
                f"{where}: the file has no {role} {name!r}{did_you_mean(name, known)} (there are "
                f"{', '.join(known)})"
            )
    if claim.baseline == claim.arm:
        raise InputError(f"{where}: {claim.arm} is compared with itself: name two arms")
    if len(set(claim.scenes)) < len(claim.scenes):
        raise InputError(f"{where}: a scene is listed twice in {', '.join(claim.scenes)}")
    for group, settings in (("budget", claim.budget), ("split", claim.split)):
        _check_settings(settings, f"{where}, {group}")
    _check_metric(claim, file)


def _check_metric(claim: Claim, file: ClaimsFile) -> None:
    where, names = f"claim {claim.id}", askable_names()
    prefix = f"eval.extra.{claim.metric}."
    if claim.metric not in names and not any(
        key.lstrip("+").startswith(prefix) for key in file.settings
    ):
        raise InputError(
            f"{where}: {claim.metric!r} is not a metric{did_you_mean(claim.metric, names)} (choose "
            f"{', '.join(names)}; one of your own by settings: {{{prefix}_target_: mine.MyMetric}})"
        )
    effect = claim.effect
    if asked_quantity(claim.metric).cost and not effect.relative:
        raise InputError(
            f"{where}: least of {claim.metric} must be a part, such as 10%, got {effect}"
        )
    if claim.metric in ("ssim", "flip") and not effect.relative and effect.size >= 1:
        raise InputError(f"{where}: least {effect} is more than {claim.metric} can differ by")
