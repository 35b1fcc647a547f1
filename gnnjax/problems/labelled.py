"""Problems with roadmaps and exact labels, to learn from: drawn as one compiled function."""

import functools
from collections.abc import Callable
from typing import Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import rests
from gnnjax.collision.checker import Backend, Checker, make_checker
from gnnjax.collision.clearances import is_self_free
from gnnjax.collision.fused import obstacles_clear
from gnnjax.devices import map_first, on_all_cores
from gnnjax.errors import InputError
from gnnjax.kept import keep
from gnnjax.problems.families import FAMILIES, FamilyName
from gnnjax.problems.family_problem import sample_family_problem
from gnnjax.problems.problem import Problem, ProblemSet, draw_problem, near_zero
from gnnjax.roadmap.graph import GOAL, Roadmap, default_radius
from gnnjax.roadmap.paths import cost_to_go, edges_that, next_slots
from gnnjax.roadmap.sampled import sample_roadmap

Split = Literal["train", "validation", "test"]
Family: TypeAlias = Literal["paper"] | FamilyName
# Sizes of the paper's sets, and what keeps the sets of one seed apart.
SPLITS = {"train": (0, 3000), "validation": (1, 100), "test": (2, 300)}


class Labels(NamedTuple):
    """What planning on a roadmap can know at best."""

    edge_valid: Bool[Array, "*batch N K"]  # true where a slot's edge is valid
    cost_to_go: Float[Array, "*batch N"]  # to the goal over valid edges; inf if unreachable
    next_node: Int[Array, "*batch N"]  # towards the goal; -1 at the goal and where unreachable


def label_roadmap(roadmap: Roadmap, edge_valid: Bool[Array, "N K"]) -> Labels:
    """Cost-to-go and next node on the valid edges of a roadmap."""
    edge_cost = jnp.where(edge_valid, roadmap.lengths, jnp.inf)
    cost = cost_to_go(roadmap, edge_cost)
    slots = next_slots(roadmap, edge_cost, cost)
    following = jnp.take_along_axis(roadmap.neighbors, slots[:, None], axis=1)[:, 0]
    reachable = jnp.isfinite(cost) & (jnp.arange(len(cost)) != GOAL)
    return Labels(edge_valid, cost, jnp.where(reachable, following, -1))


class LabelledRoadmap(NamedTuple):
    """What a network learns from: a problem, one roadmap of it, and its labels."""

    problem: Problem
    roadmap: Roadmap
    labels: Labels


@functools.cache
def generate_labelled(
    robot: Robot, num_nodes: int, checker: Backend = "fused", family: str = "paper"
) -> Callable[[jax.Array], Problem | LabelledRoadmap]:
    """Makes the compiled function `keys [P] -> LabelledRoadmap [P]`, or `Problem [P]` for 0 nodes;
    once for the same arguments.

    The function raises `InputError` where the family does not fit the arm.
    """
    if family not in ("paper", *FAMILIES):
        raise InputError(f"no family {family!r}; there are {['paper', *FAMILIES]}")
    draw, check = _problem_sampler(robot, checker, family)

    def label(key: jax.Array, problem: Problem) -> LabelledRoadmap:
        sampled = sample_roadmap(
            key,
            functools.partial(check.check_configurations, problem.scene),
            robot,
            problem.start,
            problem.goal,
            num_nodes=num_nodes,
            radius=default_radius(robot, num_nodes),
        )
        valid = edges_that(sampled.roadmap, functools.partial(check.edges_free, problem.scene))
        return LabelledRoadmap(problem, sampled.roadmap, label_roadmap(sampled.roadmap, valid))

    def one(key: jax.Array) -> tuple[Problem | LabelledRoadmap, jax.Array]:
        problem_key, roadmap_key = jax.random.split(key)
        problem, found = draw(problem_key)
        return label(roadmap_key, problem) if num_nodes else problem, found

    @keep
    def compiled(num: jax.Array, bits: jax.Array) -> tuple[Problem | LabelledRoadmap, jax.Array]:
        return map_first(one, num, jax.random.wrap_key_data(bits))

    def generate(keys: jax.Array) -> Problem | LabelledRoadmap:
        drawn, found = on_all_cores(compiled, jax.random.key_data(keys))
        if not np.all(found):
            raise InputError(
                f"no start and goal for {int((~np.asarray(found)).sum())} of {len(keys)} problems "
                f"of the family {family!r} with {robot.name}; choose another family for this arm"
            )
        return drawn

    return generate


