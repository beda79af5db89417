"""Short trainings of a tiny scene, for most tests of this folder."""

import json
from dataclasses import replace

import torch

from gsbench.densify import ADC, GNS, MCMC, MRNF, FastGS, SteepGS
from gsbench.gaussians.initial import gaussians_from_cloud
from gsbench.train.ideas import NO_IDEAS
from gsbench.train.options import TrainConfig
from gsbench.train.trainer import Trainer

CPU = torch.device("cpu")
EVENTS, METRICS = "events.jsonl", "metrics.jsonl"


def cloud(truth):
    colors = torch.full((len(truth), 3), 127, dtype=torch.uint8)
    return gaussians_from_cloud(truth.means.double().numpy(), colors.numpy())


def options(**changes):
    values = {
        "name": "test",
        "iterations": 120,
        "sh_interval": 40,
        "position_steps": 120,
        "checkpoint_every": 50,
        "volume_histogram": [60],
    }
    return TrainConfig(**(values | changes))


def small(kind=ADC, **changes):
    window = {"start": 20, "stop": 110, "interval": 20, "opacity_reset_interval": 60}
    return kind(**(window | changes))


# Densifiers whose own state a resumed training must restore.
STATEFUL = {
    "adc": small,
    "mcmc": lambda: MCMC(start=20, stop=110, interval=20),
    "mrnf": lambda: MRNF(start=0, stop=110, interval=20, decay_until=120),
    "gns": lambda: GNS(
        start=20, stop=60, interval=20, max_gaussians=90, pressure_length=1.0, overgrowth=2.0
    ),
    "fastgs": lambda: small(FastGS, error_threshold=0.05, least_count=0.0, max_gaussians=200),
    "steepgs": lambda: small(SteepGS),
}


def same(a, b):
    pairs = zip(a.tensors().values(), b.tensors().values(), strict=True)
    return len(a) == len(b) and all(torch.equal(x, y) for x, y in pairs)


class StopError(Exception):
    """Stands for a kill: nothing is saved when it is raised."""


def stop_at(step):
    def stop(status):
        if status.step == step:
            raise StopError

    return stop


class Lab:
    """A scene with its Gaussians, a rasterizer, and a folder for trainings."""

    def __init__(self, *parts):
        self.scene, self.truth, self.rasterizer, self.folder = parts

    def new(self, densifier, seed=0, snapshot_at=(), ideas=NO_IDEAS, **changes):
        parts = (self.scene, cloud(self.truth), densifier, self.rasterizer)
        return Trainer(*parts, options(**changes), seed, snapshot_at, ideas)

    def train(self, densifier, name="", on_status=lambda status: None, **changes):
        (self.folder / name).mkdir(exist_ok=True)
        return self.new(densifier, **changes).run(self.folder / name, on_status)

    def text(self, file, name=""):
        return (self.folder / name / file).read_text()

    def records(self, file, name=""):
        return [json.loads(line) for line in self.text(file, name).splitlines()]

    def steps(self, file, name=""):
        return [record["step"] for record in self.records(file, name)]

    def checkpoints(self, name=""):
        """The iterations of the checkpoints."""
        found = (self.folder / name).glob("checkpoint-*.pt")
        return sorted(int(path.stem.removeprefix("checkpoint-")) for path in found)

    def with_views(self, **changes):
        scene = replace(self.scene, **changes)
        return Lab(scene, self.truth, self.rasterizer, self.folder)
