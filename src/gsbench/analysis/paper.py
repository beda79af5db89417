"""A paper's printed results as data, and the settings that a paper leaves open or in which gsbench differs from it.

The values of gsbench are read from the recorded configurations of trials; what the paper says of a setting stands with
its numbers, as ``setup`` of its YAML. A choice of which that says nothing is not shown, nor one in which both agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import yaml

from gsbench.analysis.results import TrialResult
from gsbench.eval.facts import LPIPS, find
from gsbench.eval.protocol import PAPER, protocol_of
from gsbench.runs.trial_record import BY_LISTS

NOT_RECORDED = "not recorded"
PLACES = {"sampled": "drawn from the parent's density", "parent_mean": "the parent's mean"}
ORDERS = {
    "after_adc": "after clone and split, before pruning",
    "before_adc": "before clone and split",
    "after_prune": "after pruning",
}


@dataclass(frozen=True)
class PaperChoice:
    """Words of a paper on one setting, to be read after "the paper"; ``value`` is set where it states all of it."""

    words: str
    value: str | None = None


@dataclass(frozen=True)
class Topic:
    """A choice: ``read`` gives a trial's as text, None where it has none; it may raise KeyError for what is unknown."""

    key: str  # in ``setup`` of a paper's YAML
    label: str
    read: Callable[[TrialResult], str | None]
    detail: Callable[[Sequence[TrialResult]], str] = lambda trials: ""  # of all trials, after their choices


def read_setup(content: Mapping[str, Any]) -> dict[str, PaperChoice]:
    """``setup`` of a paper's YAML: for each topic words, or words with a value. Raises ValueError for another topic."""
    known = [topic.key for topic in TOPICS]
    if unknown := content.keys() - set(known):
        raise ValueError(f"setup: unknown {', '.join(sorted(unknown))}; known are {', '.join(known)}")
    return {
        key: PaperChoice(said) if isinstance(said, str) else PaperChoice(said["words"], str(said["value"]))
        for key, said in content.items()
    }


def choice_lines(trials: Sequence[TrialResult], setup: Mapping[str, PaperChoice]) -> list[str]:
    """A line for each topic of ``setup`` in which our trials and the paper do not state the same."""
    own = [trial for trial in trials if not trial.made_elsewhere]
    lines = []
    for topic in TOPICS:
        chosen: dict[str, list[TrialResult]] = {}
        for trial in own:
            if (text := _read(topic, trial)) is not None:
                chosen.setdefault(text, []).append(trial)
        said = setup.get(topic.key)
        if said is not None and chosen and set(chosen) != {said.value}:
            lines.append(f"{topic.label}: {_of_whom(chosen)}{topic.detail(own)}; the paper {said.words}.")
    return lines


def _read(topic: Topic, trial: TrialResult) -> str | None:
    try:
        return topic.read(trial)
    except KeyError:
        return NOT_RECORDED


def _of_whom(chosen: Mapping[str, Sequence[TrialResult]]) -> str:
    """``2,048 an image for dim, 8,192 an image for sfm``: of several choices, each with those whose it is."""
    if len(chosen) == 1:
        return next(iter(chosen))
    for name in ("init", "densify", "scene"):
        owners = {text: sorted({getattr(trial, name) for trial in trials}) for text, trials in chosen.items()}
        if len({owner for group in owners.values() for owner in group}) == sum(map(len, owners.values())):
            return ", ".join(f"{text} for {' '.join(group)}" for text, group in owners.items())
    return ", ".join(f"{text} in {len(trials)} trials" for text, trials in chosen.items())


def _poses(trial: TrialResult) -> str:
    trial.config["init.name"]  # raises where nothing was recorded
    if trial.config.get("init.poses") == "own":
        return "estimated by each initialiser (init.poses=own)"
    return "the same for all arms of a scene (init.poses=shared)" if "init.poses" in trial.config else "as they came"


def _gauge(trial: TrialResult) -> str:
    own = trial.config["init.name"] and trial.config.get("init.poses") == "own"
    if not own:
        return "that of the given cameras"
    return (
        "moved into that of the reference"
        if trial.config.get("init.align")
        else "as the mapper left it (init.align=false)"
    )


def _keypoints(trial: TrialResult) -> str | None:
    trial.config["init.name"]
    for key in ("max_keypoints", "max_num_features"):
        if (count := trial.config.get(f"init.{key}")) is not None:
            return f"{count:,} an image"
    return None


def _networks(trial: TrialResult) -> str | None:
    trial.config["init.name"]
    parts = [trial.config.get(f"init.{key}") for key in ("extractor", "matcher")]
    return " and ".join(map(str, parts)) if all(parts) else None


def _cap(trial: TrialResult) -> str:
    count, cap = trial.config.get("densify.max_gaussians"), trial.config["densify.cap"]
    return "none" if count is None else f"{count:,} (densify.cap={cap})"


def _hold_out(trial: TrialResult) -> str:
    every = f"every {trial.config['scene.test_every']}th image"
    return {"every_nth": every, BY_LISTS: "by lists"}.get(trial.split, trial.split)


def _selection(trial: TrialResult) -> str:
    return f"at most {trial.config['scene.max_images']}, evenly spaced over the sorted names"


def _volume(key: str, say: Callable[[Any], str]) -> Callable[[TrialResult], str | None]:
    """Reads a setting of the volume rule; None for arms without the rule."""

    def read(trial: TrialResult) -> str | None:
        trial.config["densify.name"]  # raises where nothing was recorded
        value = trial.config.get(f"densify.{key}")
        return None if value is None else say(value)

    return read


