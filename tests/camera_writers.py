"""Writers of the camera formats, from each format's description; they share nothing with us.

All take cameras in our convention: K with the centre of the top-left pixel at (0, 0).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from reconstruction import Camera

LENS = np.array([-0.12, 0.03, 2e-3, -1e-3, 0.01])


def quaternion(R: np.ndarray) -> np.ndarray:
    """(w, x, y, z) as the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(K)[1][:, -1]
    return np.array([w, x, y, z])


def colmap_params(camera: Camera) -> list[float]:
    """FULL_OPENCV: fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6; its pixels' centres are at .5."""
    k1, k2, p1, p2, k3 = camera.distortion
    K = camera.K
    return [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, k1, k2, p1, p2, k3, 0, 0, 0]


def write_colmap_text(folder: Path, cameras: Sequence[Camera]) -> None:
    folder.mkdir(parents=True)
    lines = ["# Camera list with one line of data per camera:"]
    images = ["# Image list with two lines of data per image:", "# POINTS2D[] as (X, Y, ID)"]
    for i, camera in enumerate(cameras):
        params = " ".join(repr(float(p)) for p in colmap_params(camera))
        lines.append(f"{10 + i} FULL_OPENCV {camera.width} {camera.height} {params}")
        pose = " ".join(repr(float(v)) for v in (*quaternion(camera.R), *camera.t))
        images.append(f"{i + 1} {pose} {10 + i} {camera.name}.jpg")
        images.append("12.5 3.25 -1 7.0 8.0 5" if i % 2 else "")
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")


def write_colmap_binary(folder: Path, cameras: Sequence[Camera]) -> None:
    folder.mkdir(parents=True)
    data = struct.pack("<Q", len(cameras))
    images = struct.pack("<Q", len(cameras))
    for i, camera in enumerate(cameras):
        data += struct.pack("<iiQQ", i, 6, camera.width, camera.height)
        data += struct.pack("<12d", *colmap_params(camera))
        images += struct.pack("<i7di", i, *quaternion(camera.R), *camera.t, i)
        images += f"{camera.name}.png".encode() + b"\0"
        images += struct.pack("<Q", 2) + 2 * struct.pack("<ddq", 1.0, 2.0, -1)
    (folder / "cameras.bin").write_bytes(data)
    (folder / "images.bin").write_bytes(images)


def write_transforms(path: Path, cameras: Sequence[Camera]) -> None:
    """nerfstudio: camera to world, x right, y up, z backwards."""
    frames = []
    for camera in cameras:
        right, down, forward = camera.R
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, -down, -forward, camera.center], axis=1)
        k1, k2, p1, p2, k3 = camera.distortion
        frame = {"file_path": f"images/{camera.name}.png", "transform_matrix": matrix.tolist()}
        frame |= {"w": camera.width, "h": camera.height}
        frame |= {"fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1]}
        frame |= {"cx": camera.K[0, 2] + 0.5, "cy": camera.K[1, 2] + 0.5}
        frames.append(frame | {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))


CHUNK_R = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])
CHUNK_T, CHUNK_SCALE = np.array([3.9, 1.6, 1.0]), 1.357


def write_metashape(path: Path, cameras: Sequence[Camera], component: bool = False) -> None:
    """Camera to chunk, x right, y down, z forward; world = scale R chunk + t; p1, p2 as Agisoft's.

    u = w/2 + cx + x' f + x' b1 + y' b2, v = h/2 + cy + y' f.
    """

    def words(values: np.ndarray) -> str:
        return " ".join(repr(float(v)) for v in np.ravel(values))

    world = (
        f"<transform><rotation locked='false'>{words(CHUNK_R)}</rotation><translation>"
        f"{words(CHUNK_T)}</translation><scale>{CHUNK_SCALE!r}</scale></transform>"
    )
    sensors, entries = "", ""
    for i, camera in enumerate(cameras):
        k1, k2, p1, p2, k3 = camera.distortion
        K, w, h = camera.K, camera.width, camera.height
        values = {"f": K[1, 1], "cx": K[0, 2] + 0.5 - w / 2, "cy": K[1, 2] + 0.5 - h / 2}
        values |= {"b1": K[0, 0] - K[1, 1], "b2": K[0, 1], "k1": k1, "k2": k2, "k3": k3}
        values |= {"p1": p2, "p2": p1}
        inner = "".join(f"<{k}>{float(v)!r}</{k}>" for k, v in values.items())
        sensors += (
            f'<sensor id="{i}" label="{camera.name}" type="frame"><resolution width="{w}" '
            f'height="{h}"/><calibration type="frame" class="initial"><f>1</f></calibration>'
            f'<calibration type="frame" class="adjusted"><resolution width="{w}" height="{h}"/>'
            f"{inner}</calibration></sensor>"
        )
        pose = np.eye(4)
        pose[:3, :3] = CHUNK_R.T @ camera.R.T
        pose[:3, 3] = CHUNK_R.T @ (camera.center - CHUNK_T) / CHUNK_SCALE
        entries += (
            f'<camera id="{i}" sensor_id="{i}" component_id="0" label="{camera.name}">'
            f"<transform>{words(pose)}</transform></camera>"
        )
    entries += f'<camera id="{len(cameras)}" sensor_id="0" label="lost"/>'
    components = f"<components><component id='0'>{world}</component></components>"
    path.write_text(
        f'<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1">'
        f"<sensors>{sensors}</sensors>{components if component else ''}"
        f"<cameras>{entries}</cameras>{'' if component else world}"
        f'<reference>LOCAL_CS["Local CS",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]</reference>'
        f"</chunk></document>"
    )


