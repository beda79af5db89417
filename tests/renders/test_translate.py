"""The same renders under the conventions of others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from gsbench.analysis.results import load_experiment
from gsbench.cli import run
from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator, quantize
from gsbench.eval.protocol import OTHERS, PAPER, Protocol
from gsbench.renders.translate import Material, Pictures, in_words, translate
from tests.eval.test_metrics import brute_force_ssim, mirrored_ssim

SIZE = (60, 80)


def pictures(seed: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """(renders before rounding, photographs by one filter, by another): three views each."""
    rng = np.random.default_rng(seed)
    exact, one, other = {}, {}, {}
    for view in ("a.png", "b.png", "c.png"):
        large = rng.integers(0, 256, (SIZE[0] * 3, SIZE[1] * 3, 3), dtype=np.uint8)
        image = Image.fromarray(large)
        size = (SIZE[1], SIZE[0])
        one[view] = np.asarray(image.resize(size, Image.Resampling.LANCZOS))
        other[view] = np.asarray(image.resize(size, Image.Resampling.BICUBIC))
        noise = rng.normal(0, 0.05, (*SIZE, 3))
        exact[view] = np.clip(one[view] / 255 + noise, 0, 1).astype(np.float32)
    return exact, one, other


def material(exact: dict[str, np.ndarray], one: Pictures, other: Pictures) -> Material:
    renders = {view: quantize(torch.from_numpy(image)).numpy() for view, image in exact.items()}
    return Material(renders, one, lambda: exact, lambda protocol: other if protocol.shrinking == "bicubic" else one)


def plain(protocol: Protocol) -> Evaluator:
    return Evaluator(protocol, lpips=(), flip=False)


def inside_ssim(truth: np.ndarray, render: np.ndarray) -> float:
    """SSIM of [H, W, 3] over the pixels whose window lies inside the image."""
    return float(
        structural_similarity(
            truth, render, channel_axis=2, data_range=1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
        )
    )


def test_each_protocol_measures_as_its_program_does() -> None:
    """scikit-image's PSNR and SSIM of the pictures that each program would compare."""
    exact, one, other = pictures(0)
    source = material(exact, one, other)
    rounded = {view: np.floor(image.astype(np.float64) * 255 + 0.5) / 255 for view, image in exact.items()}
    expected = {  # renders, photographs, how SSIM treats the border
        "3dgs": (rounded, other, "zero"), "gsplat": (exact, other, "mirrored"),
        "nerfbaselines": (rounded, other, "inside"), "nerfstudio": (exact, other, "inside"),
        "mipnerf360": (rounded, one, "inside"),
    }  # fmt: skip
    ssims = {"zero": brute_force_ssim, "mirrored": mirrored_ssim, "inside": inside_ssim}
    assert expected.keys() == OTHERS.keys()
    for name, (renders, photographs, border) in expected.items():
        found = translate(source, OTHERS[name], plain)
        pairs = [(photographs[view] / 255, np.float64(renders[view])) for view in renders]
        psnr = [peak_signal_noise_ratio(truth, render, data_range=1) for truth, render in pairs]
        assert found.metrics["psnr"] == pytest.approx(np.mean(psnr), abs=1e-4), name
        ssim = [ssims[border](truth, render) for truth, render in pairs]
        assert found.metrics["ssim"] == pytest.approx(np.mean(ssim), abs=1e-5), name


def test_what_cannot_be_followed_is_said_and_nothing_is_put_in_its_place() -> None:
    exact, one, other = pictures(2)

    def refuse(*_: object) -> Pictures:
        raise InputError("it is not there")

    source = material(exact, one, other)
    found = translate(Material(source.renders, one, refuse, refuse), OTHERS["gsplat"], plain)  # type: ignore[arg-type]
    assert found.unknown == {"resampling": "it is not there", "rounding": "it is not there"}
    whole = translate(source, OTHERS["gsplat"], plain)
    assert whole.unknown == {}
    assert found.metrics["psnr"] != whole.metrics["psnr"]
    assert "resampling as it was, since it is not there" in in_words(found)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trial of the courtyard whose photographs were shrunk."""
    home = tmp_path_factory.mktemp("home")
    words = [
        "scene=courtyard", "scene.views=12", "scene.width=160", "scene.height=120", "scene.max_size=80", "init=random",
        "init.count=2000", "init.size=1.2", "densify=none", "train.iterations=150", "eval.lpips=[]", "eval.flip=false",
        "tracking=none", "device=cpu", "name=small", f"runs={home / 'runs'}",
    ]  # fmt: skip
    assert run(words) == 0
    return home


def test_trials_are_measured_by_all(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GSBENCH_RUNS", str(home / "runs"))
    assert run(["evaluate", "small", "--protocol", "all"]) == 0
    said = dict(line.strip().split(": ", 1) for line in capsys.readouterr().out.splitlines() if ": " in line)
    assert said.keys() == {PAPER.id, *(protocol.id for protocol in OTHERS.values())}
    trial = load_experiment(home / "runs", "small").trials[0]
    own = f"PSNR {trial.metrics['psnr']:.2f}, "
    assert said[PAPER.id].startswith(own)
    assert said["mipnerf360-1"].startswith(own)  # the courtyard's photographs are shrunk as it does
    assert not said["gsplat-2"].startswith(own)
    assert all("as it was" not in line for line in said.values())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["renders"], "--truth is not given"),
        (["small", "--protocol", "all", "--truth", "small:courtyard:none"], "take no --truth"),
        (["small", "--protocol", "all", "eval.flip=true"], "as they were made"),
        (["renders", "--protocol", "gsplat", "--truth", "small:courtyard:none"], "with --as EXPERIMENT:ARM, then"),
    ],
)
def test_wrong_words_are_refused(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    monkeypatch.setenv("GSBENCH_RUNS", str(home / "runs"))
    assert run(["evaluate", *words]) == 2
    assert message in capsys.readouterr().err
