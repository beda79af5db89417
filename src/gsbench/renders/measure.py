"""The work of ``gsbench evaluate``: measuring renders of any program, and importing them.

Renders are compared with the photographs of a trial, of a scene as a trial would see it, or of a
folder. An imported trial has only metrics and pictures: no model, no times, and an unknown number
of iterations. Tables show unknown values as missing, and say which arms were evaluated from
renders.
"""

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import yaml
from PIL import Image

from gsbench.analysis.addresses import ArmName
from gsbench.analysis.quantities import COSTS
from gsbench.analysis.results import TrialResult, read_experiment, read_views
from gsbench.analysis.trial_settings import config_if_readable
from gsbench.config.command_words import parse_word, typed_permissions
from gsbench.config.compose import compose_one
from gsbench.config.groups import options
from gsbench.config.permissions import PERMISSIONS
from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator, summarize
from gsbench.eval.facts import METRICS
from gsbench.eval.options import EvalConfig
from gsbench.eval.pictures import Matching, PicturePair, match_by_order, match_pictures, measure
from gsbench.files import atomic, file_sha256, storage_errors, write_text
from gsbench.logs import progress
from gsbench.pipeline.parts import Parts, build_metrics, make_evaluator
from gsbench.pipeline.steps.evaluate import summary_of, write_per_view
from gsbench.pipeline.trial import TrialSteps, versions
from gsbench.renders.predictions import opened_renders
from gsbench.runs import keys
from gsbench.runs.keys import CODE_OF_STAGE, EVALUATE
from gsbench.runs.layout import (
    CONFIG,
    GROUND_TRUTH,
    IN_RUNS,
    MASKS,
    PER_VIEW,
    RENDERS,
    RESULTS,
    SEED,
    STORE,
)
from gsbench.runs.nested import sha256_of
from gsbench.runs.package_code import states_of
from gsbench.runs.store import Store
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import FROM_RENDERS, RENDERS_ALONE, Code, TrialRecord
from gsbench.scene.images import image_size, list_images, png_name, read_image
from gsbench.scene.readers import fingerprint
from gsbench.settings import is_folder_name
from gsbench.system.device import select_device
from gsbench.system.own_modules import allow_modules
from gsbench.system.resources import available_threads
from gsbench.view.trials import find_trial
from gsbench.words import counted, did_you_mean, some_of

PerView = Mapping[str, Mapping[str, float]]  # values by metric, by view
# groups of the configuration that apply to renders too
KEPT_GROUPS = ("scene", "eval", "tracking", "launch")
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


@dataclass(frozen=True)
class Destination:
    """The trial that renders become; ``settings`` (dotted keys) tell apart arms of one name."""

    experiment: str
    scene: str
    init: str
    densify: str
    seed: int
    settings: tuple[tuple[str, Any], ...] = ()


def measure_renders(options: argparse.Namespace, runs: Path) -> None:
    """Measure the renders that the ``options`` of the verb name, and print the values."""
    with opened_renders(Path(options.renders).expanduser()) as (renders, photographs):
        _measure(options, renders, photographs, runs)


def _measure(
    options: argparse.Namespace, renders: Path, photographs: Path | None, runs: Path
) -> None:
    """Measure the pictures in ``renders``; ``photographs`` are used if the command names none."""
    if options.truth is not None:
        truth = _reference_images(options, runs)
    elif photographs is not None:
        truth = _folder(photographs, options.settings)
        truth = replace(truth, what=f"the photographs in {options.renders}")
    else:
        raise InputError(
            "--truth PLACE is needed: only predictions of nerfbaselines bring their photographs"
        )
    destination = None
    if options.place is not None:
        destination = find_destination(options.place, options.scene, options.seed, truth, runs)
        check_destination(destination, truth, runs)
    match = match_by_order if options.by_order else match_pictures
    matching = match(list(truth.photographs), list_images(renders))
    pairs = [
        PicturePair(view, path, renders / matching.pairs[view], truth.masks.get(view))
        for view, path in truth.photographs.items()
    ]
    torch.set_num_threads(available_threads())
    evaluator = _evaluator(truth, options.protocol, options.settings)
    with progress("evaluate") as report:
        per_view = measure(pairs, evaluator, report)
    folder = None
    if destination is not None:
        source = {
            "folder": str(Path(options.renders).expanduser().resolve()),
            "names matched": matching.rule or "as they are",
        }
        with storage_errors(runs):
            folder = import_trial(destination, truth, pairs, per_view, evaluator, source, runs)
    if options.json:
        print(json.dumps(_as_dict(evaluator, matching, per_view, folder), indent=1))
    else:
        print("\n".join(_lines(truth, evaluator, matching, per_view, folder)))


