"""After an edit of gsbench itself, no command returns the numbers of the earlier code."""

import shutil
from shlex import split

import pytest

from gsbench.runs.code import PACKAGE
from gsbench.system.install import conf_dir
from tests.end_to_end.conftest import SMALL
from tests.helpers import read_json

pytestmark = pytest.mark.slow

QUICK = [
    *SMALL,
    *split(
        "train.iterations=20 eval.lpips=[] eval.flip=false tracking=none raster=cpu name=edited"
    ),
]


def test_a_trial_is_trained_again_after_an_edit_of_the_loss(gsbench, tmp_path):
    copy = tmp_path / "copy/src/gsbench"
    shutil.copytree(PACKAGE, copy)  # with byte code, which is that of unchanged files
    shutil.copytree(conf_dir(), tmp_path / "copy/conf")
    changes = {"PYTHONPATH": str(copy.parent), "GSBENCH_RUNS": str(tmp_path / "runs")}

    def train(*words):
        # The timeout leaves time to compile kernels.
        done = gsbench(*QUICK, *words, timeout=900, **changes)
        return done.stdout + done.stderr

    def results():
        (path,) = (tmp_path / "runs/edited").glob("*/*/*/results.json")
        return read_json(path)

    train()
    first = results()
    assert first["code"]["packages"]["eval/ssim.py"]
    loss = copy / "train/trainer.py"
    text = loss.read_text()
    assert text.count("PhotometricLoss(options.ssim_weight,") == 1
    loss.write_text(text + "# a comment\n")
    assert "already done" in train()
    loss.write_text(text.replace("(options.ssim_weight,", "(0.95,"))
    assert "will be checked: gsbench's train was " in train("--dry-run")
    assert "already done" not in train()
    second = results()
    assert second["metrics"]["psnr"] != first["metrics"]["psnr"]
    assert second["hashes"]["init"] == first["hashes"]["init"]

    loss.write_text(text)
    assert "iteration" not in train()  # the store has it
    assert results()["metrics"] == first["metrics"]
