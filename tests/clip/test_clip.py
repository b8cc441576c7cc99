"""A clip reads the same everywhere: exact at its knots, C1 between them, bit for bit from a file."""

import re
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vehsim
from vehsim.clip.clip import Clip
from vehsim.errors import InputError
from vehsim.integrators import Integrator
from vehsim.lie import SE3, SO3
from vehsim.vehicles import Holonomic, State


def flown(name, fps=24):
    vehicle = vehsim.load_vehicle(name)
    t = np.linspace(0, 2, 49)
    if name == "helicopter":
        controls = np.column_stack([18000 + 4000 * np.sin(t), 400 * np.cos(t), 0.05 * np.sin(3 * t), 0.04 * np.cos(t)])
        start = State(position=(0, 0, 30), twist=(0.5, -0.4, 1.0, 8, 1, 0))
    else:
        controls = np.column_stack([800 * np.cos(t), 0.5 * np.cos(2 * t)])
        start = State(twist=(0, 5, 0))
    return Integrator(vehicle, 2 / 48).rollout(start, controls, fps=fps)


def spinning(group, d, twist=(0.1, 3.0, 0.2, 1, 0, 0)):
    body = Holonomic(name="body", group=group, inertia=(1.0, 2.0, 3.0, 1.0, 1.0, 1.0)[:d], gravity=0.0)
    return Integrator(body, 0.1).rollout(State(twist=twist[:d]), np.zeros((60, 0)))


CLIPS = {
    "helicopter": lambda: flown("helicopter"),
    "car": lambda: flown("car"),
    "tumbling on SE3": lambda: spinning(SE3, 6),
    "tumbling on SO3": lambda: spinning(SO3, 3),
    "turning about Z on SO3": lambda: spinning(SO3, 3, (0.0, 0.0, 2.0)),
}
clips = pytest.mark.parametrize("make", CLIPS.values(), ids=CLIPS)
FIELDS = ("positions", "orientations", "twists", "joints", "joint_rates", "controls")


@clips
def test_exact_at_knots(make):
    clip = make()
    back = clip.at(clip.times)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(back, name), getattr(clip, name), atol=1e-11, err_msg=name)
    for name, values in clip.channels.items():
        np.testing.assert_allclose(back.channels[name], values, atol=1e-9)


@clips
def test_c1_everywhere_and_twists_are_the_derivative(make):
    """Differences of the interpolated poses, just before and after knots and between, are the interpolated twists."""
    clip = make()
    e = 1e-5
    at = np.sort(np.concatenate([clip.times[1:-1] - 1.5 * e, clip.times[1:-1] + 1.5 * e, clip.times[:-1] + 0.013]))
    before, here, after = clip.at(at - e), clip.at(at), clip.at(at + e)
    R = Rotation.from_quat(here.orientations[:, [1, 2, 3, 0]])
    velocity = R.inv().apply((after.positions - before.positions) / (2 * e))
    turn = Rotation.from_quat(before.orientations[:, [1, 2, 3, 0]]).inv()
    omega = (turn * Rotation.from_quat(after.orientations[:, [1, 2, 3, 0]])).as_rotvec() / (2 * e)
    d = clip.twists.shape[1]
    planar = d == 3 and clip.vehicle.group.name == "SE2"
    expected = np.column_stack([omega[:, 2], velocity[:, :2]]) if planar else np.hstack([omega, velocity])[:, :d]
    # three times the step's own change of velocity: a kink would show as a jump of the twist itself
    np.testing.assert_allclose(here.twists, expected, atol=2e-4 * max(1.0, np.abs(expected).max()))


def test_resample_gives_whole_frames():
    clip = flown("car", fps=Fraction(24000, 1001))
    frames = clip.resample()
    np.testing.assert_array_equal(frames.frames, np.arange(1001, clip.end_frame + 1))
    assert clip.resample(60).fps == 60 and len(clip.resample(60)) == (2 * 60) + 1


def test_quaternions_never_flip():
    clip = spinning(SE3, 6)
    assert np.all(np.sum(clip.orientations[1:] * clip.orientations[:-1], axis=1) > 0)
    angle = 3.0 * clip.duration
    assert angle > 4 * np.pi  # it has turned over more than once


