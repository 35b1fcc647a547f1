"""Fits collision spheres to the convex hulls of an arm's links.

    python -m gnnjax.fit --hulls tests/data/kuka_iiwa14_hulls.npz --out assets/kuka_iiwa14.xml \
        --base link_0
"""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import tyro

from gnnjax.arm.fit import Hull, describe, fit_link
from gnnjax.errors import InputError, run_command
from gnnjax.files import atomic_write


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """Fit collision spheres to link hulls."""

    hulls: Path
    """An .npz with the hull vertices [V, 3] of each link, in m, under the link's name."""

    out: Path
    """Output: .json for the numbers, or an existing MJCF (.xml) whose geoms of class "collision"
    are replaced in the bodies that bear the links' names (see `write_mjcf`)."""

    max_overshoot: float = 0.025
    """How far a sphere may reach out of its link's hull, in m."""

    base: str = ""
    """A link that does not move, and may overshoot by `base_overshoot` to need fewer spheres."""

    base_overshoot: float = 0.04
    """The same limit for the base, in m."""

    spacing: float = 0.002
    """No point of a hull's surface is further than this from a sample, in m. All samples end up
    inside the spheres, so nothing sticks out by more than this, and far less in practice."""

    seconds: float = 60.0
    """Time for the search, for each link."""

    links: tuple[str, ...] = ()
    """Fit these links only (all of them if empty)."""

    seed: int = 0


def write_mjcf(path: Path, spheres: dict[str, np.ndarray]) -> None:
    """Replaces the collision geoms of an MJCF, line by line, so that all the rest stays as it is.

    Each body needs its name on the line of its `<body` tag and an `<inertial .../>` of one line;
    the spheres come after that. A default class "collision" has to make them spheres.
    """
    lines, current, done = [], "", set()
    for line in path.read_text(encoding="utf-8").splitlines():
        if match := re.search(r'<body name="([^"]+)"', line):
            current = match[1]
        if re.search(r'<geom class="collision"', line) and current in spheres:
            continue
        lines.append(line)
        if "<inertial" in line and current in spheres:
            indent = line[: len(line) - len(line.lstrip())]
            lines += [
                f'{indent}<geom class="collision" pos="{x:.4f} {y:.4f} {z:.4f}" size="{r:.4f}"/>'
                for x, y, z, r in spheres[current]
            ]
            done.add(current)
    if missing := sorted(set(spheres) - done):
        raise InputError(f"no <body> with an <inertial/> for {missing} in {str(path)!r}")
    atomic_write(path, lambda part: part.write_text("\n".join(lines) + "\n", encoding="utf-8"))


def fit(config: FitConfig) -> dict[str, np.ndarray]:
    """Fits all links, prints a table and writes the spheres."""
    if not config.hulls.is_file():
        raise InputError(f"no hulls at {str(config.hulls)!r}; give an .npz of hull vertices")
    with np.load(config.hulls) as data:
        vertices = {
            name: data[name].astype(np.float64)
            for name in data.files
            if data[name].ndim == 2 and not name.endswith("__surface")
        }
    if unknown := sorted(({*config.links, config.base} - {""}) - set(vertices)):
        raise InputError(f"no link {unknown} in {str(config.hulls)!r}; there are {list(vertices)}")
    spheres = {}
    print(f"{'link':24} spheres  sticks out [mm]  overshoot [mm]")
    for name in config.links or tuple(vertices):
        hull = Hull(vertices[name])
        overshoot = config.base_overshoot if name == config.base else config.max_overshoot
        spheres[name] = fit_link(
            hull, overshoot, spacing=config.spacing, seconds=config.seconds, seed=config.seed
        )
        out, over = describe(hull, spheres[name], config.spacing)
        print(f"{name:24} {len(spheres[name]):7} {1e3 * out:16.2f} {1e3 * over:15.1f}", flush=True)
    print(f"{'all':24} {sum(map(len, spheres.values())):7}")
    if config.out.suffix == ".xml":
        write_mjcf(config.out, spheres)
    else:
        text = json.dumps({name: found.tolist() for name, found in spheres.items()}, indent=1)
        atomic_write(config.out, lambda part: part.write_text(text + "\n", encoding="utf-8"))
    return spheres


def main() -> None:
    fit(tyro.cli(FitConfig))


if __name__ == "__main__":
    run_command(main)
