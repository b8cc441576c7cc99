"""Free rigid bodies over 100,000 steps on every group with every map, and the symmetric top in closed form."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vehsim.integrators import Integrator
from vehsim.lie import GROUPS, difference_map
from vehsim.vehicles import Holonomic, State

groups = pytest.mark.parametrize("group", GROUPS.values(), ids=str)
maps = pytest.mark.parametrize("name", ["exp", "cay"])

INERTIA = {"SO3": (1.0, 2.0, 2.6), "SE2": (2.0, 1.5, 1.5)}
TWIST = {"SO3": (0.4, 1.0, 0.3), "SE2": (0.7, 0.02, -0.01)}


def free_body(group, inertia=None):
    inertia = inertia or INERTIA.get(group.name, (1.0, 2.0, 2.6, 1.5, 1.5, 1.5))
    return Holonomic(name="body", group=group, inertia=inertia, gravity=0.0)


def twist_of(group):
    return TWIST.get(group.name, (0.4, 1.0, 0.3, 0.02, -0.01, 0.005))


def run(group, name, h, steps, **options):
    integrator = Integrator(free_body(group), h, name, **options)
    return integrator.rollout(State(twist=twist_of(group)), np.zeros((steps + 1, 0)))


def segment_velocities(group, name, clip, h):
    """``tau^-1(g_k^-1 g_k+1) / h`` from the clip's poses alone."""
    g = group.from_pose(np.hstack([clip.positions, clip.orientations]))
    if group.name == "SE2":
        g[:, 0] = np.unwrap(g[:, 0])
    step = group.compose(group.inverse(g[:-1]), g[1:])
    if name == "cay":  # hat(x) = 2 (M - 1) (M + 1)^-1
        matrix = group.matrix(step)
        one = np.eye(matrix.shape[-1])
        hat = 2 * np.linalg.solve(np.swapaxes(matrix + one, 1, 2), np.swapaxes(matrix - one, 1, 2)).swapaxes(1, 2)
        return g, _vee(group, hat) / h
    if group.name == "SE2":
        x = np.zeros((len(step), 3))
        x[:, 0] = step[:, 0]
        x[:, 1:] = _solve(group, x, step[:, 1:3], slice(1, 3))
        return g, x / h
    x = np.zeros((len(step), group.dim))
    x[:, :3] = Rotation.from_quat(step[:, [1, 2, 3, 0]]).as_rotvec()
    if group.dim == 6:
        x[:, 3:] = _solve(group, x, step[:, 4:7], slice(3, 6))
    return g, x / h


def _solve(group, x, translation, part):
    """The translational part of ``x`` whose exponential has this translation (linear once the rotation is known)."""
    columns = []
    for unit in np.eye(translation.shape[1]):
        probe = x.copy()
        probe[:, part] = unit
        columns.append(group.pose(group.exp(probe))[:, : translation.shape[1]])
    return np.linalg.solve(np.stack(columns, axis=2), translation[..., None])[..., 0]


def _vee(group, hat):
    if group.name == "SE2":
        return np.stack([hat[:, 1, 0], hat[:, 0, 2], hat[:, 1, 2]], axis=1)
    omega = np.stack([hat[:, 2, 1], hat[:, 0, 2], hat[:, 1, 0]], axis=1)
    if group.name == "SO3":
        return omega
    return np.hstack([omega, hat[:, 0:3, 3] if group.name == "SE3" else hat[:, 3:6, 6]])


