"""Renders as a trial beside the arms of an experiment.

Such a trial has only metrics and pictures: no model, no times, and an unknown number of iterations.
Tables show unknown values as missing, and say which arms were evaluated from renders.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from PIL import Image

from gsbench.analysis.addresses import ArmName
from gsbench.analysis.quantities import COSTS, asked_quantity
from gsbench.analysis.questions import Asked, announce, ask
from gsbench.analysis.results import TrialResult, read_experiment
from gsbench.analysis.trial_result import Planned, config_if_readable
from gsbench.config.overrides import parse_word
from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator
from gsbench.eval.pictures import PicturePair, read_picture
from gsbench.files import atomic, file_sha256, write_text
from gsbench.pipeline.results import versions
from gsbench.pipeline.steps.evaluate import summary_of, write_per_view
from gsbench.renders.sources import ReferenceImages
from gsbench.runs.code import states_of
from gsbench.runs.commands import (
    Command,
    History,
    append,
    command_now,
    make_digest,
    read_history,
    shared_hash,
)
from gsbench.runs.configuration import flatten, sha256_of
from gsbench.runs.keys import CODE_OF_STAGE, EVALUATE
from gsbench.runs.layout import CONFIG, GROUND_TRUTH, IN_RUNS, MASKS, PER_VIEW, RENDERS, SEED
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import FROM_RENDERS, RENDERS_ALONE, Code, TrialRecord
from gsbench.scene.images import png_name
from gsbench.settings import FOLDER_RULE, is_folder_name

log = logging.getLogger(__name__)

PerView = Mapping[str, Mapping[str, float]]  # values by metric, by view
# groups of the configuration that apply to renders too
KEPT_GROUPS = ("scene", "eval", "tracking", "launch")


@dataclass(frozen=True)
class Destination:
    """The trial that renders become; ``settings`` (dotted keys) tell apart arms of one name."""

    experiment: str
    scene: str
    init: str
    densify: str
    seed: int
    settings: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class Measured:
    """Pictures of the views ``truth``, measured; ``source`` says where they came from."""

    truth: ReferenceImages
    pairs: Sequence[PicturePair]
    per_view: PerView
    evaluator: Evaluator
    source: Mapping[str, str]


def find_destination(
    word: str, scene: str | None, seed: int, truth: ReferenceImages, runs: Path
) -> Destination:
    """The destination that ``EXPERIMENT:ARM`` names: NAME or INIT-NAME, perhaps with [KEY=VALUE].

    If ARM names no initialiser, it is taken from the experiment's trials of the scene, else from
    the trial of ``truth``. Raises `InputError` if several are possible.
    """
    experiment, _, typed = word.partition(":")
    typed_arm = ArmName.read(typed)
    arm = typed_arm.name
    scene_name = scene or truth.scene
    if not (is_folder_name(experiment) and is_folder_name(arm)):
        raise InputError(f"--as {word} is not EXPERIMENT:ARM, such as table1:sfm-mine")
    # on file systems without capitals, "Store" is "store"
    if experiment.casefold() in IN_RUNS:
        raise InputError(
            f"--as {word}: {experiment} is gsbench's own folder of {runs}: name an experiment"
        )
    if seed < 0:
        raise InputError(f"--seed {seed}: must be 0 or more")
    if scene is not None and not is_folder_name(scene):
        raise InputError(f"--scene {scene}: must be {FOLDER_RULE}")
    if scene is not None and truth.scene not in (None, scene):
        raise InputError(
            f"--scene {scene}: the photographs are {truth.what}, of the scene {truth.scene}: "
            "leave it out"
        )
    if scene_name is None:
        raise InputError("--as: a folder of photographs has no scene's name: give it with --scene")
    init, dash, name = arm.partition("-")
    if not dash:
        init, name = truth.init or "", arm
        trials = _trials(runs / experiment, scene_name)
        # the trials that gsbench trained come before those made of renders
        trained = [trial for trial in trials if not trial.from_renders]
        inits = sorted({trial.init for trial in trained or trials})
        if len(inits) > 1:
            raise InputError(
                f"{experiment} has {', '.join(inits)} on {scene_name}: say which, as in "
                f"--as {experiment}:{inits[0]}-{arm}"
            )
        init = inits[0] if inits else init or "renders"
    named = (
        (key if "." in key else f"densify.{key}", value)
        for key, value in typed_arm.settings.items()
    )
    settings = tuple((key, parse_word(f"{key}={value}").value()) for key, value in named)
    return Destination(experiment, scene_name, init, name, seed, settings)


def check_destination(destination: Destination, truth: ReferenceImages, runs: Path) -> None:
    """Raise `InputError` if the experiment tests the scene on other photographs."""
    for trial in _trials(runs / destination.experiment, destination.scene):
        # Values of other photographs, or of another size, cannot be compared with the trial's.
        conditions = trial.conditions
        size = "x".join(map(str, truth.resolution))
        if conditions["data"] != truth.data or conditions["resolution"] != size:
            raise InputError(
                f"{destination.experiment} tests {destination.scene} on other photographs (such as "
                f"{trial.label}, {conditions['resolution']} px) than {truth.what} ({size} px), so "
                "nothing could be compared: give --truth "
                f"{destination.experiment}:{destination.scene}:{trial.init}-{trial.densify}"
            )


def import_trial(
    destination: Destination, measured: Measured, runs: Path, primary: str = ""
) -> Path:
    """Write the trial's folder and return it. The same renders always go to the same folder.

    With a metric ``primary``, their question is written first.

    Raises `InputError` if the destination already holds other renders.
    """
    renders = {pair.view: file_sha256(pair.picture) for pair in measured.pairs}
    protocol, data = measured.evaluator.protocol.id, measured.truth.data
    identity = sha256_of({"renders": renders, "data": data, "protocol": protocol})
    name = f"{destination.init}-{destination.densify}"
    arm = runs / destination.experiment / destination.scene / name
    folder = arm / f"{identity[:8]}{SEED}{destination.seed}"
    config = _config(destination, measured.truth, runs)
    # Two trainings with one seed would count as one pair in every comparison.
    for other in arm.glob(f"*{SEED}{destination.seed}"):
        read = config_if_readable(other)
        is_same = not read or all(read.get(key) == value for key, value in destination.settings)
        if other != folder and is_same:
            raise InputError(
                f"seed {destination.seed} of {name} on {destination.scene} is taken ({other}): "
                "give another --seed, or remove that folder"
            )
    for pair in measured.pairs:
        files = {RENDERS: pair.picture, GROUND_TRUTH: pair.photograph, MASKS: pair.mask}
        for kind, file in files.items():
            if file is None:  # all pixels of the view count
                continue
            (folder / kind).mkdir(parents=True, exist_ok=True)
            with atomic(folder / kind / png_name(pair.view), sync=False) as temporary:
                pixels = read_picture(file, is_render=kind == RENDERS)
                Image.fromarray(pixels).save(temporary, format="PNG")
    write_text(folder / CONFIG, yaml.safe_dump(config, sort_keys=False))
    write_per_view(folder / PER_VIEW, measured.per_view)
    asked = ask_about(destination, config, primary, folder) if primary else []
    results = _results(destination, measured, identity, asked)
    TrialFolder(folder).write_finished(config, results)
    return folder


def ask_about(
    destination: Destination, config: Mapping[str, Any], primary: str, folder: Path
) -> list[str]:
    """Write the question about renders, unless it was asked; returns the ids of those that cover.

    It is about all scenes and seeds that the baseline has: the other renders of the method come by
    further commands, and there is no verdict before all are there.
    """
    home, name = folder.parents[2], f"{destination.init}-{destination.densify}"
    baseline = config["eval"].get("baseline") or "adc"
    trials = read_experiment(home).trials
    own = [t for t in trials if (t.init, t.densify) == (destination.init, baseline)]
    this = destination.scene, destination.seed
    places = dict.fromkeys([*((trial.scene, trial.seed) for trial in own), this])
    config_hash = shared_hash("", config["densify"])
    digest = make_digest(name, config_hash, {}, states_of(CODE_OF_STAGE[EVALUATE.name]))
    flat = flatten(config)
    planned = [
        Planned(scene, destination.init, destination.densify, config_hash, seed, flat, digest)
        for scene, seed in places
    ]
    quantity = asked_quantity(primary, trials)
    least, sign = quantity.worthwhile, quantity.direction
    asked = Asked(metric=primary, sign=sign, least=least, baseline=baseline)

    def make(history: History) -> Command | None:
        found, _ = ask(planned, asked, trials, history)
        for question in found:
            log.info("%s: %s", home.name, announce(question))
        return command_now(questions=tuple(found)) if found else None

    append(home, make)
    return [question.id for question in read_history(home).covering(digest, *this)]


def _results(
    destination: Destination, measured: Measured, identity: str, asked: list[str]
) -> TrialRecord:
    evaluation = summary_of(measured.evaluator, measured.per_view)
    place = {name: value for name, value in vars(destination).items() if name != "settings"}
    return TrialRecord(
        status="complete",
        **place,
        questions=asked,
        evaluated_from=FROM_RENDERS,
        raster="unknown",
        protocol=measured.evaluator.protocol.id,
        iterations=0,
        metrics=evaluation.metrics,
        unavailable=evaluation.unavailable | dict.fromkeys(COSTS, RENDERS_ALONE),
        awaited=evaluation.awaited,
        metric_facts=evaluation.facts,
        num_init_points=None,
        num_gaussians=None,
        seconds={},
        peak_memory_mb=None,
        test_views=len(measured.per_view),
        resolution=measured.truth.resolution,
        renders=dict(measured.source),
        hashes={"config": identity, "data": measured.truth.data},
        code=Code(
            stages={EVALUATE.name: EVALUATE.version},
            packages=states_of(CODE_OF_STAGE[EVALUATE.name]),
        ),
        versions=versions(),
    )


def _config(destination: Destination, truth: ReferenceImages, runs: Path) -> dict[str, Any]:
    groups = {group: truth.config[group] for group in KEPT_GROUPS}
    own = truth.config["init"]
    config = {
        "name": destination.experiment,
        "seed": destination.seed,
        "runs": str(runs),
        **groups,
        "scene": dict(groups["scene"]) | {"name": destination.scene},
        "init": own if own["name"] == destination.init else {"name": destination.init},
        "densify": {"name": destination.densify, "evaluated_from": FROM_RENDERS},
    }
    for key, value in destination.settings:
        group, _, name = key.partition(".")
        config[group] = dict(config.get(group, {})) | {name: value}
    return config


def _trials(home: Path, scene: str) -> list[TrialResult]:
    """The experiment's trials of a scene; none if the experiment does not exist yet."""
    trials = read_experiment(home).trials if home.is_dir() else []
    return [trial for trial in trials if trial.scene == scene]
