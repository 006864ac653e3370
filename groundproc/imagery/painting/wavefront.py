"""Textured triangles as OBJ with its MTL and pictures (Wavefront): z up, metres, from an origin that stands in the file's head."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from groundproc.files import written_aside
from groundproc.imagery.painting.gltf import Piece


def pictures_of(path: Path, count: int) -> list[Path]:
    """The pictures that stand beside an OBJ file."""
    return [path.with_name(f"{path.stem}_{number:03d}.jpg") for number in range(count)]


def write_obj(path: Path, pieces: Sequence[Piece], head: Sequence[str]) -> None:
    """Write the file, and the others beside it, this one last; `head`: lines of comment."""
    materials = path.with_suffix(".mtl")
    named = pictures_of(path, len(pieces))
    for picture, piece in zip(named, pieces, strict=True):
        with written_aside(picture) as aside:
            aside.write_bytes(piece.jpeg)
    with written_aside(materials) as aside:
        entries = [
            f"newmtl m{number}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 0\nmap_Kd {picture.name}\n"
            for number, picture in enumerate(named)
        ]
        aside.write_text("\n".join(entries), encoding="utf-8")
    first = 1
    with written_aside(path) as aside, aside.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"# {line}\n" for line in head)
        file.write(f"mtllib {materials.name}\n")
        for number, piece in enumerate(pieces):
            file.write(f"o part{number}\nusemtl m{number}\n")
            np.savetxt(file, piece.vertex_m, "v %.4f %.4f %.4f")
            np.savetxt(file, np.stack([piece.uv[:, 0], 1.0 - piece.uv[:, 1]], axis=1), "vt %.6f %.6f")
            corner = np.repeat(piece.triangle + first, 2, axis=1)
            np.savetxt(file, corner, "f %d/%d %d/%d %d/%d")
            first += len(piece.vertex_m)
