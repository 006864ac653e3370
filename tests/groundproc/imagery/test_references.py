"""What bands are put on a scale of reflectance by, where there are no panels: the light on the ground, and the lidar's own reflectance."""

import base64
import struct
from dataclasses import replace
from pathlib import Path

import hamlet
import laspy
import numpy as np
import numpy.typing as npt
import pytest

from groundproc.cli import main
from groundproc.imagery import irradiance
from groundproc.imagery.irradiance import lit
from groundproc.imagery.lidarreference import GREY, lines

Array = npt.NDArray[np.float64]

XMP = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description {}/></x:xmpmeta>'
SCENE = hamlet.hamlet()
LENS = hamlet.Lens("small", 320, 240, 256.0, bands=("red",), more={"black_level": 4096})
SUN = (1.0, 0.6, 0.35, 0.8, 0.5, 0.9, 0.4, 0.7, 0.55)
"""Of each moment: clouds pass."""
FACTOR = {"red": 1.4, "nir": 0.8}


def words(**tags: str) -> str:
    return XMP.format(" ".join(f'Camera:{name}="{value}"' for name, value in tags.items()))


def picture(path: Path, **tags: str) -> Path:
    path.write_bytes(b"II*\0" + words(**tags).encode())
    return path


def readings(*values: tuple[int, int, int]) -> str:
    """Count, step of the gain and time [ms] of each, as the Sequoia packs them."""
    packed = b"".join(
        struct.pack("<Q4H3f", n, count, 7, step, ms, 0.0, 0.0, 0.0) for n, (count, step, ms) in enumerate(values)
    )
    return "&#xA;" + base64.b64encode(packed).decode()


def test_the_sunshine_sensor_counts_by_its_time_and_the_gain_of_its_step(tmp_path: Path) -> None:
    table = "0,600,35,17,1,600,857,437,2,600,14302,7152,3,600,65535,65535"
    one = picture(tmp_path / "a.tif", IrradianceList=readings((645, 1, 100)), IrradianceCalibrationMeasurement=table)
    other = picture(
        tmp_path / "b.tif", IrradianceList=readings((10764, 2, 100)), IrradianceCalibrationMeasurement=table
    )
    first, second = lit(one, 1e-3, 100.0), lit(other, 1e-3, 100.0)
    assert first is not None
    assert second is not None
    assert first.irradiance == pytest.approx(6.45)
    assert second.irradiance == pytest.approx(10764 / 100 / (14302 / 857))
    assert np.isnan(first.factor)


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"Irradiance": "500.5", "SensorGainAdjustment": "1.2"}, (500.5, 1.2)),
        ({"HorizontalIrradiance": "80", "Irradiance": "70", "RadiometricCalibration": "2e-4,0,0"}, (80.0, 2e-4)),
        ({"Irradiance": "3", "SensorModel": "200,10,0"}, (3.0, 1 / 200)),
    ],
    ids=["DJI", "MicaSense", "Parrot"],
)
def test_makers_say_how_their_bands_compare(
    tmp_path: Path, tags: dict[str, str], expected: tuple[float, float]
) -> None:
    found = lit(picture(tmp_path / "a.tif", **tags), 1e-3, 100.0)
    assert found is not None
    assert (found.irradiance, found.factor) == pytest.approx(expected)


@pytest.mark.parametrize("value", ["", "nan", "0", "-3", "many"])
def test_what_is_no_irradiance_is_none(tmp_path: Path, value: str) -> None:
    assert lit(picture(tmp_path / "a.tif", Irradiance=value, IrradianceList="%%%"), 1e-3, 100.0) is None


def test_rows_of_a_micasense_picture_differ_as_it_says() -> None:
    more = irradiance.rows({"RadiometricCalibration": "1e-4,1e-7,2e-5"}, 101, 1e-3)
    assert more is not None
    assert more[100, 0, 0] == pytest.approx(1.0 + 1e-7 * 100 / 1e-3 - 2e-5 * 100)
    assert irradiance.rows({}, 101, 1e-3) is None


def test_four_bands_of_a_sequoia_say_that_the_light_fell_alike(recordings: Path) -> None:
    """Between two moments five seconds apart, under one sky: by 1 %, each band by its own sensor."""
    folder = recordings / "images" / "garfield" / "msp"
    falls = []
    for band in ("GRE", "RED", "REG", "NIR"):
        found = [lit(path, 1e-3, 100.0) for path in sorted(folder.glob(f"*_{band}.TIF"))]
        first, last = (each.irradiance for each in found if each is not None)
        falls.append(last / first - 1.0)
    assert np.allclose(falls, -0.01, rtol=0, atol=0.002)


