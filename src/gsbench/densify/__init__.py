"""Densifiers: how a set of Gaussians grows and shrinks while it is trained."""

from gsbench.densify.adc import ADC
from gsbench.densify.adc_variants import AbsGS, PixelGS, QuantileADC, SteepGS
from gsbench.densify.base import Densifier, DensifyContext, NoDensifier, Refinement, Rule, Statistic
from gsbench.densify.budget import Budgeted
from gsbench.densify.improved_gs import GNS, EdgeAware, LongAxis
from gsbench.densify.lineage import Lineage
from gsbench.densify.mcmc import MCMC, MRNF
from gsbench.densify.resgs import ResGS
from gsbench.densify.scored import FastGS, Taming
from gsbench.densify.scores import TrainingViews
from gsbench.densify.volumetric import Volumetric
from gsbench.events import Cause, RefineEvent
from gsbench.parsing import table_beside
from gsbench.settings import Switch

__all__ = [
    "ADC",
    "GNS",
    "MCMC",
    "MRNF",
    "AbsGS",
    "Budgeted",
    "Cause",
    "Densifier",
    "DensifyContext",
    "EdgeAware",
    "FastGS",
    "Lineage",
    "LongAxis",
    "NoDensifier",
    "PixelGS",
    "QuantileADC",
    "RefineEvent",
    "Refinement",
    "ResGS",
    "Rule",
    "Statistic",
    "SteepGS",
    "Taming",
    "TrainingViews",
    "Volumetric",
]

# The parts that `gsbench ablate` can switch off are rows of a table; a class of a user's names its
# own in ``SWITCHES``.
for _name, _rows in table_beside(__file__, "switches.yaml").items():
    globals()[_name].SWITCHES = {part: Switch(**row) for part, row in _rows.items()}
