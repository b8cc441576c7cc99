"""Record phases at knots as a clip: rig poses, twists, joints, channels and the energy ledger."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.integrators.discrete import DiscreteMechanics, keep
from vehsim.integrators.fast.kernel import Kernel, each_part
from vehsim.lie.quaternions import continuous
from vehsim.lie.vectorized import for_rows
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.mechanics import drive_power, energy
from vehsim.vehicles.definition.vehicle import Vehicle


def build_clip(
    mechanics: DiscreteMechanics,
    times: Array,
    g: Array,
    r: Array,
    pi: Array,
    controls: Array,
    anchor: Any = (0.0, 0.0, 0.0),
    wind: Any = (0.0, 0.0, 0.0),
    **header: Any,
) -> Clip:
    """A clip from the phases at its knots: poses and twists of the rig's root, joints, controls, channels, energy."""
    phases = np.hstack([g, r, pi, np.zeros_like(pi)])
    anchors = np.asarray(anchor, float)[None]
    return build_clips(mechanics, times, phases[None], np.asarray(controls, float)[None], anchors, wind, **header)[0]


def build_clips(
    mechanics: DiscreteMechanics,
    times: Array,
    phases: Array,
    controls: Array,
    anchors: Array,
    wind: Any = (0.0, 0.0, 0.0),
    *,
    compiled: bool = False,
    threads: int = 1,
    **header: Any,
) -> list[Clip]:
    """Clips of several vehicles of one kind.

    ``phases`` (m, n, .): group elements, joints, momenta and segment velocities at the knots ``times`` (n,);
    ``controls`` (m, n, c); ``anchors`` (m, 3); ``compiled``: by machine code at once, on ``threads``. The ledger:
    kinetic and potential energy, work of controls (the drives of rate controls included) and wind, and dissipation by
    drag, each (n,) J. Work and dissipation are integrals of the power at the knots (`_integrals`); ``kinetic +
    potential - work + dissipated`` stays constant up to the integrator's error, of order 2 or 4.
    """
    vehicle, (m, n) = mechanics.vehicle, phases.shape[:2]
    function, steered = keep(mechanics, "record", lambda: _record(mechanics))
    kernel = keep(mechanics, f"record {compiled}", lambda: Kernel(function, compiled))
    rows = np.empty((m, n, function.size1_out(0)))
    times = np.asarray(times, float)
    clock, air = (np.broadcast_to(a, (m, n, a.shape[-1])) for a in (times[:, None], np.asarray(wind, float)))
    inputs = [phases, clock, np.ascontiguousarray(controls), air]
    each_part(m, threads if compiled else 1, lambda part: kernel.rows([a[part] for a in inputs], [rows[part]]))

    rates = [name for name, channel in vehicle.channels.items() if channel.rate is not None]
    s, d, drives = len(vehicle.joints), vehicle.group.dim, [control for _, control in vehicle.driven]
    count = 2 + len(rates) + len(drives)
    widths = [3, 4, d, s, s, 2, count, len(vehicle.channels) - len(rates), len(steered) * controls.shape[2]]
    powers, gradients = (np.split(rows, np.cumsum(widths[:-1]), axis=2)[k].transpose(1, 0, 2) for k in (6, 8))
    pose = phases[:, :, : vehicle.group.size + s]
    rule = _rule(times, np.abs(np.diff(pose, axis=1)).max(axis=(0, 2), initial=0.0) < STILL)
    parts = _integrals(rule, powers)
    if steered:
        by_power = gradients.reshape(n, m, len(steered), -1)
        parts[:, :, steered] += _corrections(rule, times, by_power, controls.transpose(1, 0, 2))
    # power that grows with the controls' rate jumps at the knots, where their slope does: integrate it by segments
    slopes = np.diff(controls[:, :, drives], axis=1).transpose(1, 0, 2) / np.diff(times)[:, None, None]
    parts[:, :, 0] += np.sum(slopes * parts[:, :, count - len(drives) :], axis=2)
    totals = np.concatenate([np.zeros((1, m, count)), np.cumsum(parts, axis=0)])
    values = [name for name in vehicle.channels if name not in rates]
    clips = []
    turning = powers[:, :, 2 : 2 + len(rates)].transpose(1, 2, 0)
    for row, total, turns, control, anchor in zip(
        rows, totals.transpose(1, 2, 0), turning, controls, anchors, strict=True
    ):
        position, orientation, twist, r, u, energies, _, channels, _ = (
            np.ascontiguousarray(part) for part in np.split(row, np.cumsum(widths[:-1]), axis=1)
        )
        integrated = np.ascontiguousarray(total)
        by_name = dict(zip(values, np.ascontiguousarray(channels.T), strict=True))
        by_name |= dict(zip(rates, integrated[2 : 2 + len(rates)], strict=True))
        kinetic, potential = np.ascontiguousarray(energies.T)
        clips.append(
            Clip(
                vehicle=vehicle,
                times=times,
                positions=position + anchor,
                orientations=continuous(orientation),
                twists=twist,
                joints=r,
                joint_rates=u,
                controls=control,
                channels={name: by_name[name] for name in vehicle.channels},
                channel_rates=dict(zip(rates, np.ascontiguousarray(turns), strict=True)),
                energy={
                    "kinetic": kinetic,
                    "potential": potential,
                    "work": integrated[0],
                    "dissipated": integrated[1],
                },
                **header,
            )
        )
    return clips


