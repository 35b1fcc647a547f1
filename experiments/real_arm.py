"""Claim: planned motions can be carried out by an arm that is not quite as its model, more often
than the paper's.

    python -m experiments.real_arm

The paper took ten problems to a real arm: eight were solved, and six of the paths suited the arm,
the others being too close to obstacles or swinging back and forth. Here MuJoCo stands for the arm,
with contacts, motors that have limits, and errors that no controller knows: it is a tenth heavier
than its model, has dry friction, and answers late.

Problems are drawn until there are as many as wanted whose ends have the margin. Their paths keep
that margin, and are timed within the arm's limits of velocity, acceleration and torque, of which a
reserve is left to the controller, along curves that are proven to keep half of the margin. A
payload is known to timing and controller. All planners find their paths without it first; where a
path leads through what the arm cannot hold, they are told of the payload, and of torques, and plan
again. A motion is *found* where there is a path, *timed* where there is a motion along it, and
*suitable* where this is carried out without a contact, ends at rest at the goal, and no joint
swings (`carried_out.py`, where is said what an arm can *hold*).
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.carried_out import Conditions, summarize
from experiments.measure import ExperimentConfig
from experiments.real_arm_parts import LIMIT_S, SEEDS, Part, forget, measure_part
from experiments.real_arm_table import draw, table, verdict
from experiments.record import Experiment, Measurement, main
from experiments.results import Row
from experiments.turns import folder_of
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.trajectory.simulate import ModelErrors

_DRAWN = 100  # problems at once


@dataclasses.dataclass(frozen=True)
class RealArmConfig(ExperimentConfig):
    """Carry out what is planned, in simulation; of the seeds, the first alone."""

    arms: tuple[str, ...] = ("kuka_iiwa14", "franka_panda", "kinova_gen3")
    """The arms."""
    families: tuple[str, ...] = ("paper", "shelf", "clutter")
    """Kinds of problems."""
    num_problems: int = 334
    """Problems of each kind, for each arm, whose ends have the margin."""
    draws: int = 20
    """How often a hundred problems are drawn at most to have so many."""
    payloads: tuple[float, ...] = (0.0, 1.0, 3.0)
    """What the last link carries, kg."""
    margin: float = 0.02
    """Clearance that paths keep, m; curves keep half of it."""
    mass_error: float = 0.1
    """Share by which the arm is heavier than its model."""
    friction: float = 0.5
    """Dry friction that the model does not have, N m."""
    delay: float = 0.004
    """Seconds from what is measured to the torque that answers it."""
    reserve: float = 0.2
    """Share of the motors' torques that motions leave to the controller."""

    @property
    def conditions(self) -> Conditions:
        """Under which motions are timed and carried out."""
        errors = ModelErrors(self.mass_error, self.friction, self.delay)
        return Conditions(self.margin, self.reserve, errors)


def measurement(config: RealArmConfig) -> Measurement:
    """Rows of planners, for each arm, kind of problems and payload."""
    names = ("payloads", "margin", "mass_error", "friction", "delay", "reserve")
    settings = {name: getattr(config, name) for name in names}
    settings |= {"planned": SEEDS, "time_limit": LIMIT_S, "rest_share": 1 - config.reserve}
    head = {"num_problems": config.num_problems, "draws": config.draws}
    head |= {"drawn": config.draws * _at_once(config)} | settings
    return Measurement(_rows(config, settings), {"settings": head})


def _rows(config: RealArmConfig, settings: Row) -> Iterator[Row]:
    for arm in (config.robot,) if config.robot else config.arms:
        parts: dict[str, list[Part]] = {family: [] for family in config.families}
        for turn in range(config.draws):
            for family, own in parts.items():
                if sum(len(part.accepted) for part in own) < config.num_problems:
                    own.append(_part(config, settings, arm, family, turn))
        yield from _rows_of(config, arm, parts)
        # What is compiled for three arms takes more pieces of memory than a process may have.
        forget()


def _part(config: RealArmConfig, settings: Row, arm: str, family: str, turn: int) -> Part:
    num, seed = _at_once(config), config.seeds[0]
    told = [settings, seed, arm, family, turn, num]
    name = f"real_arm_{Path(arm).stem}_{family}_{turn}"
    # Problems are drawn, by code that counts; the arm may be a file of one's own.
    folder = folder_of(config.runs, name, told, load_robot(arm).path)
    drawn = arm, family, turn * num, num
    return measure_part(folder, *drawn, config.payloads, config.conditions, seed)


def _rows_of(config: RealArmConfig, arm: str, parts: dict[str, list[Part]]) -> Iterator[Row]:
    """Rows of an arm."""
    for family, own in parts.items():
        places = [turn * _at_once(config) + part.accepted for turn, part in enumerate(own)]
        chosen = np.concatenate(places)[: config.num_problems]
        if not len(chosen):
            raise InputError(
                f"margin is {config.margin}, which the ends of no problem have ({arm}, {family}); "
                "give less margin"
            )
        enough = len(chosen) == config.num_problems
        drawn = int(chosen[-1]) + 1 if enough else len(own) * _at_once(config)
        rows = {
            key: [row for part in own for row in part.rows[key]][: len(chosen)]
            for key in own[0].rows
        }
        for (planner, payload), each in rows.items():
            named = {"arm": Path(arm).stem, "family": family, "planner": planner}
            named |= {"payload": payload, "drawn": drawn}
            solved = [any(own[i]["found"] for own in rows.values()) for i in range(len(each))]
            yield named | {"found_by_any": sum(solved)} | summarize(each)


def _at_once(config: RealArmConfig) -> int:
    """How many problems are drawn at once."""
    return min(_DRAWN, config.num_problems)


EXPERIMENT = Experiment(
    name="real_arm",
    title="Carried out by an arm",
    claim="Planned motions can be carried out by an arm that is not quite as its model, more often "
    "than the paper's.",
    config=RealArmConfig,
    quick={"num_problems": 3, "families": ("paper",), "payloads": (0.0, 1.0)},
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)

if __name__ == "__main__":
    main(EXPERIMENT)
