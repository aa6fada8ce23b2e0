"""Files that are damaged, endless, or larger than they look."""

import io
import json
import os
import zipfile

import numpy as np
import pytest

from cgemit.base.files import read_npz
from cgemit.base.settings import SettingsError
from cgemit.detector import DetectorError, load, read_field_map, write_field_map
from cgemit.particles.gun import Gun, generate
from cgemit.reconstruction.fit import FitSettings
from cgemit.tables import Table


@pytest.fixture
def table_file(tmp_path):
    path = tmp_path / "particles.npz"
    generate(Gun("mu-", p=1, theta=1), 20, seed=1).save(path)
    return path


@pytest.fixture
def map_file(tmp_path):
    r = z = np.linspace(0, 100, 5)
    return write_field_map(tmp_path / "map.npz", {"r": r, "z": z, "br": np.zeros((5, 5)), "bz": np.ones((5, 5))})


@pytest.mark.slow
def test_a_damaged_file_is_bad_input_wherever_the_damage_is(table_file, map_file):
    """Every byte of the directory and the headers, and many others, changed in several ways."""
    random = np.random.default_rng(1)
    for path, read, error in ((table_file, Table.load, ValueError), (map_file, read_field_map, DetectorError)):
        whole = path.read_bytes()
        same = refused = 0
        places = [*range(200), *range(len(whole) - 400, len(whole)), *random.integers(0, len(whole), 300)]
        for place in places:
            damaged = bytearray(whole)
            damaged[place] ^= int(random.integers(1, 256))
            path.write_bytes(damaged)
            try:
                read(path)
                same += 1
            except error:
                refused += 1
        for end in random.integers(0, len(whole), 40):
            path.write_bytes(whole[:end])
            with pytest.raises(error):
                read(path)
        assert refused > same


def npz(path, header, data, *, compressed):
    """Write an archive with one array of any header."""
    method = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, header)
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("x.npy", stream.getvalue() + data)
    return path


def test_sizes_are_checked_before_memory_is_asked_for(tmp_path):
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**13,)}
    with pytest.raises(ValueError, match="in 208 bytes"):
        read_npz(npz(tmp_path / "large.npz", header, b"0" * 80, compressed=False))
    bomb = npz(tmp_path / "bomb.npz", header | {"shape": (25_000_000,)}, bytes(200_000_000), compressed=True)
    assert bomb.stat().st_size < 1_000_000
    with pytest.raises(ValueError, match="that unpack to 2000001"):
        read_npz(bomb)
    good = npz(tmp_path / "good.npz", header | {"shape": (2,)}, bytes(16), compressed=True)
    np.testing.assert_array_equal(read_npz(good)["x"], [0.0, 0.0])
    np.savez(tmp_path / "object.npz", x=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="object"):
        read_npz(tmp_path / "object.npz")


def test_the_number_of_events_must_be_that_of_the_offsets(table_file, tmp_path):
    with np.load(table_file) as stored:
        arrays = {name: stored[name] for name in stored.files}
    about = json.loads(str(arrays.pop("__meta__"))) | {"n_events": 10**12}
    np.savez(tmp_path / "other.npz", __meta__=json.dumps(about), **arrays)
    with pytest.raises(ValueError, match=r"1000000000000 events, but 21 offsets"):
        Table.load(tmp_path / "other.npz")
    with pytest.raises(ValueError, match="n_events: is 1000000000000, expected 0 to"):
        Table.empty("truths", 10**12)


READERS = {Table.load: ValueError, read_field_map: DetectorError, FitSettings.load: SettingsError, load: DetectorError}


@pytest.mark.parametrize(("read", "error"), READERS.items())
@pytest.mark.parametrize("suffix", [".npz", ".csv", ".toml", ".json"])
def test_pipes_are_refused_at_once(read, error, suffix, tmp_path):
    path = tmp_path / f"pipe{suffix}"
    os.mkfifo(path)
    with pytest.raises(error):
        read(path)


@pytest.mark.parametrize("text", ["[" * 100_000, "x = " + "[" * 100_000, '{"a":' * 100_000, "a." * 50_000 + "a = 1"])
def test_nesting_without_end(text, tmp_path):
    for name, read in (("x.toml", load), ("x.toml", FitSettings.load), ("x.json", FitSettings.load)):
        (tmp_path / name).write_text(text)
        with pytest.raises(READERS[read]):
            read(tmp_path / name)


def test_texts_have_a_largest_size(tmp_path):
    path = tmp_path / "large.toml"
    path.write_text("#" * 10_000_001)
    with pytest.raises(DetectorError, match="10000001 bytes, expected at most 10000000"):
        load(path)
    with pytest.raises(SettingsError, match="10000001 bytes"):
        FitSettings.load(path)
