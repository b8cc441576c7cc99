"""Lie groups and difference maps, symbolic in CasADi and usable on arrays."""

from vehsim.lie.groups import GROUPS as GROUPS
from vehsim.lie.groups import SE2 as SE2
from vehsim.lie.groups import SE3 as SE3
from vehsim.lie.groups import SO3 as SO3
from vehsim.lie.groups import Group as Group
from vehsim.lie.groups import SO3xR3 as SO3xR3
from vehsim.lie.maps import DifferenceMap as DifferenceMap
from vehsim.lie.maps import difference_map as difference_map
from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
