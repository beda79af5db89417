"""Archives of the first version: JSON lines of all trials, as the files that they were made of."""

import io
import json
from typing import Any

import yaml

from gsbench.errors import InputError
from gsbench.runs.layout import (
    CONFIG,
    DECLARED,
    FAILED,
    FROM_PIXELS,
    LEDGER,
    PER_VIEW,
    RESULTS,
    TUNING,
)

# errors of contents that no gsbench wrote
NOT_AN_ARCHIVE = (KeyError, TypeError, ValueError, AttributeError, RecursionError)
PICTURES_FOLDER = "pictures"


def as_files(name: str, contents: dict[str, bytes]) -> dict[str, bytes]:
    """The files of the experiment ``name`` by their places in a runs folder.

    Raises one of `NOT_AN_ARCHIVE`, or InputError, for other contents.
    """
    files: dict[str, bytes] = {}

    def add(place: str, text: str) -> None:
        if f"{name}/{place}" in files:
            raise InputError(f"the trial {place.rpartition('/')[0]} is in it twice")
        files[f"{name}/{place}"] = text.encode()

    trials = {str(line["folder"]): line for line in _lines(contents["results.jsonl"])}
    if len(trials) < len(_lines(contents["results.jsonl"])):
        raise InputError("a trial is in it twice")
    for folder, line in trials.items():
        add(f"{folder}/{RESULTS}", json.dumps(line["results"]))
    for line in _lines(contents["configurations.jsonl"]):
        for folder, seed in line["trials"]:
            if folder in trials:
                add(f"{folder}/{CONFIG}", yaml.safe_dump(line["configuration"] | {"seed": seed}))
    for line in _lines(contents.get("unfinished.jsonl", b"")):
        add(f"{line['folder']}/{CONFIG}", yaml.safe_dump(line["configuration"]))
        add(f"{line['folder']}/{FAILED}", "{}")
    for folder, text in _tables(contents[PER_VIEW]).items():
        if folder in trials:
            add(f"{folder}/{PER_VIEW}", text)
    for line in _lines(contents.get("from_pixels.jsonl", b"")):
        if line["folder"] in trials:
            add(f"{line['folder']}/{FROM_PIXELS}", json.dumps(line["measures"]))
    for line in _lines(contents.get("searches.jsonl", b"")):
        files[f"{line['experiment']}/{TUNING}"] = json.dumps(line["search"]).encode()
    for place, content in contents.items():
        if place.startswith(f"{PICTURES_FOLDER}/"):
            files[f"{name}/{place.removeprefix(f'{PICTURES_FOLDER}/')}"] = content
    return files | {f"{name}/{own}": contents[own] for own in (DECLARED, LEDGER) if own in contents}


def _tables(content: bytes) -> dict[str, str]:
    """The table of each trial's views, by its folder."""
    import pandas as pd  # here, since it is slow to import

    frame = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)
    return {
        str(folder): own.drop(columns="trial").to_csv(index=False, lineterminator="\n")
        for folder, own in frame.groupby("trial", sort=False)
    }


def _lines(content: bytes) -> list[dict[str, Any]]:
    return [json.loads(line) for line in content.decode().splitlines()]
