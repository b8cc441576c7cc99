"""The promises in the first lines of the vehicles' own shots, measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vehsim import Shot

EXAMPLES = Path(__file__).parents[2] / "examples"


def solved(name: str):
    shot = Shot.load(EXAMPLES / f"{name}.toml")
    assert [problem for problem in shot.check()] == []
    return shot.solve()


def heading(clip) -> np.ndarray:
    w, x, y, z = clip.orientations.T
    return np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def test_rider_picks_up_speed_and_the_wheels_roll_where_they_point():
    clip = solved("snakeboard_twist").clips["rider"]
    assert clip.twists[-1, 1] > 1.5 and np.ptp(clip.positions[:, 1]) < 0.15 * clip.positions[-1, 0]
    angle, t = heading(clip), clip.times
    for end, truck, wheels in (
        (1, "foot_front", {"roll_fl": 1, "roll_fr": -1}),
        (-1, "foot_rear", {"roll_rl": 1, "roll_rr": -1}),
    ):
        pivot = clip.positions[:, :2] + end * 0.27 * np.column_stack([np.cos(angle), np.sin(angle)])
        pointing = angle + clip.channels[truck]
        ahead = np.column_stack([np.cos(pointing), np.sin(pointing)])
        aside = np.column_stack([-np.sin(pointing), np.cos(pointing)])
        assert np.abs(np.sum(np.gradient(pivot, t, axis=0) * aside, axis=1)).max() < 5e-3  # no slip
        for wheel, side in wheels.items():
            speed = np.sum(np.gradient(pivot + side * 0.075 * aside, t, axis=0) * ahead, axis=1)
            assert np.abs(0.032 * np.gradient(clip.channels[wheel], t) - speed).max() < 5e-3
        lead = np.correlate(clip.channels["hips"], -end * clip.channels[truck], "full")
        assert np.argmax(np.abs(lead)) < len(t) - 1  # the feet lag behind the twist


def test_car_steers_through_the_gates_and_stops_at_the_end():
    take = solved("car_winding")
    clip = take.clips["car"]
    assert abs(clip.twists[-1, 1]) < 0.3
    assert np.degrees(np.ptp(clip.channels["steer_fl"])) > 25
    gates = [obstacle.centre for obstacle in Shot.load(EXAMPLES / "car_winding.toml").file.world.obstacle]
    apart = np.linalg.norm(clip.positions[:, None, :2] - np.array(gates), axis=2).min(0)
    assert apart.min() > 1.2 and apart.max() < 3.0


def test_rk4_loses_energy_at_a_large_step_that_ours_conserves():
    clips = solved("tumbling_body").clips
    inertia = np.diag(clips["ours"].vehicle.inertia)[:3]
    assert clips["rk4"].times[1] == clips["ours"].times[1] == 1 / 6
    energy = {name: clip.energy["kinetic"] / clip.energy["kinetic"][0] for name, clip in clips.items()}
    momentum = {name: spatial_momentum(clip, inertia) for name, clip in clips.items()}
    size = np.linalg.norm(momentum["ours"][0])
    assert energy["ours"].min() > 0.95 and energy["ours"].max() < 1.06
    assert np.abs(momentum["ours"] - momentum["ours"][0]).max() < 1e-9 * size
    assert energy["rk4"][-1] < 0.55 and np.all(np.diff(energy["rk4"]) < 0)
    assert np.linalg.norm(momentum["rk4"][-1]) < 0.85 * size
    # RK4's body stops turning over: its axis of rotation comes to rest in the body, ours continues through it
    wander = {name: np.ptp((inertia * clip.twists[-18:, :3])[:, 0]) / size for name, clip in clips.items()}
    assert wander["rk4"] < 0.5 * wander["ours"]


def spatial_momentum(clip, inertia) -> np.ndarray:
    w, v = clip.orientations[:, :1], clip.orientations[:, 1:]
    body = inertia * clip.twists[:, :3]
    return body + 2 * np.cross(v, np.cross(v, body) + w * body)
