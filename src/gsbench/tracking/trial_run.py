"""The MLflow run of one trial: what is logged there, and how far that has come.

Each metric's time is a function of the files, so that MLflow, which drops exact repetitions, holds it once even if it
was sent twice. Which run it is stands in the trial's folder, so that none is begun twice.
"""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from gsbench.files import read_object, write_json
from gsbench.runs import layout
from gsbench.runs.hashing import flatten, sha256_of
from gsbench.runs.trial_files import failure_of
from gsbench.system.locks import hold
from gsbench.tracking.client import connect, default_uri, ensure_experiment
from gsbench.tracking.source import user_tags

STATE = "mlflow.json"  # in the trial's folder: the run that mirrors it and how far
LOCK = ".mlflow.lock"
OWN_DATABASE = "runs/mlflow.db"
TOKEN_TAG = "gsbench.token"
ERROR_TAG = "error"
FILES = (layout.CONFIG, layout.RESULTS, layout.INIT_REPORT, layout.PER_VIEW, layout.EVENTS)
MAX_TAG = 5000  # characters of a tag (MLflow's limit)
DIGEST_CHARACTERS = 16  # of the fingerprint, in a dataset's digest, for which MLflow has 36
MAX_VALUE = 6000  # characters of a parameter (MLflow's limit)
MAX_PARAMS = 100  # parameters in a batch
MAX_METRICS = 1000  # metrics in a batch
# Of the init's report: is the cloud to be trusted, and what does a volume threshold mean there?
INIT_FIELDS = ("num_registered", "num_points", "mean_reprojection_error", "mean_track_length", "pose_errors", "gauge")
CURVES = {layout.CURVES: "train", layout.EVENTS: "events"}


def mirror_trial(options: dict[str, Any], runs: Path, folder: Path, values: dict[str, Any], anew: bool = False) -> bool:
    """Mirror what is missing of an ended trial; False if nothing was missing. Raises what the tracker raises.

    With ``anew``, the run that mirrors it so far is deleted, and another made from the files alone.
    """
    with hold(folder / LOCK, "mirroring", wait=False):
        run = TrackedTrial(options, runs, folder, values)
        if anew:
            run.client.delete_run(run.state["run_id"])
            run = TrackedTrial(options, runs, folder, values)
        if run.is_complete:
            return False
        run.add_curves([folder])
        run.finish("FAILED" if (folder / layout.FAILED).exists() else "FINISHED")
    return True