def _problem_sampler(
    robot: Robot, checker: Backend, family: str
) -> tuple[Callable[[jax.Array], tuple[Problem, jax.Array]], Checker]:
    """`key -> (problem, whether one was found)`, and the checker for the family's scenes."""
    zero = near_zero(robot)
    clear = functools.partial(obstacles_clear, robot, q=jnp.asarray(zero))
    if family == "paper":
        check = make_checker(robot, checker, axis_aligned=True)
        stands = bool(is_self_free(robot, zero[None])[0] and rests(robot, zero[None])[0])

        def draw_paper(key: jax.Array) -> tuple[Problem, jax.Array]:
            # Every arm's q = 0 stands upright in the paper; the scene leaves it clear.
            problem, found = draw_problem(key, robot, check.check_configurations, clear)
            return problem, jnp.all(found) | (stands & jnp.any(found))

        return draw_paper, check

    check = make_checker(robot, checker)
    base_clear = functools.partial(clear, base_only=True)

    def draw(key: jax.Array) -> tuple[Problem, jax.Array]:
        sampled = sample_family_problem(key, family, robot, check.check_configurations, base_clear)
        return sampled.problem, sampled.found

    return draw, check


def problem_keys(seed: int, split: Split, first: int, num: int, family: str = "paper") -> jax.Array:
    """The keys of problems `first` to `first + num` of a split; the size of the set is no part."""
    key = jax.random.fold_in(jax.random.key(seed), SPLITS[split][0])
    if family != "paper":
        # Numbers beyond those of the paper's problems, whose keys are folded in at this place.
        key = jax.random.fold_in(key, 2**31 + list(FAMILIES).index(family))
    return jax.vmap(functools.partial(jax.random.fold_in, key))(np.arange(first, first + num))


def to_problem_set(robot: Robot, drawn: Problem | LabelledRoadmap) -> ProblemSet:
    """Arrays as they go to disk: indices and masks in as few bits as they need."""
    drawn = jax.tree.map(np.asarray, drawn)
    if isinstance(drawn, Problem):
        return ProblemSet(robot.name, drawn)
    roadmap, labels = drawn.roadmap, drawn.labels
    extras = {
        "roadmap_nodes": roadmap.nodes,
        "roadmap_node_mask": roadmap.node_mask,
        "roadmap_neighbors": roadmap.neighbors.astype(np.uint16),
        "roadmap_neighbor_mask": roadmap.neighbor_mask,
        "roadmap_lengths": roadmap.lengths,
        "roadmap_num_dropped": roadmap.num_dropped,
        "label_edge_valid": labels.edge_valid,
        "label_cost_to_go": labels.cost_to_go,
        "label_next_node": labels.next_node.astype(np.int16),
    }
    return ProblemSet(robot.name, drawn.problem, extras)


def from_problem_set(problems: ProblemSet) -> LabelledRoadmap:
    """The roadmaps and labels of a set that was generated with them, as NumPy arrays.

    Raises:
        InputError: the set has none.
    """
    extras = problems.extras
    missing = [
        name
        for prefix, kind in (("roadmap", Roadmap), ("label", Labels))
        for name in (f"{prefix}_{field}" for field in kind._fields)
        if name not in extras
    ]
    if missing:
        raise InputError(
            f"the problem set lacks the roadmaps or labels {missing}; generate it with --num-nodes"
        )
    roadmap = Roadmap(**{name: extras[f"roadmap_{name}"] for name in Roadmap._fields})
    labels = Labels(**{name: extras[f"label_{name}"] for name in Labels._fields})
    return LabelledRoadmap(
        problems.problems,
        roadmap._replace(neighbors=roadmap.neighbors.astype(np.int32)),
        labels._replace(next_node=labels.next_node.astype(np.int32)),
    )
