"""The renders of trials measured under the conventions of other programs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.analysis.results import TrialResult, load_experiment
from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator, quantize, summarize
from gsbench.eval.protocol import OTHERS, Protocol, get_protocol
from gsbench.gaussians.model import MAX_SH_DEGREE
from gsbench.gaussians.ply import read_ply
from gsbench.init.base import MODEL_FOLDER
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps.scene import makers_of_views
from gsbench.pipeline.wiring import TrialSteps
from gsbench.runs.layout import GROUND_TRUTH, MASKS, POINT_CLOUD, RENDERS, STORE, VIEWS
from gsbench.runs.store import Store
from gsbench.runs.trial_folder import TrialFolder
from gsbench.scene.images import read_image
from gsbench.scene.load import load_scene
from gsbench.scene.masks import Mask, read_mask
from gsbench.scene.names import png_name
from gsbench.scene.types import Scene
from gsbench.system.resources import available_threads
from gsbench.view.trials import find_trial

log = logging.getLogger(__name__)

ROUNDING_TOLERANCE = 1  # 8-bit levels by which a render that is made again may differ from its file

Picture = NDArray[np.uint8]
Pictures = Mapping[str, Picture]  # by view


@dataclass
class Material:
    """The images that a trial's test views are measured from, by view, [H, W, 3] each.

    ``renders`` and ``photographs`` are those of the trial's files, ``exact`` the renders before rounding (float32, in
    [0, 1]), ``shrunk`` gives the photographs as a protocol shrinks them. The last two raise InputError for what cannot
    be had. ``masks`` are those of the views that ignore some pixels.
    """

    renders: Pictures
    photographs: Pictures
    exact: Callable[[], Mapping[str, NDArray[np.float32]]]
    shrunk: Callable[[Protocol], Pictures]
    masks: Mapping[str, Mask] = field(default_factory=dict)


class Translation(NamedTuple):
    """A protocol's metrics; ``unknown`` maps a convention that could not be followed to the reason in one line."""

    metrics: dict[str, float]
    unknown: dict[str, str]


def translate_trials(place: str, protocol: str | None, runs: Path) -> None:
    """Measure the trials of an experiment, or one trial, by ``protocol`` or all of `OTHERS`, and print it."""
    torch.set_num_threads(available_threads())
    trials = [find_trial(place, runs)] if ":" in place else list(load_experiment(runs, place).trials)
    wanted = list(OTHERS.values()) if protocol in (None, "all") else [get_protocol(str(protocol))]
    for trial in trials:
        material = material_of(trial, runs)
        print(f"{trial.label}\n  {trial.record.protocol}: {in_words(Translation(dict(trial.metrics), {}))}")
        for one in wanted:
            print(f"  {one.id}: {in_words(translate(material, one, _lpips_evaluator(trial)))}")


def translate(material: Material, protocol: Protocol, make: Callable[[Protocol], Evaluator]) -> Translation:
    """The metrics of ``material`` by ``protocol``; ``make`` gives its evaluator."""
    unknown: dict[str, str] = {}
    photographs = material.photographs
    renders: Mapping[str, NDArray[Any]] = material.renders
    try:
        photographs = material.shrunk(protocol)
    except InputError as error:
        unknown["resampling"] = str(error)
    if not protocol.eight_bit:
        try:
            renders = material.exact()
        except InputError as error:
            unknown["rounding"] = str(error)
            protocol = replace(protocol, eight_bit=True)
    evaluator = make(protocol)
    per_view = {
        view: evaluator.evaluate_view(render, photographs[view], material.masks.get(view))
        for view, render in renders.items()
    }
    return Translation(summarize(per_view, evaluator.unavailable), unknown)


