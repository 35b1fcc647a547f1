"""Generates problem sets, with roadmaps and labels for training.

python -m gnnjax.generate --split train   # the paper's 3,000 problems, roadmaps and labels
python -m gnnjax.generate --split test    # the paper's 300 test problems
python -m gnnjax.generate --split test --family shelf   # harder ones
python -m gnnjax.generate --split test --family upright --robot franka_panda \
    --attach examples/bottle.json
srun python -m gnnjax.generate --split train --distributed   # see docs/cluster.md
"""

import contextlib
import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import Robot
from gnnjax.arm.sources import sources_sha256
from gnnjax.arm_options import HoldingOptions, load_arm
from gnnjax.cluster import ALONE, Cluster
from gnnjax.collision.checker import Backend
from gnnjax.devices import cache_compilations
from gnnjax.errors import InputError, check_seed, run_command
from gnnjax.files import check_target, is_leftover, locked
from gnnjax.problems.file import save_problems
from gnnjax.problems.labelled import (
    SPLITS,
    Family,
    Split,
    generate_labelled,
    problem_keys,
    to_problem_set,
)
from gnnjax.problems.shards import (
    MANIFEST,
    is_intact,
    join_manifests,
    known_shards,
    load_problems,
    manifest_of,
    origin,
    read_manifest,
    save_shard,
    shard_name,
)
from gnnjax.progress_bar import progress_bar
from gnnjax.roll_call import Place

_ORIGIN = "generated"  # array of a single file that says what the manifest says of a folder


@dataclasses.dataclass(frozen=True)
class GenerateConfig(HoldingOptions):
    """Draw problems of the paper's distribution or of a harder family; for training also their
    roadmaps and labels."""

    split: Split = "train"
    """Which set to draw; two sets never share a problem."""
    family: Family = "paper"
    """Kind of scenes: the paper's boxes, or structures that leave little room."""
    num_problems: int | None = None
    """Number of problems; by default 3,000 for train, 100 for validation and 300 for test."""
    num_nodes: int | None = None
    """Nodes of the roadmaps; 0 for problems alone. By default 200, and 0 for test."""
    seed: int = 0
    """Seed of the whole set."""
    out: Path | None = None
    """A folder of shards, or a file ending in .npz. By default data/ROBOT_SPLIT (test: .npz),
    for families other than the paper's data/ROBOT_FAMILY_SPLIT."""
    shard_size: int = 100
    """Problems that are drawn, labelled and written at once."""
    checker: Backend = "fused"
    """Collision backend."""
    cluster: Cluster = ALONE


def generate(config: GenerateConfig) -> Path:
    """Draws what is missing of a set, shard by shard, and returns where it is."""
    robot = load_arm(config)
    num = SPLITS[config.split][1] if config.num_problems is None else config.num_problems
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
        "robot_sha256": sources_sha256(robot.path),
    }
    if config.rest_share is not None:  # which sets from before there was one do not tell
        settings["rest_share"] = config.rest_share
    ours = origin(robot.name, config.seed, settings)
    place = config.cluster.place()
    with contextlib.ExitStack() as held:
        others = held.enter_context(config.cluster.roll_call(out))
        if place.index == 0:
            held.enter_context(locked(out if one_file else folder / MANIFEST))
        done = one_file and out.exists()
        # This command may have been killed when all was done but taking the parts away.
        if done and _origin_of(out, robot) != {**ours, "problems": num}:
            raise InputError(f"{str(out)!r} exists; remove it, or choose another --out")
        if not done:
            _draw_shards(robot, folder, num, ours, place)
        if others.gather():
            if not done:
                join_manifests(folder, ours)
            if one_file and not done:
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


def _draw_shards(robot: Robot, folder: Path, num: int, ours: dict[str, Any], place: Place) -> None:
    """Draws those of a process's shards that the folder's manifests lack, or that are not there as
    these say."""
    cache_compilations()
    seed, settings = ours["seed"], ours["settings"]
    size = settings["shard_size"]
    known = known_shards(folder, ours)
    there = sum(shards[0]["problems"] for shards in known.values())
    if there > num:
        raise InputError(
            f"{str(folder)!r} holds {there} problems, more than {num}; write to an empty folder"
        )
    if not known and folder.exists():
        # What is not ours would be mixed with the set.
        names = [p.name for p in folder.iterdir() if not is_leftover(p.name)]
        others = [name for name in names if not name.startswith("shard_")]
        if others:
            raise InputError(
                f"{str(folder)!r} holds {others[0]!r} and no problem set; write to an empty folder"
            )
    family = settings["family"]
    draw = generate_labelled(robot, settings["num_nodes"], settings["checker"], family)
    manifest = MANIFEST if place.count == 1 else manifest_of(place.index)
    mine = [i for i in range(-(-num // size)) if place.has(i)]
    wanted = {i: min(size, num - i * size) for i in mine}
    with progress_bar() as progress:
        task = progress.add_task("compiling and drawing", total=sum(wanted.values()))
        for index, count in wanted.items():
            shards = known.get(shard_name(index), [])
            if not any(s["problems"] == count and is_intact(folder, s) for s in shards):
                # Whole shards, also at the end: one compilation, and the same problems.
                keys = problem_keys(seed, settings["split"], index * size, size, family)
                drawn = jax.tree.map(lambda x, n=count: np.asarray(x)[:n], draw(keys))
                problems = to_problem_set(robot, drawn)
                save_shard(
                    *(folder, index, problems),
                    seed=seed,
                    settings=settings,
                    manifest_name=manifest,
                )
            progress.update(task, advance=count)


if __name__ == "__main__":
    run_command(
        lambda: generate(parse_arguments(GenerateConfig)) and None,
        smaller="give a smaller --shard-size or --num-nodes",
    )