class TrackedTrial:
    """The MLflow run of one trial, opened anew or gone on with."""

    def __init__(
        self,
        options: dict[str, Any],
        runs: Path,
        folder: Path,
        values: dict[str, Any],
        tags: dict[str, str] | None = None,
    ) -> None:
        self.runs, self.folder, self.values, self.options = runs, folder, values, options
        self._tags = tags or {}
        self.client = connect(options["uri"], runs)
        self.state = self._known_state()
        if not self.state:
            self.state = self._create_run(ensure_experiment(self.client, values["name"], runs))
            self._save()
        elif not self.is_complete:
            self.client.update_run(self.state["run_id"], status="RUNNING")

    @property
    def is_complete(self) -> bool:
        """Whether the run shows the present results."""
        return self.state.get("complete") is not None and self.state["complete"] == self._results_hash()

    def _known_state(self) -> dict[str, Any]:
        """How far the trial is mirrored here; empty where it never was, was elsewhere, or was since computed anew."""
        from mlflow.exceptions import MlflowException

        state = read_object(self.folder / STATE)
        if state.get("uri") not in (self._uri(), self.client.tracking_uri) or "run_id" not in state:
            return {}
        try:
            run = self.client.get_run(state["run_id"])
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
            return {}
        if run.info.lifecycle_stage != "active":
            return {}
        if state.get("complete") not in (None, self._results_hash()) and self._results_hash() is not None:
            self.client.delete_run(state["run_id"])  # it shows results that are no longer the trial's
            return {}
        return state

    def _results_hash(self) -> str | None:
        results = read_object(self.folder / layout.RESULTS)
        return sha256_of(results) if results else None

    def add_curves(self, sources: list[Path]) -> None:
        """Log the records that were written since the last call."""
        if self.is_complete:
            return
        from mlflow.entities import Metric

        for name, prefix in CURVES.items():
            source = next((folder / name for folder in sources if (folder / name).exists()), None)
            if source is None:
                continue
            last = self.state["logged"].get(name, 0)
            metrics, newest = [], last
            for record in _records(source):
                if record["step"] > last:
                    newest = record["step"]
                    metrics += [
                        Metric(f"{prefix}/{key}", float(value), self._time_of(record), record["step"])
                        for key, value in record.items()
                        if key != "step" and isinstance(value, (int, float))
                    ]
            for start in range(0, len(metrics), MAX_METRICS):
                self.client.log_batch(self.state["run_id"], metrics=metrics[start : start + MAX_METRICS])
            self.state["logged"][name] = newest
        self._save()

    def finish(self, status: str) -> None:
        """Log final metrics, pictures and tables from the trial's files, and close the run with MLflow's ``status``."""
        if self.is_complete:
            return
        run_id = self.state["run_id"]
        results = read_object(self.folder / layout.RESULTS)
        if status != "FINISHED" or not results:
            if status != "KILLED":
                self._log_failure()
            self.client.set_terminated(run_id, "FAILED" if status == "FINISHED" else status)
            return
        from mlflow.entities import Metric, RunTag

        if self.state.pop("failed", False):
            self.client.delete_tag(run_id, ERROR_TAG)
        self._log_dataset(results)
        ended = self._time_of({"step": results["iterations"], "seconds": results["seconds"].get("train", 0.0)})
        numbers = dict(results["metrics"]) | {
            key: results[key]
            for key in ("num_gaussians", "num_init_points", "peak_memory_mb")
            if results[key] is not None  # not known of renders that another program made
        }
        numbers |= {f"seconds_{key}": value for key, value in results["seconds"].items()}
        numbers |= {f"total/{key}": value for key, value in results["events"].items()}
        numbers |= {f"init/{key}": value for key, value in _numbers(results.get("init_report", {}), INIT_FIELDS)}
        tags = {"protocol": results["protocol"], "raster": results["raster"]}
        tags |= {f"hash_{key}": value for key, value in results["hashes"].items()}
        self.client.log_batch(
            run_id,
            metrics=[Metric(key, float(value), ended, 0) for key, value in numbers.items()],
            tags=[RunTag(key, value) for key, value in tags.items()],
        )
        self._log_files(*FILES, *([layout.POINT_CLOUD] if self.options.get("model") else []))
        for kind in (layout.FIGURES, layout.RENDERS, layout.GROUND_TRUTH):
            for picture in sorted((self.folder / kind).glob("*.png"))[: int(self.options["images"])]:
                self.client.log_artifact(run_id, str(picture), kind)
        self.client.set_terminated(run_id, "FINISHED")
        self.state["complete"] = self._results_hash()
        self._save()

    def _log_failure(self) -> None:
        """Why the trial failed, as a tag and as files."""
        if not (self.folder / layout.FAILED).exists():
            return
        self.client.set_tag(self.state["run_id"], ERROR_TAG, failure_of(self.folder)[:MAX_TAG])
        self._log_files(layout.CONFIG, layout.FAILED, layout.LOG)
        self.state["failed"] = True
        self._save()

    def _log_files(self, *names: str) -> None:
        for name in names:
            if (self.folder / name).exists():
                self.client.log_artifact(self.state["run_id"], str(self.folder / name))

    def _log_dataset(self, results: dict[str, Any]) -> None:
        """The photographs, once for each split: MLflow tells datasets apart by name and digest."""
        from mlflow.entities import Dataset, DatasetInput, InputTag

        digest = results["hashes"].get("data")
        if digest is None:
            return
        scene = self.values["scene"]
        source = json.dumps({"uri": str(scene.get("path") or scene["name"])})
        inputs = [
            DatasetInput(
                Dataset(
                    name=scene["name"],
                    digest=f"{digest[:DIGEST_CHARACTERS]}-{split}",
                    source_type="local",
                    source=source,
                    profile=json.dumps({"views": results[f"{split}_views"], "split": split}),
                ),
                [InputTag("mlflow.data.context", split)],
            )
            for split in ("train", "test")
            if f"{split}_views" in results  # of renders that another program made, the tests alone are known
        ]
        self.client.log_inputs(self.state["run_id"], inputs)

    def _create_run(self, experiment_id: str) -> dict[str, Any]:
        from mlflow.entities import Param, RunTag

        values = self.values
        begun = self._begin()
        label = f"{values['scene']['name']} {values['init']['name']}-{values['densify']['name']} seed {values['seed']}"
        tags = {
            "mlflow.runName": label,
            "kind": "trial",
            "scene": values["scene"]["name"],
            "init": values["init"]["name"],
            "densify": values["densify"]["name"],
            "seed": str(values["seed"]),
            "folder": self.folder.relative_to(self.runs).as_posix(),
            TOKEN_TAG: begun["token"],
            **user_tags(),
            **self._tags,
        }
        found = self.client.search_runs([experiment_id], f"tags.`{TOKEN_TAG}` = '{begun['token']}'", max_results=1)
        run = found[0] if found else self.client.create_run(experiment_id, tags=tags, run_name=label)
        run_id = run.info.run_id
        params = [Param("arm", f"{values['init']['name']}-{values['densify']['name']}")]  # first in MLflow's charts
        params += [Param(key, str(value)[:MAX_VALUE]) for key, value in flatten(values).items() if str(value)]
        for start in range(0, len(params), MAX_PARAMS):
            self.client.log_batch(run_id, params=params[start : start + MAX_PARAMS], tags=[RunTag("gsbench", "1")])
        return begun | {"run_id": run_id, "logged": {}, "complete": None}

    def _begin(self) -> dict[str, Any]:
        """Note, before a run is created, by what it is found again if nobody hears of its creation."""
        state = read_object(self.folder / STATE)
        if state.get("uri") == self._uri() and "token" in state and "run_id" not in state:
            return state
        begun = {"uri": self._uri(), "token": uuid.uuid4().hex, "started": int(time.time() * 1000)}
        write_json(self.folder / STATE, begun)
        return begun

    def _time_of(self, record: dict[str, Any]) -> int:
        """A record's time in ms: the run's start, and the training time or else the iterations since."""
        return int(self.state["started"] + 1000 * float(record.get("seconds", record["step"] / 1000)))

    def _uri(self) -> str:
        """Where the run is: the tracker's address, or a word for the runs folder's own, which may move with it."""
        uri = str(self.client.tracking_uri)
        return OWN_DATABASE if uri == default_uri(self.runs) else uri

    def _save(self) -> None:
        write_json(self.folder / STATE, self.state)


def _records(path: Path) -> Iterator[dict[str, Any]]:
    for line in path.read_text().splitlines():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:  # the last line, still being written
            return


def _numbers(report: dict[str, Any], names: Sequence[str]) -> Iterator[tuple[str, float]]:
    """The numbers among the fields ``names`` of a report, nested ones included; what is unknown is left out."""
    for name in names:
        value = report.get(name)
        if isinstance(value, dict):
            yield from _numbers(value, tuple(value))
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield name, float(value)