@groups
@maps
def test_momentum_from_poses_energy_and_orthonormality_over_100_000_steps(group, name):
    h, steps = 0.02, 100_000
    clip = run(group, name, h, steps)
    g, xi = segment_velocities(group, name, clip, h)
    body = free_body(group)
    covector = np.einsum("nij,nj->ni", np.swapaxes(difference_map(name, group).C(h * xi), 1, 2), xi @ body.inertia)
    spatial = np.einsum("nji,nj->ni", group.Ad(group.inverse(g[:-1])), covector)
    # g has 16 digits and is divided by h: this is the noise of the poses themselves
    assert np.abs(spatial - spatial[0]).max() < 1e-10 * max(1.0, np.abs(clip.positions).max()) * np.linalg.norm(spatial)

    kinetic = clip.energy["kinetic"]
    error = kinetic - kinetic[0]
    slope = np.polyfit(clip.times, error, 1)[0] * clip.times[-1]
    assert abs(slope) < 0.02 * np.ptp(error) + 1e-11 * kinetic[0]

    rotations = clip.matrices()[:, :3, :3]
    assert np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max() < 1e-12


@groups
@maps
def test_energy_error_scales_with_the_square_of_the_step(group, name):
    coarse, fine = (run(group, name, h, int(40 / h)).energy["kinetic"] for h in (0.05, 0.025))
    swings = [np.ptp(values) for values in (coarse, fine)]
    if swings[0] < 1e-12:  # planar bodies keep their energy exactly
        return
    assert swings[0] / swings[1] == pytest.approx(4, rel=0.1)
    assert swings[0] < 1e-2 * coarse[0]


@pytest.mark.parametrize("group", ["SO3", "SE3", "SO3xR3"])
@maps
@pytest.mark.parametrize(("order", "steps"), [(2, (100, 200)), (4, (40, 80)), (6, (30, 60))])
def test_symmetric_top_against_the_closed_form(group, name, order, steps):
    """``R(t) = exp(t L / J1) exp(t (1 - J3/J1) w3 e3)``: precession about the momentum times spin about the axis."""
    J1, J3, omega, end = 1.0, 1.7, np.array([0.5, 0.2, 1.1]), 4.0
    group = GROUPS[group]
    inertia = (J1, J1, J3, 2.0, 2.0, 2.0)[: group.dim]
    twist = np.concatenate([omega, [0.3, 0.1, -0.2]])[: group.dim]
    L = np.array([J1, J1, J3]) * omega
    exact = Rotation.from_rotvec(end * L / J1) * Rotation.from_rotvec([0, 0, end * (1 - J3 / J1) * omega[2]])
    errors = []
    for n in steps:
        integrator = Integrator(free_body(group, inertia), end / n, name, order)
        clip = integrator.rollout(State(twist=twist), np.zeros((n + 1, 0)))
        reached = Rotation.from_quat(clip.orientations[-1][[1, 2, 3, 0]])
        errors.append((exact.inv() * reached).magnitude())
        if group.dim == 6:  # the centre of mass moves on a straight line
            position = 1e-3 if group.name == "SE3" and order == 2 else 1e-5 if group.name == "SE3" else 1e-12
            np.testing.assert_allclose(clip.positions[-1], end * twist[3:6], atol=position)
    assert errors[0] < {2: 1e-2, 4: 2e-4, 6: 2e-4}[order]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.35)


def test_a_tops_rotation_does_not_depend_on_its_rigs_origin():
    """On SO(3) a twist is an angular velocity, independent of the rig's root."""
    from dataclasses import replace
    from pathlib import Path

    from vehsim.vehicles import Rig

    plain = free_body(GROUPS["SO3"])
    rigged = replace(plain, rig=Rig(Path("top.usda"), "/top", origin=(0.5, -0.2, 1.0)))
    clips = [Integrator(v, 0.02).rollout(State(twist=TWIST["SO3"]), np.zeros((51, 0))) for v in (plain, rigged)]
    np.testing.assert_allclose(clips[1].twists, clips[0].twists, atol=1e-12)
    np.testing.assert_allclose(clips[1].orientations, clips[0].orientations, atol=1e-12)
    stepped = Integrator(rigged, 0.02).step(Integrator(rigged, 0.02).step(State(twist=TWIST["SO3"]), ()), ())
    np.testing.assert_allclose(stepped.twist, clips[0].twists[2], atol=1e-12)
