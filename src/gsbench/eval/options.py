"""The settings of an evaluation: protocol, metrics, and the declared metric of the verdict."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from annotated_types import Predicate, doc
from pydantic import PositiveInt

from gsbench.errors import InputError
from gsbench.eval.facts import (
    LPIPS,
    MORE,
    find_metric,
    further_keys,
    known_keys,
    lpips_variants,
)
from gsbench.eval.protocol import PROTOCOLS
from gsbench.runs.experiments import AT, QUESTIONS, metric_and_question
from gsbench.settings import MISSING, FolderName, PathName, check_settings
from gsbench.words import did_you_mean

DISTANCE = "distance"  # the value of ``eval.regions`` that asks for `DISTANCES`
DISTANCES = ("near", "middle", "far")
METRIC_NAME = re.compile(r"[a-z][a-z0-9_]*")
# keys of metrics, the column of views, and the protocol's LPIPS
RESERVED_NAMES = (*known_keys(), "view", "lpips")


def all_different(values: list[Any]) -> bool:
    """Return whether no value occurs twice in a list."""
    return len(set(values)) == len(values)


ProtocolName = Annotated[
    str,
    Predicate(lambda name: name in PROTOCOLS),
    doc(" or ".join(f"'{name}'" for name in PROTOCOLS)),
]
AT_RULE = "a list of different iterations, at which the test views are measured beside the last"
CONTROLS_RULE = "a mapping {ARM: ARM}: the arm, beside the baseline, that an arm is compared with"
LPIPS_RULE = f"a list of {', '.join(lpips_variants())}, each at most once"
LpipsVariant = Annotated[str, Predicate(lambda name: name in lpips_variants())]
REGIONS_RULE = f"{DISTANCE} ({', '.join(DISTANCES)}), or a mapping {{NAME: FOLDER of masks}}"
MORE_RULE = f"a list of {', '.join(further_keys())}, each at most once"
FurtherMetric = Annotated[str, Predicate(lambda name: name in further_keys())]


@dataclass
class EvalConfig:
    name: str = MISSING
    protocol: ProtocolName = MISSING
    lpips: Annotated[list[LpipsVariant], Predicate(all_different), doc(LPIPS_RULE)] = field(
        default_factory=lambda: list(lpips_variants())
    )
    flip: bool = True
    more: Annotated[list[FurtherMetric], Predicate(all_different), doc(MORE_RULE)] = field(
        default_factory=list
    )
    # metrics of your own: {name: {_target_: mine.MyMetric}}
    extra: dict[str, Any] = field(default_factory=dict)
    at: Annotated[list[PositiveInt], Predicate(all_different), doc(AT_RULE)] = field(
        default_factory=list
    )
    # parts of the test views that are measured apart; folders lie below scene.path
    regions: Annotated[dict[str, PathName] | Literal["distance"], doc(REGIONS_RULE)] | None = None
    # the metric of the verdict; psnr@far: in a region; psnr@extrapolation: for one of two splits
    primary: str | None = "psnr"
    baseline: FolderName = "adc"  # the densifier that ideas are compared with
    # {longaxis: absgrad}
    controls: Annotated[dict[str, FolderName], doc(CONTROLS_RULE)] = field(default_factory=dict)
    weights: PathName | None = None  # folder; null: $GSBENCH_WEIGHTS, then the torch hub cache
    download: bool = True  # fetch missing weights, checked by checksum

    def __post_init__(self) -> None:
        check_settings(self, "eval")
        for name, options in self.extra.items():
            if not METRIC_NAME.fullmatch(name) or name in RESERVED_NAMES:
                raise InputError(
                    f"eval.extra.{name}: name your metric in small letters, digits and "
                    f"underscores, and none of {', '.join(RESERVED_NAMES)}"
                )
            if not isinstance(options, Mapping) or "_target_" not in options:
                raise InputError(
                    f"eval.extra.{name} must name a class, as "
                    f"eval.extra.{name}._target_=mine.MyMetric"
                )
        if self.primary is not None:
            metric, _, region = metric_and_question(self.primary)[0].partition(AT)
            if (region or AT in self.primary) and region not in ["", *self.region_names]:
                names = [*self.region_names, *QUESTIONS.values()]
                raise InputError(
                    f"eval.primary={self.primary}: after {AT} comes one of {', '.join(names)}; "
                    "eval.regions=distance adds near, middle and far"
                )
            if region and metric.startswith(LPIPS):
                raise InputError(
                    f"eval.primary={self.primary}: LPIPS is not measured in regions, because its "
                    "features reach beyond them: take psnr, ssim or flip"
                )
            if metric not in self.extra:
                self._check_primary(metric)

    @property
    def region_names(self) -> tuple[str, ...]:
        """The names of the regions that are measured apart."""
        return DISTANCES if self.regions == DISTANCE else tuple(self.regions or ())

    def _check_primary(self, key: str) -> None:
        """Raise InputError unless these settings ask for a metric of gsbench with this key."""
        facts = find_metric(key)
        if facts is None:
            known = [*known_keys(), *self.extra]
            raise InputError(
                f"eval.primary={key} is not a metric{did_you_mean(key, known)} (known are "
                f"{', '.join(known)}; your own metric by its name under eval.extra)"
            )
        variant = key.removeprefix(LPIPS)
        is_lacking, mend = {
            "eval.flip": (not self.flip, " with eval.flip=false"),
            MORE: (key not in self.more, f": add {key} to eval.more"),
            "eval.lpips": (variant not in self.lpips, f": add {variant} to eval.lpips"),
        }.get(facts.setting, (False, ""))
        if is_lacking:
            raise InputError(f"eval.primary={key} is not measured{mend}")
