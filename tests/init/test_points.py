"""Clouds of points from PLY files, against the written arrays."""

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from plyfile import PlyData, PlyElement

from gsbench.init import MODEL_FOLDER, Points, read_cloud
from gsbench.init.base import PointCloud
from gsbench.init.placed import GREY
from gsbench.init.point_files import read_points
from tests.helpers import refusal
from tests.init.tables import TABLES
from tests.init.test_report import CENTERS, model_of

RNG = np.random.default_rng(0)
XYZ = RNG.uniform(-2, 2, (40, 3)).astype(np.float32).astype(np.float64)
RGB = RNG.integers(0, 256, (40, 3))


def write(path, properties, values, text, order):
    size = len(next(iter(values.values())))
    table = np.zeros(size, dtype=properties)
    for name, column in values.items():
        table[name] = column
    PlyData([PlyElement.describe(table, "vertex")], text=text, byte_order=order).write(str(path))
    return path


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("names, kind, scale", TABLES["colours of PLY files"])
def test_ply_properties_may_have_any_order_and_type(tmp_path, text, order, names, kind, scale):
    red, green, blue = ((name, kind) for name in names)
    properties = [blue, ("z", "f8"), ("nx", "f4"), ("x", "f4"), red, ("y", "f8"), green]
    values = dict(zip((*"xyz", *names), [*XYZ.T, *RGB.T * scale], strict=True))
    points, colors = read_points(write(tmp_path / "cloud.ply", properties, values, text, order))
    assert_allclose(points, XYZ, rtol=1e-6)
    assert_array_equal(colors, RGB)


@pytest.mark.parametrize("name, text, message", TABLES["clouds refused"])
def test_files_that_are_no_clouds_are_refused_with_the_remedy(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with refusal(message):
        read_points(tmp_path / name)


def test_columns_of_a_cloud_without_colours_are_named(tmp_path, caplog):
    values = dict(zip("xyz", XYZ.T, strict=True))
    kinds = [(name, "f4") for name in (*"xyz", "nx")]
    read_points(write(tmp_path / "a.ply", kinds, values, False, "<"))
    assert not caplog.text
    _, colors = read_points(write(tmp_path / "b.ply", [*kinds, ("rgba", "u4")], values, False, "<"))
    assert colors is None
    assert "has no red, green and blue, and its rgba is not used" in caplog.text


def test_colours_of_gaussians_come_from_their_constant_harmonic(tmp_path):
    """RGB = .5 + f_dc / (2 sqrt(pi)), clipped: 3DGS's colour without view dependence."""
    properties = [(name, "f4") for name in (*"xyz", "f_dc_0", "f_dc_1", "f_dc_2")]
    dc = (RGB / 255 - 0.5) * 2 * np.sqrt(np.pi)
    dc[0], dc[1] = 9.0, -9.0
    values = dict(zip("xyz", XYZ.T, strict=True)) | {f"f_dc_{k}": dc[:, k] for k in range(3)}
    points, colors = read_points(write(tmp_path / "model.ply", properties, values, False, "<"))
    assert_array_equal(points, XYZ)
    assert_array_equal(colors, [[255] * 3, [0] * 3, *RGB[2:]])


def test_the_points_of_the_reference_are_all_replaced(courtyard, tmp_path, monkeypatch):
    model, options = model_of(CENTERS), Points(path=save(tmp_path / "scan.ply", XYZ))
    own = {tuple(point.xyz) for point in model.points3D.values()}
    cloud = PointCloud(XYZ[:4], np.array(RGB[:4], dtype=np.uint8))
    monkeypatch.setattr(Points, "cloud", lambda *_: cloud)
    assert options.set_points(model, courtyard, tmp_path) is None
    placed = {tuple(point.xyz) for point in model.points3D.values()}
    assert placed == {tuple(point) for point in XYZ[:4]}
    assert not placed & own
    assert not any(len(image.points2D) for image in model.images.values())


def test_a_cloud_is_thinned_and_written_with_the_reference_cameras(courtyard, tmp_path):
    options = Points(path=save(tmp_path / "scan.ply", XYZ), max_points=30, seed=1)
    report = options.run(courtyard, tmp_path / "out")
    cloud = read_cloud(tmp_path / "out" / MODEL_FOLDER)
    assert report.num_points == len(cloud) == 30
    assert np.linalg.norm(cloud.points[:, None] - XYZ[None], axis=2).min(axis=1).max() < 1e-9
    assert len(np.unique(cloud.points, axis=0)) == 30
    assert (cloud.colors == GREY).all()
    first = options.content()
    save(tmp_path / "scan.ply", 2 * XYZ)
    assert options.content() != first


def save(path, points):
    values = dict(zip("xyz", points.T, strict=True))
    return write(path, [(name, "f8") for name in "xyz"], values, False, "<")


def test_points_that_are_not_finite_are_refused(courtyard, tmp_path):
    path = save(tmp_path / "a.ply", np.where(XYZ > 1.9, np.nan, XYZ))
    with refusal("points have coordinates that are not finite numbers"):
        Points(path=path).cloud(courtyard, pycolmap.Reconstruction(courtyard.model))
    with refusal("holds no point"):
        read_points(save(path, XYZ[:0]))


def test_a_missing_file_is_refused_and_photos_without_cameras_need_a_reference(
    bare_photos, tmp_path
):
    with refusal(r"init\.path=nowhere\.ply is not a file$"):
        Points(path="nowhere.ply")
    (tmp_path / "model/point_cloud").mkdir(parents=True)
    (tmp_path / "model/point_cloud/a.ply").touch()
    with refusal(r"model is not a file, but a folder: give .*/model/point_cloud/a\.ply$"):
        Points(path=tmp_path / "model")
    assert Points(path=save(tmp_path / "a.ply", XYZ)).needs_reference(bare_photos)


@pytest.mark.parametrize("shape, kind", TABLES["arrays that are no points"])
def test_a_cloud_refuses_points_of_another_shape_or_type(shape, kind):
    with pytest.raises(ValueError, match="points must be"):
        PointCloud(np.zeros(shape, kind), np.zeros(shape, np.uint8))
