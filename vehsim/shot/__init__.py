"""The shot file: who moves, where, and which marks they must hit. Data only, it never executes code.

`model.py` is the file's shape, `motions.py` what each method of motion asks and does, `reading.py` turns TOML into a
model and everything wrong with it into problems, `checks.py` holds the file against the world, `shot.py` is the door.
"""

from vehsim.shot.shot import Shot

__all__ = ["Shot"]
