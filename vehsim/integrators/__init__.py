"""The forward step: variational integrators for every vehicle, from its one definition."""

from vehsim._lazy import attach
from vehsim.integrators.discrete import DiscreteMechanics as DiscreteMechanics
from vehsim.integrators.integrator import HolonomicIntegrator as HolonomicIntegrator
from vehsim.integrators.integrator import Integrator as Integrator
from vehsim.integrators.integrator import NonholonomicIntegrator as NonholonomicIntegrator

__getattr__, __dir__ = attach(__name__)
