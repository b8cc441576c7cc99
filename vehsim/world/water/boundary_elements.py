"""`Coefficients` of a hull from Capytaine, a boundary element method for waves (Ancellin and Dias 2019).

Panels are the hull's triangles below its waterline at rest; a lid on the water inside the hull removes irregular
frequencies.
"""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Iterator
from hashlib import sha256
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY, SEA_WATER
from vehsim.errors import InputError
from vehsim.intake.foreign import reason_of
from vehsim.runtime.cache import kept, lookup, store
from vehsim.runtime.progress import Progress
from vehsim.vehicles.definition.coefficients import Coefficients
from vehsim.world.water.hull_mesh import HullMesh, wetted
from vehsim.world.water.memory import Radiation, fitted, radiating

Array = NDArray[np.float64]

LENGTHS = (0.25, 24.0)
"""Shortest and longest waves, over the hull's length."""
FREQUENCIES = 40
HEADINGS = 40
"""Enough for the phases of the shortest waves along the hull."""
EXTRA, FINEST, SHARP = 30, 8, 0.1
"""Most frequencies that are added where a coefficient has a sharp peak, their spacing over the usual one, and the error
of an interpolation, over the largest value, that asks for them."""
PANELS = 1000
"""Most panels: the time grows with the square of their number."""
SIMPLE = 400
"""Faces of the hull before it is divided into panels."""
LEAST, MOST = 1e-5, 0.01
"""How far its surface may move for that, over its size: tried from the least on."""
APART = 0.2
"""Largest plausible difference of two added masses; it is below 0.1 for single hulls."""
LOST, WEAK = 0.15, 0.01
"""Largest plausible `energy_error`: it was at most 0.06 for eight hulls, and 0.46 for one with folded panels. A mode's
damping over the largest one from which the error is measured by the mode's own."""
SPREAD = 0.1
"""Largest error of a memory in roll and sway that is not warned of."""
KIND = "hydro-11"
"""Of cached results: change the number when the method changes."""
MOST_KEPT = 200_000_000
"""Bytes of all cached results: those of about 500 hulls."""
TWIST = [3, 4, 5, 0, 1, 2]
"""Capytaine's order of the modes, in a twist."""
MIRROR = np.array([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
"""Signs of a twist in the mirror."""
ALIKE = 1e-3
"""Deviation of a hull from its mirror image, over its size."""
SPECK = 1e-6
"""Points closer than this share of the hull's length are one."""


def available() -> bool:
    """Whether Capytaine is installed."""
    return find_spec("capytaine") is not None


def panels(hull: HullMesh, height: float) -> tuple[Array, NDArray[np.int64]]:
    """Points (n, 3) m and triangles (m, 3) of the wetted surface of a ``hull`` about the body frame's origin, which is
    ``height`` m above the water, at height 0."""
    size = float(np.ptp(hull.points, axis=0).max())
    coarse, edge, found = _unfolded(hull), size / 4, None
    while True:
        mesh = _laid(coarse.refined(edge), hull)
        corners = wetted(np.column_stack([mesh.points, -height - mesh.points[:, 2]]), mesh.faces).corners
        if found is not None and (len(corners) > PANELS or edge < size / 200):
            break
        found, edge = corners, edge / 2**0.25
    places = found.reshape(-1, 3) + np.array([0.0, 0.0, height])
    places[:, 2] = np.minimum(places[:, 2], 0.0)
    places[np.abs(places[:, 2]) < SPECK * size, 2] = 0.0
    _, first, faces = np.unique(np.round(places / (SPECK * size)), axis=0, return_index=True, return_inverse=True)
    faces = faces.reshape(-1, 3)
    a, b, c = faces.T
    return places[first], faces[(a != b) & (b != c) & (c != a)]


def _unfolded(hull: HullMesh) -> HullMesh:
    """A similar surface of about `SIMPLE` faces. None is turned over: `HullMesh.simplified` folds flat bottoms, which
    buoyancy does not feel, but panels that face each other make waves of their own."""
    import manifold3d

    solid = manifold3d.Manifold(manifold3d.Mesh64(hull.points, hull.faces.astype(np.uint64)))
    if len(hull.faces) <= SIMPLE or solid.is_empty():
        return hull.simplified(SIMPLE)
    size, within = float(np.ptp(hull.points, axis=0).max()), LEAST
    while (rough := solid.simplify(within * size)).num_tri() > SIMPLE and within < MOST:
        within *= 1.5
    mesh = rough.to_mesh64()
    return hull.replaced(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts, np.int64))


def _laid(mesh: HullMesh, hull: HullMesh) -> HullMesh:
    """A simpler ``mesh`` with its points on the surface of the ``hull`` and with its volume. Without this, panels have
    the flat faces of the simpler surface however fine they are: the pitch of an ellipsoid was 14 % too small. Faces
    that it would turn over stay where they are."""
    import igl

    points = igl.point_mesh_squared_distance(mesh.points, hull.points, hull.faces)[2]
    turned = (mesh.normals * hull.replaced(points, mesh.faces).normals).sum(axis=1) <= 0
    kept = mesh.faces[turned]
    points[kept] = mesh.points[kept]
    larger = np.cbrt(hull.volume / hull.replaced(points, mesh.faces).volume)
    for part in mesh.parts:  # about its own middle: the hulls of a catamaran stay as far apart
        own = np.unique(mesh.faces[part])
        middle = points[own].mean(axis=0)
        points[own] = middle + larger * (points[own] - middle)
    return hull.replaced(points, mesh.faces)


def coefficients(hull: HullMesh, height: float, progress: Progress | None = None) -> Coefficients:
    """Those of a ``hull`` about the body frame's origin, which is ``height`` m above the water, from the cache if they
    were computed before. Warns of waves that ring within it. Raises ``InputError`` if Capytaine is not installed, or if
    its panels are not good enough."""
    key = _key(hull, height)
    before = lookup(KIND, key)
    if before is not None:
        with np.load(BytesIO(before), allow_pickle=False) as arrays:
            found = Coefficients.of(dict(arrays), hull.name)
    else:
        found = _computed(hull, height, SEA_WATER, progress)
        store(KIND, key, found.content, MOST_KEPT)
    if rings(found):
        warnings.warn(
            f"{hull.name}: waves ring between its parts, as between the hulls of a catamaran; its heave and pitch in "
            "waves are right, its roll may be several times too large: check it, or leave out hydrodynamics and give "
            "physics.damping",
            stacklevel=2,
        )
    return found


def refuse_lossy(found: Coefficients, size: float, name: str) -> Coefficients:
    """``found`` for a hull of that ``size``, m. Raises ``InputError`` if its damping contradicts its waves."""
    wrong = energy_error(found, size)
    if wrong.max() > LOST:
        mode = ("roll", "pitch", "yaw", "surge", "sway", "heave")[int(wrong.argmax())]
        raise InputError(
            f"its waves carry away another energy than the damping of its {mode} takes: {100 * wrong.max():.0f} % "
            f"apart by the error of panels, where {100 * LOST:.0f} % is permitted",
            "give the hull faces of even size that do not overlap, or leave out hydrodynamics and give physics.damping",
            subject=name,
        )
    return found


def energy_error(found: Coefficients, size: float) -> Array:
    """By how much the damping of each mode (6,) differs from the energy that its waves carry away: root mean square of
    the waves that the headings resolve, over the mode's largest damping; see `WEAK`. ``size`` m: of the hull.

    By Haskind's relation, the excitation ``X`` by waves from all sides is the amplitude of the radiated ones: the
    damping is ``k / (8 pi rho g c)`` times the integral of ``|X|^2`` over the headings, with the group velocity ``c``.
    """
    number = found.omega**2 / GRAVITY
    resolved = number * size / 2 < len(found.headings) / 2 - 2
    damping = np.einsum("nii->ni", found.damping)
    speed = GRAVITY / (2 * found.omega)
    waves = 2 * np.pi * (np.abs(found.pressure + found.diffraction) ** 2).mean(axis=1)
    carried = (number / (8 * np.pi * found.density * GRAVITY * speed))[:, None] * waves
    largest = damping.max(axis=0)
    for kind in (slice(3), slice(3, 6)):
        largest[kind] = np.maximum(largest[kind], WEAK * largest[kind].max())
    return np.asarray(np.sqrt(((carried - damping)[resolved] ** 2).mean(axis=0)) / np.maximum(largest, 1e-300))


def rings(found: Coefficients) -> bool:
    """Whether damping has peaks so narrow that the memory has only a part of them: it is spread, see `fitted`."""
    if found.memory is None:
        return False
    wanted = found.damping + 1j * found.omega[:, None, None] * (found.added - found.infinite)
    error = found.memory.transfer(found.omega) - wanted
    return bool(np.linalg.norm(error[:, [0, 4]]) > SPREAD * np.linalg.norm(wanted[:, [0, 4]]))


def _key(hull: HullMesh, height: float) -> str:
    """A hash of all that they depend on."""
    digest = sha256(repr((f"{height:.6g}", LENGTHS, FREQUENCIES, HEADINGS, PANELS, SIMPLE)).encode())
    for part in (np.round(hull.points, 9) + 0.0, hull.faces):
        digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def _computed(hull: HullMesh, height: float, density: float, progress: Progress | None) -> Coefficients:
    if not available():
        raise InputError("Capytaine is not installed", "pip install 'vehsim[hydro]'", key="hydro", value=hull.name)
    import capytaine

    points, faces = panels(hull, height)
    origin = (0.0, 0.0, height)
    size = float(np.ptp(points[:, :2], axis=0).max())
    low, high = np.sqrt(2 * np.pi * GRAVITY / (size * np.array(LENGTHS[::-1])))
    omega = np.linspace(low, high, FREQUENCIES)
    rows: dict[float, tuple[NDArray[Any], ...]] = {}
    headings = 2 * np.pi * np.arange(HEADINGS) / HEADINGS
    with _quiet():
        mesh = capytaine.Mesh(points, np.column_stack([faces, faces[:, 2]]))
        body = capytaine.FloatingBody(
            mesh,
            lid_mesh=mesh.generate_lid(),
            dofs=capytaine.rigid_body_dofs(rotation_center=origin),
            center_of_mass=origin,
        )
        solver = capytaine.BEMSolver(green_function=_green_function())
        modes = [list(body.dofs)[k] for k in TWIST]
        options = {"progress_bar": False, "_check_wavelength": False}
        common = {"body": body, "rho": density, "g": GRAVITY}

        def solved(w: float) -> tuple[NDArray[Any], ...]:
            """Added mass and damping (6, 6), pressure and diffraction (headings, 6)."""
            if progress:
                progress("hydro: waves", min(len(rows) / (FREQUENCIES + EXTRA + 1), 1.0))
            moving = [capytaine.RadiationProblem(radiating_dof=mode, omega=w, **common) for mode in modes]
            moved = solver.solve_all(moving, **options)
            for row in moved:
                if row.potential is None:  # it catches its errors
                    remedy = "check its mass, or give a hull of well-shaped triangles"
                    raise InputError(
                        f"Capytaine cannot solve its waves ({reason_of(row.exception)})", remedy, subject=hull.name
                    )
            added = np.array([[row.added_mass[mode] for mode in modes] for row in moved])
            if w == np.inf:
                return (added,)
            damping = np.array([[row.radiation_damping[mode] for mode in modes] for row in moved])
            held = [capytaine.DiffractionProblem(wave_direction=b, omega=w, **common) for b in headings]
            forces = np.array([[row.forces[mode] for mode in modes] for row in solver.solve_all(held, **options)])
            waves = [capytaine.bem.airy_waves.froude_krylov_force(problem) for problem in held]
            pressure = np.array([[row[mode] for mode in modes] for row in waves])
            return added, damping, pressure, (forces + haskind(mesh, moved, held, density)) / 2

        (infinite,) = solved(np.inf)
        wanted = omega
        while len(wanted) and len(rows) + len(wanted) <= FREQUENCIES + EXTRA:
            for w in wanted:
                rows[float(w)] = solved(float(w))
            omega = np.array(sorted(rows))
            wanted = peaks(omega, np.array([rows[w][1] for w in omega]), (high - low) / FREQUENCIES / FINEST)
    added, damping, pressure, diffraction = (np.array([rows[w][k] for w in omega]) for k in range(4))
    if progress:
        progress("hydro: memory", 1.0)
    added, damping = (_rounded((each + np.swapaxes(each, 1, 2)) / 2) for each in (added, damping))
    infinite = _rounded((infinite + infinite.T) / 2)
    if symmetric(hull):
        added, damping, infinite = ((each + MIRROR[:, None] * each * MIRROR) / 2 for each in (added, damping, infinite))
        other = -np.arange(HEADINGS) % HEADINGS
        pressure, diffraction = ((each + each[:, other] * MIRROR) / 2 for each in (pressure, diffraction))
    damping = _rounded(radiating(damping))
    radiation = Radiation(omega, damping, added)
    used = plausible(_rounded(radiation.infinite), infinite)
    memory = fitted(radiation, infinite if used is infinite else None)
    if memory is None:
        warnings.warn(f"{hull.name}: no model of its radiated waves is good enough: give physics.damping", stacklevel=3)
    whole = Coefficients(
        omega=omega,
        headings=headings,
        added=added,
        damping=damping,
        infinite=used,
        pressure=_rounded(pressure),
        diffraction=_rounded(diffraction),
        density=density,
        height=height,
        memory=memory,
    )
    return refuse_lossy(whole, size, hull.name)


def _green_function() -> Any:
    """Capytaine's, from a table that takes 16 s of CPU time to make. vehsim's cache keeps it: Capytaine
    itself also reads what another process has half written."""
    import capytaine

    with TemporaryDirectory() as folder:

        def table() -> bytes:
            capytaine.Delhommeau(tabulation_cache_dir=folder)
            (file,) = Path(folder).iterdir()
            return file.name.encode() + b"\n" + file.read_bytes()

        name, _, content = kept(f"capytaine-{capytaine.__version__}", "table", table).partition(b"\n")
        Path(folder, name.decode()).write_bytes(content)
        return capytaine.Delhommeau(tabulation_cache_dir=folder)


def plausible(agreeing: Array, solved: Array) -> Array:
    """The added mass (6, 6) at infinite frequency: the one ``agreeing`` with the damping, or the ``solved`` one if they
    are apart, because the damping has peaks too narrow for its frequencies, such as between two hulls."""
    size = np.sqrt(np.outer(np.diag(solved), np.diag(solved)))
    return agreeing if (np.abs(agreeing - solved) < APART * size).all() else solved


def haskind(mesh: Any, moved: list[Any], held: list[Any], density: float) -> NDArray[np.complex128]:
    """Diffraction forces (headings, 6) of waves (``held``) from the potentials of the hull's own motions (``moved``) on
    the panels of ``mesh``, ``-rho integral(phi_j u n) dS`` (Haskind 1957).

    On panels, the added mass A is not symmetric. A uniform acceleration of the water then makes the force ``A a`` by
    the diffracted potential and ``A^T a`` by this one. Their mean fits the symmetric mean of A that is used: only then
    do long waves carry the hull along. Otherwise the roll of a barge, a small difference of large moments, is wrong.
    """
    from capytaine.bem.airy_waves import airy_waves_velocity

    potentials = np.array([row.potential[: mesh.nb_faces] for row in moved]) * mesh.faces_areas
    flow = [(airy_waves_velocity(mesh.faces_centers, wave) * mesh.faces_normals).sum(axis=1) for wave in held]
    return -density * np.array(flow) @ potentials.T


def symmetric(hull: HullMesh) -> bool:
    """Whether port and starboard are mirror images; panels are not, so their coefficients couple heave with roll."""
    import igl

    mirrored = hull.points * [1.0, -1.0, 1.0]
    squares = igl.point_mesh_squared_distance(mirrored, hull.points, hull.faces)[0]
    return bool(np.sqrt(squares.max()) < ALIKE * np.ptp(hull.points, axis=0).max())


def peaks(omega: Array, damping: Array, finest: float) -> Array:
    """Frequencies (k,) between ``omega`` (n,) rad/s, not closer than ``finest``: those that are needed because the
    ``damping`` (n, 6, 6) at one does not follow from that at the others."""
    from scipy.interpolate import CubicSpline

    values = np.einsum("nii->ni", damping)
    values = values / np.maximum(np.abs(values).max(axis=0), 1e-300)
    sharp = set()
    for k in range(1, len(omega) - 1):
        others = np.delete(np.arange(len(omega)), k)
        if np.abs(CubicSpline(omega[others], values[others])(omega[k]) - values[k]).max() > SHARP:
            sharp |= {k - 1, k}
    chosen = [(omega[k] + omega[k + 1]) / 2 for k in sorted(sharp) if omega[k + 1] - omega[k] > finest]
    return np.array(chosen)


def _rounded(values: NDArray) -> NDArray:
    """Numbers with seven digits of the largest of the same mode: the same on every machine, as far as possible."""
    unit = 10.0 ** (np.floor(np.log10(max(float(np.abs(values).max()), 1e-300))) - 9)
    return np.round(values / unit) * unit


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without Capytaine's messages."""
    log = logging.getLogger("capytaine")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)
