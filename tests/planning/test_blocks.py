"""Blocks of a planning problem: named parameters, immutable states, and problems shared if only numbers differ."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim import Mark, World
from vehsim.planning import look_at, stay
from vehsim.planning.blocks import blocks_of
from vehsim.planning.certify import certify, tighten
from vehsim.planning.constraints.block import assemble, parameter_values
from vehsim.planning.constraints.clearance import Clearance, cover_for
from vehsim.planning.constraints.obstacle_clearance import ObstacleClearance
from vehsim.planning.guesses.routes import find_paths
from vehsim.planning.iterate import Run
from vehsim.planning.problem.elements import Element, NonlinearProgram
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.refine import settle_on_frames
from vehsim.planning.request.request import make_request
from vehsim.planning.solve import begin, solve
from vehsim.world.obstacles import obstacles as ob
from vehsim.world.terrain.terrain import Terrain

REST = (0.0, 0.0, 0.0)


def silent(text, fraction):
    """Ignore progress."""


def flight():
    """Terrain, a moving obstacle, landings, a look, a free mark between marks at frames: blocks of many kinds."""
    helicopter = vehsim.load_vehicle("helicopter")
    marks = [Mark(1, position=(30, -20, 8), velocity=REST), Mark(145, position=(30, 20, 8), velocity=REST)]
    other = vehsim.plan(helicopter, None, marks, segments=8, refine=False).clip
    hills = Terrain("flat", np.zeros((12, 12)), (-40.0, -40.0), (10.0, 10.0))
    world = World(hills, wind=(1, 0, 0), obstacles=[ob.moving("other", other)])
    marks = [
        Mark(1, position=(-20, 0, 0), heading=0, on_ground=True),
        Mark("free", position=(0, 5, 9), tolerance=0.5),
        Mark(241, position=(20, 0, 0), heading=30, on_ground=True, hold=12),
    ]
    terms = [look_at((0, 0, 5), within=120.0), stay(below=30.0)]
    cost = {"effort": 1.0, "safety": 1.0}
    return make_request(helicopter, world, marks, fps=24, segments=16, terms=terms, limits={"speed": 20.0}, cost=cost)


def drive():
    """Obstacles, joint limits, and a free last mark."""
    boxes = [ob.box("near", (12, 1.5, 0), (2, 2, 1)), ob.ellipse("far", (20, -6), (2, 1))]
    marks = [Mark(1, position=REST, heading=0, velocity=REST), Mark("free", position=(26, 0, 0), velocity=REST)]
    limits = {"joints": {"sigma": 0.6}, "acceleration": 3.0}
    return make_request(vehsim.load_vehicle("car"), World(obstacles=boxes), marks, fps=24, segments=48, limits=limits)


def guessed(request):
    run, transcription = Run(request), transcribe(request.weighed)
    paths = find_paths(request, None, silent)
    return run, begin(run, request, transcription, cover_for(request, paths, silent), paths)


@pytest.mark.parametrize("make_request", [flight, drive])
def test_every_parameter_has_one_owner_that_gives_its_value(make_request):
    """All values are finite and have their parameter's shape; without the block that owns a parameter an error names
    it."""
    _, iterate = guessed(make_request())
    problem = assemble(iterate.transcription, iterate.layout, iterate.blocks)
    vector = parameter_values(problem, iterate, iterate.blocks)
    assert len(vector) == problem.parameters and np.isfinite(vector).all()
    owners = [block for block in iterate.blocks if problem.places.keys() & block.values(iterate).keys()]
    assert len(owners) > 3
    for owner in owners:
        others = [block for block in iterate.blocks if block is not owner]
        with pytest.raises(ValueError, match="it has no value"):
            parameter_values(problem, iterate, others)
    named = [name for block in owners for name in block.values(iterate)]
    assert len(named) == len(set(named))


def test_parameters_keep_their_shape_and_constants_come_last():
    problem, p, q = NonlinearProgram(2), ca.SX.sym("p"), ca.SX.sym("q")
    problem.parameter("p", 1)
    with pytest.raises(ValueError, match=r"'p': shape \(2,\), but it has \(1,\)"):
        problem.parameter("p", 2)
    y = ca.SX.sym("y", 2)
    element = Element("e", y, {"p": p, "q": q}, f=p * q * y[0] ** 2)
    with pytest.raises(ValueError, match="constants last"):
        problem.add(element, [0, 1], constants={"p": [1.0]})
    with pytest.raises(ValueError, match="'typo'"):
        problem.add(element, [0, 1], {"typo": problem.parameter("p", 1)})
    problem.add(element, [0, 1], constants={"q": [3.0]})
    assert list(problem.places) == ["p"]  # shared by name; a constant is not a parameter
    f = problem.functions()["nlp"]([2.0, 0.0], problem.vector({"p": 5.0}))[0]
    assert float(f) == 60.0


def contents(iterate):
    """Every array in an iterate and its blocks, copied."""
    arrays = {"x": iterate.x}
    for block in iterate.blocks:
        arrays |= {(type(block), id(block), k): v for k, v in vars(block).items() if isinstance(v, np.ndarray)}
    return {name: array.copy() for name, array in arrays.items()}


def test_steps_do_not_change_their_input_iterates():
    """Steps can therefore be undone by keeping the old iterate: solving, settling, certifying and tightening."""
    run, iterate = guessed(drive())
    steps = [
        lambda it: solve(run, it),
        lambda it: settle_on_frames(run, it),
        lambda it: certify(run, it),
        lambda it: tighten(replace(it, certificate=short(it))),
        lambda it: solve(run, it),
    ]
    for step in steps:
        before, blocks = contents(iterate), iterate.blocks
        after = step(iterate)
        assert after is not iterate and iterate.blocks is blocks
        now = contents(iterate)
        assert before.keys() == now.keys()
        for name, array in before.items():
            np.testing.assert_array_equal(now[name], array)
        iterate = after
    assert iterate.success and iterate.tightenings == 1


def short(iterate):
    """A certificate with too little clearance everywhere."""
    certificate = iterate.certificate
    findings = [
        replace(finding, met=False, lack=np.full((len(block.parts), iterate.layout.segments), 0.05))
        if isinstance(block, ObstacleClearance)
        else finding
        for block, finding in zip(iterate.blocks, certificate.findings, strict=True)
    ]
    return replace(certificate, findings=tuple(findings))


def test_a_tightened_clearance_adds_the_shortfall_and_a_margin():
    _, iterate = guessed(flight())
    block = iterate.block(Clearance)
    finding = replace(block.measure(iterate, iterate.clip, None), clearance=0.4, wanted=1.0, met=False)
    assert block.tighten(iterate, finding).required == pytest.approx(1.0 + 0.6 + 0.05)
    assert block.required == 1.0 and block.tighten(iterate, replace(finding, met=True)) is block


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({"position": (30, 2, 0)}, True),
        ({"frame": 301}, True),
        ({"heading": 20.0}, False),
        ({"hold": 12}, False),
        ({"tolerance": 0.5}, False),
    ],
)
def test_problems_are_shared_where_only_numbers_differ(change, same):
    car = vehsim.load_vehicle("car")
    start, goal = Mark(1, position=REST, heading=0, velocity=REST), Mark(241, position=(26, 0, 0), velocity=REST)

    def keys(goal, **options):
        request = make_request(car, None, [start, goal, Mark(401, position=(40, 0, 0))], fps=24, segments=24, **options)
        t = transcribe(car)
        _, iterate = guessed(request)
        return [block.key(iterate.layout, t) for block in blocks_of(request, t, None)]

    assert (keys(goal) == keys(replace(goal, **change))) is same
    assert keys(goal) != keys(goal, limits={"speed": 9.0}) != keys(goal, limits={"speed": 8.0})
    assert keys(goal, limits={"speed": 9.0}) == keys(goal, limits={"speed": 9.0})
