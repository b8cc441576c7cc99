"""``method = "integrate"``: one integrator at one step, undriven, to be seen beside another (LIE Figs. 3 to 5).

What belongs here compares methods; how vehicles move in a shot otherwise is in `motions.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from vehsim.errors import Problem
from vehsim.shot.checks import Setting, check_names, choose
from vehsim.shot.model import MAX_FRAMES, InSchema, Number, Positive, StartTable, Table, Text, names_in

if TYPE_CHECKING:
    from vehsim.clip import Clip
    from vehsim.take import Progress
    from vehsim.vehicles import Vehicle

OURS = "variational"
METHODS = "vehsim.integrators.references:METHODS"


class IntegrateMotion(Table):
    """``method = "integrate"``: the undriven motion as one integrator gives it, in empty space."""

    method: Literal["integrate"]
    """plan, simulate, integrate, sinusoid or clip"""
    integrator: Annotated[Text, InSchema(lambda own: {"enum": [OURS, *names_in(METHODS)]})] = OURS
    """"variational" or, to compare with, "rk2", "rk4", "implicit_rk2" or "lie_newmark\""""
    start: StartTable = StartTable()
    """the state on the shot's first frame, handle included; at the origin and at rest unless given"""
    duration: Annotated[Positive, Field(le=MAX_FRAMES)]
    """how long, in s, rounded up to whole steps"""
    step: Annotated[Number, Field(ge=1e-4, le=2)] = 1 / 24
    """the integration step in s, taken as it is: frames between steps are interpolated; 1/24 unless given"""

    def check(self, vehicle: Vehicle, setting: Setting) -> Iterator[Problem]:
        from vehsim.integrators.references import METHODS

        if self.integrator not in (known := (OURS, *METHODS)):
            yield Problem("integrator", "no such integrator", choose(self.integrator, known), self.integrator)
        if self.duration * setting.fps > MAX_FRAMES:
            yield Problem("duration", f"more than {MAX_FRAMES} frames", "shorten it", self.duration)
        yield from check_names("start.joints", self.start.joints, vehicle.joints, "joint")

    def solve(self, vehicle: Vehicle, setting: Setting, progress: Progress) -> tuple[Clip, dict[str, Any]]:
        from vehsim.integrators import Integrator
        from vehsim.integrators.references import reference_clip
        from vehsim.shot.motions import as_state

        steps = math.ceil(self.duration / self.step - 1e-9)
        controls = np.zeros((steps + 1, len(vehicle.controls)))
        state = as_state(self.start, vehicle)
        timing: dict[str, Any] = {"fps": setting.fps, "start_frame": setting.first}
        if self.integrator == OURS:
            clip = Integrator(vehicle, self.step).rollout(state, controls, **timing)
        else:
            clip = reference_clip(vehicle, self.integrator, state, controls, self.step, **timing)
        energy = clip.energy["kinetic"] + clip.energy["potential"]
        said = {"integrator": self.integrator, "step": self.step, "duration": clip.duration}
        return clip, said | {"energy": [float(energy[0]), float(energy[-1])]}
