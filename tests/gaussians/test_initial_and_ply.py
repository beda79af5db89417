"""Gaussians made from point clouds, and PLY files."""

import gzip
import math
import re

import numpy as np
import pytest
import torch
from numpy.lib.recfunctions import append_fields, drop_fields
from numpy.testing import assert_allclose, assert_array_equal
from plyfile import PlyData, PlyElement
from torch.testing import assert_close

from gsbench.gaussians.initial import gaussians_from_cloud
from gsbench.gaussians.model import dc_to_bytes, rgb_to_dc
from gsbench.gaussians.ply import check_ply, read_ply, write_ply
from gsbench.init.point_files import read_points
from gsbench.normalization import Normalization
from tests.gaussians.helpers import differences, random_gaussians
from tests.helpers import refusal, table


def table_of(path, count=4):
    write_ply(random_gaussians(count), path)
    return PlyData.read(str(path))["vertex"].data.copy()


def with_type(table, column, kind):
    return table.astype([(name, kind if name == column else "f4") for name in table.dtype.names])


def save(table, path):
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    return path


def changed(tmp_path, **columns):
    """A file of four Gaussians with these values in some columns."""
    table = table_of(tmp_path / "a.ply")
    for name, values in columns.items():
        if name not in table.dtype.names:
            table = append_fields(table, name, np.zeros(4, np.float32), usemask=False)
        table[name] = values
    return save(table, tmp_path / "b.ply")


def test_initial_scales_are_the_root_mean_square_distance_to_three_neighbours():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 50, 50]])
    gaussians = gaussians_from_cloud(points, np.array([[255, 0, 127]] * 5, dtype=np.uint8))
    assert float(gaussians.scales[0, 0]) == pytest.approx(math.sqrt((1 + 4 + 9) / 3), rel=1e-6)
    assert torch.equal(gaussians.scales[:, 0], gaussians.scales[:, 2])
    assert float(gaussians.opacities[0]) == pytest.approx(0.1)
    shown = gaussians.sh_dc[0] * 0.28209479177387814 + 0.5
    assert shown.tolist() == pytest.approx([1.0, 0.0, 127 / 255], abs=1e-6)
    together = gaussians_from_cloud(np.zeros((6, 3)), np.zeros((6, 3), dtype=np.uint8))
    assert float(together.scales[0, 0]) == pytest.approx(math.sqrt(1e-7), rel=1e-5)


def test_too_few_points_and_points_that_are_not_finite_are_refused():
    with refusal("3 points"):
        gaussians_from_cloud(np.zeros((3, 3)), np.zeros((3, 3), dtype=np.uint8))
    with refusal("not finite"):
        gaussians_from_cloud(np.full((5, 3), np.nan), np.zeros((5, 3), dtype=np.uint8))


def test_ply_round_trip_is_exact(tmp_path):
    gaussians = random_gaussians(20, dtype=torch.float32)
    write_ply(gaussians, tmp_path / "a.ply")
    assert not differences(read_ply(tmp_path / "a.ply"), gaussians)


@pytest.mark.parametrize("text", [False, True])
def test_an_element_without_rows_is_accepted(tmp_path, text):
    """Programs for meshes write an element for faces even if there are none."""
    table = table_of(tmp_path / "a.ply")
    faces = PlyElement.describe(np.empty(0, dtype=[("a", "i4"), ("b", "i4"), ("c", "i4")]), "face")
    PlyData([PlyElement.describe(table, "vertex"), faces], text=text).write(str(tmp_path / "b.ply"))
    found, wanted = (read_ply(tmp_path / name).tensors() for name in ("b.ply", "a.ply"))
    assert_close(found, wanted)


def test_ply_layout_is_the_standard_one(tmp_path):
    """plyfile finds the names in 3DGS's order, and harmonics stored channel by channel."""
    gaussians = random_gaussians(4, dtype=torch.float32)
    write_ply(gaussians, tmp_path / "a.ply")
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    names = [p.name for p in vertex.properties]
    rest = [f"f_rest_{i}" for i in range(45)]
    first, last = (
        "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2",
        "scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3",
    )
    assert names == [*first.split(), *rest, "opacity", *last.split()]
    assert vertex["f_rest_15"][2] == gaussians.sh_rest[2, 0, 1].item()  # first coefficient of green
    assert vertex["f_rest_1"][2] == gaussians.sh_rest[2, 1, 0].item()  # second coefficient of red
    assert vertex["rot_0"][1] == gaussians.quaternions[1, 0].item()  # w first


def rewritten(path, old, new):
    """Replace ``old``, which occurs once in the file, by ``new``; return the path."""
    content = path.read_bytes()
    assert content.count(old) == 1
    path.write_bytes(content.replace(old, new))
    return path


