"""Planning: discrete mechanics and optimal control (DMOC) from marks to certified motion."""

from vehsim.planning.marks import Mark as Mark
from vehsim.planning.planner import Plan as Plan
from vehsim.planning.planner import plan as plan
