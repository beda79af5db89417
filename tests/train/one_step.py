"""Count the operations of one training step for which the host would wait for a GPU.

Run as a program, on the CPU: ``python -m tests.train.one_step RASTER``. Triton's kernels run in its
interpreter (``TRITON_INTERPRET=1``). No read-back has arrived before it is waited for, as on a GPU
that is behind. Prints one JSON object for each densifier.
"""

import json
import sys
from pathlib import Path

import torch

import tests.raster.conftest  # noqa: F401 - makes the interpreter faster
from benchmarks.counters import counting_waits
from gsbench.bench.measure import NEVER, constant_scene_options
from gsbench.bench.scenes import make_scene
from gsbench.densify import ADC, MCMC, adc
from gsbench.raster import create_rasterizer, staged
from gsbench.raster.staged import Readback
from gsbench.train.loss import torch_photometric_loss
from gsbench.train.trainer import Trainer

DENSIFIERS = {
    "adc": ADC(start=NEVER - 1, stop=NEVER, opacity_reset_interval=NEVER),
    "absgrad": ADC(start=NEVER - 1, stop=NEVER, opacity_reset_interval=NEVER, gradient="absolute"),
    "mcmc": MCMC(start=NEVER - 1, stop=NEVER),
}


def main(raster):
    Readback.arrived = property(lambda self: False)
    # On a GPU, this check does not read the values.
    staged._check_background = lambda background: None
    adc.lengths_of = lambda vectors: vectors.norm(dim=-1)  # as on a GPU
    gaussians, scene = make_scene("trained", 20, 20, 12)
    for name, densifier in DENSIFIERS.items():
        rasterizer = create_rasterizer(raster, torch.device("cpu"))
        trainer = Trainer(scene, gaussians, densifier, rasterizer, constant_scene_options(), 0)
        trainer.loss = torch_photometric_loss  # no kernel of the CPU
        for _ in range(2):  # afterwards, all memory is allocated
            trainer.iterate(Path())
        with counting_waits(pretend=True) as counts:
            trainer.iterate(Path())
        print(json.dumps({name: counts}))


if __name__ == "__main__":
    main(sys.argv[1])
