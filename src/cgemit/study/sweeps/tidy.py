"""What the results of sweeps and optimizations share: one tidy table, converted and written."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cgemit.detector import Detector
from cgemit.io.files import new_file
from cgemit.io.folders import SUMMARY
from cgemit.io.parquet import write_columns
from cgemit.statistics.formatting import write_csv
from cgemit.tables.convert import data_frame


class TidyResult:
    """A result that is a table, `columns` by header."""

    columns: dict[str, list[Any]]

    def to_pandas(self) -> Any:
        """Return the table as a `pandas.DataFrame`."""
        return data_frame(self.columns)

    def write_parquet(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the table as a Parquet file (needs pyarrow, extra ``[io]``).

        Parameters
        ----------
        path : path
        overwrite : bool

        Raises
        ------
        FileExistsError
            If the file exists and `overwrite` is false.
        """
        return write_columns(path, self.columns, overwrite=overwrite)

    def _write(
        self, folder: str | os.PathLike[str], table: str, detectors: Mapping[str, Detector], summary: Mapping[str, Any]
    ) -> list[Path]:
        """Write table, detectors and summary to a folder, in this order; return the files."""
        place = Path(folder)
        with new_file(place / table, overwrite=True) as temporary:
            write_csv(temporary, self.columns)
        texts = {name: detector.to_toml() for name, detector in detectors.items()}
        texts[SUMMARY] = json.dumps(summary, indent=2) + "\n"
        for name, text in texts.items():
            with new_file(place / name, overwrite=True) as temporary:
                temporary.write_text(text, encoding="utf-8")
        return [place / name for name in (table, *texts)]
