"""Discs that push boxes in a walled square: a pure step function for rigid bodies in the plane.

The setting is that of Gebhardt et al. (2018): motors drive discs, boxes are only pushed, and all bodies slide to rest.
Bodies have momentum. Contacts are solved for velocities, by accumulated impulses:

* contacts are speculative: a pair may close its gap within a substep, not more;
* the rows of one kind of contact are solved at once (projected Jacobi), kinds one after the other (Gauss-Seidel). Each
  body's inverse mass is counted once per contact that it has in the kind ("mass splitting"; Tonge et al., 2012), so
  that the result is stable and conserves momentum whatever touches what;
* impulses start from those of the substep before.

The moved states have these fields, in meters, radians and seconds, in a square centered at the origin:

    position      [agents, 2]   of the discs
    heading       [agents]      counter-clockwise from x
    box_position  [boxes, 2]
    box_heading   [boxes]
    box_velocity  [boxes, 3]    x, y, turn rate
    box_present   [boxes] bool  absent boxes stay where they are, and nothing touches them

`PRESETS` holds the settings of the tasks; `Solver(...)` makes others.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxswarm.physics.collisions import find_contacts, hold_discs, no_impulses
from jaxswarm.physics.contacts import BOX_SIDE, DISC_RADIUS, DRAG, TICK, Contact, Motion, Motions, Pose, Solver
from jaxswarm.types import pytree

# Boxes that are pressed together overlap by up to 0.2 mm in the first, and by some millimeters in the second.
PRESETS = {"faithful": Solver(), "fast": Solver(substeps=5, max_overlap=5e-4)}

GROWTH = 0.05  # share of `Solver.max_overlap` by which overlaps may grow per substep
PARTING_SWEEPS = 8  # further displacements per substep of boxes with deep overlaps
CROWDED = 0.06  # share of the floor that bodies cover, above which `settle` takes further rounds
SETTLING_ROUNDS = 100  # most rounds of substeps of `settle`

BLOCK = 64  # environments; measured in benchmarks/LOG.md


def move(solver: Solver, side: Float[Array, ""] | float, state: Any, command: Float[Array, "agents 2"]) -> Any:
    """Return the state one step later; `command` holds the speed (m/s) and turn rate (rad/s) of each disc's motor.

    Free discs reach 0.92 of both. A blocked disc turns as fast as a free one. k discs that push a box squarely
    drive it at 0.92 k m v / (k m + 0.08 M). Headings of discs end in [-pi, pi], where float32 is finest.
    """
    return _simulate(_Program(solver, solver.substeps, has_inertia=True), side, state, command)


def settle(solver: Solver, side: Float[Array, ""] | float, state: Any, substeps: int = 40) -> Any:
    """Return the state at rest, with overlaps pushed apart; without overlaps nothing moves.

    Forty substeps separate any random placement of a few bodies to within 0.1 mm.
    """
    program = _Program(solver, substeps, has_inertia=False)
    state = _simulate(program, side, state, jnp.zeros_like(state.position))
    return state.replace(box_velocity=jnp.zeros_like(state.box_velocity))


class _Program(NamedTuple):
    """Static settings of the compiled program; boxes without inertia stop after each substep."""

    solver: Solver
    num_substeps: int
    has_inertia: bool


def _simulate(program: _Program, side: Array | float, state: Any, command: Array) -> Any:
    names = ("position", "heading", "box_position", "box_heading", "box_velocity")
    dtype = state.position.dtype
    arrays = [jnp.asarray(side, dtype), command, state.box_present.astype(dtype)]
    moved = _compiled(program, *arrays, *(getattr(state, name) for name in names))
    return state.replace(**dict(zip(names, moved, strict=True)))


@partial(jax.jit, static_argnames="program", inline=True)
def _compiled(program: _Program, *arrays: Array) -> tuple[Array, ...]:
    """Once for each program, so that steps outside of any `jit` are fast, too."""
    return _envs_last(program)(*arrays)


def _envs_last(program: _Program) -> Callable:
    """Run `_run` once under `vmap`, with all environments in the last axis, instead of mapping inside.

    The few bodies of an environment are then stored beside those of the others, which made the solver three times as
    fast on a CPU. Derivatives use `_run` directly, because JAX cannot transpose a custom batching rule.
    """
    plain = partial(_run, program, False)
    batched = jax.custom_batching.custom_vmap(
        lambda *arrays: jax.lax.platform_dependent(*arrays, cpu=partial(_run, program, True), default=plain)
    )

    @batched.def_vmap
    def many(num_envs: int, is_batched: list, *arrays: Array) -> tuple:
        def last(x: Array, has_envs: bool) -> Array:
            return jnp.moveaxis(x, 0, -1) if has_envs else jnp.broadcast_to(x[..., None], (*x.shape, num_envs))

        arrays = tuple(map(last, arrays, is_batched))
        result = jax.lax.platform_dependent(*arrays, cpu=partial(_run_blocks, program), default=plain)
        return tuple(jnp.moveaxis(x, -1, 0) for x in result), (True,) * len(result)

    differentiable = jax.custom_jvp(batched)
    differentiable.defjvp(lambda primals, tangents: jax.jvp(plain, primals, tangents))
    return differentiable


def _run_blocks(program: _Program, *arrays: Array) -> tuple[Array, ...]:
    """Run `_run` for `BLOCK` environments at a time, which fit into the cache of a CPU."""
    run = partial(_run, program, True)
    num_envs = arrays[0].shape[-1]
    if num_envs <= BLOCK:
        return run(*arrays)
    fill = -num_envs % BLOCK

    def split(x: Array) -> Array:
        x = jnp.concatenate([x, x[..., :fill]], -1)
        return jnp.moveaxis(x.reshape(*x.shape[:-1], -1, BLOCK), -2, 0)

    result = jax.lax.map(lambda block: run(*block), jax.tree.map(split, arrays))
    joined = (jnp.moveaxis(x, 0, -2) for x in result)
    return tuple(x.reshape(*x.shape[:-2], -1)[..., :num_envs] for x in joined)


# The functions below take any number of environments as last axes: [..., *envs].


@pytree
class _Bodies:
    """State of all bodies that a substep changes."""

    disc: Pose
    box: Motion  # positions and headings
    velocity: Motion  # of the boxes
    impulses: dict[str, Array]  # of each kind of contact
    depth: Float[Array, "*envs"]  # m, deepest overlap at the start of the last substep


def _run(
    program: _Program,
    is_apart: bool,
    side: Float[Array, "*envs"],
    command: Float[Array, "discs 2 *envs"],
    present: Float[Array, "boxes *envs"],
    position: Float[Array, "discs 2 *envs"],
    heading: Float[Array, "discs *envs"],
    box_position: Float[Array, "boxes 2 *envs"],
    box_heading: Float[Array, "boxes *envs"],
    box_velocity: Float[Array, "boxes 3 *envs"],
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the last five arguments after all substeps; `is_apart` compiles stages separately (see `_apart`)."""
    solver, num_substeps, has_inertia = program
    stage = _apart if is_apart else _together
    speed, rate = DRAG * command[:, 0], DRAG * command[:, 1]
    turn = solver.duration * rate
    aim = heading + (turn - TICK * rate) / 2  # the mean heading of the ticks in a substep
    turn_cos, turn_sin = jnp.cos(turn), jnp.sin(turn)

    def substep(index: Array | int, bodies: _Bodies) -> _Bodies:
        cos, sin = bodies.disc.cos, bodies.disc.sin
        drive = Motion(speed * cos, speed * sin)
        bodies = _substep(solver, partial(stage, index), has_inertia, side, present, drive, bodies)
        turned = {"cos": cos * turn_cos - sin * turn_sin, "sin": sin * turn_cos + cos * turn_sin}
        return dataclasses.replace(bodies, disc=dataclasses.replace(bodies.disc, **turned))

    disc = Pose(position[:, 0], position[:, 1], jnp.cos(aim), jnp.sin(aim))
    box = Motion(box_position[:, 0], box_position[:, 1], box_heading)
    velocity = Motion(box_velocity[:, 0], box_velocity[:, 1], box_velocity[:, 2])
    bodies = _Bodies(disc, box, velocity, no_impulses(disc.x, box.x), depth=0 * side)
    if has_inertia:
        bodies = jax.lax.fori_loop(0, num_substeps, substep, bodies)
    else:
        is_crowded = _cover(disc.x, present) > CROWDED * side**2
        bodies = _settle(solver, num_substeps, substep, is_crowded, bodies)
    disc, box, velocity = bodies.disc, bodies.box, bodies.velocity
    return (
        jnp.stack([disc.x, disc.y], 1),
        _wrap(heading + num_substeps * turn),
        jnp.stack([box.x, box.y], 1),
        box.turn,
        jnp.stack([velocity.x, velocity.y, velocity.turn], 1),
    )


