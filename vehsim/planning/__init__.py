"""Planning: discrete mechanics and optimal control (DMOC) from marks to certified motion."""

from vehsim.planning.planner import Plan as Plan
from vehsim.planning.planner import plan as plan
from vehsim.planning.request.marks import Gate as Gate
from vehsim.planning.request.marks import Mark as Mark
from vehsim.planning.request.ranges import look_at as look_at
from vehsim.planning.request.ranges import stay as stay
from vehsim.planning.terms import Constraint as Constraint
from vehsim.planning.terms import Cost as Cost
from vehsim.planning.terms import KnotView as KnotView
from vehsim.planning.terms import SegmentView as SegmentView
from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
