"""Generates problem sets, with roadmaps and labels for training.

python -m gnnjax.generate --split train   # the paper's 3,000 problems, roadmaps and labels
python -m gnnjax.generate --split test    # the paper's 300 test problems
python -m gnnjax.generate --split test --family shelf   # harder ones
"""

import contextlib
import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.checker import Backend, Checker, make_checker
from gnnjax.collision.fused import boxes_clear
from gnnjax.devices import cache_compilations, over_problems
from gnnjax.errors import InputError, check_seed, run_command
from gnnjax.files import check_target, is_leftover, locked
from gnnjax.problems.families import FAMILIES, FamilyName
from gnnjax.problems.family_problem import sample_family_problem
from gnnjax.problems.problem import (
    MANIFEST,
    Problem,
    ProblemSet,
    check_origin,
    intact_shards,
    load_problems,
    origin,
    read_manifest,
    sample_problem,
    save_problems,
    save_shard,
)
from gnnjax.roadmap.graph import Roadmap, default_radius
from gnnjax.roadmap.paths import Labels, edge_validity, label_roadmap
from gnnjax.roadmap.sampled import sample_roadmap

Split = Literal["train", "validation", "test"]
Family: TypeAlias = Literal["paper"] | FamilyName

_ORIGIN = "generated"  # array of a single file that says what the manifest says of a folder

# Sizes of the paper's sets, and what keeps the sets of one seed apart.
_SPLITS = {"train": (0, 3000), "validation": (1, 100), "test": (2, 300)}


@dataclasses.dataclass(frozen=True)
class GenerateConfig:
    """Draw problems of the paper's distribution or of a harder family; for training also their
    roadmaps and labels."""

    split: Split = "train"
    """Which set; their problems never coincide."""
    family: Family = "paper"
    """Kind of scenes: the paper's boxes, or structures that leave little room."""
    robot: str = "kuka_iiwa14"
    """Shipped robot, or path of an MJCF."""
    num_problems: int | None = None
    """Problems; by default 3,000 for train, 100 for validation and 300 for test."""
    num_nodes: int | None = None
    """Nodes of the roadmaps; 0 for problems alone. By default 200, and 0 for test."""
    seed: int = 0
    """Of the whole set."""
    out: Path | None = None
    """A folder of shards, or a file ending in .npz. By default data/ROBOT_SPLIT (test: .npz),
    for families other than the paper's data/ROBOT_FAMILY_SPLIT."""
    shard_size: int = 100
    """Problems that are drawn, labelled and written at once."""
    checker: Backend = "fused"
    """Collision backend."""


class LabelledRoadmap(NamedTuple):
    """What a network learns from: a problem, one roadmap of it, and its labels."""

    problem: Problem
    roadmap: Roadmap
    labels: Labels


