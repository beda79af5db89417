"""``gsbench explain --stale``: which stages of a trial are in the store, and why the others are not."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gsbench.compose import compose_trials
from gsbench.config import EvalConfig, SceneConfig, TrainConfig
from gsbench.errors import InputError
from gsbench.pipeline.store import MANIFEST, Entry, Stage, Store, read_manifest
from gsbench.pipeline.trial_files import CONFIG
from gsbench.verbs.sync import read_config

KEY = re.compile(r'"[0-9a-f]{64}"')
MAX_SHOWN = 80  # characters of a value


def main_stale(argv: Sequence[str], runs: Path) -> int:
    """The verb; returns the exit code, raises ``InputError`` for bad input."""
    parser = argparse.ArgumentParser(
        prog="gsbench explain --stale",
        description="For each stage of a trial: whether its result is in the store; if not, what differs from the most "
        "similar result that is.",
    )
    parser.add_argument("trial", nargs="+", help="a trial's folder, or the settings of one (scene=... densify=...)")
    words = parser.parse_args(argv).trial
    if len(words) == 1 and (Path(words[0]) / CONFIG).exists():
        values = read_config(Path(words[0]))
    else:
        if "=" not in words[0]:
            raise InputError(f"{words[0]} is neither a trial's folder nor a setting like key=value")
        values = compose_trials(words)[0].values
    for line in explain_stages(values, Store(runs / "store")):
        print(line)
    return 0


def explain_stages(values: dict[str, Any], store: Store) -> list[str]:
    """Lines on every stage of the trial with the configuration ``values``."""
    lines = []
    for stage, inputs in stage_inputs(values, store):
        key = stage.key(inputs)
        if store.find(stage, inputs) is not None:
            lines.append(f"{stage.name:<13} {key[:12]}  in the store")
        elif store.path(stage, key).exists():
            lines.append(f"{stage.name:<13} {key[:12]}  damaged: {_damage(store.path(stage, key))}; it is built again")
        elif store.partial(stage, key).exists():
            lines.append(
                f"{stage.name:<13} {key[:12]}  begun; {'it goes on' if stage.resumable else 'it starts again'}"
            )
        else:
            lines.append(f"{stage.name:<13} {key[:12]}  not in the store")
            lines += [f"    {difference}" for difference in _differences(store, stage, inputs)]
    return lines


class _KeysOnly(Store):
    """A store that notes what it is asked for, and builds nothing."""

    def __init__(self, store: Store) -> None:
        super().__init__(store.root)
        self.asked: list[tuple[Stage, dict[str, Any]]] = []

    def get(self, stage: Stage, inputs: dict[str, Any], build: Callable[[Path], None]) -> Entry:
        self.asked.append((stage, inputs))
        key = stage.key(inputs)
        return Entry(self.path(stage, key), key, 0.0, cached=True)


def stage_inputs(values: dict[str, Any], store: Store) -> list[tuple[Stage, dict[str, Any]]]:
    """The stages of a trial with their inputs, in order; a scene that is still to be made ends the list."""
    from gsbench.pipeline import stages
    from gsbench.pipeline.components import build, select_device
    from gsbench.raster import create_rasterizer, resolve_name

    keys = _KeysOnly(store)
    scene = SceneConfig(**values["scene"])
    try:
        capture = stages.read_capture(keys, scene)
    except InputError:
        if keys.asked:  # the scene itself is made by a stage, which has not run
            return keys.asked
        raise
    device = select_device(values["device"])
    rasterizer = create_rasterizer(resolve_name(values["raster"]["name"], device), device, 1)
    densifier = build("densify", values["densify"], values["allow_targets"])
    init = stages.initialize(keys, capture, build("init", values["init"], values["allow_targets"]))
    inputs = stages.scene_inputs(capture, scene)
    nothing: Any = None  # the stages' inputs do not depend on the views, which need the initial cameras
    options = TrainConfig(**values["train"])
    trained = stages.train(keys, nothing, inputs, init, densifier, rasterizer, options, values["seed"], device)
    stages.keep_ground_truth(keys, nothing, inputs, init)
    stages.evaluate(keys, nothing, init, trained, rasterizer, options, EvalConfig(**values["eval"]), device)
    return keys.asked


def _differences(store: Store, stage: Stage, inputs: dict[str, Any]) -> list[str]:
    """How the most similar result of ``stage`` in the store differs."""
    wanted = flat({"version": stage.version, "inputs": inputs})
    best: dict[str, str] | None = None
    for path in (store.root / stage.name).glob(f"*/{MANIFEST}"):
        try:
            manifest = json.loads(path.read_text(encoding="utf-8"))
            found = flat({"version": manifest["version"], "inputs": manifest["inputs"]})
        except (OSError, ValueError, KeyError, TypeError):
            continue
        if best is None or _distance(found, wanted) < _distance(best, wanted):
            best = found
    if best is None:
        return [f"the store has no result of {stage.name} yet"]
    keys = [key for key in sorted({*best, *wanted}) if best.get(key) != wanted.get(key)]
    return [
        f"{key.removeprefix('inputs.')}: {_short(best.get(key))} there, {_short(wanted.get(key))} wanted"
        for key in keys
    ]


def flat(values: Any, prefix: str = "") -> dict[str, str]:
    """Nested objects as one with dotted keys and JSON text."""
    if isinstance(values, dict) and values:
        parts = [flat(value, f"{prefix}.{key}" if prefix else str(key)) for key, value in values.items()]
        return {key: text for part in parts for key, text in part.items()}
    return {prefix: json.dumps(values, sort_keys=True)}


def _distance(found: dict[str, str], wanted: dict[str, str]) -> int:
    return sum(found.get(key) != wanted.get(key) for key in {*found, *wanted})


def _short(text: str | None) -> str:
    if text is None:
        return "absent"
    if KEY.fullmatch(text):  # an upstream result or a checksum
        return text[1:13]
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"


def _damage(path: Path) -> str:
    try:
        read_manifest(path)
    except ValueError as error:
        return str(error)
    return "nothing"
