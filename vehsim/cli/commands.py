"""The commands: arguments, progress bars and exit codes. Heavy imports stay inside the commands.

Exit codes: 0 all done, 1 something failed while working, 2 wrong input and nothing written, 130 interrupted.
"""

from __future__ import annotations

import json
import os
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from enum import StrEnum
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from vehsim.cli import arguments as _arguments
from vehsim.cli import choices
from vehsim.errors import InputError, Problem, VehsimError
from vehsim.runtime.code import version
from vehsim.runtime.registry import whose_error
from vehsim.runtime.signals import POLITE, outliving_readers, raising

if TYPE_CHECKING:
    from vehsim.batch.task import Outcome
    from vehsim.runtime.progress import Progress

app = typer.Typer(
    help="Vehicles that obey physics and arrive on the artist's marks.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
screen = Console(stderr=True, highlight=False, soft_wrap=True)
"""Shows progress, warnings and errors on standard error; results go to standard output."""

_shown: set[str] = set()
"""The warnings that this command has printed."""
FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130
STOPPED = "interrupted; no half-written files remain, and export --resume continues from here"

Shots = Annotated[
    list[Path], typer.Argument(metavar="SHOT...", help="Shot files (.toml).", autocompletion=choices.shot_file)
]
Sets = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a key: world.wind=[0,3,0]. Repeatable.",
        autocompletion=choices.override,
    ),
]
To = Annotated[
    str, typer.Option(metavar="LIST", help="Exporters, separated by commas.", autocompletion=choices.exporter_list)
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")]


class Quality(StrEnum):
    """Quality of pictures."""

    draft = "draft"
    final = "final"


class Log(StrEnum):
    """Form of the progress messages."""

    text = "text"
    json = "json"


LogForm = Annotated[Log, typer.Option("--log", help="json: one line of JSON per event.")]


@app.command(cls=choices.WithChoices)
def export(
    shots: Shots,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Each clip gets its own folder here.")] = Path("out"),
    to: To = "usd",
    workers: Annotated[int, typer.Option(min=1, max=1024, metavar="N", help="Number of worker processes.")] = 1,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help='A Dask scheduler, or "local" for N processes on this machine.'),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Skip clips that are complete and up to date.")] = False,
    no_cache: Annotated[
        bool, typer.Option("--no-cache", help="Solve again, even if the motion is in the cache.")
    ] = False,
    sets: Sets = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="VEHICLE", help="Solve only this vehicle. Repeatable.", autocompletion=choices.vehicle_of_shots
        ),
    ] = None,
    quality: Annotated[Quality, typer.Option(help="draft: half the picture size, no shadows.")] = Quality.final,
    memory: Annotated[
        float | None,
        typer.Option(min=0.5, metavar="GB", help="Address-space limit per worker; about 1.5 is reserved at start-up."),
    ] = None,
    layer_only: Annotated[bool, typer.Option("--layer-only", help="Write only the animation layers.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check, and list what would be done.")] = False,
    log: LogForm = Log.text,
    quiet: Quiet = False,
) -> None:
    """Solve shots and write them: a USD stage, pictures, a film, tables. A sweep makes several clips."""
    from vehsim.batch.run import run
    from vehsim.batch.screen import log_problems, watch
    from vehsim.batch.summary import write_summary
    from vehsim.batch.task import prepare

    names = _arguments.exporters_in(to)
    _arguments.check_folder(out)
    overrides = [*(sets or []), *["export.layer_only=true"] * layer_only]
    with _working("checking", quiet or log is Log.json):
        may = partial(_arguments.check_delivery, names, out)
        loaded, problems = _arguments.load_all(shots, overrides, only or [], may)
    if not dry_run:
        how = {"draft": quality is Quality.draft, "resume": resume, "cached": not no_cache}
        tasks, wrong = _arguments.each(loaded, lambda shot: prepare(shot, out, names, checked=True, **how))
        problems += wrong
    code = _say(problems, quiet or log is Log.json)
    if log is Log.json:
        log_problems(problems)
    errors = [str(problem) for problem in problems if problem.severity != "warning"]
    if dry_run:
        for shot in loaded:
            print(f"{out / shot.name}: {', '.join(names)} of {_arguments.summary(shot)}")
        raise typer.Exit(code)
    if errors and not tasks:
        raise typer.Exit(code)
    told = [*(problem.said for problem in problems), *_shown]
    hint = _arguments.film_hint(loaded, names, quality is Quality.draft)
    if hint and log is Log.text and not quiet:
        screen.print(hint, markup=False)
    outcomes = {}
    try:
        with watch(tasks, screen, log.value, quiet) as watcher:
            running = run(tasks, workers=workers, dask=dask, memory=memory, tell=watcher.tell)
            with closing(running):
                for outcome in running:
                    outcomes[outcome.name] = outcome
                    watcher.end(_without(outcome, told))
    except InputError:  # no such cluster: nothing was started or written
        tasks = []
        raise
    finally:
        if len(tasks) > 1 or (tasks and errors):
            write_summary(out, tasks, outcomes, errors)
    failed = any(outcome.state == "failed" for outcome in outcomes.values())
    raise typer.Exit(FAILED if failed or errors else 0)


