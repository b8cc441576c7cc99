"""Write ``tests/world/capytaine.json``: how hulls respond to waves by Capytaine, a boundary element method.

Run ``python tools/capytaine/responses.py`` where Capytaine is installed (``pip install capytaine``); with ``--check``,
compare the stored numbers with new ones instead. Hulls float at zero speed in deep water, without viscosity. Vehicle
axes; motions are heave over wave amplitude, roll and pitch over wave slope.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

STORED = Path(__file__).parents[2] / "tests" / "world" / "capytaine.json"
RHO, G = 1025.0, 9.81
LENGTHS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 8.0)
"""Of waves, over the hull's."""
HEADINGS = (180.0, 135.0, 90.0)
"""Of waves, degrees from the bow's direction: head, bow and beam seas."""
HULLS: dict[str, dict[str, Any]] = {
    "barge": {"shape": "box", "size": (20.0, 6.0, 1.5), "centre": 1.0},
    "pontoon": {"shape": "box", "size": (12.0, 4.0, 0.5), "centre": 0.8},
    "ellipsoid": {"shape": "ellipsoid", "size": (8.0, 4.0, 1.6), "centre": -0.3},
    "catamaran": {"shape": "boxes", "size": (12.0, 1.2, 0.8), "apart": 4.5, "centre": 0.8},
}
"""Length, beam and draft (m) of each; height (m) of the centre of mass above the water."""


def mesh(hull: dict[str, Any]) -> Any:
    """The wetted surface at rest."""
    import capytaine

    length, beam, draft = hull["size"]
    if hull["shape"] == "ellipsoid":
        ball = capytaine.mesh_sphere(radius=1, resolution=(16, 24)).immersed_part()
        return capytaine.Mesh(ball.vertices * [length / 2, beam / 2, draft], ball.faces)
    parts = [
        capytaine.mesh_parallelepiped(
            size=(length, beam, 2 * draft), resolution=(24, max(3, round(24 * beam / length)), 6), center=(0, y, 0)
        ).immersed_part()
        for y in ((0,) if hull["shape"] == "box" else (hull["apart"] / 2, -hull["apart"] / 2))
    ]
    return parts[0] if len(parts) == 1 else parts[0].join_meshes(parts[1])


def responses(hull: dict[str, Any]) -> dict[str, Any]:
    """Mass data, added mass and damping by wave, and motions (heading, wave, [heave, roll, pitch])."""
    import capytaine

    centre, length = (0.0, 0.0, hull["centre"]), hull["size"][0]
    surface = mesh(hull)
    width = float(np.ptp(surface.vertices[:, 1]))
    body = capytaine.FloatingBody(
        surface,
        lid_mesh=surface.generate_lid(),
        dofs=capytaine.rigid_body_dofs(rotation_center=centre),
        center_of_mass=centre,
    )
    mass = RHO * body.volume
    inertia = mass * np.array([0.35 * width, 0.25 * length, 0.25 * length]) ** 2
    stiffness = body.compute_hydrostatics(rho=RHO, g=G)["hydrostatic_stiffness"].values
    omegas = np.sqrt(2 * np.pi * G / (length * np.array(LENGTHS)))
    common = {"body": body, "rho": RHO, "g": G}
    problems = [capytaine.RadiationProblem(radiating_dof=d, omega=w, **common) for d in body.dofs for w in omegas]
    problems += [
        capytaine.DiffractionProblem(wave_direction=np.radians(b), omega=w, **common) for b in HEADINGS for w in omegas
    ]
    found = capytaine.assemble_dataset(capytaine.BEMSolver().solve_all(problems, progress_bar=False)).sel(omega=omegas)
    added, damping = found["added_mass"].values, found["radiation_damping"].values
    inertias = np.diag([mass, mass, mass, *inertia])
    motions = []
    for heading in HEADINGS:
        force = (found["Froude_Krylov_force"] + found["diffraction_force"]).sel(
            wave_direction=np.radians(heading), method="nearest"
        )
        rows = []
        for k, w in enumerate(omegas):
            matrix = -(w**2) * (inertias + added[k]) - 1j * w * damping[k] + stiffness + 1e-6 * mass * np.eye(6)
            slope = w**2 / G
            rows.append(np.abs(np.linalg.solve(matrix, force.values[k]))[2:5] / [1, slope, slope])
        motions.append(rows)
    return {
        **hull,
        "mass": mass,
        "inertia": inertia.tolist(),
        "stiffness": np.diag(stiffness)[2:5].tolist(),
        "added": [np.diag(a).tolist() for a in added],
        "damping": [np.diag(b).tolist() for b in damping],
        "motions": np.array(motions).tolist(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    check = parser.parse_args().check
    import capytaine

    made = {
        "capytaine": capytaine.__version__,
        "lengths": LENGTHS,
        "headings": HEADINGS,
        "hulls": {name: responses(hull) for name, hull in HULLS.items()},
    }
    text = json.dumps(rounded(made)) + "\n"
    if not check:
        STORED.write_text(text, encoding="utf-8")
        return
    stored = json.loads(STORED.read_text(encoding="utf-8"))
    for name, hull in stored["hulls"].items():
        for key in ("mass", "added", "damping", "motions"):
            np.testing.assert_allclose(
                made["hulls"][name][key], hull[key], rtol=0.02, atol=2e-3, err_msg=f"{name} {key}"
            )
    print(f"{STORED.name} agrees with Capytaine {capytaine.__version__}")


def rounded(data: Any) -> Any:
    """Numbers with five digits."""
    if isinstance(data, dict):
        return {key: rounded(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [rounded(value) for value in data]
    return float(f"{data:.5g}") if isinstance(data, float) else data


if __name__ == "__main__":
    main()
