"""What can be requested of a motion, as plain data.

An `Ask` is one requirement: a key in the user's words, the name of a measure, the frames to which it applies, and
bounds. Planning, steering and pilots write asks; `vehsim.audit` measures a finished motion against them. A delivery's
``report.json`` contains them, so that an audit can be repeated from the files.
"""

from vehsim.requests.asks import Ask, clearance_ask, limit_asks, look_ask, mark_asks, stay_ask
from vehsim.requests.targets import target_asks

__all__ = ["Ask", "clearance_ask", "limit_asks", "look_ask", "mark_asks", "stay_ask", "target_asks"]
