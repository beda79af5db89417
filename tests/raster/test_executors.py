"""The table of executors: what `raster=` accepts, what `auto` takes, how departures are reported."""

import dataclasses
import inspect
import sys
from pathlib import Path

import pytest
import torch

from gsbench.config.build import locate
from gsbench.raster import create_rasterizer, executors
from gsbench.raster.contract import CASES, departures
from gsbench.raster.executors import EXECUTORS, RasterConfig, find_executor, resolve
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.system.install import conf_dir
from tests.helpers import refusal
from tests.processes import completed

CPU = torch.device("cpu")


def installed(monkeypatch, *packages):
    """Pretend that ``packages`` are installed, and no other packages of executors."""
    monkeypatch.setattr(
        executors.importlib.util, "find_spec", lambda name: object() if name in packages else None
    )


@pytest.mark.parametrize("executor", EXECUTORS, ids=lambda executor: executor.name)
def test_the_facts_of_an_executor_agree_with_its_class(executor):
    if executor.name == "triton" and not executor.is_installed:
        pytest.skip("Triton has no wheels for this system")
    kind = locate(executor.target, "raster", [])
    assert kind.name == executor.name
    assert ("threads" in inspect.signature(kind).parameters) == executor.takes_threads
    assert (executor.package is None) == (executor.install == "")


def test_every_executor_has_its_file_in_conf():
    assert {path.stem for path in (conf_dir() / "raster").glob("*.yaml")} == set(executors.names())


def test_the_documents_name_every_executor():
    root = Path(__file__).resolve().parents[2]
    for document in ("README.md", "docs/rasterizer.md"):
        for name in executors.names():
            assert f"`{name}`" in (root / document).read_text(encoding="utf-8"), (document, name)


def test_the_table_does_not_import_torch():
    code = (
        "import sys, gsbench.raster.executors, gsbench.raster.base; print('torch' in sys.modules)"
    )
    assert completed([sys.executable, "-c", code]).stdout == "False\n"


def test_auto_takes_the_best_installed_executor(monkeypatch, caplog):
    assert resolve("auto", "cpu").name == "cpu"
    installed(monkeypatch, "triton")
    assert resolve("auto", "cuda").name == "triton"
    assert caplog.text == ""
    installed(monkeypatch)
    assert resolve("auto", "cuda").name == "reference"
    assert "slow reference" in caplog.text
    assert "pip install triton" in caplog.text
    assert resolve("auto", "mps").name == "reference"


def test_an_executor_that_cannot_run_is_refused_with_a_remedy(monkeypatch):
    assert resolve("reference", "cpu").name == "reference"
    assert isinstance(create_rasterizer("reference", CPU, threads=1), ReferenceRasterizer)
    for name, device, said in (
        ("opengl", "cpu", "opengl is not known; choose auto, reference, cpu, .*_target_"),
        ("triton", "cpu", "triton runs on device=cuda, not on cpu; choose from reference, cpu"),
        ("cpu", "cuda", "cpu runs on device=cpu, not on cuda; choose from reference, "),
    ):
        with refusal(f"^raster={said}"):
            resolve(name, device)
    installed(monkeypatch)
    with refusal("raster=triton needs triton: pip install triton"):
        resolve("triton", "cuda")
    assert find_executor("triton").obstacle("cuda") is not None


def test_departures_lists_errors_and_accepts_missing_options():
    class Broken(ReferenceRasterizer):
        def render(self, *arguments, **options):
            raise RuntimeError("no kernel")

    class Plain(ReferenceRasterizer):
        name = "plain"  # not in the table, and without attributes that offer optional outputs

    case = CASES[-1]
    assert departures(ReferenceRasterizer(), cases=(case,)) == []
    assert departures(Plain(), cases=(case,)) == []
    assert departures(Broken(), cases=(case,)) == [
        f"{case}: RuntimeError: no kernel",
        "without Gaussians: RuntimeError: no kernel",
    ]


def test_python_headers_are_searched_in_the_usual_scheme(tmp_path, monkeypatch):
    """Debian's own scheme, ``posix_local``, names a folder without headers."""
    asked = []
    get = lambda scheme: asked.append(scheme) or {"include": tmp_path}  # noqa: E731
    monkeypatch.setattr(executors.sysconfig, "get_paths", get)
    monkeypatch.setenv("CC", sys.executable)
    for default in ("posix_local", "posix_prefix", "nt"):
        monkeypatch.setattr(executors.sysconfig, "get_default_scheme", lambda of=default: of)
        (line,) = executors.missing_tools()
        assert line.startswith(f"{tmp_path / 'Python.h'}:")
    assert asked == ["posix_prefix", "posix_prefix", "nt"]
    (tmp_path / "Python.h").touch()
    assert executors.missing_tools() == []
    monkeypatch.setenv("CC", "no-such-compiler -O2")
    (line,) = executors.missing_tools()
    assert line.startswith("a C compiler (CC is no-such-compiler -O2, which is not there): install")


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_an_error_says_why_the_gpu_cannot_be_used(monkeypatch):
    pytest.importorskip("triton")
    monkeypatch.setattr(executors, "missing_tools", list)
    with refusal(r"^Triton cannot start: "):
        executors.load_driver()
    monkeypatch.setattr(executors, "missing_tools", lambda: ["a C compiler", "Python.h"])
    with refusal(r"^Triton needs a C compiler and Python.h$"):
        executors.load_driver()