def _without(outcome: Outcome, told: Sequence[str]) -> Outcome:
    """The outcome without warnings of solving that end in what the check already ``told``, or in one another."""
    texts = outcome.warnings
    known = *told, *(f": {text}" for text in texts)
    return replace(outcome, warnings=tuple(text for text in texts if not text.endswith(known)))


@app.command(cls=choices.WithChoices)
def retouch(
    delivery: Annotated[Path, typer.Argument(metavar="DELIVERY", help="A folder that export wrote.")],
    edit: Annotated[
        Path, typer.Option(metavar="USD", help="A stage with the edited curves of the delivery's vehicles.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="The new delivery gets its own folder here.")] = Path(
        "retouched"
    ),
    to: To = "usd",
    shot: Annotated[
        Path | None,
        typer.Option(
            metavar="SHOT",
            help="The delivery's shot file; needed if its paths are not relative to the working folder.",
            autocompletion=choices.shot_file,
        ),
    ] = None,
    log: LogForm = Log.text,
    quiet: Quiet = False,
) -> None:
    """Find the motion nearest to the edited curves of a delivery that its vehicles can make, and deliver it."""
    from vehsim.batch.screen import logged
    from vehsim.cli.delivered import edited_shot, summary

    names = _arguments.exporters_in(to)
    _arguments.check_folder(out)
    silent = quiet or log is Log.json
    with logged(delivery.name, str(delivery)) if log is Log.json else _progress(quiet) as progress:
        edited = edited_shot(delivery, edit, shot, progress)
        _arguments.check_delivery(names, out, edited)
        take = replace(edited.solve(progress, checked=True), retouches=delivery)
        folder = take.export(out, names, progress)
    if not silent:
        for line in summary(take):
            print(line)
        print(folder)


@app.command()
def job(
    shots: Shots,
    template: Annotated[
        Path, typer.Option(metavar="FILE", help="The template, FILE.json; the list of clips goes beside it.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the farm's deliveries.")] = Path("out"),
    to: To = "usd",
    chunks: Annotated[int, typer.Option(min=1, max=1000, help="Number of tasks that share a clip's frames.")] = 4,
    sets: Sets = None,
    quality: Annotated[Quality, typer.Option(help="draft: half the picture size, no shadows.")] = Quality.final,
    quiet: Quiet = False,
) -> None:
    """Write an Open Job Description template that exports the shots on a render farm."""
    from vehsim.batch.job import write_job
    from vehsim.batch.task import prepare

    names = _arguments.exporters_in(to)
    _arguments.check_folder(out)
    loaded, problems = _arguments.load_all(shots, sets or [])
    if code := _say(problems, quiet):
        raise typer.Exit(code)
    draft = quality is Quality.draft
    tasks, problems = _arguments.each(loaded, lambda shot: prepare(shot, out, names, draft, resume=True, checked=True))
    if code := _say(problems, quiet):
        raise typer.Exit(code)
    path, clips = write_job(template, tasks, chunks)
    if not quiet:
        print(f"{path}: {len(tasks)} clip{'s' * (len(tasks) != 1)}, listed in {clips}")


@app.command(hidden=True)
def step(
    name: Annotated[str, typer.Argument(metavar="STEP")],
    clips: Annotated[Path, typer.Argument(metavar="CLIPS")],
    clip: Annotated[int, typer.Option(min=0)],
    part: Annotated[int, typer.Option(min=1)] = 1,
    parts: Annotated[int, typer.Option(min=1)] = 1,
) -> None:
    """Run one step of a job; a template's tasks call this."""
    from vehsim.batch.steps import STEPS, run_step

    if name not in STEPS or part > parts:
        raise InputError("no such step or part", f"choose one of {', '.join(STEPS)}", key="STEP", value=name)
    print(f"{run_step(name, clips, clip, (part, parts))}: {name} done")


@app.command()
def new(
    name: Annotated[Path, typer.Argument(metavar="NAME", help="The shot's name, and its file: NAME.toml.")],
    vehicle: Annotated[
        str,
        typer.Option(
            metavar="V", help="A shipped vehicle, or a folder with a vehicle.toml.", autocompletion=choices.vehicle
        ),
    ],
    terrain: Annotated[
        str | None,
        typer.Option(metavar="T", help="A terrain's name or file; default: flat.", autocompletion=choices.terrain),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            metavar="M",
            help="plan, simulate, sinusoid or integrate; the default depends on the vehicle.",
            autocompletion=choices.method,
        ),
    ] = None,
) -> None:
    """Write a commented shot that exports without changes: NAME.toml. No file is overwritten."""
    from vehsim.cli.new import new_shot

    path, chosen = new_shot(name, vehicle, terrain, method)
    print(f"{path}: {vehicle}, method = {chosen!r}; next: vehsim export {path} --to usd,strobe,figures")


