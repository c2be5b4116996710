"""The file in which a model search writes down its progress, ``study.json``: its schema, and reading it checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from edp.errors import StorageError, brief
from edp.storage.paths import is_file_at, is_folder_at
from edp.storage.reading import read_json

FILE, SCHEMA = "study.json", 2
STATES = ("running", "stopped", "killed", "finished")
"""Of a study; ``killed`` is one whose file says that it runs, and which no process holds."""
MODES = ("sound", "thesis")
"""Whose tests and rules decide: those of docs/statistics.md, or those of the thesis."""


def read_study(path: str | Path) -> Mapping[str, object]:
    """The content of a study's file.

    Args:
        path: of ``study.json``, or of the folder that holds it.

    Raises:
        StorageError: missing, unreadable, of another schema, or no study.
    """
    file = Path(path)
    if is_folder_at(file) or file.suffix != ".json":
        file = file / FILE
        if not is_file_at(file):
            raise StorageError(f"'{path}' holds no study ({FILE} is missing); give the folder of edp search --study")
    study = read_json(file)
    check_study(study, str(file))
    content: Mapping[str, object] = study
    return content


@contextmanager
def reading_parts(folder: str | Path) -> Iterator[None]:
    """Turn a part of a study that is missing or of another kind into one message.

    Raises:
        StorageError: a part of the study is missing, or of another kind.
    """
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise StorageError(
            f"'{folder}' is damaged: its {FILE} lacks a part or holds another kind of value ({brief(error)}); "
            "call `edp search` on the study again, which writes it anew"
        ) from error


def check_study(study: Any, where: str = FILE) -> None:
    """Refuse what is no study of this schema.

    Raises:
        StorageError: with what to do.
    """
    if not isinstance(study, Mapping) or "schema" not in study:
        raise StorageError(f"{where} is no study: it has no 'schema'; give the study.json that `edp search` wrote")
    if study["schema"] != SCHEMA:
        raise StorageError(
            f"{where} has schema {study['schema']!r}, this version of EDP reads {SCHEMA}; use the version that wrote "
            "it, or call `edp search` on the study again with this one"
        )
    for name, options in (("state", STATES), ("mode", MODES)):
        if study.get(name) not in options:
            raise StorageError(f"{where}: {name} = {study.get(name)!r}; {', '.join(options)} are known")