def generate_labelled(
    robot: Robot, num_nodes: int, checker: Backend = "fused", family: str = "paper"
) -> Callable[[jax.Array], Problem | LabelledRoadmap]:
    """Makes the compiled function `keys [P] -> LabelledRoadmap [P]`, or `Problem [P]` for 0 nodes.

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
        edges = functools.partial(check.check_edges, problem.scene)
        valid = edge_validity(sampled.roadmap, edges).edge_valid
        return LabelledRoadmap(problem, sampled.roadmap, label_roadmap(sampled.roadmap, valid))

    def one(key: jax.Array) -> tuple[Problem | LabelledRoadmap, jax.Array]:
        problem_key, roadmap_key = jax.random.split(key)
        problem, found = draw(problem_key)
        return label(roadmap_key, problem) if num_nodes else problem, found

    @jax.jit
    def compiled(keys: jax.Array) -> tuple[Problem | LabelledRoadmap, jax.Array]:
        return over_problems(one, jnp.ones(len(keys), bool), keys)

    def generate(keys: jax.Array) -> Problem | LabelledRoadmap:
        drawn, found = compiled(keys)
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
    zero = np.clip(np.zeros(robot.num_dof, np.float32), robot.joint_lower, robot.joint_upper)
    clear = functools.partial(boxes_clear, robot, q=jnp.asarray(zero))
    if family == "paper":
        check = make_checker(robot, checker, axis_aligned=True)

        def draw_paper(key: jax.Array) -> tuple[Problem, jax.Array]:
            # Every arm's q = 0 stands upright in the paper; the scene leaves it clear.
            problem = sample_problem(key, robot, check.check_configurations, clear)
            return problem, jnp.ones((), bool)

        return draw_paper, check

    check = make_checker(robot, checker)
    base_clear = functools.partial(clear, base_only=True)

    def draw(key: jax.Array) -> tuple[Problem, jax.Array]:
        sampled = sample_family_problem(key, family, robot, check.check_configurations, base_clear)
        return sampled.problem, sampled.found

    return draw, check


def problem_keys(seed: int, split: Split, first: int, num: int, family: str = "paper") -> jax.Array:
    """The keys of problems `first` to `first + num` of a split; the size of the set is no part."""
    key = jax.random.fold_in(jax.random.key(seed), _SPLITS[split][0])
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


def generate(config: GenerateConfig) -> Path:
    """Draws what is missing of a set, shard by shard, and returns where it is."""
    robot = load_robot(config.robot)
    num = _SPLITS[config.split][1] if config.num_problems is None else config.num_problems
    nodes = (0 if config.split == "test" else 200) if config.num_nodes is None else config.num_nodes
    if num < 1 or config.shard_size < 1:
        raise InputError(
            f"num_problems is {num} and shard_size {config.shard_size}; both must be at least 1"
        )
    if not 0 <= nodes <= 32767 or nodes in (1, 2):
        raise InputError(f"num_nodes is {nodes}; give 0 for problems alone, or 3 to 32767")
    family = "" if config.family == "paper" else f"{config.family}_"
    ending = ".npz" if config.split == "test" else ""
    default = Path("data") / f"{robot.name}_{family}{config.split}{ending}"
    out = default if config.out is None else config.out
    one_file = out.suffix == ".npz"
    check_seed(config.seed)
    folder = out.with_suffix(".parts") if one_file else out
    check_target(folder / MANIFEST)
    settings = {
        "split": config.split,
        "family": config.family,
        "num_nodes": nodes,
        "shard_size": config.shard_size,
        "checker": config.checker,
    }
    ours = origin(robot.name, config.seed, settings)
    with locked(out if one_file else folder / MANIFEST):
        if one_file and out.exists():
            # This command may have been killed when all was done but taking the parts away.
            if _origin_of(out, robot) != {**ours, "problems": num}:
                raise InputError(f"{str(out)!r} exists; remove it, or choose another --out")
        else:
            _draw_shards(robot, folder, num, ours)
        if one_file and not out.exists():
            extras = {_ORIGIN: np.array(json.dumps({**ours, "problems": num}))}
            drawn = load_problems(folder, robot)
            save_problems(out, dataclasses.replace(drawn, extras=drawn.extras | extras))
        if one_file:
            _remove_parts(folder)
    print(f"{num} problems in {out}")
    return out


def _origin_of(file: Path, robot: Robot) -> Any:
    """How a file was generated, or None where it does not say."""
    with contextlib.suppress(InputError, KeyError, ValueError, RecursionError):
        return json.loads(str(load_problems(file, robot).extras[_ORIGIN]))
    return None


def _remove_parts(folder: Path) -> None:
    """Removes a folder of shards; the manifest, which says whose it is, goes last."""
    if (folder / MANIFEST).exists():
        for shard in read_manifest(folder)["shards"]:
            (folder / shard["file"]).unlink(missing_ok=True)
        (folder / MANIFEST).unlink()
    with contextlib.suppress(OSError):  # not there, or something else lies in it and stays
        folder.rmdir()


def _draw_shards(robot: Robot, folder: Path, num: int, ours: dict[str, Any]) -> None:
    """Draws the shards that the folder's manifest lacks, or that are not there as it says."""
    cache_compilations()
    seed, settings = ours["seed"], ours["settings"]
    size = settings["shard_size"]
    done = {}
    if (folder / MANIFEST).exists():
        manifest = read_manifest(folder)
        check_origin(folder, manifest, ours)
        there = sum(shard["problems"] for shard in manifest["shards"])
        if there > num:
            raise InputError(
                f"{str(folder)!r} holds {there} problems, more than {num}; write to an empty folder"
            )
        done = intact_shards(folder)
    elif folder.exists():
        # What is not ours would be mixed with the set.
        names = [p.name for p in folder.iterdir() if not is_leftover(p.name)]
        others = [name for name in names if not name.startswith("shard_")]
        if others:
            raise InputError(
                f"{str(folder)!r} holds {others[0]!r} and no problem set; write to an empty folder"
            )
    family = settings["family"]
    draw = generate_labelled(robot, settings["num_nodes"], settings["checker"], family)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, TimeRemainingColumn()) as progress:
        task = progress.add_task("compiling and drawing", total=num)
        for index, first in enumerate(range(0, num, size)):
            wanted = min(size, num - first)
            if done.get(f"shard_{index:05d}.npz") != wanted:
                # Whole shards, also at the end: one compilation, and the same problems.
                drawn = draw(problem_keys(seed, settings["split"], first, size, family))
                drawn = jax.tree.map(lambda x, n=wanted: np.asarray(x)[:n], drawn)
                problems = to_problem_set(robot, drawn)
                save_shard(folder, index, problems, seed=seed, settings=settings)
            progress.update(task, advance=wanted)


if __name__ == "__main__":
    run_command(lambda: generate(tyro.cli(GenerateConfig)) and None)
