"""Write ``tests/world/capytaine.json``: how hulls respond to waves by Capytaine, a boundary element method.

Run ``python tools/capytaine/responses.py`` where Capytaine is installed (``pip install capytaine``); with ``--check``,
compare the stored numbers with new ones instead. ``--coefficients tests/world/hydro`` writes the coefficients there, in
two minutes of CPU time. Hulls float at zero speed in deep water, without viscosity. Vehicle axes; motions are heave
over wave amplitude, roll and pitch over wave slope. ``damped`` are those with a viscous damping of roll, ``viscous``.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

STORED = Path(__file__).parents[2] / "tests" / "world" / "capytaine.json"
sys.path.insert(0, str(STORED.parent))
RHO, G = 1025.0, 9.81
LENGTHS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Of waves, over the hull's."""
HEADINGS = (180.0, 135.0, 90.0)
"""Of waves, degrees from the bow's direction: head, bow and beam seas."""
HULLS: dict[str, dict[str, Any]] = {
    "barge": {"shape": "box", "size": (20.0, 6.0, 1.5), "centre": 1.0},
    "pontoon": {"shape": "box", "size": (12.0, 4.0, 0.5), "centre": 0.8},
    "ellipsoid": {"shape": "ellipsoid", "size": (8.0, 4.0, 1.6), "centre": -0.3},
    "catamaran": {"shape": "boxes", "size": (12.0, 1.2, 0.8), "apart": 4.5, "centre": 0.8},
    "wigley": {"shape": "wigley", "size": (16.0, 3.0, 1.2), "centre": -0.3, "ahead": 0.0},
    "tug": {"shape": "tug", "size": (12.0, 4.5, 1.6), "centre": -0.2, "ahead": -0.3077},
}
"""Length, beam and draft (m) of each; place (m) of the centre of mass above the water and ahead of the middle."""
VISCOUS = 0.05
"""Viscous damping of roll over the critical one, without added mass."""


def mesh(hull: dict[str, Any], finer: int = 1) -> Any:
    """The wetted surface at rest; ``finer``: with so many times as many panels along each side."""
    import capytaine

    length, beam, draft = hull["size"]
    if hull["shape"] == "ellipsoid":
        ball = capytaine.mesh_sphere(radius=1, resolution=(24 * finer, 40 * finer)).immersed_part()
        return capytaine.Mesh(ball.vertices * [length / 2, beam / 2, draft], ball.faces)
    if hull["shape"] not in ("box", "boxes"):
        return lofted(hull, (36 * finer, 10 * finer))
    parts = [
        capytaine.mesh_parallelepiped(
            size=(length, beam, 2 * draft),
            resolution=(48 * finer, max(5, round(48 * beam / length)) * finer, 12 * finer),
            center=(0, y, 0),
        ).immersed_part()
        for y in ((0,) if hull["shape"] == "box" else (hull["apart"] / 2, -hull["apart"] / 2))
    ]
    return parts[0] if len(parts) == 1 else parts[0].join_meshes(parts[1])


def lofted(hull: dict[str, Any], many: tuple[int, int]) -> Any:
    """The mesh of a hull given by a formula: quadrangles that are narrow at the ends and at the keel."""
    import capytaine
    from hulls import sections

    sides = sections(hull["shape"], hull["size"], many, even=False)
    n, m = many
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    corner = i * (m + 1) + j
    quads = np.stack([corner, corner + m + 1, corner + m + 2, corner + 1], axis=-1).reshape(-1, 4)
    parts = [
        capytaine.Mesh(side.reshape(-1, 3), faces) for side, faces in zip(sides, (quads, quads[:, ::-1]), strict=True)
    ]
    return parts[0].join_meshes(parts[1])


