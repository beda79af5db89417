"""``gsbench export TRIAL --out page.html``: its cameras, and the commands where npx fails."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsbench.cli import run
from gsbench.normalization import Normalization
from gsbench.view.page import PACKAGE, page_settings
from gsbench.view.trials import find_trial
from tests.helpers import write
from tests.view.conftest import VIEWS

ADDRESS = "small:courtyard:adc"
NPX = """#!/bin/sh
for word in "$@"; do
    [ "$previous" = -E ] && settings="$word"; previous="$word"
    case "$word" in *.ply) [ -s "$word" ] || exit 1; esac
done
case "$*" in *"{works}"*) (echo "<head></head>"; cat "$settings") > "$previous"; {works_too};; *) {fails};; esac
"""


@pytest.fixture(autouse=True)
def _runs(small_runs, monkeypatch):
    monkeypatch.setenv("GSBENCH_RUNS", str(small_runs))


def stand_in(folder, works, fails, works_too=":"):
    """Write an npx that copies its settings to the page if its words contain ``works``."""
    write(
        folder / "npx",
        NPX.replace("{works}", works).replace("{fails}", fails).replace("{works_too}", works_too),
    )
    (folder / "npx").chmod(0o755)
    return folder


@pytest.mark.parametrize("works", ["splat-transform", "-g cpu"], ids=["with a GPU", "without"])
def test_the_page_has_every_test_view(works, small_runs, tmp_path, monkeypatch, said):
    npx = stand_in(tmp_path / "bin", works, "exit 1")
    monkeypatch.setenv("PATH", f"{npx}{os.pathsep}{os.environ['PATH']}")
    said("export", ADDRESS, "--out", tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert text.startswith(
        '<head><meta http-equiv="Content-Security-Policy" content="default-src \'n'
    )
    settings = json.loads(text.rpartition("</head>")[2])
    assert settings == page_settings(find_trial(ADDRESS, small_runs))
    assert settings["background"] == {"color": [0, 0, 0]}
    effects = settings["postEffectSettings"]
    assert not any(effect["enabled"] for effect in effects.values())
    neutral = {"brightness": 0, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]}
    assert effects["grading"] == {"enabled": False, **neutral}
    shown = [one["camera"]["initial"] for one in settings["annotations"]]
    assert [one["title"] for one in settings["annotations"]] == list(VIEWS)
    assert [one["position"] for one in settings["annotations"]] == [one["target"] for one in shown]
    assert settings["cameras"] == [{"initial": shown[0]}]
    # The viewer turns the model by half a turn about z. The cameras look along z from (1, 2, 0) and (2, 2, 0),
    # and the median depth of the points before them is 5. The longer side is that of 128 px.
    for x, focal, one in zip((1, 2), (100, 110), shown, strict=True):
        assert (one["position"], one["target"]) == ([-x, -2, 0], [-x, -2, 5])
        assert np.tan(np.radians(one["fov"] / 2)) == pytest.approx(64 / focal)


def test_the_page_is_in_the_models_own_coordinates(small_runs):
    trial = find_trial(ADDRESS, small_runs)
    moved = replace(trial.record, normalization=Normalization((7.0, 0.0, 3.0), 2.0))
    first, _ = page_settings(replace(trial, record=moved))["annotations"]
    shown = first["camera"]["initial"]
    assert (shown["position"], shown["target"]) == ([-7.5, -1, 3], [-7.5, -1, 5.5])


@pytest.mark.parametrize(
    "fails, cause",
    [
        ("echo first; echo 'no device' >&2; exit 1", "failed (no device)"),
        ("echo first; echo last; exit 1", "failed (last)"),
        ("exit 0", "failed ()"),
        ('cp "$settings" "$previous"; exit 1', "failed ()"),
        ("", "is not installed"),
    ],
)
def test_without_npx_the_error_names_the_commands_to_type(
    fails, cause, tmp_path, monkeypatch, capsys
):
    place = f"{stand_in(tmp_path / 'bin', 'never', fails)}:/bin" if fails else str(tmp_path)
    monkeypatch.setenv("PATH", place)
    assert run(["export", ADDRESS, "--out", str(tmp_path / "page.html")]) == 1
    said = capsys.readouterr().err
    assert cause in said
    assert "export --out model.ply" in said
    assert said.endswith(f": npx {PACKAGE} model.ply page.html\n")
    assert said.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} <= {"bin"}


def hostile_capture(folder, monkeypatch):
    """Go to a folder whose own npx, packages and settings would run if npm read them."""
    for name in ("node_modules/.bin/npx", ".npmrc", "package.json", "npx"):
        write(folder / name, f"#!/bin/sh\ntouch {folder}/exploded\n")
        (folder / name).chmod(0o755)
    monkeypatch.chdir(folder)


def test_npx_starts_where_no_package_of_the_current_folder_is_found(tmp_path, monkeypatch, said):
    seen = "(pwd; ls -A; echo $PATH) > $SEEN; d=$(pwd); while [ $d != / ]; do d=$(dirname $d); ls -A $d >> $SEEN; done"
    npx = stand_in(tmp_path / "bin", "splat-transform", "exit 1", seen)
    monkeypatch.setenv("SEEN", str(tmp_path / "seen"))
    own = os.environ["PATH"]
    monkeypatch.setenv("PATH", os.pathsep.join(["node_modules/.bin", ".", "", str(npx), own]))
    (tmp_path / "capture").mkdir()
    hostile_capture(tmp_path / "capture", monkeypatch)
    said("export", ADDRESS, "--out", "page.html")
    assert not Path("exploded").exists()
    where, *seen_lines = (tmp_path / "seen").read_text().splitlines()
    assert Path(where) != tmp_path / "capture"
    assert not Path(where).exists()
    assert seen_lines.count("package.json") == 1
    assert {"node_modules", ".npmrc"}.isdisjoint(seen_lines)
    assert all(
        entry.startswith("/") for line in seen_lines if ":" in line for entry in line.split(":")
    )


@pytest.mark.parametrize("name", ["node_modules", ".npmrc", "package.json"])
def test_a_temporary_folder_below_packages_is_refused(name, tmp_path, monkeypatch, capsys):
    npx = stand_in(tmp_path / "bin", "splat-transform", "exit 1")
    monkeypatch.setenv("PATH", f"{npx}{os.pathsep}{os.environ['PATH']}")
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / name).touch()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "a" / "b"))
    assert run(["export", ADDRESS, "--out", str(tmp_path / "page.html")]) == 1
    assert f"{tmp_path / 'a' / name} would be read" in capsys.readouterr().err
    assert not list((tmp_path / "a" / "b").iterdir())
