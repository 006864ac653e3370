"""Textured triangles as a binary glTF 2.0 file (Khronos, glTF 2.0 specification, section 4): y up, metres, from an origin."""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.files import written_aside

_FLOAT: Final = 5126
_UNSIGNED: Final = 5125
_VERTICES: Final = 34962
_INDICES: Final = 34963
_CLAMP: Final = 33071
_LINEAR: Final = 9729
_SMOOTH: Final = 9987
_GLB: Final = 0x46546C67
_JSON: Final = 0x4E4F534A
_BIN: Final = 0x004E4942


@dataclass(frozen=True, slots=True)
class Piece:
    """Triangles with one texture.

    Attributes
    ----------
    vertex_m : ndarray, shape (v, 3)
        East, north, up from the origin.
    uv : ndarray of float32, shape (v, 2)
        Right and down, 0 to 1.
    triangle : ndarray of int64, shape (t, 3)
    jpeg : bytes
        The texture.
    """

    vertex_m: npt.NDArray[np.float64]
    uv: npt.NDArray[np.float32]
    triangle: npt.NDArray[np.int64]
    jpeg: bytes


def write_glb(path: Path, pieces: Sequence[Piece], told: dict[str, Any]) -> None:
    """Write a file; `told` stands in `asset.extras`.

    Photographs hold the light of the day already, so materials ask not to be lit again (KHR_materials_unlit).
    """
    data = bytearray()
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []

    def view(content: bytes, **more: int) -> int:
        data.extend(b"\0" * (-len(data) % 4))
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(content)} | more)
        data.extend(content)
        return len(views) - 1

    def accessor(values: npt.NDArray[Any], kind: str, component: int, target: int, bounds: bool = False) -> int:
        entry: dict[str, Any] = {
            "bufferView": view(values.tobytes(), target=target), "componentType": component, "count": len(values), "type": kind,
        }  # fmt: skip
        if bounds:
            entry |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        accessors.append(entry)
        return len(accessors) - 1

    primitives, images = [], []
    for number, piece in enumerate(pieces):
        up = piece.vertex_m[:, [0, 2, 1]].astype("<f4")
        up[:, 2] *= -1.0
        attributes = {
            "POSITION": accessor(up, "VEC3", _FLOAT, _VERTICES, bounds=True),
            "TEXCOORD_0": accessor(piece.uv.astype("<f4"), "VEC2", _FLOAT, _VERTICES),
        }
        indices = accessor(piece.triangle.astype("<u4").reshape(-1), "SCALAR", _UNSIGNED, _INDICES)
        primitives.append({"attributes": attributes, "indices": indices, "material": number})
        images.append({"bufferView": view(piece.jpeg), "mimeType": "image/jpeg"})
    looks = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    tree = {
        "asset": {"version": "2.0", "generator": "swath", "extras": told},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "surface"}],
        "meshes": [{"primitives": primitives}],
        "materials": [
            {"pbrMetallicRoughness": looks | {"baseColorTexture": {"index": number}}, "extensions": {"KHR_materials_unlit": {}}}
            for number in range(len(pieces))
        ],
        "textures": [{"source": number, "sampler": 0} for number in range(len(pieces))],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _SMOOTH, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": images,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data) + -len(data) % 4}],
    }  # fmt: skip
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data.extend(b"\0" * (-len(data) % 4))
    with written_aside(path) as aside, aside.open("wb") as file:
        file.write(struct.pack("<III", _GLB, 2, 12 + 8 + len(text) + 8 + len(data)))
        file.write(struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", len(data), _BIN))
        file.write(data)
