"""Collision checking with MJX, MuJoCo's own collision functions in JAX.

An independent second implementation of the fused kernel's first level, but for its maps
(`contact_maps.py`): MJX tests the arm's cover, the spheres around its parts. What these leave open
is not looked at, so that of arms whose parts are no spheres this backend is conservative. It
refuses whatever touches, and besides what comes as near to a part as its spheres stand out of it.
The parts themselves are not MJX's to test here: its function for meshes and boxes is slower by
orders of magnitude, there is none for meshes and cylinders, and the one for capsules and boxes
misses one collision in a thousand.

MJX is asked pair by pair: `mjx.collision`, for a world that holds nothing but two geoms, is a
function of their poses and sizes, which `in_components` maps over all pairs of a kind and all
configurations. One world with all geoms under `jax.vmap`, the way MJX is mostly used, gives the
same verdicts at 7,000 configurations a second instead of 300,000 (Kuka, nine boxes, two cores).
Which pairs are tested is up to this module, not to the bits of the MJCF: every sphere that a joint
moves with every obstacle that exists, and `Robot.sphere_pairs`.

Poses are filled in from the package's own kinematics, and so are in the frame of scenes.
`mjx.kinematics` finds the same poses (a test compares them), but under `vmap` XLA computes its
chain of rotations anew for every consumer: 1,024 configurations take it 14 s on a CPU, and all
their collisions 3 ms. Accelerators may fare better; that was not measured, nor was MJX's other
implementation, `impl="warp"`, which needs an NVIDIA GPU.
"""

import contextlib
import io
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.kinematics import WORLD, body_frames, joint_terms
from gnnjax.arm.robot import Robot
from gnnjax.collision.components import in_components
from gnnjax.collision.levels import CollisionFunctions
from gnnjax.collision.placed import FAR
from gnnjax.collision.spheres import moved_by_joint
from gnnjax.scene.allowed import refuse_allowed
from gnnjax.scene.scene import Scene, last_obstacle, rotation_matrices
from gnnjax.scene.shapes import for_every_kind

with contextlib.redirect_stdout(io.StringIO()):  # it prints when the optional Warp is missing
    from mujoco import mjx


class _Geoms(NamedTuple):
    """Components of G geoms: numbers, or arrays that broadcast to `[G B]` over B configurations."""

    position: np.ndarray  # [3] m
    rotation: np.ndarray  # [3 3]
    size: np.ndarray  # [3] m, as MuJoCo has it


_SHAPES = [(3,), (3, 3), (3,)]  # of a geom's position, rotation and size
_SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE
_BOX = mujoco.mjtGeom.mjGEOM_BOX
# A half-space is a box.
_OBSTACLES = for_every_kind(
    "MJX backend",
    box=_BOX,
    sphere=_SPHERE,
    capsule=mujoco.mjtGeom.mjGEOM_CAPSULE,
    cylinder=mujoco.mjtGeom.mjGEOM_CYLINDER,
    half_space=_BOX,
)


