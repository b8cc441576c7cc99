"""What can be asked of a motion, as plain data.

An `Ask` is one requirement: a key in the user's words, the name of a measure, the frames it applies to, and bounds.
Planning, steering and pilots write asks; `vehsim.audit` measures a finished motion against them; a delivery's
``report.json`` holds them, so that an audit can be repeated from the files. How a motion is made does not belong here.
"""

from vehsim.requests.asks import Ask, limit_asks, look_ask, mark_asks, stay_ask
from vehsim.requests.targets import target_asks

__all__ = ["Ask", "limit_asks", "look_ask", "mark_asks", "stay_ask", "target_asks"]
