"""The shot file: who moves, where, and which marks they must hit. Data only, it never executes code.

`reading.py` turns TOML into data, `file.py` data into a model and what is wrong with it into problems; `model.py` and
`motions.py` are the tables; `checks.py` holds them against the world; `holding.py` stands vehicles still outside their
motion; `shot.py` is the door.
"""

from vehsim._lazy import attach
from vehsim.shot.shot import Shot

__all__ = ["Shot"]

__getattr__, __dir__ = attach(__name__)
