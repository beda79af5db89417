"""What is asked of MLflow's client for an experiment and at the end of a run; no tracker runs."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mlflow.exceptions import MlflowException

from gsbench.errors import InputError
from gsbench.tracking.mlflow_sink import (
    KIND,
    MLflow,
    default_uri,
    ensure_experiment,
    require_own_artifacts,
)
from gsbench.tracking.sinks import Run
from gsbench.tracking.trial import Picture, Scalar, Update
from tests.helpers import refusal

PICTURE = Picture("view", np.zeros((2, 3, 3), np.uint8), 30, 2.5)


class Client:
    """Stands in for MLflow's client: notes calls, and answers with the attributes of ``known``."""

    def __init__(self, uri="sqlite:///x.db", **known):
        self.tracking_uri, self.known = uri, known
        self.calls = []

    def __getattr__(self, name):
        def call(*given, **named):
            self.calls.append((name, given, named))
            answer = self.known.get(name)
            if isinstance(answer, list):
                answer = answer.pop(0)
            if isinstance(answer, Exception):
                raise answer
            return answer

        return call


def experiment(stage="active", **tags):
    return SimpleNamespace(experiment_id=7, lifecycle_stage=stage, tags=tags)


@pytest.mark.parametrize(
    "uri, served", [("sqlite:///x.db", False), ("http://there", True), ("https://there", True)]
)
def test_a_new_experiment_keeps_its_artifacts_in_the_runs_folder_unless_served(
    tmp_path, uri, served
):
    client = Client(uri, create_experiment=5)
    assert ensure_experiment(client, "x", tmp_path) == "5"
    ((_, given, named),) = [call for call in client.calls if call[0] == "create_experiment"]
    place = None if served else (tmp_path / "mlartifacts/x").as_uri()
    assert (given, named) == (("x",), {"artifact_location": place, "tags": KIND})


def test_an_experiment_that_another_machine_created_meanwhile_is_used(tmp_path):
    client = Client(
        create_experiment=MlflowException("exists"),
        get_experiment_by_name=[None, experiment(**KIND)],
    )
    assert ensure_experiment(client, "x", tmp_path) == "7"
    client = Client(create_experiment=MlflowException("full"))
    with pytest.raises(RuntimeError, match="MLflow could not create the experiment x"):
        ensure_experiment(client, "x", tmp_path)


def test_artifacts_of_the_own_database_stay_in_the_runs_folder(tmp_path):
    own, other = Client(default_uri(tmp_path)), Client("http://there")
    inside = tmp_path / "mlartifacts/x/run"
    require_own_artifacts(own, inside.as_uri(), tmp_path)
    (tmp_path / "mlartifacts").mkdir()
    (tmp_path / "mlartifacts/link").symlink_to("/tmp")
    for place in (tmp_path / "elsewhere", inside / "../../..", Path("/tmp")):
        with refusal("would send artifacts to "):
            require_own_artifacts(own, f"file://{place}", tmp_path)
    with pytest.raises(InputError):
        require_own_artifacts(own, f"file://{inside.parents[1]}/link/a", tmp_path)
    require_own_artifacts(other, "s3://bucket/x", tmp_path)


@pytest.fixture
def sink():
    made = MLflow()
    made._client, made._id = Client(), "r"
    made._run = Run(started=1_000_000)
    return made


def test_long_texts_are_cut_and_times_are_those_of_the_training(sink):
    update = Update(
        params={"short": "a", "long": "b" * 600},
        tags={"raster": "cpu", "command": "n" * 6000},
        scalars=[Scalar("eval/psnr", 20.5, 30, 2.5)],
        pictures=[PICTURE],
        status="FAILED",
        reason="x" * 6000,
    )
    sink.send(update)
    (_, _, sent) = sink._client.calls[0]
    assert [len(param.value) for param in sent["params"]] == [1, 500]
    lengths = {tag.key: len(tag.value) for tag in sent["tags"]}
    assert lengths == {"raster": 3, "command": 5000, "error": 5000}
    (metric,) = sent["metrics"]
    found = (metric.key, metric.value, metric.step, metric.timestamp)
    assert found == ("eval/psnr", 20.5, 30, 1_002_500)
    (image,) = [named for name, _, named in sink._client.calls if name == "log_image"]
    assert (image["timestamp"], image["synchronous"]) == (1_002_500, True)
