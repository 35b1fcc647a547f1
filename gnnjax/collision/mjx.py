"""Collision checking with MJX, MuJoCo's own collision functions in JAX.

An independent second implementation of what the fused kernel computes, and not confined to spheres
and capsules: whatever MJX collides with a box will do.

MJX is asked pair by pair: `mjx.collision`, for a world that holds nothing but two geoms, is a
function of their poses and sizes, which `in_components` maps over all pairs of a kind and all
configurations. One world with all geoms under `jax.vmap`, the way MJX is mostly used, gives the
same verdicts at 7,000 configurations a second instead of 300,000 (Kuka, nine boxes, two cores).
Which pairs are tested is up to this module, not to the bits of the MJCF: every geom that a joint
moves with every box that exists, and `Robot.part_pairs`.

Poses are filled in from the package's own kinematics, and so are in the frame of scenes.
`mjx.kinematics` finds the same poses (a test compares them), but under `vmap` XLA computes its
chain of rotations anew for every consumer: 1,024 configurations take it 14 s on a CPU, and all
their collisions 3 ms. Accelerators may fare better; that was not measured, nor was MJX's other
implementation, `impl="warp"`, which needs an NVIDIA GPU.
"""

import contextlib
import io
from collections import defaultdict
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.kinematics import WORLD, body_frames, joint_terms
from gnnjax.arm.parts import CAPSULE, SPHERE, quat_to_matrix
from gnnjax.arm.robot import Robot
from gnnjax.collision.components import in_components
from gnnjax.collision.fused import FAR, CollisionFunctions, moved_by_joint
from gnnjax.errors import InputError
from gnnjax.scene.scene import Scene, last_box, rotation_matrices
from gnnjax.scene.shapes import for_every_kind

with contextlib.redirect_stdout(io.StringIO()):  # it prints when the optional Warp is missing
    from mujoco import mjx


class _Kind(NamedTuple):
    """Geoms for which MJX compiles the same code."""

    type: int  # MuJoCo's geom type
    mesh: int = -1  # of the arm's model


class _Geoms(NamedTuple):
    """Components of G geoms: numbers, or arrays that broadcast to `[G B]` over B configurations."""

    position: np.ndarray  # [3] m
    rotation: np.ndarray  # [3 3]
    size: np.ndarray  # [3] m, as MuJoCo has it


_SHAPES = [(3,), (3, 3), (3,)]  # of a geom's position, rotation and size
# A half-space is a box.
_OBSTACLES = for_every_kind(
    "MJX backend",
    box=_Kind(int(mujoco.mjtGeom.mjGEOM_BOX)),
    sphere=_Kind(SPHERE),
    capsule=_Kind(CAPSULE),
    cylinder=_Kind(int(mujoco.mjtGeom.mjGEOM_CYLINDER)),
    half_space=_Kind(int(mujoco.mjtGeom.mjGEOM_BOX)),
)
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)


