"""Clouds of points from files of all formats, against the written arrays and pycolmap."""

import re
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from plyfile import PlyData, PlyElement

from gsbench.init import MODEL_FOLDER, Points, read_cloud
from gsbench.init.base import PointCloud
from gsbench.init.placed import GREY, points_in_view, seen_colors
from gsbench.init.point_files import read_points
from gsbench.scene.images import read_image
from tests.helpers import refusal
from tests.init.models import camera_at, model_with
from tests.init.tables import TABLES
from tests.init.test_report import CENTERS, model_of

RNG = np.random.default_rng(0)
XYZ = RNG.uniform(-2, 2, (40, 3)).astype(np.float32).astype(np.float64)
RGB = RNG.integers(0, 256, (40, 3))


def write(path, properties, values, text, order):
    table = np.zeros(len(XYZ), dtype=[(name, kind) for name, kind in properties])
    for name, column in values.items():
        table[name] = column
    PlyData([PlyElement.describe(table, "vertex")], text=text, byte_order=order).write(str(path))
    return path


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    "names, kind, scale",
    TABLES["colours of PLY files"],
)
def test_ply_properties_may_have_any_order_and_type(tmp_path, text, order, names, kind, scale):
    red, green, blue = ((name, kind) for name in names)
    properties = [blue, ("z", "f8"), ("nx", "f4"), ("x", "f4"), red, ("y", "f8"), green]
    values = dict(zip((*"xyz", *names), [*XYZ.T, *RGB.T * scale], strict=True))
    points, colors = read_points(write(tmp_path / "cloud.ply", properties, values, text, order))
    assert_allclose(points, XYZ, rtol=1e-6)
    assert_array_equal(colors, RGB)


def rows(*columns, between=" "):
    table = np.column_stack(columns)
    return "".join(between.join(f"{value:.17g}" for value in row) + "\n" for row in table)


COLUMNS = {"XYZ": XYZ, "ZYX": XYZ[:, ::-1], "RGB": RGB, "FRACTIONS": RGB / 255}
COLUMNS |= {"NUMBER": np.arange(40), "INTENSITY": np.arange(40) - 1200.0, "ALPHA": np.full(40, 255)}
TEXTS = [
    ("a.pts", f"3\n{rows(XYZ[:3], RGB[:3])}37\n{rows(XYZ[3:], RGB[3:])}", True),
    ("a.csv", "\ufeff" + rows(XYZ, between=",").replace("\n", "\r\n"), False),
    ("a.csv", '"x","y","z"\n' + re.sub(r"[^,\n]+", r'"\g<0>"', rows(XYZ, between=",")), False),
    ("a.csv", rows(XYZ, RGB, between=",").replace("\n", ",\n"), True),
]
for name, head, columns, between, colored in TABLES["tables of points"]:
    table = rows(*map(COLUMNS.get, columns.split()), between=between)
    TEXTS.append((name, head + table, colored))


@pytest.mark.parametrize("name, text, colored", TEXTS)
def test_tables_of_scanners_and_other_programs_are_read(tmp_path, name, text, colored):
    (tmp_path / name).write_bytes(text.encode())
    points, colors = read_points(tmp_path / name)
    assert_array_equal(points, XYZ)
    assert_array_equal(colors, RGB if colored else None)


@pytest.mark.parametrize(
    "name, text, message",
    TABLES["clouds refused"],
)
def test_tables_that_would_be_read_wrong_are_refused_with_the_remedy(tmp_path, name, text, message):
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


def test_colours_come_from_the_nearest_photograph(courtyard):
    model = pycolmap.Reconstruction(courtyard.model)
    points = RNG.uniform(-6, 6, (60, 3))
    found = seen_colors(points, courtyard, model)
    for point, color in zip(points, found, strict=True):
        images = [model.find_image_with_name(name) for name in courtyard.train_names]
        images.sort(key=lambda image: np.linalg.norm(image.projection_center() - point))
        expected = np.full(3, -1)
        for image in images:
            pixel = image.project_point(point)
            camera = model.cameras[image.camera_id]
            if pixel is not None and 0 <= pixel[0] < camera.width and 0 <= pixel[1] < camera.height:
                expected = read_image(courtyard.images / image.name)[int(pixel[1]), int(pixel[0])]
                break
        assert_array_equal(color, expected)
    assert 5 < (found[:, 0] >= 0).sum() < 60


def test_black_counts_as_a_colour_and_points_without_a_camera_are_grey(
    courtyard, tmp_path, monkeypatch
):
    save(tmp_path / "scan.xyz", XYZ[:3])
    seen = np.array([[0, 0, 0], [-1, -1, -1], [0, 9, 255]], dtype=np.int16)
    monkeypatch.setattr("gsbench.init.placed.seen_colors", lambda *_: seen)
    cloud = Points(path=tmp_path / "scan.xyz").cloud(courtyard, pycolmap.Reconstruction())
    assert_array_equal(cloud.colors, [[0, 0, 0], [GREY] * 3, [0, 9, 255]])


