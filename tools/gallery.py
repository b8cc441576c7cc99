"""Pictures of the gallery from exported stages: for every example a film of forty frames, and a still by Cycles.

``python tools/gallery.py STAGES [NAME...]``: STAGES is a folder to which ``vehsim export`` wrote the examples. Writes
docs/gallery/NAME.webp and still_NAME.jpg; stills need Blender (`VEHSIM_BLENDER`) and take two CPU minutes each.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image

from vehsim.exporters import blender
from vehsim.exporters.pictures.frames import render_stage
from vehsim.exporters.usd.stage import StageReader

GALLERY = Path(__file__).parents[1] / "docs" / "gallery"
STILLS = {
    "boat_bumps_dock": (1043, "pier"),
    "boat_docking": (1301, "chase"),
    "boat_in_swell": (1082, "low"),
    "canyon_flight": (1225, "chase"),
    "car_commands": (1128, "chase"),
    "car_obstacles": (1128, "chase"),
    "car_over_hills": (1156, "chase"),
    "car_winding": (1337, "chase"),
    "drift_park": (1070, "chase"),
    "harbour": (1060, "tower"),
    "hopper_flip": (1083, "chase"),
    "landing_on_mark": (1738, "cut"),
    "parallel_park": (1650, "chase"),
    "parallel_parking": (1242, "chase"),
    "river_bend": (1565, "chase"),
    "robot_worlds_seed0": (1166, "chase"),
    "simple_car_worlds_seed0": (1160, "chase"),
    "slalom_on_gravel": (1103, "chase"),
    "snakeboard_to_mark": (1100, "chase"),
    "snakeboard_twist": (1109, "chase"),
    "storm_turn": (1084, "follow"),
    "truck_reverses_trailer": (1285, "chase"),
    "tumbling_body": (1145, "left"),
}
"""Stage -> the frame and the camera of its still; the film uses the same camera."""
FRAMES, SIZE, SMALLER, SECONDS = 40, (480, 270), (384, 216), 5.0
"""A sea, where every pixel changes, gets a smaller picture rather than a blurred one."""
LARGEST_FILM, LARGEST_STILL = 400_000, 250_000
"""Largest sizes of pictures, bytes."""


def film(stage: Path, camera: str, path: Path) -> None:
    """Write an animated WebP of about ``FRAMES`` frames, with the best quality that fits."""
    first, last = StageReader(stage).frames
    frames = range(first, last + 1, max(1, (last - first) // FRAMES))
    with tempfile.TemporaryDirectory() as folder:
        files = render_stage(stage, folder, camera=camera, frames=frames, size=SIZE)
        pictures = [Image.open(file).convert("RGB") for file in files]
    duration = round(1000 * SECONDS / len(pictures))
    for size in (SIZE, SMALLER):
        smaller = [picture.resize(size) for picture in pictures]
        for quality in (75, 65, 55, 45):
            # every frame whole: differences leave blocks of earlier frames, and save nothing where the camera moves
            options = {"duration": duration, "loop": 0, "quality": quality, "method": 4, "kmax": 1}
            smaller[0].save(path, save_all=True, append_images=smaller[1:], **options)
            if path.stat().st_size <= LARGEST_FILM:
                return


def still(stage: Path, camera: str, frame: int, path: Path) -> None:
    """Render 1920 x 1080 by Cycles, as JPEG with the best quality that fits."""
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "still.png"
        blender._run(stage, "--still", picture, "--frame", frame, "--camera", camera)
        compress(picture, path)


def compress(picture: Path, path: Path) -> None:
    """Write a picture as JPEG, with the best quality that fits."""
    for quality in (90, 82, 74, 66, 55):
        Image.open(picture).convert("RGB").save(path, quality=quality, optimize=True, progressive=True)
        if path.stat().st_size <= LARGEST_STILL:
            return


def main(stages: str, *names: str) -> None:
    for name in names or STILLS:
        frame, camera = STILLS[name]
        stage = Path(stages) / name / f"{name}.usda"
        film(stage, camera, GALLERY / f"{name.removesuffix('_seed0')}.webp")
        still(stage, camera, frame, GALLERY / f"still_{name.removesuffix('_seed0')}.jpg")


if __name__ == "__main__":
    main(*sys.argv[1:])
