"""The error in textured parts, against its definition pixel by pixel."""

import numpy as np
import pytest
from PIL import Image

from gsbench.analysis.images import textured_error
from gsbench.runs.layout import FROM_PIXELS, MASKS
from tests.analysis.helpers import trials_of
from tests.helpers import refusal, write
from tests.trials import write_runs


def test_textured_error_is_the_mean_error_in_the_most_textured_fifth(tmp_path):
    """Texture grows from left to right, as steps do.

    The render is off by a tenth of the column's number.
    """
    write_runs(
        tmp_path, scenes=("garden",), densifiers=("adc",), seeds=(0,), views=1, pictures=True
    )
    (trial,) = trials_of(tmp_path)
    column = np.arange(100)
    truth = np.repeat((9 + column**2 // 50)[None], 20, axis=0)
    render = truth - column // 10
    for folder, pixels in (("ground_truth", truth), ("renders", render)):
        picture = np.repeat(pixels[..., None], 3, axis=2).astype(np.uint8)
        Image.fromarray(picture).save(trial.path / f"{folder}/view000.png")
    assert textured_error(trial) == pytest.approx(8.5, abs=0.2)  # of the last twenty columns
    counts = np.full((20, 100), 255, np.uint8)
    counts[:, 50:] = 0
    (trial.path / MASKS).mkdir()
    Image.fromarray(counts).save(trial.path / f"{MASKS}/view000.png")
    # the last ten columns of the left half
    assert textured_error(trial) == pytest.approx(4.0, abs=0.2)
    for picture in (trial.path / "renders").iterdir():
        picture.unlink()
    with refusal("holds no renders"):
        textured_error(trial)
    write(trial.path / FROM_PIXELS, {"error_textured": 3.25})
    assert textured_error(trial) == 3.25