@app.command()
def inspect(
    asset: Annotated[Path, typer.Argument(metavar="ASSET", help="USD, GLB, glTF or OBJ, or a vehicle's folder.")],
    write: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write a first vehicle.toml there; no file is overwritten.")
    ] = None,
) -> None:
    """Print an asset's prims, axes and sizes, its possible wheels and rotors, and a first vehicle.toml."""
    from vehsim.cli.inspect import inspect as look_at
    from vehsim.cli.inspect import report, vehicle_toml, write_vehicle

    found = look_at(asset)
    print("\n".join(report(found)))
    if write is None:
        print(f"\nvehicle.toml beside it (--write DIR writes it):\n\n{vehicle_toml(found, found.asset.parent)}", end="")
    else:
        path = write_vehicle(found, write)
        print(f"{path}: written; next: vehsim new NAME --vehicle {write}")


@app.command()
def check(shots: Shots, sets: Sets = None, log: LogForm = Log.text, quiet: Quiet = False) -> None:
    """Report what is wrong with shot files, where, and how to fix it. Nothing is solved or written."""
    from vehsim.batch.screen import log_problems

    silent = quiet or log is Log.json
    with _working("checking", silent):
        loaded, problems = _arguments.load_all(shots, sets or [])
    code = _say(problems, silent)
    if log is Log.json:
        log_problems(problems)
    for shot in loaded:
        if not silent:
            print(f"{shot.source}: {shot.name} is ready, {_arguments.summary(shot)}")
            for line in _arguments.chosen_frames(shot):
                print(line)
    raise typer.Exit(code)


@app.command()
def manoeuvres(
    shots: Shots,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the pictures.")] = Path("out"),
    sets: Sets = None,
    quiet: Quiet = False,
) -> None:
    """List the manoeuvres available to vehicles steered by sinusoids, and draw them from above."""
    from vehsim.shot.offers import paint_offers

    _arguments.check_folder(out)
    loaded, problems = _arguments.load_all(shots, sets or [])

    def draw(shot: Any) -> None:
        with _working(f"{shot.name}  drawing manoeuvres", quiet):
            lines = list(paint_offers(shot, out))
        for line in lines:
            print(line)

    code = _say(problems, quiet)
    raise typer.Exit(_say(_arguments.each(loaded, draw)[1], quiet) or code)