def _reference_images(options: argparse.Namespace, runs: Path) -> ReferenceImages:
    """The photographs; those of a scene come from trials of the experiment in ``--as``, if any."""
    overrides = [
        word for word in options.settings if not word.startswith(("eval", f"{PERMISSIONS}="))
    ]
    experiment = runs / (options.place or "").partition(":")[0]
    if not overrides and options.place and not Path(options.truth).is_dir() and experiment.is_dir():
        trials = [trial for trial in read_experiment(experiment).trials if not trial.from_renders]
        if same_scene := next((trial for trial in trials if trial.scene == options.truth), None):
            return reference_images_of(same_scene)
    truth = find_reference_images(options.truth, options.settings, runs)
    if truth.init is not None and overrides:
        raise InputError(
            f"{overrides[0]}: the settings of {truth.what} are as they are; only eval.… can be "
            "set here"
        )
    return truth


def _evaluator(truth: ReferenceImages, protocol: str | None, settings: Sequence[str]) -> Evaluator:
    """The evaluator with the settings of the photographs' trial or scene, or with the command's."""
    allowed = typed_permissions([word for word in settings if word.startswith(f"{PERMISSIONS}=")])
    allow_modules(allowed)
    config: Mapping[str, Any] = truth.config
    if any(word.startswith("eval") for word in settings):
        own_words = [word for word in settings if word.startswith(("eval", f"{PERMISSIONS}="))]
        config = compose_one(own_words).values
    chosen = dict(config["eval"]) | ({} if protocol is None else {"protocol": protocol})
    own = build_metrics(chosen, list(allowed))
    return make_evaluator(EvalConfig(**chosen), select_device(config.get("device", "auto")), own)


def _lines(
    truth: ReferenceImages,
    evaluator: Evaluator,
    matching: Matching,
    per_view: PerView,
    folder: Path | None,
) -> list[str]:
    metrics = summarize(per_view, evaluator.unavailable)
    width = max(len(view) for view in ("mean", *per_view))
    facts = {entry.key: entry for entry in METRICS} | evaluator.own
    names = {key: facts[key].name for key in metrics}
    lines = [f"{counted(len(per_view), 'view')}: {truth.what}; protocol {evaluator.protocol.id}"]
    if matching.rule:
        lines.append(f"names matched {matching.rule}")
    if matching.left_out:
        lines.append(f"left out, without a photograph: {some_of(matching.left_out)}")
    lines.append("  ".join([" " * width, *names.values()]))
    for view, row in [*per_view.items(), ("mean", metrics)]:
        cells = [view.ljust(width)]
        for key, heading in names.items():
            cells.append(f"{row[key]:.{facts[key].decimals + 1}f}".rjust(len(heading)))
        lines.append("  ".join(cells))
    lines += [f"{key}: n/a, {evaluator.unavailable[key]}" for key in sorted(evaluator.awaited)]
    if folder is not None:
        lines.append(f"entered as {folder}")
    return lines


def _as_dict(
    evaluator: Evaluator,
    matching: Matching,
    per_view: PerView,
    folder: Path | None,
) -> dict[str, Any]:
    return {
        "protocol": evaluator.protocol.id,
        "metrics": summarize(per_view, evaluator.unavailable),
        "unavailable": evaluator.unavailable,
        "views": per_view,
        "pictures": dict(matching.pairs),
        "names_matched": matching.rule,
        "left_out": list(matching.left_out),
        "entered": None if folder is None else str(folder),
    }


def find_reference_images(place: str, settings: Sequence[str], runs: Path) -> ReferenceImages:
    """The photographs of a folder, a trial (folder or EXPERIMENT:SCENE:ARM), or a scene.

    ``settings`` are overrides of the configuration. Raises `InputError` if ``place`` is none of
    these.
    """
    folder = Path(place).expanduser()
    if folder.is_dir():
        home = folder.parent if folder.name in (GROUND_TRUTH, RENDERS) else folder
        if not (home / RESULTS).is_file():
            return _folder(folder, settings)
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


