"""A content-addressed store of stage results: the same inputs are never computed twice.

Layout: ``<root>/<stage>/<key>/`` holds a finished result, with ``manifest.json`` written last; ``.<key>.partial/`` is where it
is built, and what a killed build leaves; ``.<key>.lock`` lets one process build while others wait.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock

from gsbench import __version__
from gsbench.config import sha256_of

log = logging.getLogger(__name__)

MANIFEST = "manifest.json"
CHUNK = 1 << 20


@dataclass(frozen=True)
class Stage:
    """A step of the pipeline. Bump ``version`` by hand when its code changes what it computes.

    ``resumable`` stages find what a killed build left and go on from it; the others start in an empty folder.
    """

    name: str
    version: int
    resumable: bool = False

    def key(self, inputs: dict[str, Any]) -> str:
        """sha256 of canonical JSON of the stage and all that it reads, upstream keys included."""
        return sha256_of({"stage": self.name, "version": self.version, "inputs": inputs})


@dataclass(frozen=True)
class Entry:
    """A finished result in the store."""

    path: Path
    key: str
    seconds: float
    cached: bool


class Store:
    """The store below ``root``."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, stage: Stage, key: str) -> Path:
        return self.root / stage.name / key

    def find(self, stage: Stage, inputs: dict[str, Any]) -> Entry | None:
        """The finished result for ``inputs``, or None; a damaged one is named, removed and counts as none."""
        key = stage.key(inputs)
        path = self.path(stage, key)
        if not path.is_dir():
            return None
        try:
            manifest = read_manifest(path)
        except ValueError as error:
            log.warning("store: %s is damaged (%s) and is built again", path, error)
            shutil.rmtree(path, ignore_errors=True)
            return None
        return Entry(path, key, float(manifest["seconds"]), cached=True)

    def get(self, stage: Stage, inputs: dict[str, Any], build: Callable[[Path], None]) -> Entry:
        """The result for ``inputs``, computed by ``build(folder)`` unless it is there; published by an atomic rename."""
        key = stage.key(inputs)
        final = self.path(stage, key)
        final.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(final.parent / f".{key}.lock"):
            found = self.find(stage, inputs)
            if found is not None:
                return found
            partial = final.parent / f".{key}.partial"
            if partial.exists() and not stage.resumable:
                shutil.rmtree(partial)
            partial.mkdir(exist_ok=True)
            started = time.perf_counter()
            build(partial)
            seconds = time.perf_counter() - started
            write_manifest(partial, stage, key, inputs, seconds)
            os.replace(partial, final)
        return Entry(final, key, seconds, cached=False)


def write_manifest(folder: Path, stage: Stage, key: str, inputs: dict[str, Any], seconds: float) -> None:
    """Record what made ``folder`` and a checksum of every file in it."""
    outputs = {
        str(path.relative_to(folder)): {"size": path.stat().st_size, "sha256": sha256_of_file(path)}
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    manifest = {
        "stage": stage.name,
        "version": stage.version,
        "key": key,
        "inputs": inputs,
        "outputs": outputs,
        "seconds": seconds,
        "gsbench": __version__,
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    write_json(folder / MANIFEST, manifest)


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a finished result; raises ValueError naming what is damaged."""
    try:
        manifest: dict[str, Any] = json.loads((folder / MANIFEST).read_text())
        outputs = manifest["outputs"]
        if manifest["key"] != folder.name:
            raise ValueError(f"{MANIFEST} belongs to another key")
        expected = sha256_of({name: manifest[name] for name in ("stage", "version", "inputs")})
        if expected != manifest["key"]:
            raise ValueError(f"{MANIFEST} does not match its key")
    except (OSError, KeyError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{MANIFEST} is missing or unreadable") from error
    for name, recorded in outputs.items():
        path = folder / name
        if not path.is_file() or path.stat().st_size != recorded["size"] or sha256_of_file(path) != recorded["sha256"]:
            raise ValueError(f"{name} differs from what was written")
    return manifest


def sha256_of_file(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while chunk := stream.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def write_json(path: Path, values: Any) -> None:
    """Write JSON so that a reader sees the old file or the new one, never a part. NaN and infinity are refused."""
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")
    temporary.write_text(json.dumps(values, indent=1, allow_nan=False) + "\n")
    os.replace(temporary, path)