@app.command()
def validate(
    stages: Annotated[
        list[Path],
        typer.Argument(metavar="STAGE|FOLDER...", help="USD files, or folders with such files, such as a delivery."),
    ],
    quiet: Quiet = False,
) -> None:
    """Check USD stages against the rules of OpenUSD and of vehsim."""
    from vehsim.exporters.checks.validate import validate_stage

    stages = _arguments.stages_in(stages)
    _arguments.check_stages(stages)

    def validated(path: Path) -> bool:
        with _working(f"validating {path}", quiet):
            issues = validate_stage(path)
        for issue in issues:
            if issue.severity == "error" or not quiet:
                screen.print(f"{path}: {issue}", markup=False)
        if not issues and not quiet:
            print(f"{path}: valid")
        return not any(issue.severity == "error" for issue in issues)

    valid, problems = _arguments.each(stages, validated, str)
    raise typer.Exit(_say(problems, quiet) or (0 if all(valid) else FAILED))


@app.command()
def audit(
    deliveries: Annotated[list[Path], typer.Argument(metavar="DELIVERY...", help="Folders that export wrote.")],
    quiet: Quiet = False,
) -> None:
    """Measure deliveries against everything that was requested, from their files alone."""
    from vehsim.audit import missed
    from vehsim.exporters.checks.audit import audit_delivery, changed_files

    def audited(folder: Path) -> bool:
        with _progress(quiet) as progress:
            measured = audit_delivery(folder, progress)
        for name, rows in measured.items():
            for row in rows:
                if not quiet or row in missed(rows):
                    no = "MISSED" if row.severity == "error" else "beyond"
                    verdict = {True: "ok    ", False: no, None: "-     "}[row.met]
                    print(f"{verdict}  {name}: {row}")
        changed = changed_files(folder)
        for file in changed:
            print(f"MISSED  {file}: changed since the export; export the shot again")
        return not changed and not any(missed(rows) for rows in measured.values())

    met, problems = _arguments.each(deliveries, audited, str)
    raise typer.Exit(_say(problems, quiet) or (0 if all(met) else FAILED))


