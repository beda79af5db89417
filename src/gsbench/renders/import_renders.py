"""Importing renders of another program as a trial of an experiment.

Such a trial has only metrics and pictures: no model, no times, and an unknown number of iterations. Tables show unknown
values as missing, and say which arms were evaluated from renders.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from PIL import Image

from gsbench.analysis.results import TrialResult, read_experiment
from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator
from gsbench.eval.pictures import PicturePair
from gsbench.files import atomic, file_sha256, write_text
from gsbench.pipeline.steps.evaluate import summary_of, write_per_view
from gsbench.pipeline.trial import versions
from gsbench.renders.reference_images import ReferenceImages
from gsbench.runs.code import ROOMS, states_of
from gsbench.runs.keys import EVALUATE, sha256_of
from gsbench.runs.layout import CONFIG, GROUND_TRUTH, IN_RUNS, MASKS, PER_VIEW, RENDERS, SEED
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import FROM_RENDERS, RENDERS_ALONE, Code, TrialRecord
from gsbench.scene.images import png_name, read_image
from gsbench.settings import is_folder_name

KEPT_GROUPS = ("scene", "eval", "tracking", "launch")  # groups of the configuration that apply to renders too


@dataclass(frozen=True)
class Destination:
    """The trial that renders become: experiment, scene, arm (initialiser and densifier) and seed."""

    experiment: str
    scene: str
    init: str
    densify: str
    seed: int


def find_destination(word: str, scene: str | None, seed: int, truth: ReferenceImages, runs: Path) -> Destination:
    """The destination that ``EXPERIMENT:ARM`` names; ARM is a name, or INIT-NAME.

    If ARM names no initialiser, it is taken from the experiment's trials of the scene, else from the trial of
    ``truth``. Raises `InputError` if several are possible.
    """
    experiment, _, arm = word.partition(":")
    scene_name = scene or truth.scene
    if not is_folder_name(experiment) or not is_folder_name(arm):
        raise InputError(f"--as {word} is not EXPERIMENT:ARM, such as table1:sfm-mine")
    if experiment.casefold() in IN_RUNS:
        raise InputError(f"--as {word}: {experiment} is gsbench's own folder of {runs}: name an experiment")
    if seed < 0:
        raise InputError(f"--seed {seed}: must be 0 or more")
    if scene is not None and not is_folder_name(scene):
        raise InputError(f"--scene {scene}: must be a plain folder name")
    if scene is not None and truth.scene not in (None, scene):
        raise InputError(f"--scene {scene}: the photographs are {truth.what}, of the scene {truth.scene}: leave it out")
    if scene_name is None:
        raise InputError("--as: a folder of photographs has no scene's name: give it with --scene")
    init, dash, name = arm.partition("-")
    if not dash:
        init, name = truth.init or "", arm
        trials = _trials(runs / experiment, scene_name)
        inits = sorted({trial.init for trial in trials if not trial.from_renders}) or sorted({t.init for t in trials})
        if len(inits) > 1:
            raise InputError(
                f"{experiment} has {', '.join(inits)} on {scene_name}: say which, as in "
                f"--as {experiment}:{inits[0]}-{arm}"
            )
        init = inits[0] if inits else init or "renders"
    return Destination(experiment, scene_name, init, name, seed)


def check_destination(destination: Destination, truth: ReferenceImages, runs: Path) -> None:
    """Raise `InputError` if the experiment's trials of the scene were tested on other photographs."""
    for trial in _trials(runs / destination.experiment, destination.scene):
        conditions = trial.conditions
        size = "x".join(map(str, truth.resolution))
        if conditions["data"] != truth.data or conditions["resolution"] != size:
            raise InputError(
                f"{destination.experiment} tests {destination.scene} on other photographs (such as {trial.label}, "
                f"{conditions['resolution']} px) than {truth.what} ({size} px), so nothing could be compared: give "
                f"--truth {destination.experiment}:{destination.scene}:{trial.init}-{trial.densify}"
            )


