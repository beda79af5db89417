"""Archives of the first version: JSON lines of all trials, as the files that they were made of."""

import io
import json
from collections.abc import Mapping
from typing import Any

import yaml

from gsbench.runs.layout import (
    CONFIG,
    DECLARED,
    FAILED,
    FROM_PIXELS,
    LEDGER,
    PER_VIEW,
    RESULTS,
)


def as_files(name: str, contents: Mapping[str, bytes]) -> dict[str, bytes]:
    """The files of the experiment ``name`` by their places in a runs folder."""
    import pandas as pd  # here, since it is slow to import

    def lines(member: str) -> list[dict[str, Any]]:
        return [json.loads(line) for line in contents.get(member, b"").decode().splitlines()]

    texts: dict[str, str] = {}
    for line in lines("results.jsonl"):
        texts[f"{line['folder']}/{RESULTS}"] = json.dumps(line["results"])
    for line in lines("configurations.jsonl"):
        for folder, seed in line["trials"]:
            values = line["configuration"] | {"seed": seed}
            texts[f"{folder}/{CONFIG}"] = yaml.safe_dump(values)
    for line in lines("unfinished.jsonl"):
        texts[f"{line['folder']}/{CONFIG}"] = yaml.safe_dump(line["configuration"])
        texts[f"{line['folder']}/{FAILED}"] = "{}"
    for line in lines("from_pixels.jsonl"):
        texts[f"{line['folder']}/{FROM_PIXELS}"] = json.dumps(line["measures"])
    frame = pd.read_csv(io.BytesIO(contents[PER_VIEW]), dtype=str, keep_default_na=False)
    for folder, own in frame.groupby("trial", sort=False):
        views = own.drop(columns="trial").to_csv(index=False, lineterminator="\n")
        texts[f"{folder}/{PER_VIEW}"] = views
    files = {f"{name}/{place}": text.encode() for place, text in texts.items()}
    return files | {f"{name}/{own}": contents[own] for own in (DECLARED, LEDGER) if own in contents}
