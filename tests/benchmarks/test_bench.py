"""``gsbench bench``: what it prints and measures. No test looks at how long anything takes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from gsbench.bench import PEER, camera_before, frontal_camera, main, run_bench, trained_like_gaussians
from gsbench.errors import InputError
from gsbench.gaussians.ply import write_ply
from gsbench.raster.cpu import CpuRasterizer

KEYS = {"raster", "size", "count", "forward_ms", "backward_ms", "step_ms", "peak_memory_mb"}


def test_rows() -> None:
    rows = run_bench(["cpu", "reference"], [(40, 30), (33, 17)], [50, 100], repeats=2, threads=1, memory=False)
    assert [(row["size"], row["count"], row["raster"]) for row in rows] == [
        (size, count, raster) for size in ("40x30", "33x17") for count in (50, 100) for raster in ("cpu", "reference")
    ]
    for row in rows:
        assert row.keys() >= KEYS
        parts = row["forward_ms"] + row["loss_ms"] + row["backward_ms"] + row["adam_ms"]
        assert min(row["forward_ms"], row["backward_ms"], row["adam_ms"]) > 0
        assert row["step_ms"] == pytest.approx(parts, abs=0.01)  # the median of two steps is their mean
        assert row["peak_memory_mb"] is None


def test_json_with_memory(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--raster", "cpu", "--size", "40x30", "--count", "60", "--json", "--repeats", "1"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row.keys() >= KEYS
    assert (row["raster"], row["size"], row["count"]) == ("cpu", "40x30", 60)
    assert 50 < row["peak_memory_mb"] < 10_000  # a process with torch, and no more than a small scene


def test_table_of_a_ply(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "model.ply"
    write_ply(trained_like_gaussians(70), path)
    assert main(["--ply", str(path), "--size", "40x30", "--repeats", "1", "--no-memory"]) == 0
    header, line = capsys.readouterr().out.splitlines()
    assert "forward_ms" in header
    assert line.split()[:3] == ["cpu", "40x30", "70"]


def test_peer_is_labelled() -> None:
    pytest.importorskip("gsplat", reason="the peer is gsplat's torch reference")
    (row,) = run_bench([PEER], [(40, 30)], [50], repeats=1, memory=False)
    assert "no compositing" in row["note"]


def test_scene_is_seeded_and_seen() -> None:
    scene = trained_like_gaussians(500)
    assert torch.equal(scene.means, trained_like_gaussians(500).means)
    for camera in (frontal_camera(60, 45), camera_before(scene, 60, 45)):
        output = CpuRasterizer(threads=1).render(scene, camera, 3, torch.zeros(3))
        assert 0.3 < output.visible.float().mean() <= 1
        assert output.alpha.mean() > 0.3


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        (["--size", "500"], "500x375"),
        (["--count", "0"], "at least 1"),
        (["--raster", "nosuch", "--no-memory"], "nosuch"),
        (["--ply", "/no/such.ply"], "such.ply"),
    ],
)
def test_bad_input(arguments: list[str], cause: str) -> None:
    with pytest.raises(InputError, match=cause):
        main(arguments)