def mjx_functions(robot: Robot) -> CollisionFunctions:
    """Builds the functions of a `Checker` on MJX.

    `clearance(scene, q [*batch D]) -> [*batch]` m is the least distance over MJX's contacts. Its
    sign is right; its size, where positive, is none to rely on: MJX sets the distance of a sphere
    and a box to 1 m, or leaves it approximate, once they are separated. Below zero it is minus the
    depth of the deepest penetration, of spheres. The fused backend gives the true distance.
    """
    moving = np.flatnonzero(moved_by_joint(robot))
    to_obstacle = {kind: _distance(kind) for kind in dict.fromkeys(_OBSTACLES.values())}
    of_two_spheres = to_obstacle[_SPHERE]

    def smallest_distance(scene: Scene, q: jax.Array, *, only_sign: bool) -> jax.Array:
        """Of a scene, or of a scene for each configuration, `[B M ...]`."""
        refuse_allowed(scene, "the MJX backend")
        place = _placer(robot, q)
        smallest = jnp.full(len(q), jnp.inf, q.dtype)
        kinds, sizes = _enclosing(scene)
        for kind, distance in to_obstacle.items():
            exists = scene.mask & kinds[kind]
            # Those of other kinds are far away, and none is looked at after the last.
            obstacles = (
                jnp.where(exists[..., None], scene.centers, FAR),
                rotation_matrices(scene.quats),
                sizes[kind],
            )
            if scene.mask.ndim > 1:
                obstacles = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), obstacles)
            num = last_obstacle(exists)

            def going_on(state: tuple[jax.Array, jax.Array], num=num) -> jax.Array:
                i, smallest = state
                return (i < num) & (jnp.any(smallest > 0) | (not only_sign))

            def next_one(state, obstacles=obstacles, distance=distance):
                i, smallest = state
                parts = zip(obstacles, (1, 2, 1), strict=True)
                placed = _Geoms(*(_components(part[i], axes) for part, axes in parts))
                return i + 1, jnp.minimum(smallest, distance(place(moving), placed))

            if len(moving):
                _, smallest = jax.lax.while_loop(going_on, next_one, (jnp.int32(0), smallest))
        if len(robot.sphere_pairs):
            first, second = robot.sphere_pairs.T
            smallest = jnp.minimum(smallest, of_two_spheres(place(first), place(second)))
        return smallest

    def clearance(scene: Scene, q: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
        flat = smallest_distance(scene, q.reshape(-1, q.shape[-1]), only_sign=False)
        return flat.reshape(q.shape[:-1])

    def collision_free(scene: Scene, nodes: Float[Array, "B D"]) -> Bool[Array, " B"]:
        return smallest_distance(scene, nodes, only_sign=True) > 0

    def collision_free_each(
        scenes: Scene, owner: Int[Array, " G"], nodes: Float[Array, "G T D"]
    ) -> Bool[Array, "G T"]:
        groups, each, num_dof = nodes.shape
        own = jax.tree.map(lambda x: jnp.repeat(x[owner], each, axis=0), scenes)
        return collision_free(own, nodes.reshape(-1, num_dof)).reshape(groups, each)

    # Traced once a shape, however often a function that is compiled around it asks.
    return CollisionFunctions(
        clearance,
        jax.jit(collision_free),
        lambda scenes: scenes,
        jax.jit(collision_free_each),
        None,
    )


def _enclosing(
    scene: Scene,
) -> tuple[dict[mujoco.mjtGeom, jax.Array], dict[mujoco.mjtGeom, jax.Array]]:
    """MuJoCo's geoms that hold the obstacles: which are of a kind, and their sizes `[... 3]`.

    An obstacle is a box, a disc and a ball, summed. MuJoCo has no box or cylinder with rounded
    edges, as a margin makes them: those are larger here, at the edges alone.
    """
    x, y, z = jnp.moveaxis(scene.half_extents, -1, 0)
    disc, ball = scene.radii[..., 0], scene.radii[..., 1]
    is_box = (x > 0) | (y > 0)
    is_cylinder = ~is_box & (disc > 0)
    is_capsule = ~is_box & ~is_cylinder & (z > 0)
    nothing = jnp.zeros_like(ball)
    kinds = {
        _BOX: is_box,
        _OBSTACLES["cylinder"]: is_cylinder,
        _OBSTACLES["capsule"]: is_capsule,
        _SPHERE: ~is_box & ~is_cylinder & ~is_capsule,
    }
    sizes = {
        _BOX: (x + disc + ball, y + disc + ball, z + ball),
        _OBSTACLES["cylinder"]: (disc + ball, z + ball, nothing),
        _OBSTACLES["capsule"]: (ball, z, nothing),
        _SPHERE: (ball, nothing, nothing),
    }
    return kinds, {kind: jnp.stack(size, axis=-1) for kind, size in sizes.items()}


def _placer(robot: Robot, q: Float[Array, "B D"]) -> Callable[[np.ndarray], _Geoms]:
    """Makes the function that places spheres, given by their rows, in B configurations."""
    # Spheres that are fixed to the world have the body -1, which is the last.
    frames = [*body_frames(robot, joint_terms(robot, q)), WORLD]

    def of_bodies(components: list) -> jax.Array:
        return jnp.stack([jnp.broadcast_to(jnp.asarray(x, q.dtype), len(q)) for x in components])

    # The barrier keeps the compiler from computing the frames anew for every sphere.
    positions, rotations = jax.lax.optimization_barrier(
        (
            [of_bodies([p[i] for p, _ in frames]) for i in range(3)],
            [[of_bodies([r[i][j] for _, r in frames]) for j in range(3)] for i in range(3)],
        )
    )

    def place(rows: np.ndarray) -> _Geoms:
        bodies = robot.sphere_bodies[rows]
        x, y, z = jnp.asarray(robot.sphere_centers[rows].T[..., None], q.dtype)
        position = [
            p[bodies] + a[bodies] * x + b[bodies] * y + c[bodies] * z
            for p, (a, b, c) in zip(positions, rotations, strict=True)
        ]
        size = np.zeros((3, len(rows), 1))
        size[0, :, 0] = robot.sphere_radii[rows]
        return _Geoms(
            _components(jnp.array(position), 1),
            _components(jnp.eye(3), 2),  # which looks the same from all sides
            _components(jnp.asarray(size, q.dtype), 1),
        )

    return place


def _distance(kind: mujoco.mjtGeom) -> Callable[[_Geoms, _Geoms], Float[Array, " B"]]:
    """Makes the function for the least distance [m] over pairs of a sphere and another geom."""
    world = _world(_SPHERE, kind)
    # Named, since MJX would choose another implementation by the device and what is installed.
    model, data = mjx.put_model(world, impl="jax"), mjx.make_data(world, impl="jax")

    def distance_of_two(
        position: jax.Array, rotation: jax.Array, size: jax.Array, *second: jax.Array
    ) -> jax.Array:
        both = [jnp.stack(two) for two in zip((position, rotation, size), second, strict=True)]
        here = data.replace(geom_xpos=both[0], geom_xmat=both[1])
        collided = mjx.collision(model.tree_replace({"geom_size": both[2]}), here)
        return jnp.min(collided._impl.contact.dist)  # all that is not MJX's public interface

    try:
        distance_in_components = in_components(distance_of_two, _SHAPES * 2)
    except NotImplementedError:  # cylinders: a loop that descends to the nearest point
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


def _components(array: jax.Array, num_axes: int) -> np.ndarray:
    """The entries of an array over its first axes."""
    shape = array.shape[:num_axes]
    flat = array.reshape(-1, *array.shape[num_axes:])
    components = np.empty(len(flat), object)
    for i in range(len(flat)):  # one by one, or NumPy would take the arrays apart
        components[i] = flat[i]
    return components.reshape(shape)


def _world(*kinds: mujoco.mjtGeom) -> mujoco.MjModel:
    """A world of two geoms, whose poses and sizes are those of nothing in particular."""
    spec = mujoco.MjSpec()
    names = [f"geom_{number}" for number in range(len(kinds))]
    for name, kind in zip(names, kinds, strict=True):
        # Without bits: what is paired is paired by name.
        spec.worldbody.add_geom(
            name=name, type=kind, size=[0.1, 0.1, 0.1], contype=0, conaffinity=0
        )
    spec.add_pair(geomname1=names[0], geomname2=names[1], condim=1)
    return spec.compile()
