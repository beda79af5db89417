"""Densifiers: how a set of Gaussians grows and shrinks while it is trained."""

from gsbench.densify.absgs import AbsGS
from gsbench.densify.adc import ADC
from gsbench.densify.base import Densifier, DensifyContext, Lineage, NoDensifier, Refinement, Rule, Statistic
from gsbench.densify.budget import Budgeted
from gsbench.densify.edge_aware import EdgeAware
from gsbench.densify.fast_gs import FastGS
from gsbench.densify.gns import GNS
from gsbench.densify.long_axis import LongAxis
from gsbench.densify.mcmc import MCMC
from gsbench.densify.mrnf import MRNF
from gsbench.densify.pixel_gs import PixelGS
from gsbench.densify.quantile import QuantileADC
from gsbench.densify.res_gs import ResGS
from gsbench.densify.scores import TrainingViews
from gsbench.densify.steep_gs import SteepGS
from gsbench.densify.taming import Taming
from gsbench.densify.volumetric import Volumetric
from gsbench.events import Cause, RefineEvent

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