def material_of(trial: TrialResult, runs: Path) -> Material:
    """The test views of a finished trial; what is in its folder is read now, the rest when it is asked for."""
    names = sorted(path.name for path in (trial.path / RENDERS).glob("*.png"))
    if not names:
        raise InputError(f"{trial.label} holds no renders")
    renders, photographs = (
        {name: read_image(trial.path / folder / name) for name in names} for folder in (RENDERS, GROUND_TRUTH)
    )

    @cache
    def source() -> tuple[Parts, TrialSteps]:
        config = TrialFolder(trial.path).configuration() | {"runs": str(runs)}
        if trial.from_renders:
            raise InputError("renders of another program are what they are")
        parts = Parts(config)
        steps = TrialSteps(parts, Store(runs / STORE))
        for step in steps.steps():
            if steps.store.find(step) is None:
                raise InputError(f"the stage {step.stage.name} of the trial is not in the store any more")
        return parts, steps

    @cache
    def exact() -> Mapping[str, NDArray[np.float32]]:
        parts, steps = source()
        if not (trial.path / POINT_CLOUD).is_file():
            raise InputError("the renders are 8-bit files and the model is not there")
        model = read_ply(trial.path / POINT_CLOUD, parts.device)
        background = torch.tensor(list(parts.train.background), device=parts.device)  # [3]
        found = {}
        for view in steps.views.scene.test:
            with torch.no_grad():
                image = parts.rasterizer.render(model, view.camera, MAX_SH_DEGREE, background).image.clamp(0, 1)
            name = png_name(view.name)
            apart = np.abs(quantize(image).cpu().numpy().astype(int) - renders[name]).max()
            if apart > ROUNDING_TOLERANCE:
                raise InputError(f"made again, the render of {view.name} differs from its file by {apart} levels")
            found[name] = image.cpu().numpy()
        return found

    @cache
    def shrunk(protocol: Protocol) -> Pictures:
        _, steps = source()
        return resampled(steps, protocol, photographs)

    there = {path.name: read_mask(path) for path in sorted((trial.path / MASKS).glob("*.png"))}
    return Material(renders, photographs, exact, shrunk, there)


def resampled(steps: TrialSteps, protocol: Protocol, photographs: Pictures) -> Pictures:
    """The test photographs at the size of ``photographs``, made smaller as ``protocol`` does it.

    They are ``photographs`` themselves where it would do nothing else. Raises InputError where the files that it
    starts from are not there.
    """
    views, options = steps.views, steps.views.options
    capture, downscale, longest = views.capture, options.downscale, options.max_size
    folder = None if options.path is None else Path(options.path).expanduser() / "images"
    if protocol.full_size and options.images not in (None, "images") and folder is not None:
        if capture.masks:
            raise InputError(f"{protocol.name} shrinks photographs of the full size, and masks are of {options.images}")
        if missing := [name for name in capture.image_names if not (folder / name).is_file()]:
            raise InputError(
                f"{protocol.name} shrinks photographs of the full size, and {folder / missing[0]} is missing"
            )
        capture = replace(capture, images=folder, fingerprint=f"{capture.fingerprint}-full-size")
        downscale, longest = 1, max(next(iter(photographs.values())).shape)
    elif protocol.shrinking is None or protocol.shrinking == options.resample:
        return photographs
    assert protocol.shrinking is not None
    scene = load_scene(
        capture,
        views.store.path(views.init) / MODEL_FOLDER,
        views.store.root / VIEWS,
        downscale=downscale,
        max_size=longest,
        resample=protocol.shrinking,
        principal_point=options.principal_point,
        made_by=makers_of_views(),
    )
    return _same_views(scene, photographs, protocol)


def _same_views(scene: Scene, photographs: Pictures, protocol: Protocol) -> Pictures:
    found = {png_name(view.name): view.image for view in scene.test}
    for name, photograph in photographs.items():
        if name not in found or found[name].shape != photograph.shape:
            raise InputError(f"shrunk as {protocol.name} does it, {name} is not of the size of the render")
    if all(np.array_equal(found[name], photograph) for name, photograph in photographs.items()):
        return photographs  # nothing was shrunk
    return {name: found[name] for name in photographs}


def in_words(one: Translation) -> str:
    """``PSNR 27.41, SSIM 0.8123, LPIPS 0.1034; rounding as it was, since …``"""
    parts = [
        f"{key.upper()} {one.metrics[key]:.{digits}f}"
        for key, digits in (("psnr", 2), ("ssim", 4))
        if key in one.metrics
    ]
    parts += [f"{key} {value:.4f}" for key, value in one.metrics.items() if key.startswith("lpips")]
    return ", ".join(parts) + "".join(f"; {name} as it was, since {reason}" for name, reason in one.unknown.items())


def _lpips_evaluator(trial: TrialResult) -> Callable[[Protocol], Evaluator]:
    """Makes the evaluator of a protocol with its LPIPS, if the trial asked for any LPIPS."""
    asked = bool(trial.config.get("eval.lpips"))
    weights = trial.config.get("eval.weights")
    folder = None if weights is None else Path(str(weights)).expanduser()

    def make(protocol: Protocol) -> Evaluator:
        lpips = (protocol.lpips,) if protocol.lpips and asked else ()
        return Evaluator(protocol, "cpu", lpips, False, folder, bool(trial.config.get("eval.download", True)))

    return make