def _record(mechanics: DiscreteMechanics) -> tuple[ca.Function, list[int]]:
    """``(x, t, c, wind) -> row`` with ``x = (g, r, pi, z)``, and which of its powers depend on the controls.

    A row: pose (7,), twist (d,), joints, their rates, kinetic and potential energy; the powers: supplied and
    dissipated, the channels given by rates, the drives' power per rate of their controls; the channels given by values;
    the gradients by the controls of those powers that depend on them.
    """
    v, y = mechanics.vehicle, mechanics.symbols
    g, r, pi, c, wind, t = y["g"], y["r"], y["pi"], y["c0"], y["wind"], ca.SX.sym("t")
    u, xi = mechanics.knot_velocity(r, pi, c)
    joint, body = v.force(g, r, u, xi, c, wind)
    lost = ca.SX(v.dissipation(g, r, u, xi, wind))
    drives, jumps = drive_power(v, g, r, mechanics.knot_velocity_guess(r, pi, c), c, wind)
    work = ca.dot(joint, u) + ca.dot(body, xi) + lost + drives
    laws = v.channels.values()
    given = (t, r, u, v.group.velocity_to_body(g, xi), c)
    rates = [ca.SX(channel.rate(*given)) for channel in laws if channel.rate is not None]
    values = [ca.SX(channel.value(*given)) for channel in laws if channel.rate is None and channel.value is not None]
    powers = ca.vertcat(work, lost, *rates, jumps)
    slopes = ca.jacobian(powers, c)
    steered = sorted(set(slopes.sparsity().row()))
    gradients = ca.vec(ca.densify(slopes[steered, :].T))
    row = ca.vertcat(*mechanics.root_state(g, r, pi, c), *energy(v, g, r, u, xi), powers, *values, gradients)
    return ca.Function("record", [ca.vertcat(g, r, pi, y["z"]), t, c, wind], ca.cse([ca.densify(row)])), steered


def channel_laws(vehicle: Vehicle) -> ca.Function:
    """``(t, r, u, xi, c) -> values, rates`` of the channels, with the twist ``xi`` (d,) of the rig's root."""
    t, r, u = ca.SX.sym("t"), ca.SX.sym("r", len(vehicle.joints)), ca.SX.sym("u", len(vehicle.joints))
    xi, c = ca.SX.sym("xi", vehicle.group.dim), ca.SX.sym("c", len(vehicle.controls))
    body = vehicle.group.shift(xi, ca.DM(vehicle.origin))
    laws = vehicle.channels.values()
    values = [channel.value(t, r, u, body, c) if channel.rate is None and channel.value else 0.0 for channel in laws]
    rates = [channel.rate(t, r, u, body, c) if channel.rate else 0.0 for channel in laws]
    return ca.Function(
        "channels", [t, r, u, xi, c], [ca.densify(ca.vertcat(*map(ca.SX, each))) for each in (values, rates)]
    )


