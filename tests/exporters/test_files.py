"""Films play anywhere, tables read back to the same numbers, the report lists every file with its hash."""

from __future__ import annotations

import csv
import hashlib
import json

import numpy as np
import pytest

import vehsim
from vehsim.errors import ExportError
from vehsim.exporters.pictures import film, frames
from vehsim.exporters.pictures.contact_sheet import write_contact_sheet
from vehsim.exporters.tables.csv import columns, write_csv
from vehsim.exporters.tables.report import write_report
from vehsim.exporters.usd import exporter as usd


@pytest.fixture
def pictures(tmp_path):
    """Nine pictures of odd size, each brighter than the last."""
    from PIL import Image

    paths = []
    for k in range(9):
        paths.append(tmp_path / f"shot.main.{1001 + k}.png")
        Image.new("RGB", (161, 91), (20 * k, 20 * k, 20 * k)).save(paths[-1])
    return paths


def test_a_film_is_h264_with_even_sides_at_the_shots_rate(tmp_path, pictures):
    from fractions import Fraction

    import av

    path = film.write_film(pictures, tmp_path / "a.mp4", Fraction(24000, 1001))
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height) == (160, 90)
        assert stream.average_rate == Fraction(24000, 1001)
        decoded = [frame.to_ndarray(format="rgb24").mean() for frame in container.decode(stream)]
    assert np.allclose(decoded, 20.0 * np.arange(9), atol=4)
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "the index comes first, so that it streams"


def test_the_same_pictures_give_the_same_film(tmp_path, pictures):
    a, b = (film.write_film(pictures, tmp_path / name, 24).read_bytes() for name in ("a.mp4", "b.mp4"))
    assert a == b


def test_a_film_needs_frames(tmp_path, toys, make_take):
    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    with pytest.raises(ExportError, match="has no frames"):
        film.write_films(take, tmp_path, toys.silent)


def test_contact_sheet_shows_first_and_last_with_numbers(tmp_path, pictures):
    from PIL import Image

    with Image.open(write_contact_sheet(pictures, tmp_path / "contact.png")) as sheet:
        pixels = np.asarray(sheet)
    assert (pixels == 160).all(axis=2).sum() >= 161 * 91  # the last and brightest
    assert pixels.max() > 200  # the numbers


def test_a_contact_sheet_has_room_for_pictures_of_any_size(tmp_path):
    """One camera's pictures next to combined ones: none overlaps another or exceeds the sheet."""
    from PIL import Image

    files = []
    for k, size in enumerate([(60, 40), (160, 40), (60, 90)]):
        files.append(tmp_path / f"shot.any.{k}.png")
        Image.new("RGB", size, (255, 0, 60 + k)).save(files[-1])
    with Image.open(write_contact_sheet(files, tmp_path / "contact.png")) as sheet:
        pixels = np.asarray(sheet)
    counts = [(pixels == (255, 0, 60 + k)).all(axis=2).sum() for k in range(3)]
    assert counts == [60 * 40, 160 * 40, 60 * 90]


def test_png_and_mp4_follow_usd_through_one_folder(tmp_path, toys, make_take):
    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")), size=(64, 36))
    out = tmp_path / "out"
    written = []
    for exporter in (usd.exporter, frames.exporter, film.exporter):
        written += exporter.write(take, out, toys.silent)
    names = {str(path.relative_to(out)) for path in written}
    assert {"shot.usda", "contact.png", "shot.chase.mp4", "frames/chase/shot.chase.1024.png"} <= names
    assert all(path.is_file() for path in written)
    report = json.loads(write_report(take, out, written).read_text())
    assert set(report["files"]) == names
    assert report["files"]["shot.usda"] == hashlib.sha256((out / "shot.usda").read_bytes()).hexdigest()
    assert report["vehicles"]["toy0"]["frames"] == [1001, 1024]


def test_a_table_has_a_row_per_frame_and_reads_back_exactly(tmp_path, toys, make_take):
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))
    (path,) = write_csv(make_take(clip), tmp_path, toys.silent)
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == [str(frame) for frame in range(1001, 1025)]
    for axis, values in zip("xyz", clip.resample().positions.T, strict=True):
        assert [float(row[f"world.position.{axis} [m]"]) for row in rows] == values.tolist()
    assert [float(row["channel.rotor [rad]"]) for row in rows] == clip.resample().channels["rotor"].tolist()
    assert "control.lift [N]" in rows[0]
    assert [float(row["body.velocity.x [m/s]"]) for row in rows] == clip.resample().twists[:, -3].tolist()


@pytest.mark.parametrize(
    ("name", "units"),
    [
        (
            "car",
            {
                "joint.psi [rad]",
                "joint.sigma [1]",
                "joint_rate.sigma [1/s]",
                "channel.travel_fl [m]",
                "channel.heave [m]",
                "channel.pitch [rad]",
                "channel.load_rr [N]",
            },
        ),
        ("drift_car", {"channel.slip_rl [m/s]", "channel.slip_ratio_rl [1]", "channel.load_rl [N]"}),
        ("rally_car", {"joint.heave [m]", "joint_rate.heave [m/s]", "channel.slip_angle_fr [rad]"}),
        ("hopper", {"joint.stretch [m]", "joint_rate.stretch [m/s]", "channel.half_stretch [m]"}),
        ("truck", {"joint.hitch_1 [rad]", "channel.roll_fl [rad]"}),
    ],
)
def test_tables_name_the_unit_of_each_column(name, units):
    clip = vehsim.simulate(vehsim.load_vehicle(name), vehsim.World(terrain="flat"), duration=0.1)
    assert units <= columns(clip).keys()


def test_the_report_is_the_same_every_time_and_plain_json(tmp_path, toys, make_take):
    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    take.report.update(solved=np.float64(1.5), clearance=np.inf, path=np.zeros((2, 3)))
    a = write_report(take, tmp_path, []).read_bytes()
    assert a == write_report(take, tmp_path, []).read_bytes()
    solved = json.loads(a)["solved"]
    assert solved == {"solved": 1.5, "clearance": None, "path": [[0.0] * 3] * 2}
