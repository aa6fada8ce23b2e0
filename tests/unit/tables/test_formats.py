"""Our TTrees, opened by ROOT itself where it is installed (wheel `root`, 250 MB, in no extra)."""

import importlib.util
import json
import subprocess
import sys

import numpy as np
import pytest

import cgemit as cg

# In a process of its own: ROOT warns and takes over signals when it is imported.
PROGRAM = """
import json, sys
import ROOT

frame = ROOT.RDataFrame(sys.argv[2], sys.argv[1]).Define("code", "int(status)").Define("second", "cov[6]")
columns = {name: frame.AsNumpy([name])[name].tolist() for name in ("event", "ndf", "dr", "code", "second")}
about = ROOT.TFile.Open(sys.argv[1]).Get("cgemit")
print(json.dumps({
    "version": ROOT.gROOT.GetVersion(), "rows": frame.Count().GetValue(), "columns": columns,
    "names": [str(name) for name in frame.GetColumnNames()], "meta": json.loads(str(about)),
    "mean": frame.Filter("status == 0").Mean("dr").GetValue(),
}))
"""


@pytest.mark.skipif(importlib.util.find_spec("ROOT") is None, reason="ROOT is not installed (pip install root)")
@pytest.mark.slow
def test_a_table_in_root(tmp_path):
    tracks = cg.run("besiii-cgem", cg.Gun("mu-", p=(0.3, 1), cos_theta=(-0.5, 0.5)), n=20, seed=1).tracks
    path = tmp_path / "tracks.root"
    tracks.save(path)
    program = [sys.executable, "-W", "ignore", "-c", PROGRAM, str(path), "tracks"]
    found = json.loads(subprocess.run(program, check=True, capture_output=True, text=True).stdout)
    assert found["rows"] == len(tracks)
    assert set(found["names"]) == {*tracks.keys(), "code", "second"}
    columns = found["columns"]
    for name in ("event", "ndf", "dr"):
        np.testing.assert_array_equal(columns[name], tracks[name])
    np.testing.assert_array_equal(columns["code"], tracks["status"])  # int8 is Char_t, which AsNumpy cannot take
    np.testing.assert_array_equal(columns["second"], tracks["cov"][:, 1, 1])  # a matrix is read row by row
    assert found["mean"] == pytest.approx(tracks["dr"][tracks["status"] == 0].mean(), rel=1e-12)
    assert found["meta"]["kind"] == "tracks"
