"""The types of a trial's files: defaults of missing values, and values that count as damage."""

import json
from pathlib import Path

import pytest

from gsbench.normalization import Normalization
from gsbench.parsing import DamagedError, parse_typed
from gsbench.runs.trial_record import (
    Failure,
    MetricRecord,
    UnfinishedError,
    read_rows,
    record_from,
    split_text,
    whole_lines,
)
from tests.helpers import table
from tests.trials import results_of, trial_values

PATH = Path("results.json")
RESULTS = results_of(trial_values("runs"), num_gaussians=2)


def record(**changes):
    return record_from(RESULTS | changes, PATH)


def test_only_results_of_renders_may_lack_the_number_of_gaussians():
    assert record().num_gaussians == 2
    assert record(evaluated_from="renders").num_gaussians == 2
    assert record(evaluated_from="renders", num_gaussians=None).num_gaussians is None
    for evaluated_from in (None, "model"):
        with pytest.raises(DamagedError, match="num_gaussians is not there"):
            record(evaluated_from=evaluated_from, num_gaussians=None)


@pytest.mark.parametrize("key", ["packages", "rooms"])  # the second in early files
def test_the_states_of_packages_are_read_by_either_name(key):
    code = record(code={key: {"train": "a" * 16}}).code
    assert code.to_json() == {"packages": {"train": "a" * 16}}


def test_a_result_has_the_same_normalization_after_reading():
    moved = Normalization((2e6, -9e6, 0.5), 24.5)
    read = record(normalization={"center": [2e6, -9e6, 0.5], "scale": 24.5})
    assert read.normalization == moved
    assert record_from(read.to_json(), PATH) == read
    with pytest.raises(DamagedError, match="a normalisation needs a finite centre"):
        record(normalization={"center": [0.0, 0.0, 0.0], "scale": -1.0})


def test_unfinished_results_are_distinguished_from_damaged_ones():
    with pytest.raises(UnfinishedError, match="is unfinished, its status is 'running'"):
        record(status="running", seed="0")
    with pytest.raises(UnfinishedError, match="is unfinished, its status is None"):
        record_from({}, PATH)
    with pytest.raises(DamagedError, match="seed is '0'") as caught:
        record(seed="0")
    assert not isinstance(caught.value, UnfinishedError)


def test_omitted_facts_of_a_metric_or_a_failure_have_defaults():
    assert parse_typed(b'{"label": "a"}', MetricRecord, PATH) == MetricRecord(
        label="a", direction=0, decimals=3, unit=""
    )
    empty = parse_typed(b"{}", Failure, PATH)
    assert (empty.seed, empty.reason) == (0, "no reason was given")
    assert Failure(error="E").reason == "E"
    assert Failure(error="E", message=" first \nsecond").reason == "first"


@pytest.mark.parametrize(
    "settings, text",
    table(__file__, "the_rule_of_a_split_has_a_short_text"),
)
def test_the_rule_of_a_split_has_a_short_text(settings, text):
    assert split_text({f"scene.{name}": value for name, value in settings.items()}) == text


@pytest.mark.parametrize(
    "row, sound",
    [
        ({"step": 0, "loss": 0.5}, True),
        ({"step": 7, "loss": -1e30, "reset": True, "count": 2**62}, True),
        ({"step": -1}, False),
        ({"step": True}, False),
        ({"step": 1.5}, False),
        ({"loss": 0.5}, False),
        ({"step": 1, "loss": 1e31}, False),
        ({"step": 1, "loss": "x"}, False),
    ],
)
def test_a_row_has_an_iteration_and_numbers(row, sound, tmp_path):
    assert read_rows(tmp_path / "absent.jsonl") == []
    path = tmp_path / "metrics.jsonl"
    path.write_text(json.dumps({"step": 1}) + "\n" + json.dumps(row) + "\n")
    assert read_rows(path) == [{"step": 1}, row][: 1 + sound]


def test_whole_lines_end_before_the_first_torn_one(tmp_path):
    path = tmp_path / "metrics.jsonl"
    assert whole_lines(path) == []
    path.write_text('{"step": 1, "x": "kept as it is"}\n{"step": 2}\n{"st')
    assert whole_lines(path) == [('{"step": 1, "x": "kept as it is"}', 1), ('{"step": 2}', 2)]
