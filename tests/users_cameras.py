"""Projection by a user's own camera files; their parsers share nothing with ours.

A `Pixels` takes points `(N, 3)` in the file's frame and unit to pixels `(N, 2)` by camera.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

Pixels = Callable[[np.ndarray], dict[str, np.ndarray]]
Lens = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""K with the centre of the top-left pixel at (0, 0), R, t, and OpenCV's coefficients."""


def by_opencv(lenses: dict[str, Lens]) -> Pixels:
    def pixels(points: np.ndarray) -> dict[str, np.ndarray]:
        out = {}
        for name, (K, R, t, distortion) in lenses.items():
            there, _ = cv2.projectPoints(np.array(points), cv2.Rodrigues(R)[0], t, K, distortion)
            out[name] = there[:, 0]
        return out

    return pixels


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """K of a file in which the corner of the top-left pixel is at (0, 0)."""
    return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])


def of_colmap(sparse: Path) -> Pixels:
    """Cameras of the model PINHOLE or FULL_OPENCV, named by the images' folder, else their name."""
    rows = [x.split() for x in (sparse / "images.txt").read_text().splitlines()]
    rows = [x for x in rows if len(x) == 10 and x[0] != "#"]
    models = [x.split() for x in (sparse / "cameras.txt").read_text().splitlines()]
    numbers = {x[0]: np.array([*map(float, x[4:]), *8 * [0.0]]) for x in models if x[0] != "#"}
    lenses = {}
    for row in rows:
        w, x, y, z = map(float, row[1:5])
        R, t = Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(row[5:8], float)
        picture, of = Path(row[9]), numbers[row[8]]
        name = picture.parent.name or picture.stem
        lenses[name] = (intrinsics(*of[:4]), R, t, of[4:12])
    return by_opencv(lenses)


def of_nerfstudio(path: Path) -> Pixels:
    lenses = {}
    for f in json.loads(path.read_text())["frames"]:
        to_camera = np.diag([1.0, -1, -1, 1]) @ np.linalg.inv(f["transform_matrix"])
        picture = Path(f["file_path"])
        name = picture.stem if picture.parent.name == "images" else picture.parent.name
        distortion = np.array([f[k] for k in ("k1", "k2", "p1", "p2", "k3")])
        K = intrinsics(f["fl_x"], f["fl_y"], f["cx"], f["cy"])
        lenses[name] = (K, to_camera[:3, :3], to_camera[:3, 3], distortion)
    return by_opencv(lenses)


def of_json(path: Path) -> Pixels:
    read = json.loads(path.read_text())["cameras"]
    return by_opencv(
        {
            c["id"]: (*(np.array(c[k]) for k in ("K", "R", "t")), np.array(c["distortion"]))
            for c in read
        }
    )


def of_easymocap(folder: Path) -> Pixels:
    """By OpenCV's reader, as EasyMocap's read_camera (mytools/camera_utils.py) does."""
    inner, outer = (
        cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_READ)
        for name in ("intri.yml", "extri.yml")
    )
    names = inner.getNode("names")
    lenses = {}
    for i in range(names.size()):
        name = names.at(i).string()
        distortion = inner.getNode(f"dist_{name}").mat()
        if distortion is None:
            distortion = inner.getNode(f"D_{name}").mat()
        R = cv2.Rodrigues(outer.getNode(f"R_{name}").mat())[0]
        T = outer.getNode(f"T_{name}").mat()
        lenses[name] = (inner.getNode(f"K_{name}").mat(), R, T, distortion)
    return by_opencv(lenses)


def of_metashape(path: Path) -> Pixels:
    """By the equations of Agisoft's manual, appendix C (frame cameras)."""
    chunk = ElementTree.parse(path).getroot().find("chunk")
    assert chunk is not None

    def numbers(element: ElementTree.Element | None, name: str) -> np.ndarray:
        assert element is not None
        return np.array(element.findtext(name, "").split(), float)

    component = chunk.find("components/component/transform")
    world = chunk.find("transform") if component is None else component
    turn, move = numbers(world, "rotation").reshape(3, 3), numbers(world, "translation")
    scale = numbers(world, "scale")
    sensors = {}
    for sensor in chunk.iter("sensor"):
        tables = sensor.findall("calibration")
        table = next((x for x in tables if x.get("class") == "adjusted"), tables[-1])
        values = {x.tag: float(x.text) for x in table if x.text and x.tag != "resolution"}
        size = sensor.find("resolution")
        size = table.find("resolution") if size is None else size
        assert size is not None
        sensors[sensor.get("id")] = (int(size.get("width", 0)), int(size.get("height", 0)), values)
    posed = [c for c in chunk.iter("camera") if c.find("transform") is not None]

    def pixels(points: np.ndarray) -> dict[str, np.ndarray]:
        inside = (points - move) @ turn / scale
        out = {}
        for camera in posed:
            to_chunk = numbers(camera, "transform").reshape(4, 4)
            x, y, z = np.linalg.inv(to_chunk)[:3, :3] @ (inside - to_chunk[:3, 3]).T
            x, y = x / z, y / z
            width, height, v = sensors[camera.get("sensor_id")]
            of = defaultdict(float, v)
            r2 = x**2 + y**2
            radial = 1 + of["k1"] * r2 + of["k2"] * r2**2 + of["k3"] * r2**3 + of["k4"] * r2**4
            p1, p2 = of["p1"], of["p2"]
            u = x * radial + p1 * (r2 + 2 * x**2) + 2 * p2 * x * y
            v_ = y * radial + p2 * (r2 + 2 * y**2) + 2 * p1 * x * y
            across = width / 2 + of["cx"] + u * (of["f"] + of["b1"]) + v_ * of["b2"]
            down = height / 2 + of["cy"] + v_ * of["f"]
            out[str(camera.get("label"))] = np.stack([across, down], axis=1) - 0.5
        return out

    return pixels


def of_calib(path: Path, width: int) -> Pixels:
    """The Captury's cameras, `Cam01` and on, of undistorted pictures `width` pixels wide."""
    lenses: dict[str, Lens] = {}
    blocks = path.read_text().split("camera\t")[1:]
    for i, block in enumerate(blocks):
        words = [line.partition("#")[0].split() for line in block.splitlines()[1:]]
        of = {
            w[0]: np.array(w[1:], float) for w in words if len(w) > 1 and w[0] != "distortionModel"
        }
        per_mm = width / of["sensorSize"][0]
        fx = per_mm * of["focalLength"][0]
        cx, cy = per_mm * (of["sensorSize"] / 2 + of["centerOffset"])
        down = -of["up"]
        R = np.stack([of["right"], down, np.cross(of["right"], down)])
        K = intrinsics(fx, fx * of["pixelAspect"][0], cx, cy)
        lenses[f"Cam{i + 1:02d}"] = (K, R, -R @ of["origin"], np.zeros(5))
    return by_opencv(lenses)


def of_openillumination(tables: list[Path], width: int, height: int) -> Pixels:
    """As the authors' OpenIllumDataset: a field of view each, Blender's axes, frames by camera."""
    lenses = {}
    for table in tables:
        for name, frame in json.loads(table.read_text())["frames"].items():
            to_world = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])
            to_camera = np.linalg.inv(to_world)
            f = 0.5 * width / np.tan(0.5 * frame["camera_angle_x"])
            K = intrinsics(f, f, width / 2, height / 2)
            lenses[name] = (K, to_camera[:3, :3], to_camera[:3, 3], np.zeros(5))
    return by_opencv(lenses)
