"""The page `docs/data_model.md`, written from the schemas."""

from __future__ import annotations

import sys

from cgemit.tables.schema import ROWS, SCHEMAS, Column

_INTRODUCTION = """# Data model

Stages meet in tables: plain numpy columns, one row per object, sorted by `event`. This page is written from
`cgemit.tables.SCHEMAS` (`python -m cgemit.tables.document > docs/data_model.md`); a test keeps it up to date.

- Units are those of every number in the program: mm, ns, GeV, GeV/c, rad, e; strip charge in fC, energy deposits
  in keV.
- `event` is the global event number. Rows `offsets[i]` to `offsets[i + 1]` of a table belong to event
  `first_event + i`; an event without rows has none there.
- A column that links counts rows of another table, from 0; -1 means none. Links hold for tables as a stage returned
  them or `concatenate` joined them, not after rows were picked. `Result.select_events` keeps them for some events,
  and `Result.to_awkward` gives lists per event in which links count within the event.
- `status` tells how a row ended (`TransportStatus` for particles, `FitStatus` for tracks, `StateStatus` for
  states). Rows of every status are kept; a value that does not exist is NaN.
- Columns cannot be written; `with_columns` returns a new table, in which further columns may follow those below.

## Files

`Result.save(folder, format=...)` and `cgemit simulate --format` write each table to a file of its name:

| format | file | needs | a matrix column is | read by |
|---|---|---|---|---|
| `npz` | `tracks.npz`, also with `offsets`; JSON text `__meta__` | | one array | `numpy.load` |
| `parquet` | `tracks.parquet`; JSON text `cgemit` in the schema | pyarrow | `cov_0_0, cov_0_1, ...` | pandas, dask |
| `root` | `tracks.root`: a TTree `tracks`, JSON text `cgemit` | uproot | one branch `[5][5]` | ROOT, uproot |

`pip install 'cgemit[io]'` installs the packages. The JSON text holds version, units, event range, and the
configuration hash and seed of the run, and a checksum of each column. `tables.json` lists all tables. `Result.load` and
`cgemit.open` read every format back to equal tables and check that all files belong to the run of `run.json`.
`Table.load` reads one file of any format. `table.to_pandas().to_csv(path)` writes CSV for other programs.

### More events than memory

`cgemit.run(..., keep=("tracks",))` keeps only the tables named (`tracks` brings `matches`), with links to other
tables set to -1. With `output=folder` (on the command line `--keep tracks`, or `--keep all` for every table) tables
are written while the run goes on, in parts `tracks/part-000000.npz` (with `--format parquet` `.parquet`), ... of 32 MB.
The memory does not depend on the number of events: 154 MB for 10^5 muons, 162 MB for 3·10^5 and 175 MB for 10^6, at
0.5 kB of disk an event, with

    cgemit simulate -d besiii-cgem-design --p 1 --cos-theta -0.93:0.93 -n 300000 --keep tracks --threads 1 -o many

With `-n 1e7 --format parquet` the same command takes six minutes of processor time, 334 MB of memory (10^6 muons:
327 MB; pyarrow and its buffers are the difference to `.npz`) and 5.2 GB of disk.

Links count rows of the whole table, so that other programs can read the parts as one data set
(of Parquet files with `pandas.read_parquet("many/tracks")`). The folder appears under its name when it is complete; an
interrupted run leaves none.

`cgemit.open(folder)` reads no table before it is asked for. `result.tracks` then reads all parts; `result.parts()`
gives one `Result` after the other, whose links count rows of the part; `result.column("tracks", "p")` reads one
column. `cgemit.resolution`, `cgemit.study.pulls` and `cgemit.study.resolution_against` read only the columns that they
need.

## Names in EDM4hep and LCIO

| here | EDM4hep | LCIO, where it differs |
|---|---|---|
| `particles` | `MCParticle` | |
| its `pdg`, `charge`, `mass` | `PDG`, `charge`, `mass` | |
| its `x y z`, `px py pz` | `vertex`, `momentum` | |
| its `status` | `simulatorStatus`, a bit pattern | |
| `truths`, `wire_truths` | `SimTrackerHit` | |
| `x y z` (of `truths`: `r phi z`), `px py pz` | `position`, `momentum` | |
| `path`, `time` | `pathLength`, `time` | |
| `energy` | `eDep` | `EDep` |
| `gid` of digis, wire hits | `cellID` | `cellID0` |
| `digis` with `charge`, `time` | `TrackerPulse` with `charge`, `time` | |
| `wire_hits` | `SenseWireHit` | `TrackerHit` |
| its `drift`, `sigma` | `distanceToWire`, `distanceToWireError` | |
| `clusters` of views X and V | `TrackerHitPlane` with `du` or `dv` | `dU` or `dV` |
| `clusters` of view XV | `TrackerHit3D` with `position`, `covMatrix` | `TrackerHit` |
| links to `truths` | `TrackerHitSimTrackerHitLink` | `LCRelation` |
| `tracks` | `Track` | |
| its `chi2`, `ndf` | `chi2`, `ndf` | |
| `states`, and the parameters of `tracks` | `TrackState` | |
| `dr`, `dz` | `D0` (`-dr`), `Z0` | `d0`, `z0` |
| `phi0`, `tanl` | `phi` (`phi0 + pi/2`), `tanLambda` | |
| `kappa` | `omega`, the curvature in 1/mm | |
| `cov` (5, 5) | `covMatrix`, lower triangle of d0, phi, omega, z0, tan lambda | |
| `surface` 0 | `location` `AtIP` | |
| `matches` | `TrackMCParticleLink` | `LCRelation` |

The names are those of EDM4hep 0.99 and LCIO 2. Lengths in mm, times in ns and momenta in GeV/c are the same; deposits
are in keV here and in GeV there. `cgemit.helix.to_perigee` returns d0, z0, phi, theta and q/p with their covariance.
"""


def data_model() -> str:
    """Return the page as Markdown."""
    return "\n".join([_INTRODUCTION, *(_section(kind, columns) for kind, columns in SCHEMAS.items())])


def _section(kind: str, columns: tuple[Column, ...]) -> str:
    head = "| column | dtype | unit | meaning | links to |\n|---|---|---|---|---|\n"
    return f"## {kind}\n\nOne row: {ROWS[kind]}.\n\n" + head + "".join(_row(column) for column in columns)


def _row(column: Column) -> str:
    links = column.links if isinstance(column.links, str) else ", ".join(dict.fromkeys(column.links or ()))
    shape = f" ({', '.join(map(str, column.shape))})" if column.shape else ""
    return f"| `{column.name}` | {column.dtype}{shape} | {column.unit} | {column.doc} | {links} |\n"


if __name__ == "__main__":
    sys.stdout.write(data_model())