def _cover(disc: Float[Array, "discs *envs"], present: Float[Array, "boxes *envs"]) -> Float[Array, "*envs"]:
    """Return the area in square meters that discs and present boxes cover."""
    return math.pi * DISC_RADIUS**2 * len(disc) + BOX_SIDE**2 * present.sum(0)


def _settle(
    solver: Solver, num_substeps: int, substep: Callable, is_crowded: Bool[Array, "*envs"], bodies: _Bodies
) -> _Bodies:
    """Take one round of substeps, and further rounds in crowded environments with deep overlaps."""

    def one_round(index: Array | int, bodies: _Bodies) -> _Bodies:
        def advance(bodies: _Bodies) -> _Bodies:
            return _where(is_unsettled, jax.lax.fori_loop(0, num_substeps, substep, bodies), bodies)

        is_unsettled = (index == 0) | (is_crowded & (bodies.depth > solver.max_overlap))
        return jax.lax.cond(_any_env(is_unsettled), advance, lambda bodies: bodies, bodies)

    return jax.lax.fori_loop(0, SETTLING_ROUNDS, one_round, bodies)


def _wrap(angle: Array) -> Array:
    """Return the angle in [-pi, pi]; a full turn is subtracted in two parts, so that nothing is rounded."""
    num_turns = jnp.round(angle / (2 * math.pi))
    return (angle - 6.28125 * num_turns) - (2 * math.pi - 6.28125) * num_turns


