"""The records of a finished trial and of a search, for tests that need one."""

from gsbench.runs.trial_record import TrialRecord
from tests.helpers import write


def record_of(values, **changes):
    """The record of a finished trial with the configuration ``values``; ``changes`` are fields."""
    fields = {
        "status": "complete",
        "experiment": values["name"],
        **{group: values[group]["name"] for group in ("scene", "init", "densify")},
        "seed": values["seed"],
        "raster": "cpu",
        "protocol": "paper-1",
        "iterations": values.get("train", {}).get("iterations", 10),
        "metrics": {"psnr": 20.5},
        "unavailable": {},
        "seconds": {"train": 1.0},
        "num_init_points": 5,
        "num_gaussians": 10,
        "peak_memory_mb": 1.5,
        "hashes": {},
        "versions": {},
    }
    return TrialRecord(**(fields | changes))


def write_results(folder, values, **changes):
    """Write ``results.json`` without a record of the trial's inputs (``made_of``)."""
    record = record_of(values, **changes)
    write(folder / "results.json", record.to_json())
    return record


def search_record(points):
    """The content of ``tuning.json`` for a search with these points, for the arm ``volumetric``."""
    return {
        "sweep": "vth",
        "arm": "sfm-volumetric",
        "metric": "psnr",
        "direction": 1,
        "wanted": 2,
        "seeds": [100],
        "scenes": ["courtyard"],
        "ranges": {},
        "log": [],
        "points": points,
    }
