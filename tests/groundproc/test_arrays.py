from pathlib import Path

import numpy as np
import pytest
import seeds

from flightlog.errors import LogError
from groundproc.arrays import read_arrays


def test_arrays_are_read_as_numpy_reads_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    whole = {
        "a": rng.normal(size=(7, 3)), "b": np.asfortranarray(rng.normal(size=(4, 5))), "c": np.arange(5, dtype=">i2"),
        "d": np.array(["x", "yz"]), "e": np.float64(3.5), "f": np.empty((0, 3)),
    }  # fmt: skip
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **whole)
        found = read_arrays(tmp_path / "a.npz")
        assert found.keys() == whole.keys()
        for name, values in whole.items():
            assert found[name].dtype == np.asarray(values).dtype
            assert np.array_equal(found[name], values)


@pytest.mark.parametrize("shape", ["(1000000000000, 5)", "(11,)", "(-1, 5)", "'x'"])
def test_an_array_larger_than_its_entry_is_refused(tmp_path: Path, shape: str) -> None:
    (tmp_path / "a.npz").write_bytes(seeds.npz_bomb(shape))
    with pytest.raises(LogError, match=r"a\.npz: is no file of arrays"):
        read_arrays(tmp_path / "a.npz")


def test_an_archive_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(9 << 20))
    with pytest.raises(LogError, match="unpacks to"):
        read_arrays(tmp_path / "a.npz")


def test_objects_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", a=np.array([{}], object))
    with pytest.raises(LogError, match="is no file of arrays"):
        read_arrays(tmp_path / "a.npz")
