"""Renders with their photographs, and places that are no folder of renders."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from tests.helpers import write


def png(values):
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, format="png")
    return stream.getvalue()


def test_predictions_of_nerfbaselines_are_measured_with_their_photographs(tmp_path, said, refused):
    """Each render is 10 levels darker than its photograph."""
    views = ("DSC001", "sub/DSC002")
    rng = np.random.default_rng(0)
    for view in views:
        photograph = rng.integers(20, 255, (24, 32, 3)).astype(np.uint8)
        write(tmp_path / f"color/{view}.png", png(photograph - 10))
        write(tmp_path / f"gt-color/{view}.png", png(photograph))
    words = ["evaluate", tmp_path / "color", "eval.lpips=[]", "eval.flip=false", "--json"]
    measured = json.loads(said(*words, "--truth", tmp_path / "gt-color"))
    assert set(measured["views"]) == {f"{view}.png" for view in views}
    assert measured["metrics"]["psnr"] == pytest.approx(20 * np.log10(255 / 10))
    assert "--truth PLACE is needed" in refused(*words)
    assert "nowhere is not a folder of renders" in refused("evaluate", tmp_path / "nowhere")


@pytest.mark.parametrize(
    "name, content, said",
    [
        ("a.ply", b"ply\nformat ascii 1.0\n", "is a model: gsbench scene=SCENE init=ply"),
        ("a.png", png(np.zeros((4, 4, 3), np.uint8)), "is one picture: give its folder"),
        ("a.zip", b"version https://git-lfs.github.com/spec/v1\n", "is a pointer of Git LFS"),
        ("a.zip", b"PK\x03\x04", "is packed: unpack it and give the folder"),
        ("a.tar.gz", b"\x1f\x8b\x08", "is packed: unpack it and give the folder"),
        ("renders/a.npy", b"NUMPY", "holds no pictures that gsbench reads, only a.npy: write PNG"),
        ("renders/.a.png", b"", "holds no pictures that gsbench reads, only .a.png"),
    ],
)
def test_renders_of_other_kinds_are_named_with_the_remedy(name, content, said, tmp_path, refused):
    place = write(tmp_path / name, content)
    photographs = write(tmp_path / "truth/a.png", png(np.zeros((4, 4, 3), np.uint8))).parent
    renders = place.parent if "/" in name else place
    assert said in refused("evaluate", renders, "--truth", photographs)
