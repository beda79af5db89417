"""The first guess of a training's time, against measured steps."""

import pytest
from PIL import Image

from gsbench.launch import estimates as guess
from gsbench.launch.estimates import describe_plan, guess_training, picture_size
from tests.trials import bare_trial


def values(kind="courtyard", threads=1, device="cpu", cap=None, iterations=1000, **scene):
    scene = {"kind": kind, "width": 400, "height": 300} | scene
    densify = {"name": "adc", "max_gaussians": cap}
    train = {"iterations": iterations}
    return {
        "scene": scene,
        "densify": densify,
        "train": train,
        "threads": threads,
        "device": device,
    }


def seconds(**changes):
    return guess_training(values(**changes))[0]


def test_a_step_of_the_courtyard_takes_what_was_measured():
    """A trained one, of 55,555 Gaussians, took 31.7 CPU-ms; it is not among the constants."""
    found, text = guess_training(values())
    assert text.endswith("on this CPU, from pictures of 400×300 px and 55,200 Gaussians")
    assert found == pytest.approx(31.7, rel=0.05)


def test_threads_caps_iterations_and_gpus_count(monkeypatch):
    one = seconds()
    assert seconds(threads=2) == pytest.approx(one / 1.9)
    assert seconds(iterations=3000) == pytest.approx(3 * one)
    assert seconds(cap=1000) < 0.7 * one
    monkeypatch.setattr(guess, "has_gpu", lambda: True)
    on_gpu, text = guess_training(values(device="auto", cap=1_000_000, width=1600, height=1400))
    assert on_gpu == pytest.approx(3.0, rel=0.01)  # a million: 3.0 ms on an H100
    assert "on an H100, from pictures of 1600×1400 px and 1,000,000 Gaussians" in text
    assert seconds() == one


def test_pictures_are_measured_at_the_size_of_the_training(tmp_path):
    assert picture_size(values("photos", path=str(tmp_path))["scene"]) is None
    assert guess_training(values("photos", path=str(tmp_path / "no"))) is None
    guess._first_size.cache_clear()
    (tmp_path / "images").mkdir()
    (tmp_path / "images/a.jpg").write_text("no picture")
    Image.new("RGB", (80, 60)).save(tmp_path / "images/b.jpg")
    scene = values("photos", path=str(tmp_path))["scene"]
    assert picture_size(scene) == (80, 60)
    assert picture_size(scene | {"max_size": 40}) == (40, 30)


def test_a_dry_run_guesses_the_first_trial(tmp_path):
    asked = values(iterations=2000)
    asked["scene"]["name"], asked["init"] = "courtyard", {"name": "sfm"}
    trial = bare_trial(tmp_path, 0, raster={"name": "cpu"}, **asked)
    said = describe_plan([trial])[-1]
    assert said.startswith("time: about 64 s, a first guess for trainings on this CPU, from ")