def import_trial(
    destination: Destination,
    truth: ReferenceImages,
    pairs: Sequence[PicturePair],
    per_view: Mapping[str, Mapping[str, float]],
    evaluator: Evaluator,
    source: Mapping[str, str],
    runs: Path,
) -> Path:
    """Write the trial's folder and return it. The same renders always go to the same folder.

    ``source`` says where the renders came from. Raises `InputError` if the destination already holds other renders.
    """
    renders = {pair.view: file_sha256(pair.picture) for pair in pairs}
    identity = sha256_of({"renders": renders, "data": truth.data, "protocol": evaluator.protocol.id})
    arm = runs / destination.experiment / destination.scene / f"{destination.init}-{destination.densify}"
    folder = arm / f"{identity[:8]}{SEED}{destination.seed}"
    if taken := [other for other in arm.glob(f"*{SEED}{destination.seed}") if other != folder]:
        raise InputError(
            f"seed {destination.seed} of {destination.init}-{destination.densify} on {destination.scene} is taken "
            f"({taken[0]}): give another --seed, or remove that folder"
        )
    for name, files in (
        (RENDERS, {png_name(pair.view): pair.picture for pair in pairs}),
        (GROUND_TRUTH, {png_name(pair.view): pair.photograph for pair in pairs}),
        (MASKS, {png_name(pair.view): pair.mask for pair in pairs if pair.mask is not None}),
    ):
        if files:
            (folder / name).mkdir(parents=True, exist_ok=True)
        for target, file in files.items():
            with atomic(folder / name / target, sync=False) as temporary:
                Image.fromarray(read_image(file)).save(temporary, format="PNG")
    config = _config(destination, truth, runs)
    write_text(folder / CONFIG, yaml.safe_dump(config, sort_keys=False))
    write_per_view(folder / PER_VIEW, per_view)
    TrialFolder(folder).write_finished(config, _results(destination, truth, identity, per_view, evaluator, source))
    return folder


def _results(
    destination: Destination,
    truth: ReferenceImages,
    identity: str,
    per_view: Mapping[str, Mapping[str, float]],
    evaluator: Evaluator,
    source: Mapping[str, str],
) -> TrialRecord:
    evaluation = summary_of(evaluator, per_view)
    unknown = dict.fromkeys(("gaussians", "train_time", "init_points", "total_time", "peak_memory_mb"), RENDERS_ALONE)
    return TrialRecord(
        status="complete",
        experiment=destination.experiment,
        scene=destination.scene,
        init=destination.init,
        densify=destination.densify,
        seed=destination.seed,
        evaluated_from=FROM_RENDERS,
        raster="unknown",
        protocol=evaluator.protocol.id,
        iterations=0,
        metrics=evaluation.metrics,
        unavailable=evaluation.unavailable | unknown,
        awaited=evaluation.awaited,
        metric_facts=evaluation.facts,
        num_init_points=None,
        num_gaussians=None,
        seconds={},
        peak_memory_mb=None,
        test_views=len(per_view),
        resolution=truth.resolution,
        renders=dict(source),
        hashes={"config": identity, "data": truth.data},
        code=Code(stages={EVALUATE.name: EVALUATE.version}, rooms=states_of(ROOMS[EVALUATE.name])),
        versions=versions(),
    )


def _config(destination: Destination, truth: ReferenceImages, runs: Path) -> dict[str, Any]:
    groups = {group: truth.config[group] for group in KEPT_GROUPS}
    own = truth.config["init"] if truth.config["init"]["name"] == destination.init else {"name": destination.init}
    names: dict[str, Any] = {"name": destination.experiment, "seed": destination.seed, "runs": str(runs)}
    groups["scene"] = dict(groups["scene"]) | {"name": destination.scene}
    return names | groups | {"init": own, "densify": {"name": destination.densify, "evaluated_from": FROM_RENDERS}}


def _trials(home: Path, scene: str) -> list[TrialResult]:
    """The experiment's trials of a scene; none if the experiment does not exist yet."""
    return [trial for trial in read_experiment(home).trials if trial.scene == scene] if home.is_dir() else []