def _substep(
    solver: Solver, stage: Callable, has_inertia: bool, side: Array, present: Array, drive: Motion, bodies: _Bodies
) -> _Bodies:
    """Advance one substep: find contacts, solve for velocities that keep bodies apart, then move all bodies."""
    box = Pose(bodies.box.x, bodies.box.y, jnp.cos(bodies.box.turn), jnp.sin(bodies.box.turn))
    contacts = find_contacts(solver, side, bodies.disc, box, present, stage)
    counts = stage(lambda: {kind: contact.counts() for kind, contact in contacts.items()})
    masses = stage(lambda: {kind: contact.masses(solver, counts[kind]) for kind, contact in contacts.items()})
    contacts = {kind: contact.weighted(*masses[kind]) for kind, contact in contacts.items()}
    depth = stage(lambda: _deepest([contact.depth() for contact in contacts.values()]))
    inertia = solver.drag * present if has_inertia else 0 * present
    motions = {"disc": drive, "box": jax.tree.map(lambda v: inertia * v, bodies.velocity)}
    motions, impulses = stage(partial(_warm_start, solver), contacts, motions, bodies.impulses)
    hold = partial(hold_discs, solver, side, bodies.disc)
    motions, impulses = _solve(solver, stage, contacts, hold, depth, motions, impulses)
    shift = stage(partial(_part_boxes, solver), contacts, bodies.box)
    further = partial(_part_further, solver, contacts, depth > solver.max_overlap)
    shift = jax.lax.cond(_any_env(depth > solver.max_overlap), further, lambda shift: shift, shift)

    def advance(place: Array, velocity: Array) -> Array:
        return place + solver.duration * velocity

    x, y = advance(bodies.disc.x, motions["disc"].x), advance(bodies.disc.y, motions["disc"].y)
    moved = jax.tree.map(lambda a, v, s: advance(a, v) + s, bodies.box, motions["box"], shift)
    return _Bodies(dataclasses.replace(bodies.disc, x=x, y=y), moved, motions["box"], impulses, depth)


def _warm_start(
    solver: Solver, contacts: dict[str, Contact], motions: Motions, impulses: dict[str, Array]
) -> tuple[Motions, dict[str, Array]]:
    """Apply the impulses of the substep before to pairs that are still in contact."""
    impulses = {kind: impulses[kind] * contact.normal.near for kind, contact in contacts.items()}
    for kind, contact in contacts.items():
        motions = contact.push(solver, motions, impulses[kind])
    return motions, impulses


def _solve(
    solver: Solver,
    stage: Callable,
    contacts: dict[str, Contact],
    hold: Callable[[Motion], Motion],
    depth: Float[Array, "*envs"],
    motions: Motions,
    impulses: dict[str, Array],
) -> tuple[Motions, dict[str, Array]]:
    """Take one round of sweeps, and further rounds in environments where a deep overlap would still grow."""
    one_round = partial(_round, solver, stage, contacts, hold)

    def is_growing(motions: Motions) -> Bool[Array, "*envs"]:
        growth = [contact.growth(solver, motions) for contact in contacts.values()]
        return _deepest(growth) > GROWTH * solver.max_overlap

    def again(_: Array | int, carry: tuple) -> tuple:
        def advance(carry: tuple) -> tuple:
            return _where(is_growing(carry[0]), one_round(*carry), carry)

        return jax.lax.cond(_any_env(is_growing(carry[0])), advance, lambda carry: carry, carry)

    def refine(carry: tuple) -> tuple:
        return jax.lax.fori_loop(1, solver.rounds, again, carry)

    slips = {kind: contact.tangent and 0 * contact.tangent.near for kind, contact in contacts.items()}
    carry = one_round(motions, {kind: (impulses[kind], slips[kind]) for kind in contacts})
    is_any_deep = _any_env(depth > solver.max_overlap)
    motions, impulses_and_slips = jax.lax.cond(is_any_deep, refine, lambda carry: carry, carry)
    return motions, {kind: impulse for kind, (impulse, _) in impulses_and_slips.items()}


