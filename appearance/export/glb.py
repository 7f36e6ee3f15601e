"""Binary glTF 2.0 (Khronos Group): one JSON chunk, one buffer."""

from __future__ import annotations

import json
import struct
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import AnyFloats, Floats, Ints
from reconstruction.files.durable import write_whole

FLOAT, UINT = 5126, 5125
VERTICES, INDICES = 34962, 34963


class Glb:
    """Parts are added one after the other, then written."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": f"hairstage {version('hairstage')}"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            **{k: [] for k in ("nodes", "meshes", "materials", "accessors", "bufferViews")},
        }

    def mesh(
        self,
        name: str,
        vertices: AnyFloats,
        normals: AnyFloats,
        faces: Ints,
        uv: Floats | None = None,
        *,
        material: int,
    ) -> int:
        """Add a node with a mesh: `vertices`, `normals (V, 3)`, `faces (F, 3)`, `uv (V, 2)`."""
        attributes = {
            "POSITION": self._accessor(vertices.astype(np.float32), VERTICES, bounds=True),
            "NORMAL": self._accessor(normals.astype(np.float32), VERTICES),
        }
        if uv is not None:
            attributes["TEXCOORD_0"] = self._accessor(uv, VERTICES)
        indices = self._accessor(faces.ravel().astype(np.uint32), INDICES)
        part = {"attributes": attributes, "indices": indices, "material": material}
        mesh = self._add("meshes", {"name": name, "primitives": [part]})
        return self._add("nodes", {"name": name, "mesh": mesh})

    def hair_material(self, name: str, texture: Ints) -> int:
        """A two-sided material that is cut out by the alpha of `texture (H, W, 4)`, BGRA."""
        _, png = cv2.imencode(".png", texture)
        view = self._view(png.tobytes())
        image = self._add("images", {"name": name, "mimeType": "image/png", "bufferView": view})
        sampler = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}
        samplers = self._json.setdefault("samplers", [sampler])
        source = {"source": image, "sampler": samplers.index(sampler)}
        base = {"baseColorTexture": {"index": self._add("textures", source)}}
        return self._add(
            "materials",
            {
                "name": name,
                "pbrMetallicRoughness": {**base, "metallicFactor": 0.0, "roughnessFactor": 0.5},
                "alphaMode": "MASK",
                "alphaCutoff": 0.5,
                "doubleSided": True,
            },
        )

    def skin_material(self, albedo: tuple[float, float, float]) -> int:
        """A rough material of a linear colour."""
        rough = {"baseColorFactor": [*albedo, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
        return self._add("materials", {"name": "skin", "pbrMetallicRoughness": rough})

    def levels(self, nodes: list[int]) -> None:
        """Put levels of detail into the scene, the finest first."""
        if len(nodes) > 1:
            self._json["extensionsUsed"] = ["MSFT_lod"]
            self._json["nodes"][nodes[0]]["extensions"] = {"MSFT_lod": {"ids": nodes[1:]}}
            coverage = [0.5 / 4**i for i in range(len(nodes))]
            self._json["nodes"][nodes[0]]["extras"] = {"MSFT_screencoverage": coverage}
        self.root(nodes[0])

    def root(self, node: int) -> None:
        """Put a node into the scene."""
        self._json["scenes"][0]["nodes"].append(node)

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        self._json["buffers"] = [{"byteLength": len(self._data)}]
        text = json.dumps(self._json, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self._data), b"BIN\0") + bytes(self._data)
        write_whole(path, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)

    def _add(self, kind: str, item: dict[str, Any]) -> int:
        items = self._json.setdefault(kind, [])
        items.append(item)
        return len(items) - 1

    def _view(self, data: bytes, target: int | None = None) -> int:
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self._data += data + bytes(-len(data) % 4)
        return self._add("bufferViews", view if target is None else {**view, "target": target})

    def _accessor(self, values: NDArray[Any], target: int, *, bounds: bool = False) -> int:
        width = 1 if values.ndim == 1 else values.shape[1]
        accessor: dict[str, Any] = {
            "bufferView": self._view(np.ascontiguousarray(values).tobytes(), target),
            "componentType": FLOAT if values.dtype == np.float32 else UINT,
            "count": len(values),
            "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3"}[width],
        }
        if bounds:
            accessor["min"] = values.min(axis=0).tolist()
            accessor["max"] = values.max(axis=0).tolist()
        return self._add("accessors", accessor)