@pytest.mark.parametrize("text, bytes_each", [(False, 61 * 4 + 8), (True, 62 * 2)])
def test_a_header_that_promises_more_than_the_file_has_is_refused(tmp_path, text, bytes_each):
    """The header promises 62 numbers each, one of them a double; in text, at least two bytes."""
    write_ply(random_gaussians(4), tmp_path / "a.ply")
    path = rewritten(tmp_path / "a.ply", b"property float opacity", b"property double opacity")
    many = b"comment a property float b\nelement vertex 1000000"
    rewritten(path, b"element vertex 4", many)
    if text:
        rewritten(path, b"format binary_little_endian", b"format ascii")
    with refusal(f"cut short: its header promises {1_000_000 * bytes_each} bytes or more"):
        check_ply(path)
    check_ply(rewritten(path, b"element vertex 1000000", b"element vertex 2"))
    with refusal("count of an element is negative"):
        check_ply(rewritten(path, b"element vertex 2", b"element vertex -1"))


@pytest.mark.parametrize(
    "old, new, said",
    [
        (b" f_rest_0\n", b" f_rest_50\n", r"it has 45, with f_rest_50"),
        (b" f_rest_0\n", b" f_rest_00\n", r"it has 45, with f_rest_00"),
        (b" f_rest_44\n", b" f_rest_145\n", r"it has 45, with f_rest_145"),
        (b" f_rest_44\n", b" unknown\n", r"it has 44"),
        (b"property float f_rest_43\nproperty float f_rest_44\n", b"", "it has 43"),
    ],
)
def test_harmonics_with_a_wrong_name_or_number_are_refused(tmp_path, old, new, said):
    write_ply(random_gaussians(4, seed=2), tmp_path / "a.ply")
    with refusal(said):
        read_ply(rewritten(tmp_path / "a.ply", old, new))


def test_colours_become_harmonics_and_bytes_again():
    # 0.5 plus 0.2821 times the coefficient, in [0, 1], times 255
    harmonics = torch.tensor([[0.0, 10.0, -10.0], [1.0, -1.0, 0.5]])
    assert dc_to_bytes(harmonics).tolist() == [[128, 255, 0], [199, 56, 163]]
    levels = torch.arange(256).reshape(-1, 2)
    assert dc_to_bytes(rgb_to_dc(levels / 255)).tolist() == levels.tolist()


@pytest.mark.parametrize("degree, stored", [(0, 0), (1, 3), (2, 8), (3, 15)])
def test_a_ply_of_a_lower_degree_is_read(tmp_path, degree, stored):
    """Some programs store fewer coefficients, channel by channel; the missing ones become zero."""
    table = table_of(tmp_path / "a.ply")
    gaussians = read_ply(tmp_path / "a.ply")
    places = [15 * channel + k for channel in range(3) for k in range(stored)]  # in the full table
    names = [name for name in table.dtype.names if not name.startswith("f_rest_")]
    kind = [(name, "f4") for name in [*names, *(f"f_rest_{k}" for k in range(len(places)))]]
    small = np.empty(4, dtype=kind)
    for name in names:
        small[name] = table[name]
    for k, place in enumerate(places):
        small[f"f_rest_{k}"] = table[f"f_rest_{place}"]
    back = read_ply(save(small, tmp_path / "b.ply"))
    assert torch.equal(back.sh_rest[:, :stored], gaussians.sh_rest[:, :stored])
    assert not back.sh_rest[:, stored:].any()
    assert torch.equal(back.means, gaussians.means)


def test_the_end_of_a_header_is_searched_in_the_first_64_kib(tmp_path):
    path = tmp_path / "a.ply"
    for length, fits in ((60_000, True), (66_000, False)):
        comment = f"comment {'x' * length}"
        path.write_text(f"ply\nformat ascii 1.0\n{comment}\nelement vertex 0\nend_header\n")
        with refusal(None if fits else "it has no header"):
            check_ply(path)


@pytest.mark.parametrize(
    "name, value, said",
    [
        ("x", np.nan, "x is not a finite number everywhere"),
        ("f_rest_44", np.inf, "f_rest_44 is not a finite number everywhere"),
        ("rot_", 0.0, r"a Gaussian has a rotation of \(0, 0, 0, 0\)"),
    ],
)
def test_an_error_names_the_property_with_an_invalid_value(tmp_path, name, value, said):
    columns = [f"rot_{k}" for k in range(4)] if name == "rot_" else [name]
    with refusal(rf"b\.ply: {said}"):
        read_ply(changed(tmp_path, **{key: [1, value, 1, 1] for key in columns}))


