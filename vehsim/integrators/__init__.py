"""Variational integrators for every vehicle, from its single definition."""

from vehsim.integrators.discrete import DiscreteMechanics as DiscreteMechanics
from vehsim.integrators.integrator import HolonomicIntegrator as HolonomicIntegrator
from vehsim.integrators.integrator import Integrator as Integrator
from vehsim.integrators.integrator import NonholonomicIntegrator as NonholonomicIntegrator
from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
