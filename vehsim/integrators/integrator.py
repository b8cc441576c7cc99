"""The forward step: one integrator for every vehicle, holonomic or nonholonomic."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from vehsim.clip.clip import Clip
from vehsim.errors import InputError
from vehsim.integrators.fast.fleet import Fleet, control_table
from vehsim.integrators.fast.steps import PublicStep
from vehsim.integrators.guards import warn_of_stiff_damping
from vehsim.integrators.phase import Phase, packed
from vehsim.integrators.phase_integrator import PhaseIntegrator
from vehsim.integrators.record import build_clips
from vehsim.integrators.stepper import Stepper
from vehsim.vehicles import State
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.states import control_vector, flat


class Integrator(PhaseIntegrator):
    """Advances a vehicle by fixed steps: states one by one, in place, side by side, or as whole clips.

    ``step`` s; ``difference_map``: a key of `vehsim.lie.maps.MAPS`; ``order`` 2, 4 or 6; ``wind`` (3,) m/s in world
    axes; ``quadrature`` of the forces. Momentum is carried at the knots, so velocities are those *at* the knot.
    ``compiled``: as machine code from the first step, with the same results, up to four times as fast; by default,
    only long clips are. Without ``llvmlite`` there is a warning, and ``compiled`` stays False.

    Damping too fast for the step is warned about: by clips at both their ends, by steppers, fleets and the first
    ``step`` of an integrator at their start.
    """

    _stepped = False

    @cached_property
    def _public(self) -> PublicStep:
        return PublicStep(self.mechanics, self.order, self.step_size, self.wind, self.compiled)

    def step(self, state: State, controls: Any, next_controls: Any = None, wrench: Any = None) -> State:
        """The state one step later. ``controls`` (c,) at its start, ``next_controls`` at its end (the same if None).

        ``wrench``: an external body wrench (d,) about the body frame's origin, or a function of the state that returns
        one; half of its impulse acts at either end, the second half at the predicted state.
        """
        if not self._stepped:
            self._stepped = True
            self._warn_of_stiff_damping(state, controls)
        if wrench is None and not self.guarded:
            after = self._public(state, controls, controls if next_controls is None else next_controls)
            if after is not None:
                return after
        c0 = control_vector(self.vehicle, controls)
        c1 = c0 if next_controls is None else control_vector(self.vehicle, next_controls, "next_controls")
        phase = self.start(state, c0)
        anchor = self.anchor(state, phase)
        if wrench is not None:
            self._kick(phase, wrench, state)
        phase = self.advance(phase, c0, c1)
        if wrench is not None:
            self._kick(phase, wrench, self.state(phase, c1, anchor))
        return self.state(phase, c1, anchor)

    def stepper(self, state: State, controls: Any = None) -> Stepper:
        """A vehicle to be stepped in place from a state: the fast way from Python."""
        c = np.zeros(len(self.vehicle.controls)) if controls is None else controls
        stepper = Stepper(self, state, c)
        self._warn_of_stiff_damping(state, c)
        return stepper

    def fleet(self, states: Sequence[State], controls: Any = None, threads: int = 1) -> Fleet:
        """Many vehicles in motion from ``states`` (m,), with ``controls`` (m, c) or (c,) at the start."""
        c = np.zeros(len(self.vehicle.controls)) if controls is None else controls
        fleet = Fleet(self, states, c, threads)
        if len(fleet.x):
            warn_of_stiff_damping(self.mechanics, fleet.x[:1], fleet.controls[:1], self.step_size, self.wind)
        return fleet

    def _warn_of_stiff_damping(self, state: State, controls: Any) -> None:
        """Warn, at the caller of the public method, if damping at a start is too fast for the step."""
        c = control_vector(self.vehicle, controls)
        phases = packed(self.start(state, c))[None]
        warn_of_stiff_damping(self.mechanics, phases, c[None], self.step_size, self.wind, stacklevel=4)

    def _kick(self, phase: Phase, wrench: Any, state: State) -> None:
        body = np.asarray(wrench(state) if callable(wrench) else wrench, float)
        if body.shape != (self.vehicle.group.dim,) or not np.all(np.isfinite(body)):
            raise InputError(
                "not a wrench",
                f"give {self.vehicle.group.dim} finite numbers, torque then force",
                key="wrench",
                value=body.tolist(),
            )
        phase.pi = phase.pi + self.step_size / 2 * flat(self.mechanics.wrench_momentum(phase.g, phase.r, body))

    def rollout(
        self, state: State, controls: Any, *, fps: Any = 24, start_frame: int = 1001, rests: bool = False
    ) -> Clip:
        """A clip of ``len(controls) - 1`` steps under knot controls (n, c), linear between knots. ``rests``: a vehicle
        that has come to rest costs nothing until its controls change."""
        controls = np.atleast_2d(np.asarray(controls, float))
        if controls.shape[1:] != (len(self.vehicle.controls),) or not np.all(np.isfinite(controls)):
            names = ", ".join(self.vehicle.control_names) or "none"
            raise InputError(
                f"shape {controls.shape}", f"give (n, {len(self.vehicle.controls)}) finite: {names}", key="controls"
            )
        phase = self.start(state, controls[0])
        x = self.history(packed(phase), controls, rests)
        warn_of_stiff_damping(self.mechanics, x, controls, self.step_size, self.wind)
        return self._clips(x[None], controls[None], self.anchor(state, phase)[None], fps, start_frame)[0]

    def rollouts(
        self, states: Sequence[State], controls: Any, *, threads: int = 1, fps: Any = 24, start_frame: int = 1001
    ) -> list[Clip]:
        """Clips of many vehicles: ``states`` (m,), ``controls`` (m, n, c), or (n, c) for all of them.

        Each clip equals that of `rollout`. If the integrator is ``compiled``, ``threads`` threads share the vehicles.
        """
        given = np.asarray(controls, float)
        knots = control_table(self.vehicle, given, (len(states), given.shape[-2] if given.ndim > 1 else 0))
        if self.guarded:  # each may need its own choice of columns
            return [self.rollout(s, c, fps=fps, start_frame=start_frame) for s, c in zip(states, knots, strict=True)]
        fleet = Fleet(self, states, knots[:, 0], threads)
        phases = fleet.advance(knots[:, 1:])
        if len(phases):
            warn_of_stiff_damping(self.mechanics, phases[0], knots[0], self.step_size, self.wind)
        return self._clips(phases, knots, fleet.anchors, fps, start_frame, threads)

    def _clips(
        self, x: Array, controls: Array, anchors: Array, fps: Any, start_frame: int, threads: int = 1
    ) -> list[Clip]:
        times = np.asarray(self.step_size * np.arange(x.shape[1]), float)
        options = {"compiled": self.compiled, "threads": threads, "fps": fps, "start_frame": start_frame}
        return build_clips(self.mechanics, times, x, controls, anchors, self.wind, **options)


HolonomicIntegrator = NonholonomicIntegrator = Integrator
