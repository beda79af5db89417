"""Description of an archive of results in the terms of RO-Crate 1.2 (w3id.org/ro/crate/1.2)."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

from gsbench.analysis.results import TrialResult

SPECIFICATION = "https://w3id.org/ro/crate/1.2"
FILES = {  # media type and description
    "results.jsonl": (
        "application/jsonl",
        "Results of every trial, one JSON object a line: metrics, counts, hashes, code",
    ),
    "configurations.jsonl": ("application/jsonl", "Every configuration, with the trials that had it"),
    "per_view.csv": ("text/csv", "Metrics of every test view of every trial"),
    "from_pixels.jsonl": ("application/jsonl", "What declared claims ask of the trials' pictures, measured"),
    "declared.jsonl": ("application/jsonl", "What was declared before the trials were run"),
    "archive.json": ("application/json", "Version of the archive, and the sha256 of its files"),
}
PICTURE = ("image/png", "A test view of a trial: its render, or the photograph")


def crate_metadata(name: str, trials: Sequence[TrialResult], sizes: Mapping[str, int]) -> dict[str, Any]:
    """The content of ``ro-crate-metadata.json``; ``sizes`` are the bytes of each file in the archive."""
    scenes = sorted({trial.scene for trial in trials})
    arms = sorted({f"{trial.init}-{trial.densify}" for trial in trials})
    protocols = sorted({trial.record.protocol for trial in trials})
    day = time.strftime("%Y-%m-%d", time.gmtime(max(trial.measured for trial in trials)))
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": f"{name}: results of gsbench",
        "description": f"{len(trials)} trainings of 3D Gaussian Splatting: {', '.join(arms)} on {', '.join(scenes)}, "
        f"measured by {', '.join(protocols)}. No models.",
        "datePublished": day,
        "hasPart": [{"@id": file} for file in sizes],
    }
    files = [
        {
            "@id": file,
            "@type": "File",
            "name": file,
            "description": FILES.get(file, PICTURE)[1],
            "encodingFormat": FILES.get(file, PICTURE)[0],
            "contentSize": str(size),
        }
        for file, size in sizes.items()
    ]
    descriptor = {
        "@id": "ro-crate-metadata.json",
        "@type": "CreativeWork",
        "conformsTo": {"@id": SPECIFICATION},
        "about": {"@id": "./"},
    }
    return {"@context": f"{SPECIFICATION}/context", "@graph": [descriptor, root, *files]}