@app.command()
def review(
    reviewed: Annotated[
        list[Path],
        typer.Argument(metavar="DELIVERY|SHOT...", help="Folders that export wrote, or shot files, which are solved."),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the pages: <shot>.review.html.")] = Path("out"),
    sets: Sets = None,
    quiet: Quiet = False,
) -> None:
    """Compare motion with real machines on a page: jerk, bank, g-load, slip, saturation, reversals, settling."""
    from vehsim.exporters.checks.review import outside, review, review_of
    from vehsim.exporters.checks.review_page import write_page
    from vehsim.vehicles.definition.character import NORMAL

    _arguments.check_folder(out)
    shots, problems = _arguments.load_all([path for path in reviewed if not path.is_dir()], sets or [])

    def of_shot(shot: Any) -> dict[str, Any]:
        with _progress(quiet) as progress:
            take = shot.solve(progress=progress)
        clips = {name: review(clip, take.world) for name, clip in take.clips.items()}
        return {"shot": shot.name, "fps": str(take.fps), "vehicles": clips}

    made, wrong = _arguments.each(shots, of_shot)
    found, unread = _arguments.each([path for path in reviewed if path.is_dir()], review_of, str)
    for one in [*found, *made]:
        page = write_page(one, NORMAL, out / f"{one['shot']}.review.html")
        for name, rows in one["vehicles"].items():
            for line in outside(rows):
                print(f"{one['shot']}: {name}: outside: {line}")
        if not quiet:
            print(page)
    raise typer.Exit(_say([*problems, *wrong, *unread], quiet))


@app.command()
def render(
    stage: Annotated[Path, typer.Argument(metavar="STAGE", help="A USD stage that vehsim exported.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the pictures.")],
    frames: Annotated[
        str | None, typer.Option(metavar="A-BxN", help="Frames: 1001-1100x10, 1001-1100 or 1001.")
    ] = None,
    size: Annotated[str, typer.Option(metavar="WxH", help="Picture size in pixels.")] = "960x540",
    camera: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="A camera of the stage.", autocompletion=choices.camera_of_stage),
    ] = None,
    passes: Annotated[
        str, typer.Option(metavar="LIST", help="Additional pictures: depth, segmentation, flow, normals.")
    ] = "",
    burn_in: Annotated[bool, typer.Option("--burn-in", help="Write stage, camera and frame on the pictures.")] = False,
    quality: Annotated[Quality, typer.Option(help="draft: one sample per pixel, no shadows.")] = Quality.final,
    quiet: Quiet = False,
) -> None:
    """Render a stage off-screen, from the file alone."""
    _arguments.check_stages([stage])
    _arguments.check_folder(out)
    wanted, pixels = _arguments.frames_in(frames), _arguments.size_in(size)
    look: dict[str, Any] = {"samples": 0, "shadows": False} if quality is Quality.draft else {}
    from vehsim.exporters.pictures.frames import render_stage

    with _progress(quiet) as progress:
        files = render_stage(
            stage, out, frames=wanted, size=pixels, camera=camera, progress=progress, burn_in=burn_in, **look,
            passes=[kind.strip() for kind in passes.split(",") if kind.strip()],
        )  # fmt: skip
    if not quiet:
        print(f"{len(list(files))} files in {out}" if passes else f"{len(list(files))} pictures in {out}")


@app.command()
def compare(
    renders: Annotated[Path, typer.Argument(metavar="RENDERS", help="A folder of pictures.")],
    references: Annotated[Path, typer.Argument(metavar="REFERENCES", help="A folder of reference pictures.")],
    tolerance: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="Share of colour pixels that may change, 0 to 1; default: 0.0005."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for a page that shows the changes: index.html.")
    ] = None,
) -> None:
    """Compare pictures with references by counting the pixels that differ visibly."""
    from vehsim.exporters.compare.compare import compare_folders
    from vehsim.exporters.compare.report import write_report

    with _working(f"comparing {renders} with {references}"):
        results = compare_folders(renders, references)
    bad = [comparison for comparison in results if comparison.fails(tolerance)]
    for comparison in bad:
        print(comparison)
    if out is not None and bad:
        print(f"shown in {write_report(bad, out, str(renders), len(results))}")
    print(f"{len(results) - len(bad)} of {len(results)} pictures match")
    raise typer.Exit(FAILED if bad else 0)


@app.command()
def vehicles(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[VEHICLE]",
            help="A vehicle's name or folder, to list its parameters.",
            autocompletion=choices.vehicle,
        ),
    ] = None,
) -> None:
    """List the vehicles that ship with vehsim, or the parameters of one, with their units."""
    from vehsim.vehicles import available, load_vehicle

    if name is not None:
        from vehsim.vehicles.library.library import parameters_of

        for key, value, what in parameters_of(name):
            shown = f'"{value}"' if isinstance(value, str) else list(value) if isinstance(value, tuple) else value
            print(f"{key} = {shown}  # {what}")
        return
    for name in available():
        vehicle = load_vehicle(name)
        print(f"{name}: controls {', '.join(map(_arguments.bounds, vehicle.controls))}")
        if vehicle.joints:
            print(f"{' ' * len(name)}  joints {', '.join(vehicle.joints)}")


@app.command()
def terrains() -> None:
    """List the terrains that shots can name: those that ship with vehsim and those of installed packages."""
    from vehsim.assets import described
    from vehsim.world import Terrain

    for name in described("terrain"):
        terrain = Terrain.load(name)
        ranges = zip("xyz", terrain.lower, terrain.upper, strict=True)
        print(f"{name}: " + ", ".join(f"{axis} {low:g} to {high:g} m" for axis, low, high in ranges))


