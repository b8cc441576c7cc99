"""``method = "integrate"``: one integrator at one step, without controls, for comparison (LIE Figs. 3 to 5).

Other motion of vehicles in a shot is in `plan.py` and `simulate.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from vehsim.errors import Problem
from vehsim.shot.checks import Context, check_names, did_you_mean
from vehsim.shot.schema.tables import MAX_FRAMES, InSchema, Number, Positive, StartTable, Table, Text, names_in

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.runtime.progress import Progress
    from vehsim.vehicles import Vehicle

OURS = "variational"
METHODS = "vehsim.integrators.references:METHODS"


class IntegrateMotion(Table):
    """``method = "integrate"``: the motion without controls by one integrator, in empty space."""

    method: Literal["integrate"]
    """plan, simulate, sticks, integrate, sinusoid or clip"""
    integrator: Annotated[Text, InSchema(lambda own: {"enum": [OURS, *names_in(METHODS)]})] = OURS
    """"variational" or, for comparison, "rk2", "rk4", "implicit_rk2" or "lie_newmark\""""
    start: StartTable = StartTable()
    """the state on the shot's first frame, including handles; default: at rest at the origin"""
    duration: Annotated[Positive, Field(le=MAX_FRAMES)]
    """the duration in s, rounded up to whole steps"""
    step: Annotated[Number, Field(ge=1e-4, le=2)] = 1 / 24
    """the integration step in s; frames between steps are interpolated; default: 1/24"""

    def check(self, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        from vehsim.integrators.references import METHODS

        if self.integrator not in (known := (OURS, *METHODS)):
            yield Problem("integrator", "no such integrator", did_you_mean(self.integrator, known), self.integrator)
        if self.duration * context.fps > MAX_FRAMES:
            yield Problem("duration", f"more than {MAX_FRAMES} frames", "shorten it", self.duration)
        yield from check_names("start.joints", self.start.joints, vehicle.joints, "joint")

    def solve(self, vehicle: Vehicle, context: Context, progress: Progress) -> tuple[Clip, dict[str, Any]]:
        from vehsim.integrators import Integrator
        from vehsim.integrators.references import reference_clip
        from vehsim.shot.motions.state import as_state

        steps = math.ceil(self.duration / self.step - 1e-9)
        controls = np.zeros((steps + 1, len(vehicle.controls)))
        state = as_state(self.start, vehicle)
        timing: dict[str, Any] = {"fps": context.fps, "start_frame": context.first}
        if self.integrator == OURS:
            clip = Integrator(vehicle, self.step).rollout(state, controls, **timing)
        else:
            clip = reference_clip(vehicle, self.integrator, state, controls, self.step, **timing)
        energy = clip.energy["kinetic"] + clip.energy["potential"]
        details = {"integrator": self.integrator, "step": self.step, "duration": clip.duration}
        return clip, details | {"energy": [float(energy[0]), float(energy[-1])]}
