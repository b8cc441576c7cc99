"""The shot file: which vehicles move, where, and which marks they must hit. Data only, it never executes code.

`schema` holds the tables as pydantic models, `motions` the methods of motion, `world` its obstacles and water.
`checks.py` compares them with the world, `follow_through.py` keeps vehicles still outside their motion, and `shot.py`
loads, checks and solves a shot.
"""

from vehsim.runtime.lazy import attach
from vehsim.shot.shot import Shot

__all__ = ["Shot"]

__getattr__, __dir__ = attach(__name__)