@pytest.mark.parametrize("name", ["helicopter", "car"])
def test_save_and_load_bit_for_bit(name, tmp_path):
    clip = flown(name, fps="24000/1001")
    path = clip.save(tmp_path / "deep" / "clip")
    back = Clip.load(path)
    assert path.suffix == ".npz" and [p.name for p in path.parent.iterdir()] == ["clip.npz"]
    for field in ("times", *FIELDS):
        assert getattr(back, field).tobytes() == getattr(clip, field).tobytes()
    for group in ("channels", "energy"):
        assert set(getattr(back, group)) == set(getattr(clip, group))
        for key, values in getattr(clip, group).items():
            assert getattr(back, group)[key].tobytes() == values.tobytes()
    assert (back.fps, back.start_frame, back.vehicle.name) == (clip.fps, clip.start_frame, clip.vehicle.name)


def test_a_planar_boats_clip_loads_as_a_planar_boat(tmp_path):
    """Its twists have three columns: as those of the floating boat they would be rolls, pitches and yaws."""
    boat = vehsim.load_vehicle("boat")
    t = np.linspace(0, 2, 25)
    gliding = Integrator(boat.planar, 1 / 12).rollout(State(), np.column_stack([2000 + 0 * t, 0.2 * np.sin(t)]))
    path = gliding.save(tmp_path / "gliding")
    for back in (Clip.load(path), Clip.load(path, boat)):
        assert back.vehicle.group.name == "SE2" and back.vehicle.rig == gliding.vehicle.rig
        assert np.array_equal(back.at(np.linspace(0, 2, 97)).positions, gliding.at(np.linspace(0, 2, 97)).positions)
    with pytest.raises(InputError, match="another vehicle than 'helicopter': its twists have 3 columns, not 6"):
        Clip.load(path, vehsim.load_vehicle("helicopter"))


