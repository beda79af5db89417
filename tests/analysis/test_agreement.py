"""How far trainings lie apart, against brute force and trials whose distance is known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement
from skimage.metrics import peak_signal_noise_ratio

from gsbench.analysis.report.build import build_report
from gsbench.analysis.report.models import agreements, cloud_distance, image_psnr, read_positions, render_psnr
from gsbench.analysis.results import load_experiment
from gsbench.errors import InputError
from gsbench.runs.declaration import Arm
from tests.analysis.synthetic import Plan, write_runs


def write_points(path: Path, points: np.ndarray, opacity: float = 0.9) -> None:
    vertices = np.zeros(len(points), dtype=[(name, "f4") for name in ("x", "y", "z", "opacity")])
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis]
    vertices["opacity"] = math.log(opacity / (1 - opacity))
    PlyData([PlyElement.describe(vertices, "vertex")]).write(path)


def test_cloud_distance_is_that_of_brute_force_and_symmetric() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(80, 3)), rng.normal(size=(50, 3)) + 0.2
    table = np.linalg.norm(first[:, None] - second[None], axis=-1)
    there, back = table.min(axis=1), table.min(axis=0)
    found = cloud_distance(first, second)
    assert found.mean == pytest.approx((there.mean() + back.mean()) / 2)
    assert found.far == pytest.approx(np.quantile(np.concatenate([there, back]), 0.95))
    assert cloud_distance(second, first) == found
    assert cloud_distance(first, first).mean == 0
    with pytest.raises(InputError, match="no visible"):
        cloud_distance(first, np.zeros((0, 3)))


def test_image_psnr_is_that_of_scikit_image() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 256, (2, 20, 30, 3), dtype=np.uint8)
    assert image_psnr(first, second) == pytest.approx(peak_signal_noise_ratio(first, second, data_range=255))
    assert image_psnr(first, first) == 100
    assert image_psnr(np.zeros_like(first), np.full_like(first, 255)) == 0
    with pytest.raises(InputError, match="30x20 and 29x20"):
        image_psnr(first, second[:, 1:])


def test_invisible_gaussians_do_not_count(tmp_path: Path) -> None:
    write_points(tmp_path / "faint.ply", np.ones((5, 3)), opacity=0.09)
    write_points(tmp_path / "seen.ply", np.ones((5, 3)), opacity=0.11)
    assert [len(read_positions(tmp_path / name)) for name in ("faint.ply", "seen.ply")] == [0, 5]


def test_trainings_a_known_way_apart(tmp_path: Path) -> None:
    """Renders that differ by 10 levels everywhere; points moved by 1 % of the extent, which is 4.2."""
    paths = write_runs(tmp_path, Plan(scenes=["garden"], densifiers=["adc"], seeds=(0, 1), pictures=True, views=3))
    rng = np.random.default_rng(0)
    points = rng.uniform(-5, 5, (300, 3))
    for seed, path in enumerate(paths):
        write_points(path / "point_cloud.ply", points + np.array([0.042 * seed, 0, 0]))
        for view in (path / "renders").glob("*.png"):
            Image.fromarray(np.full((20, 30, 3), 100 + 10 * seed, np.uint8)).save(view)
    (found,) = agreements(load_experiment(tmp_path, "exp").trials)
    assert (found.scene, found.arm, found.pairs, found.faults) == ("garden", Arm("sfm", "adc"), 1, ())
    assert found.psnr == pytest.approx(20 * math.log10(255 / 10))
    assert found.distance == pytest.approx(0.01, rel=0.01)
    first, second = load_experiment(tmp_path, "exp").trials
    assert render_psnr(first, second) == render_psnr(second, first)


def test_only_trainings_of_one_arm_and_neighbouring_seeds_are_held_together(tmp_path: Path) -> None:
    write_runs(tmp_path, Plan(seeds=(0, 1, 5, 6, 7), pictures=True, views=2))
    found = agreements(load_experiment(tmp_path, "exp").trials)
    assert [(one.scene, one.arm.densify, one.pairs) for one in found] == [
        (scene, arm, 3) for scene in ("courtyard", "garden") for arm in ("adc", "volumetric")
    ]
    assert all(one.distance == 0 and 40 < one.psnr < 100 for one in found)


def test_what_cannot_be_read_is_said_and_the_rest_is_measured(tmp_path: Path) -> None:
    plan = Plan(scenes=["garden"], densifiers=["adc"], seeds=(0, 1), pictures=True, views=2)
    paths = write_runs(tmp_path, plan)
    (paths[0] / "point_cloud.ply").write_bytes(b"no point cloud")
    (found,) = agreements(load_experiment(tmp_path, "exp").trials)
    assert (found.distance, found.far) == (None, None)
    assert found.psnr is not None
    assert "point_cloud.ply is not a readable 3DGS PLY" in found.faults[0]
    (paths[0] / "renders" / "view000.png").unlink()
    (found,) = agreements(load_experiment(tmp_path, "exp").trials)
    assert found.psnr is None
    assert len(found.faults) == 2
    page = build_report(load_experiment(tmp_path, "exp"))
    assert "How far two trainings" in page
    assert "have different renders" in page


def test_one_seed_has_nobody_to_agree_with(tmp_path: Path) -> None:
    write_runs(tmp_path, Plan(seeds=(0,), pictures=True, views=2))
    experiment = load_experiment(tmp_path, "exp")
    assert agreements(experiment.trials) == []
    assert "How far two trainings" not in build_report(experiment)