def test_a_model_without_gaussians_or_without_a_property_is_refused(tmp_path):
    nothing = save(table_of(tmp_path / "a.ply")[:0].copy(), tmp_path / "b.ply")
    with refusal("missing or odd properties: all, since it is empty"):
        read_ply(nothing)
    with refusal(r"missing or odd properties: opacity$"):
        read_ply(rewritten(tmp_path / "a.ply", b" opacity\n", b" opaqueness\n"))


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("change", ["utf-8", "latin-1", "crlf"])
def test_headers_of_other_programs_are_read(tmp_path, change, text):
    vertex = PlyElement.describe(table_of(tmp_path / "a.ply"), "vertex")
    PlyData([vertex], text=text, comments=["made by hand"]).write(str(tmp_path / "b.ply"))
    header, end, body = (tmp_path / "b.ply").read_bytes().partition(b"end_header\n")
    if change == "crlf":
        body = body.replace(b"\n", b"\r\n") if text else body
        changed = (header + end).replace(b"\n", b"\r\n") + body
    else:
        changed = header.replace(b"made by", "gemäß".encode(change)) + end + body
    (tmp_path / "b.ply").write_bytes(changed)
    wanted = read_ply(tmp_path / "a.ply")
    assert not differences(read_ply(tmp_path / "b.ply"), wanted)
    assert_array_equal(read_points(tmp_path / "b.ply")[0], wanted.means.double())


COMPRESSED = b"ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\n"
COMPRESSED += b"element vertex 1\nproperty uint packed_position\nend_header\n" + bytes(8)


