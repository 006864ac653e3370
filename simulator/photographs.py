"""Photographs of a flight: what each camera sees, as files with EXIF, beside the rig as it is believed, and what is true of both."""

import io
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import yaml
from PIL import Image

from flightlog.constants import NS_PER_S
from simulator.cameras import Camera, Exposure, exposures
from simulator.chance import generator
from simulator.clocks import Clocks
from simulator.flight import Flight
from simulator.geodesy import Origin, geodetic
from simulator.grid import on_grid
from simulator.optics import EQUIDISTANT, rays
from simulator.parts import World
from simulator.rays import Surfaces
from simulator.rigfile import KELVIN, KELVIN_STEP, angles_deg, entry
from simulator.textures import BANDS, SKY, TABLE_OF_LOOKS, TEMPERATURE, appearance, light

Array = npt.NDArray[np.float64]

WHITE: Final = 0.7
"""Albedo in full sun that fills the scale at an exposure of 1."""
_ROWS: Final = 32
_EXPOSURE_S: Final = 1.0 / 1250.0
_ISO, _F_NUMBER = 100, 4.0
_STEP_M: Final = 10.0


class Studio:
    """A world with its cameras on a flight.

    Parameters
    ----------
    world : World
    surfaces : Surfaces
        Of that world.
    flight : Flight
    cameras : tuple of Camera
    clocks : Clocks
    origin : Origin
    seed : int
    """

    def __init__(
        self, world: World, surfaces: Surfaces, flight: Flight, cameras: tuple[Camera, ...], clocks: Clocks, origin: Origin, seed: int
    ) -> None:  # fmt: skip
        self.world, self.flight, self.cameras, self.clocks, self.origin = world, flight, cameras, clocks, origin
        self.surfaces, self.seed = surfaces, seed
        self.exposures = exposures(cameras, flight.duration_s)

    def name_of(self, one: Exposure) -> str:
        """Of the file."""
        camera = self.cameras[one.camera]
        return f"{camera.name}_{one.number + 1:04d}.{'jpg' if len(camera.options.bands) == 3 else 'png'}"

    def poses(self, camera: Camera, time_s: Array) -> tuple[Array, Array]:
        """Projection centres, shape (n, 3), and local from camera, shape (n, 3, 3)."""
        poses = self.flight.poses(time_s)
        mat = poses.mat_local_ins()
        return poses.position_m + mat @ camera.position_m, mat @ camera.mat_cam_ins.T

    def row_times_s(self, one: Exposure) -> Array:
        """When each row is exposed."""
        camera = self.cameras[one.camera]
        rows = np.arange(camera.options.height_px)
        return np.asarray(one.time_s + (rows - camera.middle_row_px) * camera.options.line_delay_s)

    def light(self, one: Exposure) -> Array:
        """What a perfect sensor behind the lens sees, shape (height, width, bands)."""
        camera = self.cameras[one.camera]
        o = camera.options
        place, mat = self.poses(camera, self.row_times_s(one))
        bands = np.array([BANDS.index(band) for band in o.bands])
        out = np.empty((o.height_px, o.width_px, len(bands)))
        fish_eye, numbers = o.distortion_model == EQUIDISTANT, camera.lens.numbers()
        per_pixel = o.samples**2
        for first in range(0, o.height_px, _ROWS):
            mats = np.ascontiguousarray(mat[first : first + _ROWS])
            directions = np.empty((len(mats) * o.width_px * per_pixel, 3))
            rays(fish_eye, numbers, first, mats, o.width_px, o.samples, directions)
            origins = np.repeat(place[first : first + _ROWS], o.width_px * per_pixel, axis=0).astype(np.float32)
            hits = self.surfaces.opaque(origins, directions.astype(np.float32))
            values = np.empty((len(mats) * o.width_px, len(bands)))
            light(
                origins, directions, hits, self.surfaces.planes, self.world.material, 1.0 / numbers[0], SKY, TABLE_OF_LOOKS,
                bands, values,
            )  # fmt: skip
            out[first : first + _ROWS] = values.reshape(len(mats), o.width_px, len(bands))
        return out

    def exposure_of(self, one: Exposure) -> float:
        """Factor of an image's exposure time."""
        rng = generator(self.seed, f"exposure {self.cameras[one.camera].name}", one.number)
        return float(np.exp(self.cameras[one.camera].options.exposure_spread * rng.standard_normal()))

    def picture(self, one: Exposure) -> npt.NDArray[Any]:
        """Numbers of the sensor: of 8 bit with three bands, of 16 with one."""
        o = self.cameras[one.camera].options
        rng = generator(self.seed, f"pixels {self.cameras[one.camera].name}", one.number)
        seen = self.light(one)
        if o.bands == (BANDS[TEMPERATURE],):
            noisy = seen[:, :, 0] + o.temperature_noise_k * rng.standard_normal(seen.shape[:2])
            return np.clip(np.rint((noisy + KELVIN) / KELVIN_STEP), 0, 65535).astype(np.uint16)
        share = self.exposure_of(one) / WHITE * seen * _falloff(o.vignetting, seen.shape)[:, :, None]
        share = o.black_level + (1.0 - o.black_level) * np.clip(share, 0.0, 1.0)
        if o.transfer == "srgb":
            share = np.where(share <= 0.0031308, 12.92 * share, 1.055 * np.maximum(share, 1e-9) ** (1.0 / 2.4) - 0.055)
        share += o.noise * rng.standard_normal(share.shape)
        full, kind = (255.0, np.uint8) if len(o.bands) == 3 else (65535.0, np.uint16)
        numbers: npt.NDArray[Any] = np.rint(full * np.clip(share, 0.0, 1.0)).astype(kind)
        return numbers if len(o.bands) == 3 else numbers[:, :, 0]

    def write(self, one: Exposure, folder: Path) -> None:
        """Render an image and write its file."""
        camera = self.cameras[one.camera]
        image = Image.fromarray(self.picture(one))
        data = io.BytesIO()
        if len(camera.options.bands) == 3:
            image.save(data, "JPEG", quality=camera.options.quality, subsampling=0, exif=self._exif(one))
        else:
            image.save(data, "PNG", exif=self._exif(one))
        (folder / self.name_of(one)).write_bytes(data.getvalue())

    def _exif(self, one: Exposure) -> Image.Exif:
        camera = self.cameras[one.camera]
        o = camera.options
        shows_ns = int(self.clocks.utc.shows_ns(one.time_s)) + round(o.clock_offset_s * NS_PER_S)
        moment = datetime.fromtimestamp(shows_ns // NS_PER_S, UTC).strftime("%Y:%m:%d %H:%M:%S")
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "swath", f"simulated {camera.name}"
        detail = exif.get_ifd(0x8769)
        detail[0x9003] = moment
        if o.clock_digits:
            detail[0x9291] = f"{shows_ns % NS_PER_S:09d}"[: o.clock_digits]
        detail[0x829A], detail[0x829D], detail[0x8827] = _EXPOSURE_S * self.exposure_of(one), _F_NUMBER, _ISO
        return exif

    def write_all(self, folder: Path, workers: int, progress: Callable[[float], object] | None = None) -> None:
        """All images, `rig.yaml`, and below `truth/` the poses and the rig as they are."""
        (folder / "truth").mkdir(parents=True)
        with ThreadPoolExecutor(workers) as pool:
            for _ in pool.map(lambda one: self.write(one, folder), self.exposures):
                if progress is not None:
                    progress(1)
        for path, believed in ((folder / "rig.yaml", True), (folder / "truth" / "rig.yaml", False)):
            path.write_text(yaml.safe_dump(self.rig(believed), sort_keys=False), encoding="utf-8")
        (folder / "truth" / "poses.csv").write_text(self._poses_table(), encoding="utf-8")

    def rig(self, believed: bool = True) -> dict[str, Any]:
        """As rig.yaml holds it, in Kalibr's terms: as it is believed to be, or as it is."""
        return {camera.name: entry(camera, believed, len(self.cameras) > 1) for camera in self.cameras}

    def truth(self) -> dict[str, Any]:
        """What truth.json says of the cameras."""
        turned = {c.name: angles_deg(c.mat_cam_ins @ c.believed_mat.T) for c in self.cameras}
        return {
            c.name: {
                "boresight_deg": turned[c.name], "position_m": c.position_m.tolist(), "focal_px": c.lens.focal_px,
                "centre_px": list(c.lens.centre_px), "clock_offset_s": c.options.clock_offset_s,
                "feedback_delay_s": c.options.feedback_delay_s, "line_delay_s": c.options.line_delay_s,
                "images": len(c.exposures_s(self.flight.duration_s)),
            }
            for c in self.cameras
        }  # fmt: skip

    def on_grid(self, points_m: Array) -> Array:
        """Grid east, north and height above mean sea level of places, shape (n, 3)."""
        latitude, longitude, height = geodetic(points_m, self.origin)
        return np.column_stack([*on_grid(latitude, longitude), height])

    def _poses_table(self) -> str:
        """Columns of poses.csv; heights above mean sea level."""
        lines = ["image,utc_ns,easting,northing,height,omega_deg,phi_deg,kappa_deg"]
        for one in self.exposures:
            place, mat = self.poses(self.cameras[one.camera], np.array([one.time_s]))
            # the grid's axes at the place against the local frame's: convergence, and how the plumb line leans
            look = self._grid_axes(place[0]).T @ mat[0] @ np.diag([1.0, -1.0, -1.0])
            angles = np.degrees(
                [np.arctan2(-look[1, 2], look[2, 2]), np.arcsin(look[0, 2]), np.arctan2(-look[0, 1], look[0, 0])]
            )
            east, north, up = self.on_grid(place)[0]
            utc_ns = int(self.clocks.utc.shows_ns(one.time_s))
            words = ",".join(f"{angle:.7f}" for angle in angles)
            lines.append(f"{self.name_of(one)},{utc_ns},{east:.5f},{north:.5f},{up:.5f},{words}")
        return "\n".join(lines) + "\n"

    def _grid_axes(self, place_m: Array) -> Array:
        """Grid east, grid north and up at a place in the local frame, as columns: the rotation in the coordinates' derivatives."""
        steps = _STEP_M * np.eye(3)
        slope = (self.on_grid(place_m + steps) - self.on_grid(place_m - steps)).T / (2.0 * _STEP_M)
        u, _, v = np.linalg.svd(slope)
        return np.asarray((u @ v).T)

    def pixels_of(self, one: Exposure, points_m: Array) -> Array:
        """Where an image shows places, shape (n, 2), its shutter rolling; not a number where it does not see them."""
        camera = self.cameras[one.camera]
        o = camera.options
        pixels = np.tile([o.width_px / 2.0, camera.middle_row_px], (len(points_m), 1))
        place = np.empty((len(points_m), 3))
        for _ in range(4 if o.line_delay_s else 1):
            row = np.clip(np.nan_to_num(pixels[:, 1]), 0, o.height_px)
            place, mat = self.poses(camera, one.time_s + (row - camera.middle_row_px) * o.line_delay_s)
            pixels = camera.lens.project(np.einsum("nji,nj->ni", mat, points_m - place))
        inside = ((pixels >= 1.0) & (pixels <= np.array([o.width_px, o.height_px]) - 2.0)).all(axis=1)
        away = points_m - place
        distance = np.linalg.norm(away, axis=1)
        unit = away / distance[:, None]
        hits = self.surfaces.opaque(place.astype(np.float32), unit.astype(np.float32))
        planes = self.surfaces.planes[hits]
        with np.errstate(divide="ignore", invalid="ignore"):
            met = (planes[:, 3] - np.einsum("ni,ni->n", planes[:, :3], place)) / np.einsum(
                "ni,ni->n", planes[:, :3], unit
            )
        open_ = inside & (hits >= 0) & (np.abs(met - distance) < 0.03)
        return np.where(open_[:, None], pixels, np.nan)

    def albedo(self, points_m: Array, material: npt.NDArray[np.uint8], bands: tuple[str, ...]) -> Array:
        """True albedo, or degrees, of places of some material, shape (n, b)."""
        out = np.empty((len(points_m), len(bands)))
        numbers = np.array([BANDS.index(band) for band in bands])
        appearance(np.ascontiguousarray(points_m), material, np.zeros(len(points_m)), TABLE_OF_LOOKS, numbers, out)
        return out


def _falloff(vignetting: tuple[float, float, float], shape: tuple[int, ...]) -> Array:
    """How much light reaches each pixel, shape (height, width)."""
    height, width = shape[:2]
    y, x = np.mgrid[:height, :width]
    r2 = ((x - (width - 1) / 2) ** 2 + (y - (height - 1) / 2) ** 2) / (((width - 1) / 2) ** 2 + ((height - 1) / 2) ** 2)
    a, b, c = vignetting
    return np.asarray(np.maximum(1.0 + r2 * (a + r2 * (b + r2 * c)), 0.05))