def test_the_points_of_the_reference_are_all_replaced(courtyard, tmp_path, monkeypatch):
    save(tmp_path / "scan.xyz", XYZ)
    model, options = model_of(CENTERS), Points(path=tmp_path / "scan.xyz")
    own = {tuple(point.xyz) for point in model.points3D.values()}
    cloud = PointCloud(XYZ[:4], np.array(RGB[:4], dtype=np.uint8))
    monkeypatch.setattr(Points, "cloud", lambda *_: cloud)
    assert options.set_points(model, courtyard, tmp_path) is None
    placed = {tuple(point.xyz) for point in model.points3D.values()}
    assert placed == {tuple(point) for point in XYZ[:4]}
    assert not placed & own
    assert not any(len(image.points2D) for image in model.images.values())


def test_a_cloud_is_thinned_and_written_with_the_reference_cameras(courtyard, tmp_path):
    save(tmp_path / "scan.xyz", XYZ)
    options = Points(path=tmp_path / "scan.xyz", max_points=30, seed=1)
    report = options.run(courtyard, tmp_path / "out")
    cloud = read_cloud(tmp_path / "out" / MODEL_FOLDER)
    assert report.num_points == len(cloud) == 30
    assert np.linalg.norm(cloud.points[:, None] - XYZ[None], axis=2).min(axis=1).max() < 1e-9
    assert len(np.unique(cloud.points, axis=0)) == 30
    seen = seen_colors(cloud.points, courtyard, pycolmap.Reconstruction(courtyard.model))
    assert_array_equal(cloud.colors, np.where(seen < 0, GREY, seen))
    first = options.content()
    save(tmp_path / "scan.xyz", 2 * XYZ)
    assert options.content() != first


def save(path, table):
    np.savetxt(path, table, fmt="%.17g")


def header(path, text):
    path.write_text(f"ply\nformat ascii 1.0\n{text}")


FLOATS = "".join(f"property float {axis}\n" for axis in "xyz")
PLYS = [
    ("element vertex 3\nproperty float x\nend_header\n1\n2\n3\n", "no column y, z"),
    (f"element vertex 0\n{FLOATS}end_header\n", "holds no point"),
    ("element point 1\nproperty int x\nend_header\n1\n", "it has no element vertex, only point"),
]


@pytest.mark.parametrize(
    "name, make, message",
    [
        *(("a.ply", lambda path, text=text: header(path, text), said) for text, said in PLYS),
        ("a.ply", lambda path: path.write_bytes(b"no cloud"), "not a readable file of points"),
        ("a.xyz", lambda path: save(path, XYZ[:, :2]), "it has 2 columns without names: wanted"),
        ("a.xyz", lambda path: save(path, np.where(XYZ > 1.9, np.nan, XYZ)), "not finite numbers"),
        ("a.xyz", lambda path: path.write_text("1 2 x\n"), "not a readable file of points"),
        ("a.xyz", lambda path: path.write_text("1 2 3", "utf-16"), "UTF-16 or UTF-32: save it as"),
    ],
)
def test_bad_files_are_refused_in_one_line(courtyard, tmp_path, name, make, message):
    make(tmp_path / name)
    with refusal(message):
        Points(path=tmp_path / name).cloud(courtyard, pycolmap.Reconstruction(courtyard.model))


def test_a_missing_file_is_refused_and_photos_without_cameras_need_a_reference(
    bare_photos, tmp_path
):
    with refusal(r"init\.path=nowhere\.ply is not a file$"):
        Points(path="nowhere.ply")
    (tmp_path / "model/point_cloud").mkdir(parents=True)
    (tmp_path / "model/point_cloud/a.ply").touch()
    with refusal(r"model is not a file, but a folder: give .*/model/point_cloud/a\.ply$"):
        Points(path=tmp_path / "model")
    save(tmp_path / "a.xyz", XYZ)
    assert Points(path=tmp_path / "a.xyz").needs_reference(replace(bare_photos))


@pytest.mark.parametrize("shape, kind", TABLES["arrays that are no points"])
def test_a_cloud_refuses_points_of_another_shape_or_type(shape, kind):
    with pytest.raises(ValueError, match="points must be"):
        PointCloud(np.zeros(shape, kind), np.zeros(shape, np.uint8))


def test_points_in_view_include_the_upper_and_left_border_and_exclude_points_behind():
    wide = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0, 100, 80)
    model = model_with({"a": camera_at([0, 0, 0])}, camera=wide)
    # The first pixel beyond the right and lower border is at column 100 and row 80. The points at
    # z <= 0 are behind the camera.
    points = [[-1.0, 0, 1], [1.0, 0, 1], [0, -0.8, 1], [0, 0.8, 1], [0, 0, 0], [0, 0, -1]]
    points = np.array([*points, [0.3, 0.2, 0.5]])
    seen, pixels, distances = points_in_view(points, "a", model)
    assert seen.tolist() == [0, 2, 6]
    assert_allclose(pixels, [[0, 40], [50, 0], [80, 60]])
    assert_allclose(distances, [2**0.5, 1.64**0.5, 0.38**0.5])
    unknown = points_in_view(points, "b", model)
    assert [values.shape for values in unknown] == [(0,), (0, 2), (0,)]
