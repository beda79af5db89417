"""Densifiers: how a set of Gaussians grows and shrinks while it is trained."""

from gsbench.densify.adc import ADC
from gsbench.densify.base import Densifier, DensifyContext, NoDensifier
from gsbench.densify.events import Cause, Lineage, RefineEvent
from gsbench.densify.mcmc import MCMC
from gsbench.densify.volumetric import Volumetric

__all__ = ["ADC", "MCMC", "Cause", "Densifier", "DensifyContext", "Lineage", "NoDensifier", "RefineEvent", "Volumetric"]