def test_wrong_clips_and_times_are_named(tmp_path):
    clip = flown("car")
    with pytest.raises(InputError, match=r"outside 0\.\.2 s"):
        clip.at([2.1])
    with pytest.raises(InputError, match="times must increase"):
        Clip(clip.vehicle, **{f: getattr(clip, f)[[0, 0]] for f in ("times", *FIELDS)})
    with pytest.raises(InputError, match="different lengths"):
        Clip(clip.vehicle, times=clip.times, **{f: getattr(clip, f)[:5] for f in FIELDS})
    (tmp_path / "bad.npz").write_bytes(b"nothing")
    with pytest.raises(InputError, match="not a clip saved by vehsim"):
        Clip.load(tmp_path / "bad.npz")
    with pytest.raises(InputError, match="not a clip saved by vehsim"):
        Clip.load(tmp_path / "missing.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(InputError, match="not a clip saved by vehsim"):
        Clip.load(tmp_path / "other.npz")


@pytest.mark.parametrize(
    ("name", "wrong", "says"),
    [
        ("positions", np.zeros((49, 2)), r"positions has the shape \(49, 2\), not n by 3"),
        ("positions", np.zeros((49, 3), "U1"), "could not convert string to float"),
        ("orientations", np.ones(49), r"orientations has the shape \(49,\), not n by 4"),
        ("times", np.array(0.0), "different lengths or empty"),
        ("times", np.linspace(0, 1, 49)[:, None], r"times has the shape \(49, 1\), not n$"),
        ("joints", np.zeros((49, 9)), r"joints has the shape \(49, 9\), not n by"),
        ("controls", np.zeros((49, 9)), r"controls has the shape \(49, 9\), not n by 2"),
        ("channel.steer_fl", np.zeros(4), "different lengths or empty"),
        ("energy.kinetic", np.zeros((49, 2)), r"energy.kinetic has the shape \(49, 2\), not n$"),
        ("header", np.array('{"events": [null]}'), "not iterable"),
    ],
)
def test_saved_arrays_of_wrong_shapes_are_named(tmp_path, name, wrong, says):
    clip = flown("car")
    with np.load(clip.save(tmp_path / "clip.npz")) as saved:
        arrays = dict(saved)
    assert name in arrays and len(clip) == 49
    np.savez(tmp_path / "clip.npz", **arrays | {name: wrong})
    with pytest.raises(InputError) as caught:
        Clip.load(tmp_path / "clip.npz")
    problem = caught.value.problem
    assert problem.file == str(tmp_path / "clip.npz") and problem.remedy
    assert re.search(f"^not a clip saved by vehsim: .*{says}", problem.message)


def test_one_sample_is_a_clip():
    clip = flown("car")
    one = Clip(clip.vehicle, **{f: getattr(clip, f)[:1] for f in ("times", *FIELDS)})
    assert len(one.resample()) == 1 and one.at([0.0]).positions.shape == (1, 3)


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04half", None])
def test_damaged_files_are_named(tmp_path, damage):
    """Empty, truncated and bit-flipped files are wrong input, not an error of vehsim."""
    import vehsim
    from vehsim.errors import InputError

    clip = vehsim.simulate(vehsim.load_vehicle("car"), None, (0.0, 0.0), duration=0.5)
    path = clip.save(tmp_path / "clip.npz")
    whole = path.read_bytes()
    if damage is None:
        middle = len(whole) // 2
        damage = whole[:middle] + bytes(255 - b for b in whole[middle : middle + 64]) + whole[middle + 64 :]
    path.write_bytes(damage)
    with pytest.raises(InputError, match=r"clip\.npz"):
        vehsim.Clip.load(path)


def test_clips_hold_finite_numbers_and_unit_quaternions():
    from dataclasses import replace

    import vehsim
    from vehsim.errors import InputError

    clip = vehsim.simulate(vehsim.load_vehicle("car"), None, (0.0, 0.0), duration=0.5)
    with pytest.raises(InputError, match="positions are not finite"):
        replace(clip, positions=clip.positions * np.nan)
    with pytest.raises(InputError, match="unit quaternions"):
        replace(clip, orientations=clip.orientations * 0)
    with pytest.raises(InputError, match="fps"):
        clip.resample(0)
    with pytest.raises(InputError, match="finite seconds"):
        clip.at([np.nan])
    assert len(repr(clip)) < 120


FOLLOWING = {  # vehicle: channel -> the value that it shows, from the joints by name
    "car": {
        "steer_fl": lambda r: np.arctan2(r["sigma"], 1 - 0.77 / 2.6 * r["sigma"]),
        "steer_fr": lambda r: np.arctan2(r["sigma"], 1 + 0.77 / 2.6 * r["sigma"]),
    },
    "simple_car": {"steer": lambda r: np.arctan(r["sigma"]), "roll_rear": lambda r: r["psi"]},
    "snakeboard": {"hips": lambda r: r["psi"], "foot_rear": lambda r: r["phi"], "foot_front": lambda r: -r["phi"]},
    "hopper": {"leg": lambda r: r["psi"], "stretch": lambda r: -r["stretch"]},
}


@pytest.mark.parametrize("name", FOLLOWING)
def test_channels_follow_their_joints_between_knots(name):
    """Joints that turn back between knots: an interpolant of the channel alone would stand still there."""
    vehicle = vehsim.load_vehicle(name)
    n, s = 9, len(vehicle.joints)
    rng = np.random.default_rng(1)
    r, u = rng.uniform(-0.5, 0.5, (n, s)), rng.uniform(-2, 2, (n, s))
    by_name = dict(zip(vehicle.joints, r.T, strict=True))
    clip = Clip(
        vehicle,
        times=np.linspace(0, 2, n),
        positions=np.zeros((n, 3)),
        orientations=np.eye(4)[[0] * n],
        twists=np.zeros((n, vehicle.group.dim)),
        joints=r,
        joint_rates=u,
        controls=np.zeros((n, len(vehicle.controls))),
        channels={channel: law(by_name) for channel, law in FOLLOWING[name].items()},
    )
    at = clip.at(np.linspace(0, 2, 101))
    by_name = dict(zip(vehicle.joints, at.joints.T, strict=True))
    for channel, law in FOLLOWING[name].items():
        np.testing.assert_allclose(at.channels[channel], law(by_name), atol=1e-12, err_msg=channel)

    edited = {channel: values + 0.1 for channel, values in clip.channels.items()}  # an animator's own
    at = replace(clip, channels=edited).at(clip.times)
    for channel, values in edited.items():
        np.testing.assert_allclose(at.channels[channel], values, atol=1e-12, err_msg=channel)
