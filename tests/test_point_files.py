"""Files of points are read, and refused in a sentence where they are broken."""

import numpy as np
import pytest
import trimesh

from gnnjax.errors import InputError
from gnnjax.scene.point_files import points_from_file
from gnnjax.scene.surfaces import (
    scene_from_points,
)


@pytest.mark.parametrize("ending", ["npy", "npz", "ply", "pcd", "pcd.binary"])
def test_points_are_read_from_files(ending, tmp_path):
    points = np.random.default_rng(8).normal(size=(50, 3)).astype(np.float32)
    file = tmp_path / f"points.{ending.split('.')[0]}"
    if ending == "npy":
        np.save(file, np.concatenate([points, [[np.nan] * 3]]))
    elif ending == "npz":
        np.savez(file, points=points, colors=points)
    elif ending == "ply":
        trimesh.PointCloud(points).export(file)
    else:
        form = "binary" if "binary" in ending else "ascii"
        header = (
            "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x y z\nSIZE 4 4 4 4\nTYPE U F F F\n"
            "COUNT 1 1 1 1\nWIDTH 50\nHEIGHT 1\nVIEWPOINT 1 2 3 0 1 0 0\nPOINTS 50\n"
            f"DATA {form}\n"
        ).encode()
        rows = np.zeros(50, [("rgb", "<u4"), ("p", "<f4", 3)])
        rows["p"] = points
        text = "\n".join(" ".join(map(repr, [0, *p])) for p in points.tolist()).encode()
        file.write_bytes(header + (rows.tobytes() if form == "binary" else text))
    np.testing.assert_allclose(points_from_file(file), points, rtol=1e-6)
    scene = scene_from_points(file, 0.01, None)
    assert scene.cloud.num == 50
    if "pcd" in ending:  # of which some would be left out
        whole = file.read_bytes()
        for promised in (b"49", b"-1"):
            file.write_bytes(whole.replace(b"POINTS 50", b"POINTS " + promised))
            with pytest.raises(InputError, match=r"it promises -?\d+ .*points, and there are \d+"):
                points_from_file(file)
        file.write_bytes(whole)  # cut off, as by a disk that was full
        file.write_bytes(file.read_bytes()[:-100])
        with pytest.raises(InputError, match=r"is no PCD file .*; save it anew"):
            points_from_file(file)


def test_files_that_hold_no_points_are_refused(tmp_path):
    (tmp_path / "a.pcd").write_bytes(b"FIELDS x y z\nPOINTS 1\nDATA binary_compressed\n")
    with pytest.raises(InputError, match="is binary_compressed; save it as ascii or binary"):
        points_from_file(tmp_path / "a.pcd")
    trimesh.creation.box().export(tmp_path / "box.ply")
    with pytest.raises(
        InputError, match=r"box.ply' has 12 faces, which points leave open; give it"
    ):
        points_from_file(tmp_path / "box.ply")
    (tmp_path / "a.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"a.npz' cannot be read as points .*; save it anew by"):
        points_from_file(tmp_path / "a.npz")
    (tmp_path / "a.txt").write_text("0 0 0")
    with pytest.raises(InputError, match="is none of"):
        points_from_file(tmp_path / "a.txt")
