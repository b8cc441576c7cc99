"""The same request has the same plan on any machine under any load."""

import os
import subprocess
import sys

SCRIPT = """
import hashlib, warnings
import vehsim
from vehsim.world.obstacles.obstacles import box

warnings.simplefilter("ignore")
still = (0, 0, 0)
marks = [
    vehsim.Mark(1, position=(-18.261, 9.711, 0), heading=90.016, velocity=still, hold=3),
    vehsim.Mark(546, position=(-21.301, 21.365, 0), heading=119.216),
    vehsim.Mark(1183, position=(-19.929, 39.638, 0), heading=52.2, velocity=still, hold=30),
]
world = vehsim.World(obstacles=[box("post", (-15.844, 28.837, -1), (2.07, 2.07, 4), heading=72.749)])
plan = vehsim.plan(vehsim.load_vehicle("boat"), world, marks, fps="30000/1001", segments=16, clearance=0.26,
                   max_iterations=100)
arrays = plan.clip.positions, plan.clip.orientations, plan.clip.twists, plan.clip.joints, plan.clip.controls
print(plan.message, hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest())
"""
"""An ill-conditioned plan: slightly different rounding in its linear algebra leads its last solve elsewhere."""


def test_a_plan_does_not_depend_on_the_number_of_threads():
    """Nor on the iteration order of sets."""
    runs = []
    for number in ("1", "2"):
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), number)
        environment = os.environ | threads | {"PYTHONHASHSEED": number}
        runs.append(
            subprocess.Popen([sys.executable, "-c", SCRIPT], env=environment, stdout=subprocess.PIPE, text=True)
        )
    first, second = (run.communicate()[0] for run in runs)
    assert first and first == second