def test_an_unknown_rasterizer_is_refused():
    assert RasterConfig(name="cpu").name == "cpu"
    with refusal("raster=cpuu is not known; choose auto, reference, .*; did you mean cpu"):
        RasterConfig(name="cpuu")
    assert RasterConfig(name="mine", _target_="mine.Mine")._target_ == "mine.Mine"


TINY = CASES[-1]


class Changed(ReferenceRasterizer):
    """The reference, with changed outputs: ``change`` gets the number of Gaussians and the output."""

    def __init__(self, change):
        self.change = change

    def render(self, gaussians, *arguments, **options):
        out = super().render(gaussians, *arguments, **options)
        return dataclasses.replace(out, **self.change(len(gaussians), out))


def footprint_of(out, **changes):
    """The footprint of a view with some fields multiplied by the factors ``changes``."""

    def footprint(values=None):
        true = out.require_footprint(values)
        factors = {name: factor * getattr(true, name) for name, factor in changes.items()}
        return dataclasses.replace(true, **factors)

    return footprint


OFF = "is off by up to"


@pytest.mark.parametrize(
    "change, told",
    [
        (lambda out: {"image": out.image[None]}, "image has shape (1, 5, 7, 3), expected (5, 7"),
        (lambda out: {"image": out.image + 0.5}, f"image {OFF} 5.00e-01"),
        (lambda out: {"alpha": out.alpha - 0.25}, f"alpha {OFF} 2.50e-01"),
        (lambda out: {"image": out.image + torch.nan}, f"image {OFF} nan"),
        (lambda out: {"radii": out.radii.long()}, "radius is torch.int64, expected torch.int32"),
        (
            lambda out: {"radii": out.radii + (out.radii == out.radii.max())},
            f"radius {OFF} 1.00e+00 at Gaussian",
        ),
        (lambda out: {"screen_points": torch.zeros(20, 2)}, "gradient of screen_points is missing"),
        (
            lambda out: {"footprint": footprint_of(out, pixels=3)},
            f"footprint (pixels) {OFF} 2.00e+00 of the sum",
        ),
        (
            lambda out: {"footprint": footprint_of(out, values=0.5)},
            f"footprint (values) {OFF} 5.00e-01 of the sum",
        ),
    ],
)
def test_each_kind_of_departure_is_listed(change, told):
    (line,) = departures(Changed(lambda n, out: change(out) if n else {}), cases=(TINY,))
    assert line.startswith(f"{TINY}: {told}")


@pytest.mark.parametrize(
    "change, told",
    [
        (lambda out: {"image": out.image + 1}, "the image is not the background"),
        (lambda out: {"alpha": out.alpha + 1}, "the image is not the background"),
        (lambda out: {"image": out.image.detach()}, "RuntimeError: "),
    ],
)
def test_departures_tests_a_view_without_gaussians(change, told):
    (line,) = departures(Changed(lambda n, out: {} if n else change(out)), cases=(TINY,))
    assert line.startswith(f"without Gaussians: {told}")


def test_the_scenes_of_the_contract_do_not_change():
    """Reports about rasterizers outside gsbench name these scenes."""
    assert " ".join(map(str, CASES)) == (
        "33x49-n50-sh3 97x65-n250-sh3 64x48-n150-sh2 50x37-n120-sh1 81x50-n150-sh0 40x40-n300-sh3 "
        "7x5-n20-sh3"
    )
    camera = CASES[1].camera()
    intrinsics = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
    assert intrinsics == pytest.approx([97, 65, 106.7, 101.85, 55.8, 27.4])
    assert camera.rotation[0].tolist() == pytest.approx([0.9800666, 0, 0.1986693])
    assert camera.rotation[2].tolist() == pytest.approx([-0.1986693, 0, 0.9800666])
    assert camera.translation.tolist() == [0.1, -0.2, 0.3]
    sums = [tensor.sum().item() for tensor in CASES[-2].gaussians().tensors().values()]
    expected = [1186.380758, -1317.554622, -18.917049, 900.250302, 15.529487, -11.050933]
    assert sums == pytest.approx(expected, rel=1e-6)