@pytest.mark.parametrize(
    "name, content, said",
    [
        ("a.compressed.ply", COMPRESSED, "a compressed PLY, as SuperSplat writes it"),
        ("a.ply", b"NGSP" + bytes(9), "a packed model"),
        ("a.KSPLAT", bytes(32), "a packed model"),
        ("last.ckpt", bytes(9), "a checkpoint of PyTorch: give the PLY"),
        ("a.bin", b"\x80\2}q\0.", "a checkpoint of PyTorch: give the PLY"),
        ("a.npz", b"PK\3\4" + bytes(9), "a ZIP archive: unpack it, and give the PLY in it"),
        ("a.ply.gz", gzip.compress(b"ply\n", mtime=0), "compressed by gzip: gunzip a.ply.gz"),
        ("a.json", b'{"frames": []}', "JSON: give the PLY of a model"),
        ("a.ply", b"version https://git-lfs.github.com/spec/v1\n", "a pointer of Git LFS"),
    ],
)
def test_files_that_are_no_model_are_named(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    readers = [read_ply, check_ply]
    if said.startswith(("a packed model", "a compressed PLY")):
        said += f": unpack it with npx @playcanvas/splat-transform {name} out.ply"
        readers += [read_points] if name.endswith("ply") else []
    for read in readers:
        with refusal(re.escape(said)):
            read(tmp_path / name)


def test_the_filter_of_mip_splatting_is_applied(tmp_path, caplog):
    """Scales .3 and filter .4 give scales .5, and opacity .8 times (.3 / .5)³."""
    columns = {f"scale_{axis}": math.log(0.3) for axis in range(3)}
    columns["opacity"] = math.log(0.8 / 0.2)
    read = read_ply(changed(tmp_path, **columns, filter_3D=[0.4, 0.4, 0.4, 0.0]))
    assert "Mip-Splatting's filter_3D is applied" in caplog.text
    assert read.scales[:3].flatten().tolist() == pytest.approx([0.5] * 9)
    assert read.opacities.tolist() == pytest.approx([0.8 * 0.6**3] * 3 + [0.8])
    assert read.scales[3].tolist() == pytest.approx([0.3] * 3)
    with refusal("filter_3D is negative or not a finite number"):
        read_ply(changed(tmp_path, filter_3D=[0.4, np.nan, 0.4, 0.4]))


@pytest.mark.parametrize(
    "column, refused, said",
    table(__file__, "columns"),
)
def test_unknown_columns_are_named_or_refused(tmp_path, column, refused, said, caplog):
    with refusal(said if refused else None):
        read_ply(changed(tmp_path, **{column: 0}))
    if not refused:
        assert said in caplog.text
        assert bool(caplog.text) is bool(said)


@pytest.mark.parametrize(
    "comment, warned",
    [
        ("SplatRenderMode: mip", True),
        ("antialiased 1", True),
        ("SplatRenderMode: default", False),
        ("antialiased 0", False),
    ],
)
def test_a_model_for_an_antialiased_rasterizer_is_told(tmp_path, comment, warned, caplog):
    vertices = PlyElement.describe(table_of(tmp_path / "a.ply"), "vertex")
    PlyData([vertices], comments=["Exported from Brush", comment]).write(str(tmp_path / "b.ply"))
    read_ply(tmp_path / "b.ply")
    assert ("its opacities belong to an antialiased rasterizer" in caplog.text) is warned
    assert bool(caplog.text) is warned


def test_models_with_two_scales_or_whole_numbers_are_refused_by_name(tmp_path):
    table = table_of(tmp_path / "a.ply")
    flat = drop_fields(table, "scale_2", usemask=False)
    with refusal(r"scale_2: it has flat Gaussians \(2DGS\)"):
        read_ply(save(flat, tmp_path / "flat.ply"))
    kinds = [(name, "u1" if name == "opacity" else "f4") for name in table.dtype.names]
    with refusal("opacity has whole numbers, as in a compressed model"):
        read_ply(save(table.astype(kinds), tmp_path / "bytes.ply"))


def test_files_of_gsbench_are_not_suspected(tmp_path, caplog):
    """Sparse clouds in large units have logarithms above 0, as lengths do."""
    gaussians = random_gaussians(4, dtype=torch.float32)
    gaussians.log_scales[:] = 0.5
    gaussians.opacity_logits[:] = 0.5
    write_ply(gaussians, tmp_path / "own.ply")
    read_ply(tmp_path / "own.ply")
    assert not caplog.records
    save(PlyData.read(str(tmp_path / "own.ply"))["vertex"].data, tmp_path / "foreign.ply")
    read_ply(tmp_path / "foreign.ply")
    assert "no opacity is below 0" in caplog.text


@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_opacities_of_zero_and_one_are_read(tmp_path, kind, caplog):
    table = with_type(table_of(tmp_path / "a.ply"), "opacity", kind)
    table["opacity"] = [np.inf, -np.inf, 0.3, np.inf]
    opacities = torch.sigmoid(read_ply(save(table, tmp_path / "b.ply")).opacity_logits)
    assert opacities.tolist() == pytest.approx([1, 0, 1 / (1 + np.exp(-0.3)), 1], abs=2e-7)
    assert ((opacities > 0) & (opacities < 1)).all()  # so that they can be trained
    assert "3 Gaussians have an opacity of exactly 0 or 1" in caplog.text
    table["opacity"][2] = np.nan
    with refusal("opacity is not a finite number everywhere: it is nan in row 2 and in 0 more"):
        read_ply(save(table, tmp_path / "b.ply"))
    far = with_type(table_of(tmp_path / "a.ply"), "x", "f8")
    far["x"][1] = 1e300  # beyond float32
    with refusal(r"x is not a finite number everywhere: it is 1e\+300 in row 1"):
        read_ply(save(far, tmp_path / "b.ply"))


@pytest.mark.parametrize("lowest, warned", [(0.0, True), (-0.001, False)])
@pytest.mark.parametrize("what", ["scale", "opacity"])
def test_values_that_look_activated_cause_a_warning(tmp_path, what, lowest, warned, caplog):
    names = ["scale_0", "scale_1", "scale_2", "opacity"]
    values = np.linspace(lowest, 1, 4)
    read_ply(changed(tmp_path, **{name: values if what in name else -3.0 for name in names}))
    assert (f"no {what} is below 0" in caplog.text) is warned
    assert bool(caplog.text) is warned


@pytest.mark.parametrize(
    "center, scale, kind",
    [
        ((0.0, 0.0, 0.0), 1.0, "f4"),
        ((0.1, -0.2, 0.3), 100.0, "f4"),
        ((5e5, 5.4e6, 300.0), 1.0, "f8"),
        ((2.0, 3.0, 4.0), 1e5, "f8"),
    ],
)
def test_a_normalized_model_is_written_in_its_own_coordinates_and_read_back(
    tmp_path, center, scale, kind
):
    normalization = Normalization(center, scale)
    gaussians = random_gaussians(50, dtype=torch.float32)
    write_ply(gaussians, tmp_path / "own.ply", normalization)
    table = PlyData.read(str(tmp_path / "own.ply"))["vertex"].data
    assert table["x"].dtype == np.dtype(kind)
    own = np.array(center) + gaussians.means.double().numpy() / scale
    assert_allclose(np.column_stack([table[axis] for axis in "xyz"]), own, rtol=2e-7)
    assert_allclose(np.exp(table["scale_1"]), gaussians.scales[:, 1] / scale, rtol=1e-5)
    again = read_ply(tmp_path / "own.ply", normalization=normalization)
    assert_close(again.means, gaussians.means, atol=1e-5, rtol=0)
    assert_close(again.log_scales, gaussians.log_scales, atol=1e-5, rtol=0)
    assert_close(again.quaternions, gaussians.quaternions)