def reflectances(places: Array, kind: npt.NDArray[np.int64]) -> Array:
    """Red and near infrared: a meadow, a road of asphalt, roofs."""
    x, y = places[:, 0], places[:, 1]
    found = np.stack([0.08 + 0.03 * np.sin(0.5 * x), 0.4 + 0.12 * np.cos(0.4 * y)], axis=1)
    found[np.abs(x - y) < 2.0] = 0.2 * GREY, 0.2
    found[kind == hamlet.ROOF] = 0.25, 0.35
    return found


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cloud with reflectance of 15 % noise, and two bands under a sun that comes and goes."""
    folder, rng = tmp_path_factory.mktemp("lit"), np.random.default_rng(3)
    true, kind = SCENE.sampled(40.0, rng)
    hamlet.write_cloud(folder / "plain.laz", true + rng.normal(0.0, 0.015, true.shape))
    las = laspy.read(folder / "plain.laz")
    known = reflectances(true, kind)[:, 1] * rng.normal(1.0, 0.15, len(true))
    las.add_extra_dim(laspy.ExtraBytesParams("reflectance", np.float32))
    las.reflectance = known.astype(np.float32)
    las.write(folder / "cloud.laz")
    rows, rigs = [], []
    (folder / "images").mkdir()
    for plane, band in enumerate(FACTOR):
        lens = replace(LENS, name=band, bands=(band,))
        flown = hamlet.flown([(lens, 0.0, 0.0)], step=8.0, half=8.0)
        shots = [
            replace(shot, exposure=(0.9 * sun / FACTOR[band],), exif={33434: 1e-3})
            for shot, sun in zip(flown, SUN, strict=True)
        ]

        def one(places: Array, kind: npt.NDArray[np.int64], plane: int = plane) -> Array:
            return reflectances(places, kind)[:, plane : plane + 1]

        hamlet.write_block(folder / "images", SCENE, shots, one, 60_000.0, 4096.0, 0.01, "tif", plane)
        rows.append((folder / "images" / "poses.csv").read_text().splitlines())
        rigs.append((folder / "images" / "rig.yaml").read_text())
    (folder / "images" / "poses.csv").write_text("\n".join([*rows[0], *rows[1][1:]]) + "\n")
    (folder / "images" / "rig.yaml").write_text("".join(rigs))
    np.savez(folder / "truth.npz", true=true, kind=kind)
    return folder


def told(folder: Path, compared: bool) -> None:
    """Pictures say how the ground was lit, and how bands compare."""
    for band in FACTOR:
        for number, (path, sun) in enumerate(zip(sorted((folder / "images" / band).glob("*.tif")), SUN, strict=True)):
            whole = path.read_bytes().split(b"<x:xmpmeta")[0]
            tags = {"Irradiance": f"{1234.0 * sun:.3f}"} | (
                {"SensorGainAdjustment": str(FACTOR[band])} if compared else {}
            )
            path.write_bytes(whole + words(**tags).encode())
            assert number < len(SUN)


def error(folder: Path, *more: str) -> float:
    """Median of what the index of the ground is off."""
    out = folder / "out.laz"
    arguments = [
        "--images",
        str(folder / "images"),
        "--gsd",
        "0.3",
        "-o",
        str(folder / "i.tif"),
        "--cloud",
        str(out),
        "--force",
    ]
    assert main(["ndvi", str(folder / "cloud.laz"), *arguments, *more]) == 0
    truth, las = np.load(folder / "truth.npz"), laspy.read(out)
    red, nir = reflectances(truth["true"], truth["kind"]).T
    found = np.asarray(las.ndvi)
    ground = np.isfinite(found) & (truth["kind"] == hamlet.GROUND)
    return float(np.median(np.abs(found - (nir - red) / (nir + red))[ground]))


def test_irradiance_puts_a_flight_under_passing_clouds_on_one_scale(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told(place, compared=True)
    assert error(place) < 0.02
    assert "by irradiance" in capsys.readouterr().out


def test_the_lidar_puts_bands_on_its_own_scale(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Irradiance takes the clouds out; the bands are a factor of 1.75 apart, which nobody says."""
    told(place, compared=False)
    assert error(place, "--reference", "lidar") < 0.02
    said = capsys.readouterr()
    assert "by lidar" in said.out
    assert "red is put on the lidar's scale by the greyest ground" in said.err


def test_a_reference_that_is_not_there_is_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told(place, compared=False)
    words = ["--images", str(place / "images"), "--gsd", "0.5", "-o", str(place / "n.tif"), "--reference"]
    assert main(["ndvi", str(place / "cloud.laz"), *words, "irradiance"]) == 2
    assert "how the maker's bands compare" in capsys.readouterr().err
    assert not (place / "n.tif").exists()


def test_a_line_to_the_lidar_is_found_in_noise_and_past_shadows() -> None:
    rng = np.random.default_rng(5)
    true = rng.uniform(0.1, 0.6, 20_000)
    shade = np.where(rng.random(len(true)) < 0.05, 0.3, 1.0)
    light = {"nir": shade * (true + 0.02) / 1.7, "red": shade * np.where(true < 0.2, GREY * true, 0.3 * true) / 2.3}
    found = lines(light, true * rng.normal(1.0, 0.15, len(true)))
    assert found is not None
    assert found["nir"].gain * 0.3 / 1.7 + found["nir"].offset == pytest.approx(0.28, rel=0.03)
    assert found["red"].gain == pytest.approx(2.3, rel=0.08)
    assert lines({"red": light["red"]}, true) is None