@app.command(context_settings={"ignore_unknown_options": True})  # -3.5 is a number, not an option
def height(
    points: Annotated[list[str], typer.Argument(metavar="X Y...", help="x and y of each point, in m.")],
    terrain: Annotated[
        str, typer.Option(metavar="T", help="A terrain's name or file.", autocompletion=choices.terrain)
    ],
    water: Annotated[float | None, typer.Option(metavar="Z", help="Level of still water, m: prints its depth.")] = None,
) -> None:
    """Print the height of the ground at points, and its slope."""
    from vehsim.world.terrain.terrain import Terrain

    for line in _arguments.heights(Terrain.load(terrain), _arguments.points_in(points), water):
        print(line)


@app.command()
def hydro(
    hull: Annotated[
        str,
        typer.Argument(
            metavar="HULL",
            help="A vehicle's name or folder, or a file with a closed mesh.",
            autocompletion=choices.vehicle,
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where to write it; default: HULL.hydro.npz here.")
    ] = None,
    mass: Annotated[float | None, typer.Option(metavar="KG", min=1e-3, max=1e12, help="What the hull weighs.")] = None,
    origin: Annotated[
        tuple[float, float, float], typer.Option(metavar="X Y Z", help="Centre of mass of a mesh, m, in its axes.")
    ] = (0.0, 0.0, 0.0),
    quiet: Quiet = False,
) -> None:
    """Compute added mass, damping and wave forces of a hull with Capytaine, and write them for its vehicle.toml."""
    from vehsim.cli.hydro import of_hull, table

    with _progress(quiet) as progress:
        found = of_hull(hull, mass, origin, progress)
    path = out or Path(f"{Path(hull).stem}.hydro.npz")
    found.save(path)
    if not quiet:
        print("\n".join(table(found)))
    print(f'{path}: written; put it beside the vehicle.toml and add: hydrodynamics = "{path.name}"')


@app.command()
def live(
    shot: Annotated[Path, typer.Argument(metavar="SHOT", help="A shot file.", autocompletion=choices.shot_file)],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for exports from the page.")] = Path("out"),
    host: Annotated[
        str, typer.Option(help="The address to listen on; any other than localhost needs --token.")
    ] = "localhost",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free port.")] = 8765,
    token: Annotated[str, typer.Option(help="A secret that the page's address must contain.")] = "",
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the page's address; open no browser.")
    ] = False,
) -> None:
    """Open a shot in the browser, where you play it and drag its marks; the motion follows."""
    from vehsim.live import edit

    def ready(address: str) -> None:
        print(address, flush=True)
        screen.print("Ctrl-C ends the session", markup=False)
        if not no_browser:
            import webbrowser

            webbrowser.open(address)

    edit(shot, out, host, port, token, ready)


@app.command()
def schema() -> None:
    """Print the JSON schema of shot files, with which editors complete and check them.

    `vehsim schema > vehsim.schema.json` also prints the line with which each shot file in the same folder must begin.

    This works in VS Code with Even Better TOML, and in other editors that use Taplo.
    """
    from vehsim.shot.schema.shot_file import SCHEMA_LINE
    from vehsim.shot.schema.shot_file import schema as shot_schema

    print(json.dumps(shot_schema(), indent=2))
    screen.print(f"make this the first line of a shot file in the same folder: {SCHEMA_LINE}", markup=False)


