"""Report on the steps of a trial that are in the store, and on why the others are not."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from gsbench.records import read_if_sound
from gsbench.runs.hashing import flatten
from gsbench.runs.layout import MANIFEST
from gsbench.runs.stages import Step
from gsbench.runs.store import Manifest, Store, read_manifest

KEY = re.compile(r'"[0-9a-f]{64}"')
MAX_SHOWN = 80  # characters of a value


def explain_steps(steps: Iterable[Step], store: Store) -> list[str]:
    """A line on each step: whether its result is in the store; if not, what differs from the most similar that is."""
    lines = []
    for step in steps:
        stage = step.stage
        name = f"{stage.name:<13} {step.key[:12]}"
        if store.find(step) is not None:
            lines.append(f"{name}  in the store")
        elif store.path(step).exists():
            lines.append(f"{name}  damaged: {_damage(store.path(step))}; it is built again")
        elif store.partial(stage, step.key).exists():
            lines.append(f"{name}  begun; {'it goes on' if stage.resumable else 'it starts again'}")
        else:
            lines.append(f"{name}  not in the store")
            lines += [f"    {difference}" for difference in _differences(store, step)]
    return lines


def _differences(store: Store, step: Step) -> list[str]:
    """Say how the most similar result of the step's stage in the store differs."""
    wanted = flat({"version": step.stage.version, "inputs": step.inputs})
    best: dict[str, str] | None = None
    for path in (store.root / step.stage.name).glob(f"*/{MANIFEST}"):
        manifest = read_if_sound(path, Manifest)
        if manifest is None:
            continue
        found = flat({"version": manifest.version, "inputs": manifest.inputs})
        if best is None or _distance(found, wanted) < _distance(best, wanted):
            best = found
    if best is None:
        return [f"the store has no result of {step.stage.name} yet"]
    keys = [key for key in sorted({*best, *wanted}) if best.get(key) != wanted.get(key)]
    return [
        f"{key.removeprefix('inputs.')}: {_short(best.get(key))} there, {_short(wanted.get(key))} wanted"
        for key in keys
    ]


def flat(values: dict[str, Any]) -> dict[str, str]:
    """Nested objects as one with dotted keys and JSON text."""
    return {key: json.dumps(value, sort_keys=True) for key, value in flatten(values, keep_empty=True).items()}


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