def _round(
    solver: Solver,
    stage: Callable,
    contacts: dict[str, Contact],
    hold: Callable[[Motion], Motion],
    motions: Motions,
    impulses: dict[str, tuple],
) -> tuple[Motions, dict[str, tuple]]:
    """Sweep over all kinds of contact, from the stiffest to the softest.

    Contacts between discs are solved twice per sweep, and walls stop discs after each time, because piles of discs
    separate most slowly.
    """

    def sweep(index: Array | int, carry: tuple) -> tuple:
        motions, before = carry
        relaxation = jnp.where(index < solver.iterations - 1, solver.relaxation, 1.0)
        after = dict(before)
        for kind in (*contacts, "disc_disc"):
            contact, last = contacts[kind], after[kind]
            moved = {body: motions[body] for body in contact.bodies}
            after[kind] = stage(partial(contact.answer, relaxation), moved, *last)
            motions = motions | stage(partial(_correct, solver, contact), moved, after[kind], last)
            if kind == "disc_disc":
                motions = motions | {"disc": hold(motions["disc"])}
        return motions, after

    return jax.lax.fori_loop(0, solver.iterations, sweep, (motions, impulses))


def _correct(solver: Solver, contact: Contact, motions: Motions, after: tuple, before: tuple) -> Motions:
    """Return the motions after the impulses changed from `before` to `after`."""
    return contact.push(solver, motions, *jax.tree.map(jnp.subtract, after, before))


def _part_boxes(solver: Solver, contacts: dict[str, Contact], box: Motion) -> Motion:
    """Return displacements of boxes that remove a share of their overlaps without changing velocities."""
    shift = {"box": jax.tree.map(jnp.zeros_like, box)}
    for kind in ("box_box", "box_wall"):
        contact = contacts[kind]
        overlap = jnp.maximum(-contact.gap, 0)
        shift = contact.push(solver, shift, solver.box_recovery * overlap * contact.normal.mass)
    return shift["box"]


def _deepest(depths: list[Float[Array, "*envs"]]) -> Float[Array, "*envs"]:
    return functools.reduce(jnp.maximum, depths)


def _where(is_chosen: Bool[Array, "*envs"], new: Any, old: Any) -> Any:
    """Select arrays [..., *envs] by environment."""
    return jax.tree.map(lambda a, b: jnp.where(jnp.broadcast_to(is_chosen, a.shape), a, b), new, old)


@jax.custom_batching.custom_vmap
def _any_env(is_chosen: Bool[Array, "*envs"]) -> Bool[Array, ""]:
    """Return whether any environment is chosen, as a scalar also under `vmap`, where `cond` would run both branches."""
    return jnp.any(is_chosen)


@_any_env.def_vmap
def _any_env_of_all(_: int, is_batched: list, is_chosen: Array) -> tuple[Array, bool]:
    return jnp.any(is_chosen), False


def _part_further(solver: Solver, contacts: dict[str, Contact], is_deep: Bool[Array, "*envs"], shift: Motion) -> Motion:
    """Add displacements that remove most of what these leave of the overlaps, in environments with deep ones."""

    def part(_: Array | int, more: Motion) -> Motion:
        left = {kind: contacts[kind].displaced({"box": more}) for kind in ("box_box", "box_wall")}
        return jax.tree.map(operator.add, more, _part_boxes(solver, left, more))

    return _where(is_deep, jax.lax.fori_loop(0, PARTING_SWEEPS, part, shift), shift)


def _together(_: Array | int, function: Callable, *args: Any) -> Any:
    return function(*args)


def _apart(index: Array | int, function: Callable, *args: Any) -> Any:
    """Return `function(*args)`, compiled separately; `index` is the index of a loop.

    XLA on a CPU fuses as much as possible, and then recomputes shared values for each result, which took five times as
    long. A conditional that XLA cannot predict prevents this fusion. On a GPU, conditionals are expensive.
    """
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(function, *args))
    return jax.lax.cond(index >= 0, function, lambda *_: nothing, *args)