@app.command()
def doctor() -> None:
    """Check this machine: Python, libraries, EGL, the film codec, the cache."""
    from vehsim.cli.doctor import examine

    with _working("examining"):
        findings = examine()
    for finding in findings:
        remedy = "" if finding.good else f"; {finding.remedy}"
        print(f"{'ok ' if finding.good else 'BAD'}  {finding.what}: {finding.found}{remedy}")
    raise typer.Exit(0 if all(finding.good for finding in findings) else FAILED)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"vehsim {version('vehsim')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options of vehsim itself."""


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code. The user sees a traceback only if VEHSIM_DEBUG is set."""
    _end_like_interrupt()
    warnings.formatwarning = _warning_once()
    with outliving_readers() as lost:
        code = _run(arguments)
        missed = lost()
        if missed is not None and not code:  # if the output could not be printed, the command has failed
            code = _fail(f"the output could not be printed: {missed.strerror}; everything else succeeded", FAILED)
    return code


def _warning_once() -> Callable[..., str]:
    """A format of warnings without their place in the source; empty for one that was formatted before."""
    _shown.clear()

    def formatted(message: object, *rest: object, **more: object) -> str:
        repeated = str(message) in _shown
        _shown.add(str(message))
        return "" if repeated else f"warning: {message}\n"

    return formatted


@cache
def _command() -> Any:
    """The commands, as click knows them: typer reads their signatures, which takes as long as a small command."""
    return typer.main.get_command(app)


def _run(arguments: Sequence[str]) -> int:
    try:
        code = int(_command().main(args=list(arguments), standalone_mode=False) or 0)
        return _fail(STOPPED, code) if code == INTERRUPTED else code
    except KeyboardInterrupt:
        return _fail(STOPPED, INTERRUPTED)
    except VehsimError as error:
        return _fail(str(error), WRONG_INPUT if isinstance(error, InputError) else FAILED)
    except Exception as error:
        if hasattr(error, "format_message"):  # click's errors about the command line
            return _fail(f"{error.format_message().rstrip('.')}; see vehsim --help", WRONG_INPUT)
        if isinstance(error.__cause__, EOFError):  # click treats any end of file as the end of a dialogue
            error = error.__cause__
        if type(error).__name__ == "Abort":
            return _fail(STOPPED, INTERRUPTED)
        if os.environ.get("VEHSIM_DEBUG"):
            raise
        what = f"{type(error).__name__}: {error}"
        return _fail(
            f"unexpected: {what}; this is {whose_error(error)}: set VEHSIM_DEBUG=1 to see the traceback", FAILED
        )


def _fail(message: str, code: int) -> int:
    screen.print(message, markup=False, style="red")
    return code


class _Stop(KeyboardInterrupt):
    """Raised on Ctrl-C instead of `KeyboardInterrupt`: once that has passed through ``exec``, Python exits by signal,
    not with our code."""


def _end_like_interrupt() -> None:
    """Treat SIGTERM and SIGHUP as Ctrl-C."""

    stop = raising(_Stop)
    with suppress(ValueError):  # not the main thread: the caller handles signals
        for number in (*POLITE, signal.SIGINT):
            if signal.getsignal(number) is not signal.SIG_IGN:  # ignored, as under nohup
                signal.signal(number, stop)


def _say(problems: Sequence[Problem], quiet: bool) -> int:
    """Print problems; return the exit code, 0 for warnings only."""
    for problem in problems:
        warns = problem.severity == "warning"
        if not (warns and quiet):
            screen.print(str(problem), markup=False, style="yellow" if warns else "red")
    found = {problem.severity for problem in problems}
    return FAILED if "fault" in found else WRONG_INPUT if "error" in found else 0


@contextmanager
def _progress(quiet: bool) -> Iterator[Progress]:
    """A progress bar on a terminal; elsewhere one line every few seconds."""
    if quiet or not screen.is_terminal:
        at = ""

        def note(what: str, done: float) -> None:
            nonlocal at
            at = f"{what}  {done:.0%}"
            tick()

        with _working(lambda: at, quiet) as tick:
            yield note
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=screen, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda what, done: bar.update(task, description=what.replace("[", r"\["), completed=done)


@contextmanager
def _working(what: str | Callable[[], str], quiet: bool = False) -> Iterator[Callable[[], None]]:
    """Print one line every few seconds with the current work; nothing for short work."""
    from vehsim.batch.screen import ticking

    if quiet:
        yield lambda: None
        return
    with ticking(lambda: ("", what if isinstance(what, str) else what())) as tick:
        yield tick
