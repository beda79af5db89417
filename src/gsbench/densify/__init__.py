"""Densifiers: how a set of Gaussians grows and shrinks while it is trained."""

from gsbench.densify.adc import ADC
from gsbench.densify.base import Densifier, DensifyContext, NoDensifier, Refinement, Rule
from gsbench.densify.budgeted import Budgeted
from gsbench.densify.edge_aware import EdgeAware
from gsbench.densify.lineage import Lineage
from gsbench.densify.long_axis import LongAxis
from gsbench.densify.mcmc import MCMC
from gsbench.densify.pixel_gs import PixelGS
from gsbench.densify.scores import TrainingViews
from gsbench.densify.taming import Taming
from gsbench.densify.volumetric import Volumetric
from gsbench.events import Cause, RefineEvent

__all__ = [
    "ADC",
    "MCMC",
    "Budgeted",
    "Cause",
    "Densifier",
    "DensifyContext",
    "EdgeAware",
    "Lineage",
    "LongAxis",
    "NoDensifier",
    "PixelGS",
    "RefineEvent",
    "Refinement",
    "Rule",
    "Taming",
    "TrainingViews",
    "Volumetric",
]
