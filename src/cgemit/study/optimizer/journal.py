"""Optuna's journal of a search: written once for each group of designs, cut back to whole groups when it is read."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from cgemit.problems import ProblemsError

#: User attribute of the study that ends each group of designs.
GROUPS_DONE = "groups"


class MissingPackageError(ValueError):
    """A package of an extra that is not installed."""


def optuna() -> Any:
    """Return the module `optuna`, silent.

    Raises
    ------
    MissingPackageError
        If it is not installed.
    """
    try:
        import optuna as module
    except ImportError as error:
        raise MissingPackageError(
            'expected Optuna 5 or later, which is not installed: pip install "cgemit[opt]"'
        ) from error
    module.logging.set_verbosity(module.logging.WARNING)
    return module


def open_journal(path: Path | None) -> tuple[Any, Any]:
    """Return a storage of Optuna and a function that writes what was stored since its last call.

    Parameters
    ----------
    path : Path or None
        A file of one JSON text for each operation, which `optuna.storages.journal.JournalFileBackend` reads, too; None:
        nothing is written.

    Raises
    ------
    ProblemsError
        If the file holds something else.
    """
    optuna()
    from optuna.storages import JournalStorage
    from optuna.storages.journal import BaseJournalBackend

    lines = _whole_groups(path) if path else []

    class Backend(BaseJournalBackend):
        """Operations in memory."""

        written = len(lines)

        def read_logs(self, log_number_from: int) -> Iterable[dict[str, Any]]:
            return lines[log_number_from:]

        def append_logs(self, logs: list[dict[str, Any]]) -> None:
            lines.extend(logs)

    class Storage(JournalStorage):
        """A storage without queue: looking for waiting trials takes half of the time of a search."""

        def get_all_trials(self, study_id: int, deepcopy: bool = True, states: Any = None) -> Any:
            if states is not None and [state.name for state in states] == ["WAITING"]:
                return []
            return super().get_all_trials(study_id, deepcopy, states)

    backend = Backend()

    def write() -> None:
        if path is None:
            return
        text = "".join(json.dumps(line, separators=(",", ":")) + "\n" for line in lines[backend.written :])
        with path.open("a", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        backend.written = len(lines)

    return Storage(backend), write


def _whole_groups(path: Path) -> list[dict[str, Any]]:
    """Return the operations of a journal up to the last complete group; the file is cut there."""
    if not path.exists():
        return []
    found: list[dict[str, Any]] = []
    end = size = complete = 0
    with path.open("rb") as stream:
        for line in stream:
            try:
                found.append(json.loads(line))
            except ValueError:  # the last line of an interrupted run
                break
            size += len(line)
            if not isinstance(found[-1], dict):
                raise ProblemsError(str(path), [f"line {len(found)}: got {line[:40]!r}, expected a journal of Optuna"])
            if line.endswith(b"\n") and GROUPS_DONE in found[-1].get("user_attr", {}):
                end, complete = size, len(found)
    os.truncate(path, end)
    return found[:complete]
