"""Pictures of motions that were carried out: joints over time."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from gnnjax.arm.robot import Robot
from gnnjax.files import atomic_write
from gnnjax.plot import check_picture
from gnnjax.trajectory.execution import Execution


def draw_execution(robot: Robot, found: Execution, out: str | Path) -> None:
    """Draws joint values, velocities, torques and tracking errors over time into a picture file.

    Velocities and torques are shares of their limits; velocities as they are where the arm's model
    has no limits. What was wanted is dotted.
    """
    check_picture(out)
    trace, wanted = found.trace, found.trace.wanted
    speed, speeds = robot.velocity_limit, "velocity / limit"
    if speed is None:
        speed, speeds = np.ones(robot.num_dof), "velocity [rad/s or m/s]"
    panels = (
        ("joint value [rad or m]", trace.positions, wanted.positions),
        (speeds, trace.velocities / speed, wanted.velocities / speed),
        ("torque / limit", trace.torques / trace.torque_limit, wanted.torques / trace.torque_limit),
        ("tracking error [mrad or mm]", 1e3 * (trace.positions - wanted.positions), None),
    )
    figure = Figure(figsize=(11, 6.4), layout="constrained")
    for axes, (title, values, target) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        for joint, name in enumerate(robot.joint_names):
            (line,) = axes.plot(trace.times, values[:, joint], linewidth=1.2, label=name)
            if target is not None:
                axes.plot(trace.times, target[:, joint], ":", color=line.get_color(), linewidth=1)
        if title.endswith("/ limit"):
            axes.set_ylim(-1.1, 1.1)
            for side in (-1, 1):
                axes.axhline(side, color="0.6", linewidth=0.8)
        if found.touched:
            axes.axvline(found.touched_at, color="red", linewidth=0.8)
        axes.set(title=title, xlabel="time [s]")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center")
    outcome = "nothing touched, at rest at the goal" if found.success else found.reason
    figure.suptitle(f"{robot.name}: {outcome}")
    atomic_write(out, lambda file: figure.savefig(file, dpi=110))