def write_opencv(folder: Path, cameras: Sequence[Camera]) -> None:
    """By OpenCV itself, a file for each camera; half of them with a Rodrigues vector."""
    folder.mkdir(parents=True)
    for i, camera in enumerate(cameras):
        storage = cv2.FileStorage(str(folder / f"{camera.name}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", camera.width)
        storage.write("image_height", camera.height)
        storage.write("camera_matrix", camera.K)
        storage.write("distortion_coefficients", camera.distortion[None])
        if i % 2:
            storage.write("R", camera.R)
            storage.write("T", camera.t[:, None])
        else:
            storage.write("rvec", cv2.Rodrigues(camera.R)[0])
            storage.write("tvec", camera.t)
        storage.release()


def write_opencv_json(path: Path, cameras: Sequence[Camera]) -> None:
    """By OpenCV itself, a map for each camera in one file."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for camera in cameras:
        storage.startWriteStruct(camera.name, cv2.FILE_NODE_MAP)
        storage.write("image_width", camera.width)
        storage.write("image_height", camera.height)
        storage.write("camera_matrix", camera.K)
        storage.write("distortion_coefficients", camera.distortion[None])
        storage.write("R", camera.R)
        storage.write("T", camera.t[:, None])
        storage.endWriteStruct()
    storage.release()


def write_map(path: Path, cameras: Sequence[Camera]) -> None:
    """A map for each camera with its camera-to-world pose."""
    out = {}
    for camera in cameras:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.R.T, camera.center
        out[camera.name] = {"K": camera.K.tolist(), "dist": [camera.distortion.tolist()]}
        out[camera.name] |= {"width": camera.width, "height": camera.height, "pose": pose.tolist()}
    path.write_text(json.dumps(out))


def write_calib(path: Path, cameras: Sequence[Camera]) -> None:
    """In millimetres, through a sensor 10 mm wide; k1, k2, p2, p1, k3."""
    lines = ["tc camera calibration v0.3"]
    for i, camera in enumerate(cameras):
        K, w, h = camera.K, camera.width, camera.height
        k1, k2, p1, p2, k3 = camera.distortion
        high = 10.0 * h / w
        lines += [f"camera\t{i}\tCamera_{i + 1}", "\tframe\t0"]
        lines.append(f"\t\tsensorSize\t10.0 {high!r}\t# in mm")
        lines.append(f"\t\tfocalLength\t{float(10 * K[0, 0] / w)!r}   # in mm")
        lines.append(f"\t\tpixelAspect {float(K[1, 1] / K[0, 0])!r} # y / x")
        cx, cy = (K[0, 2] + 0.5 - w / 2) / w * 10, (K[1, 2] + 0.5 - h / 2) / h * high
        lines.append(f"\t\tcenterOffset {float(cx)!r} {float(cy)!r} # in mm")
        lines.append("\t\tdistortionModel\tOpenCV")
        lines.append("\t\tdistortion " + " ".join(repr(float(v)) for v in (k1, k2, p2, p1, k3)))
        for name, value in (
            ("origin", 1000 * camera.center),
            ("up", -camera.R[1]),
            ("right", camera.R[0]),
        ):
            lines.append(f"\t\t{name} " + " ".join(repr(float(v)) for v in value))
        lines.append("#    extrinsics")
    path.write_text("\n".join(lines) + "\n")


def write_rig(path: Path, cameras: list[Camera], change: Callable[[str], str] = str) -> None:
    """Metashape's XML of a rig: the first camera the master, the others by their sensors' offsets
    to it; a component turned by 90 degrees about z, scaled by 2 and moved."""

    def text(values: np.ndarray) -> str:
        return " ".join(repr(float(v)) for v in values.ravel())

    def pose(camera: Camera) -> np.ndarray:
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = camera.R.T, camera.center
        return out

    turn, move = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.array([0.3, 0.2, 0.1])
    inner = [np.eye(4) for _ in cameras]
    for matrix, camera in zip(inner, cameras, strict=True):  # world to component
        matrix[:3, :3] = turn.T @ camera.R.T
        matrix[:3, 3] = turn.T @ (camera.center - move) / 2
    sensors = entries = ""
    for i, camera in enumerate(cameras):
        offset = np.linalg.inv(inner[0]) @ inner[i]
        rig = (
            f"<rotation>{text(offset[:3, :3])}</rotation><location>{text(offset[:3, 3])}</location>"
        )
        K, (k1, k2, p1, p2, k3) = camera.K, camera.distortion
        of_master = ' master_id="0"' if i else ""
        sensors += f"""<sensor id="{i}"{of_master} type="frame"><calibration type="frame">
<resolution width="{camera.width}" height="{camera.height}"/><f>{float(K[1, 1])!r}</f>
<b1>{float(K[0, 0] - K[1, 1])!r}</b1><cx>{float(K[0, 2] + 0.5 - camera.width / 2)!r}</cx>
<cy>{float(K[1, 2] + 0.5 - camera.height / 2)!r}</cy><k1>{k1}</k1><k2>{k2}</k2><k3>{k3}</k3>
<p1>{p2}</p1><p2>{p1}</p2></calibration>{rig if i else ""}</sensor>"""
        place = "" if i else f"<transform>{text(inner[0])}</transform>"
        entries += f"""<camera id="{i}" sensor_id="{i}" component_id="0"{of_master}
 label="{camera.name}">{place}</camera>"""
    path.write_text(
        change(f"""<document><chunk><sensors>{sensors}</sensors><components active_id="0">
<component id="0"><transform>
<rotation>{text(turn)}</rotation><translation>{text(move)}</translation>
<scale>2</scale></transform></component></components><cameras>{entries}</cameras>
<reference>LOCAL_CS["Local",UNIT["metre",1]]</reference></chunk></document>""")
    )


def write_easymocap(folder: Path, cameras: list[Camera], *, vectors=True, sizes=True) -> None:
    """By EasyMocap's own text: six digits, CRLF (camera_utils.FileStorage)."""
    folder.mkdir()
    files = {"intri.yml": "", "extri.yml": ""}

    def put(file: str, key: str, value: np.ndarray) -> None:
        data = ", ".join(f"{v:.6f}" for v in value.ravel())
        files[file] += f"{key}: !!opencv-matrix\r\n  rows: {len(value)}\r\n"
        files[file] += f"  cols: {value.shape[1]}\r\n  dt: d\r\n  data: [{data}]\r\n"

    for i, camera in enumerate(cameras):
        name = f"{i + 1:02d}"
        put("intri.yml", f"K_{name}", camera.K)
        put("intri.yml", f"{'dist' if i % 2 else 'D'}_{name}", camera.distortion[None])
        if sizes:
            files["intri.yml"] += f"H_{name}: {camera.height}\r\nW_{name}: {camera.width}\r\n"
        if vectors:
            put("extri.yml", f"R_{name}", cv2.Rodrigues(camera.R)[0])
        put("extri.yml", f"Rot_{name}", camera.R)
        put("extri.yml", f"T_{name}", camera.t[:, None])
    names = "".join(f'  - "{i + 1:02d}"\r\n' for i in range(len(cameras)))
    for file, text in files.items():
        (folder / file).write_text(f"%YAML:1.0\r\n---\r\nnames:\r\n{names}{text}", newline="")


def stage() -> list[Camera]:
    """Six cameras about the origin, tilted, one upright, half of them through a lens."""
    out = []
    for i in range(6):
        angle = 1.1 * i
        position = [np.cos(angle), np.sin(angle), 0.3 * np.sin(2 * angle)]
        camera = Camera.look_at(f"cam_{i:02d}", 640, 480, position, [0, 0, 0.01], 30, 17.0 * i)
        K = camera.K * [[1, 1, 1], [1, 1.01, 1], [1, 1, 1]] + [[0, 0, 4.2], [0, 0, -7.3], [0, 0, 0]]
        out.append(replace(camera, K=K, distortion=LENS * (i % 2)))
    return out
