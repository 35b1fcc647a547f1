"""The arms that are shipped, and the files of others."""

from pathlib import Path

from gnnjax.errors import InputError


def assets_dir() -> Path:
    """The folder of the shipped MJCF: inside the wheel, or at the top of a checkout."""
    inside = Path(__file__).parents[1] / "assets"
    return inside if inside.is_dir() else Path(__file__).parents[2] / "assets"


def in_kind(path: Path, *, mjcf: str, urdf: str) -> str:
    """Words for messages about an arm's file, of its kind."""
    return urdf if path.suffix == ".urdf" else mjcf


def find_model(robot: Path) -> Path:
    """The MJCF or URDF of an arm: that of a shipped one's name, or the file that is named.

    Raises:
        InputError: there is none.
    """
    if robot.suffix in (".xml", ".urdf"):
        if robot.is_file():
            return robot
        kind = in_kind(robot, mjcf="MJCF", urdf="URDF")
        raise InputError(f"no {kind} file at {str(robot)!r}; check the path")
    known = sorted(
        file.stem
        for file in assets_dir().glob("*.xml")
        if "<mujoco" in file.read_text(encoding="utf-8")
    )
    if str(robot) not in known:
        raise InputError(
            f"no robot {str(robot)!r} in assets/; there are {known}, "
            "or give the path of an MJCF file ending in .xml or a URDF ending in .urdf"
        )
    return assets_dir() / f"{robot}.xml"