def _window(trial: TrialResult) -> str | None:
    config = trial.config
    if config.get("densify.volume_order") is None:
        config["densify.name"]  # raises where nothing was recorded
        return None
    start, stop = (
        config[f"densify.{key}"] if config.get(f"densify.volume_{key}") is None else config[f"densify.volume_{key}"]
        for key in ("start", "stop")
    )
    interval = config.get("densify.volume_interval") or config["densify.interval"]
    return f"every {interval} iterations, after {start:,} and before {stop:,}"


def _images(trial: TrialResult) -> str:
    config = trial.config
    text = f"the files of {config['scene.images']}" if config.get("scene.images") else "the photographs"
    if config["scene.downscale"] != 1:
        text += f" divided by {config['scene.downscale']}"
    if config.get("scene.max_size") is not None:
        text += f" at most {config['scene.max_size']} px long"
    return f"{text} ({config['scene.resample']} where shrunk)"


def _sizes(trials: Sequence[TrialResult]) -> str:
    """`` at 400×300 px``, or the smallest and the largest."""
    sizes = sorted({tuple(size) for trial in trials if (size := trial.record.resolution)}, key=math.prod)
    shown = [f"{width}×{height}" for width, height in dict.fromkeys([*sizes[:1], *sizes[-1:]])]
    return f", {' to '.join(shown)} px" if shown else ""


def _lpips(trial: TrialResult) -> str:
    protocol = protocol_of(trial.record.protocol) or PAPER
    facts = find(f"{LPIPS}{protocol.lpips}")
    assert facts is not None
    return f"net {facts.options['net']}, fed [{'0' if facts.options['raw'] else '−1'}, 1]"


TOPICS = (
    Topic("poses", "Poses", _poses),
    Topic("gauge", "Gauge (the unit of V_th)", _gauge),
    Topic("keypoints", "Keypoints", _keypoints),
    Topic("networks", "Matching networks", _networks),
    Topic("cap", "Cap of Gaussians", _cap),
    Topic("opacity", "Learning rate of opacity", lambda trial: str(trial.config["train.opacity"])),
    Topic("iterations", "Iterations", lambda trial: str(trial.record.iterations)),
    Topic("images", "Images", _images, _sizes),
    Topic("hold_out", "Held out", _hold_out),
    Topic("selection", "Images of a large scene", _selection),
    Topic("children", "Children of a volume split", _volume("volume_children", str)),
    Topic("placement", "Their places", _volume("placement", PLACES.__getitem__)),
    Topic("order", "Order of the volume rule", _volume("volume_order", ORDERS.__getitem__)),
    Topic("window", "Window of the volume rule", _window),
    Topic("hardware", "Hardware", lambda trial: trial.machine or NOT_RECORDED),
    Topic("lpips", "LPIPS weights", _lpips),
)


TABLE1_QUANTITIES = ("ssim", "psnr", "lpips_vgg_raw", "gaussians_millions", "train_minutes")
TABLE1_ARMS = (("dim", "adc"), ("dim", "volumetric"))
TABLE2_ARMS = (("sfm", "adc"), ("dim", "adc"), ("sfm", "volumetric"), ("dim", "volumetric"))
ARM_NAMES = {"adc": "3DGS", "volumetric": "Ours"}
INIT_NAMES = {"sfm": "SfM", "dim": "DIM"}


@dataclass(frozen=True)
class Printed:
    """A printed number; it stands for anything within half a step of its last digit."""

    text: str

    @property
    def value(self) -> float:
        return float(self.text)

    @property
    def half_step(self) -> float:
        _, _, digits = self.text.partition(".")
        return 0.5 * 10.0 ** -len(digits)

    @property
    def range(self) -> tuple[float, float]:
        return self.value - self.half_step, self.value + self.half_step


Key = tuple[str, str, str, str]  # scene, init, densify, quantity


@dataclass(frozen=True)
class Paper:
    """Both tables: ``table1`` and ``table2`` map (scene, init, densify, quantity) to the printed number."""

    table1: Mapping[Key, Printed]
    table2: Mapping[Key, Printed]
    contradictions: tuple[str, ...]  # of the paper with itself, a sentence each
    setup: Mapping[str, PaperChoice]

    def table(self, name: str) -> Mapping[Key, Printed]:
        return {"table1": self.table1, "table2": self.table2}[name]

    def scenes(self, name: str) -> list[str]:
        """The scenes of a table in the printed order."""
        return list(dict.fromkeys(key[0] for key in self.table(name)))


@cache
def load_paper() -> Paper:
    """The paper's tables from the file that ships with the package."""
    content = yaml.safe_load(files("gsbench.analysis").joinpath("paper.yaml").read_text(encoding="utf-8"))
    table1: dict[Key, Printed] = {}
    for scene, (_, *pairs) in content["table1"]["scenes"].items():
        for quantity, pair in zip(TABLE1_QUANTITIES, pairs, strict=True):
            for (init, densify), text in zip(TABLE1_ARMS, pair, strict=True):
                table1[scene, init, densify, quantity] = Printed(text)
    table2 = {
        (scene, init, densify, "lpips_vgg_raw"): Printed(text)
        for scene, texts in content["table2"]["scenes"].items()
        for (init, densify), text in zip(TABLE2_ARMS, texts, strict=True)
    }
    return Paper(table1, table2, tuple(content["contradictions"]), read_setup(content["setup"]))