def _scene(name: str, settings: Sequence[str]) -> ReferenceImages:
    """The test views of a scene as a trial with these settings sees them: undistorted, at its size.

    If the scene comes with cameras, the fastest initialiser is used, unless the settings choose
    one.
    """
    config = compose_one([f"scene={name}", *settings]).values
    chooses = any(word.startswith("init=") for word in settings)
    if not chooses and config["scene"]["kind"] != "photos":
        config = compose_one([f"scene={name}", *CAMERAS_ONLY, *settings]).values
    store = Store(Path(config["runs"]).expanduser().resolve() / STORE)
    trial = TrialSteps(Parts(config), store)
    for step in trial.steps():
        if step.stage in (keys.CAPTURE, keys.INIT, keys.GROUND_TRUTH):
            entry = store.get(step)
            if step.stage is keys.GROUND_TRUTH:
                folder = entry.path
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


def _folder(folder: Path, settings: Sequence[str]) -> ReferenceImages:
    names = list_images(folder)
    if not names:
        raise InputError(f"--truth {folder} holds no pictures")
    photographs = {name: folder / name for name in names}
    resolution = max(image_size(path) for path in photographs.values())
    config = compose_one(list(settings)).values
    return ReferenceImages(
        photographs, f"the pictures in {folder}", fingerprint(folder, names), resolution, config
    )


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
    if not is_folder_name(experiment) or not is_folder_name(arm):
        raise InputError(f"--as {word} is not EXPERIMENT:ARM, such as table1:sfm-mine")
    # on file systems without capitals, "Store" is "store"
    if experiment.casefold() in IN_RUNS:
        raise InputError(
            f"--as {word}: {experiment} is gsbench's own folder of {runs}: name an experiment"
        )
    if seed < 0:
        raise InputError(f"--seed {seed}: must be 0 or more")
    if scene is not None and not is_folder_name(scene):
        raise InputError(f"--scene {scene}: must be a plain folder name")
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
    destination: Destination,
    truth: ReferenceImages,
    pairs: Sequence[PicturePair],
    per_view: PerView,
    evaluator: Evaluator,
    source: Mapping[str, str],
    runs: Path,
) -> Path:
    """Write the trial's folder and return it. The same renders always go to the same folder.

    ``source`` says where the renders came from. Raises `InputError` if the destination already
    holds other renders.
    """
    renders = {pair.view: file_sha256(pair.picture) for pair in pairs}
    protocol = evaluator.protocol.id
    identity = sha256_of({"renders": renders, "data": truth.data, "protocol": protocol})
    name = f"{destination.init}-{destination.densify}"
    arm = runs / destination.experiment / destination.scene / name
    folder = arm / f"{identity[:8]}{SEED}{destination.seed}"
    config = _config(destination, truth, runs)
    # Two trainings with one seed would count as one pair in every comparison.
    others = [other for other in arm.glob(f"*{SEED}{destination.seed}") if other != folder]
    own = dict(destination.settings)
    if taken := [other for other in others if _has(other, own)]:
        raise InputError(
            f"seed {destination.seed} of {name} on {destination.scene} is taken ({taken[0]}): "
            "give another --seed, or remove that folder"
        )
    for pair in pairs:
        files = {RENDERS: pair.picture, GROUND_TRUTH: pair.photograph, MASKS: pair.mask}
        for kind, file in files.items():
            if file is None:  # all pixels of the view count
                continue
            (folder / kind).mkdir(parents=True, exist_ok=True)
            with atomic(folder / kind / png_name(pair.view), sync=False) as temporary:
                Image.fromarray(read_image(file)).save(temporary, format="PNG")
    write_text(folder / CONFIG, yaml.safe_dump(config, sort_keys=False))
    write_per_view(folder / PER_VIEW, per_view)
    TrialFolder(folder).write_finished(
        config, _results(destination, truth, identity, per_view, evaluator, source)
    )
    return folder


def _results(
    destination: Destination,
    truth: ReferenceImages,
    identity: str,
    per_view: PerView,
    evaluator: Evaluator,
    source: Mapping[str, str],
) -> TrialRecord:
    evaluation = summary_of(evaluator, per_view)
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
        unavailable=evaluation.unavailable | dict.fromkeys(COSTS, RENDERS_ALONE),
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
        code=Code(
            stages={EVALUATE.name: EVALUATE.version}, rooms=states_of(CODE_OF_STAGE[EVALUATE.name])
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


def _has(folder: Path, settings: Mapping[str, Any]) -> bool:
    """Return whether a trial has these settings, or none that tell its arm apart."""
    own = config_if_readable(folder)
    return not own or all(own.get(key) == value for key, value in settings.items())


def _trials(home: Path, scene: str) -> list[TrialResult]:
    """The experiment's trials of a scene; none if the experiment does not exist yet."""
    trials = read_experiment(home).trials if home.is_dir() else []
    return [trial for trial in trials if trial.scene == scene]
