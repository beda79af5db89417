"""A setting is composed once, and checked once before the sweep and once when it is used."""

from collections import Counter
from shlex import split

import hydra
import pytest

from gsbench import settings
from gsbench.cli import run
from gsbench.config import compose
from tests.end_to_end.conftest import SMALL

pytestmark = pytest.mark.slow

KEY = "densify.volume_threshold"
TRIAL = SMALL + split(
    "train.iterations=4 train.densify_start=1 train.densify_interval=2 train.densify_stop=4 "
    "scene.views=9 scene.width=48 scene.height=36 init.count=200 raster=reference "
    "eval.lpips=[] eval.flip=false tracking=none device=cpu "
    f"densify=volumetric {KEY}=1e-9"
)


def test_a_setting_is_composed_once_and_checked_twice(tmp_path, monkeypatch):
    calls = Counter()

    def watch(owner, name, counts=lambda *given, **named: True):
        real = getattr(owner, name)

        def watched(*given, **named):
            calls[name] += counts(*given, **named)
            return real(*given, **named)

        monkeypatch.setattr(owner, name, watched)

    watch(hydra, "compose")
    watch(compose, "check_permissions")
    watch(settings, "_converted", lambda value, field, cls, key, **named: key == KEY)
    assert run(["-m", *TRIAL, f"runs={tmp_path}"]) == 0
    assert calls["compose"] == 1  # before the sweep: not again when a trial begins
    assert calls["check_permissions"] == 1
    assert calls["_converted"] == 2  # checked before the sweep, built when the trial begins
