"""The way of a setting from YAML to its use: few composings, few checks, few folders.

The way follows the call stacks at the moments when the value is composed, checked and used: from
one stack to the next, up to the frame that they share and down again. A crossing is a step from one
folder of gsbench to another.
"""

import inspect
import itertools
import operator
from collections import Counter
from pathlib import Path
from shlex import split

import hydra
import pytest

import gsbench
from gsbench import settings
from gsbench.cli import run
from gsbench.config import compose
from gsbench.densify import Volumetric
from gsbench.gaussians.trainable import TrainableGaussians
from tests.end_to_end.conftest import SMALL

pytestmark = pytest.mark.slow

PACKAGE = Path(gsbench.__file__).parent
MAX_CROSSINGS = 11
KEY = "densify.volume_threshold"
TRIAL = SMALL + split(
    "train.iterations=4 train.densify_start=1 train.densify_interval=2 train.densify_stop=4 "
    "scene.views=9 scene.width=48 scene.height=36 init.count=200 raster=reference "
    "eval.lpips=[] eval.flip=false eval.maps=false tracking=none device=cpu "
    f"densify=volumetric {KEY}=1e-9"
)


def stack():
    """The present frames of gsbench, the outermost first."""
    frames = [(id(entry.frame), Path(entry.filename)) for entry in reversed(inspect.stack(0))]
    return [
        (number, path.relative_to(PACKAGE).as_posix())
        for number, path in frames
        if path.is_relative_to(PACKAGE)
    ]


def way(stacks):
    """The files on the way from the end of each stack to the end of the next."""
    passed = stacks[0][-1:]
    for here, there in itertools.pairwise(stacks):
        shared = sum(itertools.accumulate(map(operator.eq, here, there), min))
        passed += [*reversed(here[max(0, shared - 1) : -1]), *there[shared:]]
    return [file for file, _ in itertools.groupby(file for _, file in passed)]


def crossings(files):
    """The number of steps between folders on a way from ``conf/`` over these files."""
    folders = ["conf", *(file.partition("/")[0] for file in files)]
    return sum(one != other for one, other in itertools.pairwise(folders))


def test_a_way_is_counted_by_its_folders():
    outer, inner = (
        [(1, "app/a.py"), (2, "config/b.py")],
        [(1, "app/a.py"), (3, "app/c.py"), (4, "launch/d.py")],
    )
    assert way([outer, inner]) == split("config/b.py app/a.py app/c.py launch/d.py")
    assert crossings(way([outer, inner])) == 3  # conf, config, app, launch


def test_a_setting_is_checked_twice_and_crosses_few_folders_from_yaml_to_use(tmp_path, monkeypatch):
    stacks = []
    calls = Counter()

    def watch(owner, name, counts=lambda *given, **named: True, keep=True):
        """Count the calls of ``owner.name`` that ``counts`` accepts; keep the first one's stack."""
        real = getattr(owner, name)

        def watched(*given, **named):
            if counts(*given, **named):
                calls[name] += 1
                if calls[name] == 1 and keep:
                    file = Path(inspect.getfile(inspect.unwrap(real)))
                    stacks.append([*stack(), (0, file.relative_to(PACKAGE).as_posix())])
            return real(*given, **named)

        monkeypatch.setattr(owner, name, watched)

    watch(hydra, "compose", keep=False)
    watch(compose, "check_composed", keep=False)
    watch(compose, "check_permissions", keep=False)
    watch(settings, "_converted", lambda value, field, cls, key, **named: key == KEY)
    watch(Volumetric, "split_by_volume")
    watch(TrainableGaussians, "edit", lambda *given, **named: calls["split_by_volume"] > 0)
    assert run(["-m", *TRIAL, f"runs={tmp_path}"]) == 0
    assert calls["compose"] == 1  # before the sweep: not again when a trial begins
    # the values of the command, and of the trial; and what these are resolved to
    assert (calls["check_composed"], calls["check_permissions"]) == (2, 1)
    assert calls["_converted"] == 2  # checked before the sweep, built when the trial begins
    assert len(stacks) == 3
    passed = way(stacks)
    assert crossings(passed) <= MAX_CROSSINGS, "\n".join(passed)