def responses(hull: dict[str, Any]) -> dict[str, Any]:
    """Mass data, added mass and damping by wave, and motions (heading, wave, [heave, roll, pitch])."""
    import capytaine

    centre, length = (hull.get("ahead", 0.0), 0.0, hull["centre"]), hull["size"][0]
    surface, fine = mesh(hull), mesh(hull, 4)
    width = float(np.ptp(surface.vertices[:, 1]))
    body = capytaine.FloatingBody(
        surface,
        lid_mesh=surface.generate_lid(),
        dofs=capytaine.rigid_body_dofs(rotation_center=centre),
        center_of_mass=centre,
    )
    # pressures of still water and of undisturbed waves cancel over the hull: their integrals need finer panels
    bare = capytaine.FloatingBody(fine, dofs=capytaine.rigid_body_dofs(rotation_center=centre), center_of_mass=centre)
    mass = RHO * bare.volume
    inertia = mass * np.array([0.35 * width, 0.25 * length, 0.25 * length]) ** 2
    stiffness = bare.compute_hydrostatics(rho=RHO, g=G)["hydrostatic_stiffness"].values
    omegas = np.sqrt(2 * np.pi * G / (length * np.array(LENGTHS)))
    common = {"body": body, "rho": RHO, "g": G}
    problems = [capytaine.RadiationProblem(radiating_dof=d, omega=w, **common) for d in body.dofs for w in omegas]
    problems += [
        capytaine.DiffractionProblem(wave_direction=np.radians(b), omega=w, **common) for b in HEADINGS for w in omegas
    ]
    found = capytaine.assemble_dataset(capytaine.BEMSolver().solve_all(problems, progress_bar=False)).sel(omega=omegas)
    added, damping = found["added_mass"].values, found["radiation_damping"].values
    inertias = np.diag([mass, mass, mass, *inertia])
    viscous = 2 * VISCOUS * float(np.sqrt(stiffness[3, 3] * inertia[0]))
    motions, damped = [], []
    for heading in HEADINGS:
        force = found["diffraction_force"].sel(wave_direction=np.radians(heading), method="nearest").values
        for k, w in enumerate(omegas):
            wave = capytaine.DiffractionProblem(body=bare, wave_direction=np.radians(heading), omega=w, rho=RHO, g=G)
            pressure = capytaine.bem.airy_waves.froude_krylov_force(wave)
            force[k] = force[k] + np.array([pressure[mode] for mode in bare.dofs])
        for extra, into in ((0.0, motions), (viscous, damped)):
            rows = []
            for k, w in enumerate(omegas):
                resisting = damping[k] + np.diag([0, 0, 0, extra, 0, 0])
                matrix = -(w**2) * (inertias + added[k]) - 1j * w * resisting + stiffness + 1e-6 * mass * np.eye(6)
                slope = w**2 / G
                rows.append(np.abs(np.linalg.solve(matrix, force[k]))[2:5] / [1, slope, slope])
            into.append(rows)
    return {
        **hull,
        "mass": mass,
        "inertia": inertia.tolist(),
        "stiffness": np.diag(stiffness)[2:5].tolist(),
        "added": [np.diag(a).tolist() for a in added],
        "damping": [np.diag(b).tolist() for b in damping],
        "viscous": viscous,
        "motions": np.array(motions).tolist(),
        "damped": np.array(damped).tolist(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    parser.add_argument("--coefficients", metavar="DIR", type=Path, help="write vehsim's own coefficients of the hulls")
    arguments = parser.parse_args()
    check = arguments.check
    if arguments.coefficients:
        return write_coefficients(arguments.coefficients)
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
        for key in ("mass", "added", "damping", "motions", "damped"):
            np.testing.assert_allclose(
                made["hulls"][name][key], hull[key], rtol=0.02, atol=2e-3, err_msg=f"{name} {key}"
            )
    print(f"{STORED.name} agrees with Capytaine {capytaine.__version__}")


def write_coefficients(folder: Path) -> None:
    """Those of `vehsim hydro` for the stored hulls, in single precision and at every fifth heading, for the tests."""
    from hulls import floating
    from test_wave_response import surface

    from vehsim.world.water.boundary_elements import coefficients
    from vehsim.world.water.buoyancy import Afloat
    from vehsim.world.world import World

    folder.mkdir(parents=True, exist_ok=True)
    hulls = json.loads(STORED.read_text(encoding="utf-8"))["hulls"]
    for name in HULLS:
        hull = hulls[name]
        body = Afloat(floating(surface(hull), hull["mass"], hull["inertia"]), World(water=0.0))
        found = coefficients(body.hull, body.floating()[0], lambda what, done: print(what, f"{done:.0%}"))
        few = {key: getattr(found, key)[:, ::5] for key in ("pressure", "diffraction")}
        replace(found, headings=found.headings[::5], **few).save(folder / f"{name}.npz")
        with np.load(folder / f"{name}.npz") as arrays:
            single = {key: x.astype(np.complex64 if np.iscomplexobj(x) else np.float32) for key, x in arrays.items()}
        np.savez(folder / f"{name}.npz", **single)


def rounded(data: Any) -> Any:
    """Numbers with five digits."""
    if isinstance(data, dict):
        return {key: rounded(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [rounded(value) for value in data]
    return float(f"{data:.5g}") if isinstance(data, float) else data


if __name__ == "__main__":
    main()
