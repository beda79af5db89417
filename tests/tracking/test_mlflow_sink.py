"""What is asked of MLflow's client for an experiment and at the end of a run; no tracker runs."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mlflow.exceptions import MlflowException

from gsbench.errors import InputError
from gsbench.tracking.mlflow_sink import (
    KIND,
    MlflowSink,
    default_uri,
    ensure_experiment,
    require_own_artifacts,
)
from gsbench.tracking.sinks import MirrorState, Scalar, Summary


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

    def called(self, name):
        return [given for called, given, _ in self.calls if called == name]


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
    place = None if served else (tmp_path / "mlartifacts" / "x").as_uri()
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


def test_a_deleted_experiment_is_restored_and_a_foreign_one_gets_the_missing_tags(tmp_path):
    client = Client(get_experiment_by_name=experiment("deleted", **KIND))
    ensure_experiment(client, "x", tmp_path)
    assert client.called("restore_experiment") == [(7,)]
    assert client.called("set_experiment_tag") == []
    client = Client(get_experiment_by_name=experiment())
    ensure_experiment(client, "x", tmp_path)
    assert client.called("restore_experiment") == []
    assert client.called("set_experiment_tag") == [(7, *item) for item in KIND.items()]


def test_artifacts_of_the_own_database_stay_in_the_runs_folder(tmp_path):
    own, other = Client(default_uri(tmp_path)), Client("http://there")
    inside = tmp_path / "mlartifacts" / "x" / "run"
    require_own_artifacts(own, inside.as_uri(), tmp_path)
    (tmp_path / "mlartifacts").mkdir()
    (tmp_path / "mlartifacts" / "link").symlink_to("/tmp")
    for place in (tmp_path / "elsewhere", inside / ".." / ".." / "..", Path("/tmp")):
        with pytest.raises(InputError, match="would send artifacts to "):
            require_own_artifacts(own, f"file://{place}", tmp_path)
    with pytest.raises(InputError):
        require_own_artifacts(own, f"file://{inside.parents[1]}/link/a", tmp_path)
    require_own_artifacts(other, "s3://bucket/x", tmp_path)


@pytest.fixture
def sink(tmp_path):
    made = MlflowSink.__new__(MlflowSink)
    made.client, made.run_id, made._started = Client(), "r", 1_000_000
    params = {"short": "a", "long": "b" * 600}
    made._trial = SimpleNamespace(folder=SimpleNamespace(path=tmp_path), params=lambda: params)
    return made


def test_a_failed_run_gets_its_reason_and_the_files_that_are_there(sink, tmp_path):
    (tmp_path / "config.yaml").touch()
    sink.stop("KILLED", None)
    assert sink.client.calls == [("set_terminated", ("r", "KILLED"), {})]
    sink.stop("FAILED", "x" * 6000)
    assert sink.client.called("set_tag") == [("r", "error", "x" * 5000)]
    assert sink.client.called("log_artifact") == [("r", str(tmp_path / "config.yaml"))]
    assert sink.client.called("set_terminated")[1] == ("r", "FAILED")


def test_a_run_that_failed_before_and_is_complete_now_has_no_error(sink):
    for tags, deleted in (({}, []), ({"error": "nan"}, [("r", "error")])):
        sink.client = client = Client(get_run=SimpleNamespace(data=SimpleNamespace(tags=tags)))
        picture = np.zeros((2, 3, 3), np.uint8)
        sink.complete(
            Summary(
                note="n" * 6000,
                scalars=[Scalar("eval/psnr", 20.5, 30, 2.5)],
                tags={"raster": "cpu"},
                pictures={"view": picture},
                files=[("", Path("a")), ("sub", Path("b"))],
                step=30,
                seconds=2.5,
            )
        )
        assert client.called("delete_tag") == deleted
        (metric,) = client.calls[len(deleted) + 1][2]["metrics"]
        assert (metric.key, metric.value, metric.step) == ("eval/psnr", 20.5, 30)
        assert metric.timestamp == 1_002_500
        tags = client.calls[len(deleted) + 2][2]["tags"]
        assert {tag.key: len(tag.value) for tag in tags} == {
            "raster": 3,
            "mlflow.note.content": 5000,
        }
        assert client.called("log_artifact") == [("r", "a", None), ("r", "b", "sub")]
        (image,) = [named for name, _, named in client.calls if name == "log_image"]
        assert image == {"key": "view", "step": 30, "timestamp": 1_002_500, "synchronous": True}
        assert client.calls[-1] == ("set_terminated", ("r", "FINISHED"), {})


@pytest.mark.parametrize(
    "refusals, lengths", [(0, [600]), (1, [600, 500]), (2, [600, 500, 250]), (3, None)]
)
def test_long_settings_are_shortened_for_servers_that_refuse_them(sink, refusals, lengths):
    full = MlflowException("too long")
    sink.client = client = Client(log_batch=[full] * refusals + [None])
    if lengths is None:
        with pytest.raises(MlflowException):
            sink._log_params()
        assert client.called("set_tag") == []
        return
    sink._log_params()
    sent = [named["params"] for name, _, named in client.calls if name == "log_batch"]
    assert [len(params[1].value) for params in sent] == lengths
    assert client.called("set_tag") == [("r", "gsbench", "1")]


def test_settings_that_are_short_already_are_not_sent_again(sink):
    sink._trial.params = lambda: {"short": "a" * 250}
    sink.client = client = Client(log_batch=MlflowException("full"))
    with pytest.raises(MlflowException, match="full"):
        sink._log_params()
    assert len(client.called("log_batch")) == 1


@pytest.mark.parametrize("own", [True, False])
def test_the_state_names_the_own_database_without_its_folder(tmp_path, own):
    """So a runs folder may be moved; another tracker is named by its address."""
    uri = default_uri(tmp_path) if own else "http://there"
    artifacts = (tmp_path / "mlartifacts" / "x").as_uri()
    run = SimpleNamespace(
        info=SimpleNamespace(run_id="r", artifact_uri=artifacts),
        data=SimpleNamespace(tags={"gsbench": "1"}),
    )
    client = Client(uri, create_run=run, get_experiment_by_name=experiment(**KIND))
    sink = MlflowSink.__new__(MlflowSink)
    sink.client = client
    folder = SimpleNamespace(path=tmp_path, runs=tmp_path)
    sink._trial = SimpleNamespace(folder=folder, values={"name": "x"}, label="l", tags=dict)
    state = sink.open(MirrorState(), None)
    assert state.uri == ("runs/mlflow.db" if own else "http://there")
    assert client.called("search_runs") == []  # no run is known yet
    client.known["search_runs"] = [[run]]
    assert sink.open(state, None) == state
    assert len(client.called("create_run")) == 1
