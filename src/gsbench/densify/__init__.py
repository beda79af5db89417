"""Densifiers: how a set of Gaussians grows and shrinks while it is trained."""

from gsbench.densify.adc import ADC
from gsbench.densify.adc_variants import AbsGS, PixelGS, QuantileADC
from gsbench.densify.base import Densifier, DensifyContext, NoDensifier, Refinement, Rule, Statistic
from gsbench.densify.budget import Budgeted
from gsbench.densify.gns import GNS
from gsbench.densify.improved_gs import EdgeAware, LongAxis
from gsbench.densify.lineage import Lineage
from gsbench.densify.mcmc import MCMC, MRNF
from gsbench.densify.resgs import ResGS
from gsbench.densify.scored import FastGS, Taming
from gsbench.densify.scores import TrainingViews
from gsbench.densify.steepgs import SteepGS
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