def mjx_functions(robot: Robot) -> CollisionFunctions:
    """Builds the functions of a `Checker` on MJX.

    `clearance(scene, q [*batch D]) -> [*batch]` m is the least distance over MJX's contacts. Its
    sign is right; its size, where positive, is none to rely on: MJX sets the distance of a sphere
    or capsule and a box to 1 m, or leaves it approximate, once they are separated. Below zero it
    is minus the depth of the deepest penetration. The fused backend gives the true distance.

    Raises:
        InputError: the arm has something that MJX does not collide.
    """
    kinds = _kinds(robot)
    moving, pairs = defaultdict(list), defaultdict(list)
    moved = np.unique(robot.geom_parts[moved_by_joint(robot)])
    for part in moved.tolist():
        moving[kinds[part]].append(part)
    for i, j in robot.part_pairs.tolist():
        # One group for two kinds, whichever of them comes first.
        i, j = (i, j) if kinds[i] <= kinds[j] else (j, i)
        pairs[kinds[i], kinds[j]].append((i, j))
    with_obstacles = {
        other: [(np.array(rows), _distance_to(robot, kind, other)) for kind, rows in moving.items()]
        for other in dict.fromkeys(_OBSTACLES.values())
    }
    with_itself = [(np.array(rows), _distance(robot, *two)) for two, rows in pairs.items()]

    in_bodies = _frames_in_bodies(robot)

    def smallest_distance(scene: Scene, q: jax.Array, *, only_sign: bool) -> jax.Array:
        """Of a scene, or of a scene for each configuration, `[B M ...]`."""
        place = _placer(robot, in_bodies, q)
        smallest = jnp.full(len(q), jnp.inf, q.dtype)
        disc, ball = scene.radii[..., 0], scene.radii[..., 1]
        radius, half_length = disc + ball, scene.half_extents[..., 2]
        round_sizes = jnp.stack([radius, half_length, jnp.zeros_like(radius)], axis=-1)
        for other, pairs_of_kind in with_obstacles.items():
            exists = scene.mask & _is_of_kind(other, disc, ball, half_length)
            is_box = other == _OBSTACLES["box"]
            # Those of other kinds are far away, and none is looked at after the last.
            obstacles = (
                jnp.where(exists[..., None], scene.centers, FAR),
                rotation_matrices(scene.quats),
                scene.half_extents if is_box else round_sizes,
            )
            if scene.mask.ndim > 1:
                obstacles = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), obstacles)
            num = last_box(exists)

            def going_on(state: tuple[jax.Array, jax.Array], num=num) -> jax.Array:
                i, smallest = state
                return (i < num) & (jnp.any(smallest > 0) | (not only_sign))

            def next_one(state, obstacles=obstacles, pairs_of_kind=pairs_of_kind):
                i, smallest = state
                parts = zip(obstacles, (1, 2, 1), strict=True)
                placed = _Geoms(*(_components(part[i], axes) for part, axes in parts))
                for rows, distance in pairs_of_kind:
                    smallest = jnp.minimum(smallest, distance(place(rows), placed))
                return i + 1, smallest

            _, smallest = jax.lax.while_loop(going_on, next_one, (jnp.int32(0), smallest))
        for rows, distance in with_itself:
            smallest = jnp.minimum(smallest, distance(place(rows[:, 0]), place(rows[:, 1])))
        return smallest

    def clearance(scene: Scene, q: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
        flat = smallest_distance(scene, q.reshape(-1, q.shape[-1]), only_sign=False)
        return flat.reshape(q.shape[:-1])

    def collision_free(scene: Scene, nodes: Float[Array, "B D"]) -> Bool[Array, " B"]:
        return smallest_distance(scene, nodes, only_sign=True) > 0

    def collision_free_each(
        scenes: Scene, owner: Int[Array, " B"], nodes: Float[Array, "B D"]
    ) -> Bool[Array, " B"]:
        return collision_free(jax.tree.map(lambda x: x[owner], scenes), nodes)

    # Traced once a shape, however often a function that is compiled around it asks.
    return CollisionFunctions(
        clearance, jax.jit(collision_free), jax.jit(collision_free_each), None
    )


def _distance_to(
    robot: Robot, kind: _Kind, obstacle: _Kind
) -> Callable[[_Geoms, _Geoms], Float[Array, " B"]]:
    """`_distance` to obstacles; those that MJX cannot collide geoms of a kind with touch them all.

    MJX has no function for cylinders and boxes or meshes, for example.
    """
    if obstacle != _OBSTACLES["box"]:
        try:
            return _distance(robot, kind, obstacle)
        except InputError:
            return lambda geoms, _: jnp.full(jnp.shape(geoms.position[0])[-1:], -jnp.inf)
    return _distance(robot, kind, obstacle)


def _is_of_kind(kind: _Kind, disc: jax.Array, ball: jax.Array, half_length: jax.Array) -> jax.Array:
    """Which obstacles MJX collides as geoms of a kind."""
    if kind == _OBSTACLES["cylinder"]:
        return disc > 0
    if kind == _OBSTACLES["box"]:
        return (disc == 0) & (ball == 0)
    return (ball > 0) & ((half_length > 0) == (kind == _OBSTACLES["capsule"]))


def _kinds(robot: Robot) -> list[_Kind]:
    """Of the arm's parts, which are geoms of its model."""
    types = robot.mj_model.geom_type[robot.part_geom_ids]
    meshes = np.where(types == _MESH, robot.mj_model.geom_dataid[robot.part_geom_ids], -1)
    return [_Kind(*two) for two in zip(types.tolist(), meshes.tolist(), strict=True)]


def _frames_in_bodies(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Positions [P 3] m and rotations [P 3 3] of the arm's parts in the frames of their bodies."""
    positions = robot.mj_model.geom_pos[robot.part_geom_ids]
    rotations = np.empty((len(positions), 3, 3))
    for g, kind in enumerate(_kinds(robot)):
        rotations[g] = quat_to_matrix(robot.mj_model.geom_quat[robot.part_geom_ids[g]])
        if kind.type == _MESH:
            # Compiling the mesh again may turn it into another frame.
            world = _world(robot, kind)
            positions[g] += rotations[g] @ world.mesh_pos[0]
            rotations[g] = rotations[g] @ quat_to_matrix(world.mesh_quat[0])
    return positions, rotations


def _placer(
    robot: Robot, in_bodies: tuple[np.ndarray, np.ndarray], q: Float[Array, "B D"]
) -> Callable[[np.ndarray], _Geoms]:
    """Makes the function that places parts, given by their numbers, in B configurations."""
    positions, rotations = in_bodies
    sizes = robot.mj_model.geom_size[robot.part_geom_ids]
    types = robot.mj_model.geom_type[robot.part_geom_ids]
    part_bodies = np.array([part.body for part in robot.parts])
    # Geoms that are fixed to the world have the body -1, which is the last.
    frames = [*body_frames(robot, joint_terms(robot, q)), WORLD]

    def of_bodies(components: list) -> jax.Array:
        return jnp.stack([jnp.broadcast_to(jnp.asarray(x, q.dtype), len(q)) for x in components])

    # The barrier keeps the compiler from computing the frames anew for every geom.
    body_positions, body_rotations = jax.lax.optimization_barrier(
        (
            [of_bodies([p[i] for p, _ in frames]) for i in range(3)],
            [[of_bodies([r[i][j] for _, r in frames]) for j in range(3)] for i in range(3)],
        )
    )

    def place(rows: np.ndarray) -> _Geoms:
        bodies = part_bodies[rows]
        turns = [[x[bodies] for x in row] for row in body_rotations]

        def turned(vectors: np.ndarray) -> list[jax.Array]:
            """Vectors `[G 3]` of the bodies' frames, in the world's."""
            x, y, z = jnp.asarray(vectors.T[..., None], q.dtype)
            return [a * x + b * y + c * z for a, b, c in turns]

        offsets = turned(positions[rows])
        position = [p[bodies] + offset for p, offset in zip(body_positions, offsets, strict=True)]
        rotation = jnp.eye(3)
        if any(types[rows] != SPHERE):  # which looks the same from all sides
            axes = [turned(rotations[rows, :, j]) for j in range(3)]
            rotation = jnp.array(axes).swapaxes(0, 1)
        size = jnp.asarray(sizes[rows].T[..., None], q.dtype)
        return _Geoms(
            _components(jnp.array(position), 1), _components(rotation, 2), _components(size, 1)
        )

    return place


def _distance(
    robot: Robot, first: _Kind, second: _Kind
) -> Callable[[_Geoms, _Geoms], Float[Array, " B"]]:
    """Makes the function for the least distance [m] over pairs of geoms of two kinds."""
    try:
        world = _world(robot, first, second)
        # Named, since MJX would choose another implementation by the device and what is installed.
        model, data = mjx.put_model(world, impl="jax"), mjx.make_data(world, impl="jax")
    except (NotImplementedError, ValueError) as error:
        raise InputError(
            f"MJX cannot collide {robot.name}: {str(error).strip()}; use the fused backend"
        ) from None

    def distance_of_two(
        position: jax.Array, rotation: jax.Array, size: jax.Array, *second: jax.Array
    ) -> jax.Array:
        both = [jnp.stack(two) for two in zip((position, rotation, size), second, strict=True)]
        here = data.replace(geom_xpos=both[0], geom_xmat=both[1])
        collided = mjx.collision(model.tree_replace({"geom_size": both[2]}), here)
        return jnp.min(collided._impl.contact.dist)  # all that is not MJX's public interface

    try:
        distance_in_components = in_components(distance_of_two, _SHAPES * 2)
    except NotImplementedError:  # meshes and boxes: loops, sorting
        distance_in_components = _by_vmap(distance_of_two)

    def distance(first: _Geoms, second: _Geoms) -> Float[Array, " B"]:
        (found,) = distance_in_components(*first, *second).flat
        return jnp.min(jax.lax.optimization_barrier(found), axis=0)

    return distance


def _by_vmap(function: Callable[..., jax.Array]) -> Callable[..., np.ndarray]:
    """What `in_components` makes, for functions that it has no rules for."""

    def run(*args: np.ndarray) -> np.ndarray:
        shape = jnp.broadcast_shapes(*(jnp.shape(x) for arg in args for x in arg.flat))

        def stacked(arg: np.ndarray) -> jax.Array:
            flat = [jnp.broadcast_to(jnp.asarray(x, jnp.float32), shape) for x in arg.flat]
            return jnp.stack(flat, axis=-1).reshape(*shape, *arg.shape)

        return _components(jax.vmap(jax.vmap(function))(*map(stacked, args)), 0)

    return run


def _components(array: jax.Array, num_axes: int | None = None) -> np.ndarray:
    """The entries of an array over its first axes, by default all of them."""
    shape = array.shape[:num_axes]
    flat = array.reshape(-1, *array.shape[len(shape) :])
    components = np.empty(len(flat), object)
    for i in range(len(flat)):  # one by one, or NumPy would take the arrays apart
        components[i] = flat[i]
    return components.reshape(shape)


def _world(robot: Robot, *kinds: _Kind) -> mujoco.MjModel:
    """A world of one or two geoms, whose poses and sizes are those of nothing in particular."""
    spec = mujoco.MjSpec()
    names = [f"geom_{number}" for number in range(len(kinds))]
    for name, kind in zip(names, kinds, strict=True):
        options: dict = {"type": mujoco.mjtGeom(kind.type), "size": [0.1, 0.1, 0.1]}
        if kind.mesh >= 0:
            model = robot.mj_model
            vertices, faces = (
                every[first[kind.mesh] : first[kind.mesh] + count[kind.mesh]].ravel()
                for every, first, count in (
                    (model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum),
                    (model.mesh_face, model.mesh_faceadr, model.mesh_facenum),
                )
            )
            spec.add_mesh(name=name, uservert=vertices, userface=faces)
            options["meshname"] = name
        # Without bits: what is paired is paired by name.
        spec.worldbody.add_geom(name=name, contype=0, conaffinity=0, **options)
    if len(names) == 2:
        spec.add_pair(geomname1=names[0], geomname2=names[1], condim=1)
    return spec.compile()