def measured_along(mechanics: DiscreteMechanics, clip: Clip) -> Clip:
    """The clip with its channels that are integrals measured along its interpolated motion by three points of Gauss per
    interval: between the knots of a coarse plan, wheels slip by centimetres otherwise."""
    if not clip.channel_rates or len(clip) < 2:
        return clip
    nodes, weights = np.polynomial.legendre.leggauss(3)
    h = np.diff(clip.times)[:, None]
    at = replace(clip, channels={}, channel_rates={}, energy={}).at(
        (clip.times[:-1, None] + h * (1 + nodes) / 2).ravel()
    )
    laws = keep(mechanics, "channel laws", lambda: channel_laws(mechanics.vehicle))
    rates = for_rows(laws, at.times[:, None], at.joints, at.joint_rates, at.twists, at.controls)[1]
    turned = np.einsum("kij,i->jk", rates.reshape(len(h), 3, -1), weights) * h[:, 0] / 2
    totals = dict(
        zip(mechanics.vehicle.channels, np.hstack([0 * turned[:, :1], np.cumsum(turned, axis=1)]), strict=True)
    )
    return replace(clip, channels={**clip.channels, **{name: totals[name] for name in clip.channel_rates}})


Rule = tuple[NDArray[np.intp], Array]
"""Up to six neighbours (n - 1, 6) of every interval, and their weights in the integral over it, s; others weigh
nothing."""


def _integrals(rule: Rule, rates: Array) -> Array:
    """Integrals (n - 1, m, k) from knot to knot of rates at knots (n, m, k)."""
    total = np.zeros((len(rule[0]), *rates.shape[1:]))
    for near, weights in zip(*(part.T for part in rule), strict=True):
        total += weights[:, None, None] * rates[near]
    return total


def _corrections(rule: Rule, times: Array, gradients: Array, controls: Array) -> Array:
    """What `_integrals` of powers with ``gradients`` (n, m, p, c) lacks, (n - 1, m, p), because ``controls`` (n, m, c)
    are linear between knots.

    Within a segment, its own line replaces the controls at its neighbours. This matters to the powers' fourth order.
    """
    slopes = np.diff(controls, axis=0) / np.diff(times)[:, None, None]
    total = np.zeros((len(slopes), *gradients.shape[1:3]))
    for near, weights in zip(*(part.T for part in rule), strict=True):
        away = (times[near] - times[:-1])[:, None, None]
        bent = controls[:-1] + away * slopes - controls[near]
        total += weights[:, None, None] * np.einsum("kmpc,kmc->kmp", gradients[near], bent)
    return total


UNEVEN = 3.0
"""Ratio of neighbouring intervals above which no polynomial passes through knots on both sides: it would swing."""
STILL = 1e-7
"""Changes of poses and joints over an interval in which nothing moves, m and rad."""


def _rule(times: Array, still: NDArray[np.bool_]) -> Rule:
    """The integrals of the polynomials through every six neighbours; ``still`` (n - 1,): where nothing moves.

    Polynomials end where a hold begins or ends: through knots on both sides, wheels would turn in it.
    """
    h = np.diff(times)
    ratio = h[1:] / h[:-1]
    cuts = np.flatnonzero((ratio > UNEVEN) | (ratio < 1 / UNEVEN) | (still[1:] != still[:-1])) + 1
    near, weights = np.zeros((len(h), 6), np.intp), np.zeros((len(h), 6))
    for first, end in pairwise([0, *cuts, len(h)] if len(h) else []):
        count = min(6, end - first + 1)
        neighbours, weights[first:end, :count] = _even_rule(times[first : end + 1], count)
        near[first:end, :count] = first + neighbours
    return near, weights


def _even_rule(times: Array, count: int) -> Rule:
    """The integrals of the polynomials through every ``count`` neighbours."""
    first = np.clip(np.arange(len(times) - 1) - 2, 0, len(times) - count)[:, None]
    near, h = first + np.arange(count), np.diff(times)[:, None]
    s = (times[near] - times[:-1, None]) / h  # 0 to 1 over the interval
    powers = np.arange(count)
    moments = np.broadcast_to(1 / (powers + 1)[:, None], (len(s), count, 1))
    return near, h * np.linalg.solve(s[:, None] ** powers[:, None], moments)[:, :, 0]
