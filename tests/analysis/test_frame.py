"""The data frame of an experiment: one row per trial, with the values of the result files."""

import io
from shlex import split

import pandas as pd
from numpy.testing import assert_array_equal

from gsbench.analysis import to_frame
from gsbench.verbs.results import tables
from tests.analysis.helpers import loaded
from tests.helpers import read_json
from tests.trials import write_trial


def test_each_row_has_the_values_of_one_trials_file(make_experiment):
    experiment = make_experiment()
    frame = to_frame(experiment)
    assert len(frame) == len(experiment.trials) == 12
    for (_, row), trial in zip(frame.iterrows(), experiment.trials, strict=True):
        data = read_json(trial.path / "results.json")
        assert row["folder"] == str(trial.path)
        for key in split("experiment scene init densify seed raster protocol num_gaussians"):
            assert row[key] == data[key]
        assert {key: row[key] for key in data["metrics"]} == data["metrics"]
        assert (row["width"], row["height"]) == (400, 300)
        assert row["seconds_train"] == data["seconds"]["train"]
        assert row["event_split_volume"] == data["events"]["split_volume"]
        assert row["hash_init"] == data["hashes"]["init"]
    assert frame["num_gaussians"].dtype == frame["seed"].dtype == pd.Int64Dtype()


def test_a_missing_value_is_na_and_a_swept_setting_has_a_column(tmp_path):
    write_trial(tmp_path, 0, "aaaaaaaa", psnr=27.0, flip=0.1, _num_init_points=None)
    write_trial(tmp_path, 0, "bbbbbbbb", {"densify.volume_threshold": 0.1}, psnr=28.0, own=3.0)
    frame = to_frame(loaded(tmp_path))
    assert frame["densify.volume_threshold"].tolist() == [0.03, 0.1]
    assert frame["flip"].isna().tolist() == [False, True]
    assert frame["own"].tolist()[1] == 3.0
    assert frame["num_init_points"].isna().tolist() == [True, False]
    assert frame["num_init_points"][1] == 3000


def test_the_csv_of_trials_reads_back_as_the_frame(make_experiment, tmp_path, capsys):
    frame = to_frame(make_experiment())
    assert tables(split("exp --format trials"), tmp_path) == 0
    again = pd.read_csv(io.StringIO(capsys.readouterr().out))
    assert again.columns.tolist() == frame.columns.tolist()
    for name in ("psnr", "flip", "seconds_train"):
        assert_array_equal(again[name], frame[name])
