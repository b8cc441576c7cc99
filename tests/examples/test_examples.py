"""Every example exports, validates, and looks as it did when its reference was approved. Motion stays in the
envelope of real machines, except stunts.

The references were rendered at 320 x 180 and inspected. After a change that should be visible, inspect the new
pictures, then write them with ``VEHSIM_WRITE_REFERENCES=1 pytest tests/examples``.
"""

import os
import shutil
from pathlib import Path

import pytest

from vehsim import Shot
from vehsim.exporters.checks.review import outside, review_of
from vehsim.exporters.compare.compare import compare_pictures, write_difference
from vehsim.vehicles.definition.character import STUNT

ROOT = Path(__file__).parents[2]
REFERENCES = ROOT / "tests" / "references"
TOLERANCE = 0.02
"""Share of pixels that may differ visibly: another Mesa or CPU moves edges; a missing shadow or vehicle is more."""

OUTSIDE = {"boat_bumps_dock": "it hits a dock", "hopper_flip": "a somersault has no envelope"}
"""Examples whose motion is outside the envelope on purpose."""

EXAMPLES = sorted((ROOT / "examples").glob("*.toml"))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_looks_as_it_did_and_stays_in_the_envelope(example, tmp_path):
    shot = Shot.load(example, ["render.size=[320, 180]"])
    take = shot.solve()
    middle = (take.frames[0] + take.frames[1]) // 2
    folder = take.export(tmp_path, to=("usd",))
    from vehsim.exporters.pictures.frames import render_stage

    pictures = render_stage(folder / f"{take.name}.usda", tmp_path / "frames", frames=[middle], size=(320, 180))
    assert pictures
    for picture in pictures:
        reference = REFERENCES / picture.name
        if os.environ.get("VEHSIM_WRITE_REFERENCES"):
            REFERENCES.mkdir(exist_ok=True)
            shutil.copy(picture, reference)
        comparison = compare_pictures(picture, reference)
        if comparison.changed > TOLERANCE and not comparison.reason:
            write_difference(comparison, tmp_path / "difference.png")
        assert comparison.changed <= TOLERANCE, f"{comparison.reason or comparison.changed}: see {tmp_path}"
    if example.stem in OUTSIDE:
        return
    driven = [table for table in shot.file.vehicle if getattr(table.motion, "character", None) != STUNT]
    calm = [table.name for table in driven]
    assert not {name: found for name in calm if (found := outside(review_of(folder)["vehicles"][name]))}
